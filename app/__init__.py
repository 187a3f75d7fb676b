"""The command line: set-up, verbs, console output. The only part that prints and exits."""
