"""How options are written, and how the command line speaks."""

import sys

from lidarpose.io.files import one_line


def names(text: str) -> tuple[str, ...]:
    """The names in a list that commas part."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def tell(text: str) -> None:
    """One line for the user, on stderr; nowhere where that is closed, since stdout may be somebody's JSON."""
    if sys.stderr is not None:
        print(one_line(text), file=sys.stderr)


def is_watched() -> bool:
    """Whether somebody sees stderr as it comes, so that a bar is worth drawing."""
    return sys.stderr is not None and sys.stderr.isatty()
