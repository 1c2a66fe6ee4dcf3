"""How options are written, and how the command line speaks."""

import sys

from lidarpose.io.files import one_line
from lidarpose.progress import is_quiet


def names(text: str) -> tuple[str, ...]:
    """The names in a list that commas part."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def tell(text: str, *, error: bool = False) -> None:
    """One line for the user, on stderr; nowhere where that is closed, since stdout may be somebody's JSON. With
    --quiet only errors are printed."""
    if sys.stderr is not None and (error or not is_quiet()):
        print(one_line(text), file=sys.stderr)


def is_watched() -> bool:
    """Whether somebody sees stderr as it comes, so that a bar is worth drawing."""
    return sys.stderr is not None and sys.stderr.isatty() and not is_quiet()
