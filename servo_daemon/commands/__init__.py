"""One module a command: `HELP`, `EXAMPLE`, `add_arguments(parser)`, `run(arguments) -> exit code`."""
