"""The command line: `lidarpose COMMAND`, also `python -m lidarpose`."""


def main(arguments: list[str] | None = None) -> int:
    """Runs one command. Returns 0, or 2 after one line on stderr where the input is at fault."""
    try:
        # here, so that a module of one command is imported without those of all others
        from lidarpose.cli.command_line import run

        return run(arguments)
    except KeyboardInterrupt:
        from lidarpose.cli.terminal import tell

        # before the command runs, which says more
        tell("lidarpose: stopped", error=True)
        return 130
