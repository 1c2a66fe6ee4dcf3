"""`lidarpose evaluate` and `table`."""


def add(commands) -> None:
    """Adds the commands to the parser's."""
