"""One module a command: `add` declares its options, `command` carries it out and returns the exit code."""
