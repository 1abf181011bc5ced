"""The operator: what may be said, who may say it, and the desk in the terminal."""
