"""Errors that a user can act on: one line that says what was expected, what came, and what to do."""

import difflib
from collections.abc import Iterable


class LidarPoseError(Exception):
    """Base of every error that is the input's fault. The command line prints it as one line and exits with 2."""


class InputError(LidarPoseError, ValueError):
    """A file, an array or an argument is not what was expected."""


class MissingExtra(LidarPoseError, ImportError):
    """An optional dependency is not installed; the message names the pip command."""

    def __init__(self, what: str, extra: str):
        super().__init__(f"{what} needs an optional dependency: pip install 'lidarpose[{extra}]'")


def unknown_name(kind: str, name: object, known: Iterable[str]) -> InputError:
    """The error for a name that is not in a closed list, with the nearest names first."""
    known = list(known)
    near = difflib.get_close_matches(str(name), known, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    return InputError(f"unknown {kind} {name!r}: {hint}known are {', '.join(known)}")
