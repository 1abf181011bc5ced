"""From a log to numbers and pages. Everything here reads logs only."""
