"""The command line: `lidarpose COMMAND`, also `python -m lidarpose`."""


def main(arguments: list[str] | None = None) -> int:
    """Runs one command. Returns 0, or 2 after one line on stderr where the input is at fault."""
    try:
        # imported here, so that importing the module of one command does not import those of all others
        from lidarpose.cli.command_line import run

        return run(arguments)
    except KeyboardInterrupt:
        from lidarpose.cli.terminal import tell

        # interrupted before the command runs; later, `run` handles it with a more detailed message
        tell("lidarpose: stopped", error=True)
        return 130
