"""Errors that a user can act on: the message states in one line what was expected, what was given, and what to do."""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from math import isfinite
from numbers import Integral, Real
from typing import Any, TypeGuard


class LidarPoseError(Exception):
    """Base class of all errors caused by the input. The command line prints the message and exits with status 2."""


class InputError(LidarPoseError, ValueError):
    """A file, an array or an argument is invalid."""


class MissingExtra(LidarPoseError, ImportError):
    """An optional dependency is not installed; the message contains the pip command."""

    def __init__(self, what: str, extra: str):
        super().__init__(f'{what} needs an optional dependency: in the clone, pip install ".[{extra}]"')


# optional module -> extra that installs it
_EXTRA_OF = {
    "torch": "train",
    "accelerate": "train",
    "numba": "synth",
    "threadpoolctl": "synth",
    "pyarrow": "synth",
    "onnx": "export",
    "onnxscript": "export",
    "rosbags": "recordings",
    "lazrs": "recordings",
    "velodyne_decoder": "recordings",
    "h5py": "itop",
}


def missing_extra(error: ModuleNotFoundError, what: str, extra: str | None = None) -> ImportError:
    """The error to raise for a missing module: `MissingExtra` if an extra installs it, else `error`.

    extra: the extra to name if several install the module.
    """
    known_extra = _EXTRA_OF.get((error.name or "").partition(".")[0])
    return error if known_extra is None else MissingExtra(what, extra or known_extra)


@contextmanager
def needs_extra(what: str, extra: str | None = None) -> Iterator[None]:
    """Raises `missing_extra` for a module that an import in the block does not find."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise missing_extra(error, what, extra) from None


def unknown_name(kind: str, name: object, known: Iterable[str]) -> InputError:
    """The error for a name that is not in a closed list; suggests similar names."""
    known = list(known)
    matches = difflib.get_close_matches(str(name), known, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(matches)}? " if matches else ""
    return InputError(f"unknown {kind} {name!r}: {hint}known are {', '.join(known)}")


def check_int(name: str, value: Any, *, least: int, most: int | None = None, hint: str = "") -> int:
    """Converts a whole number (numpy's included) to int. Raises InputError for other types and values outside `least`
    to `most`."""
    if isinstance(value, Integral) and not isinstance(value, bool):
        number = int(value)
        if number >= least and (most is None or number <= most):
            return number
    bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
    raise InputError(f"{name} must be a whole number {bounds}{hint}, got {value!r}")


def check_finite(name: str, value: Any) -> None:
    """Raises InputError unless `value` is a finite number of Python or numpy."""
    try:
        is_finite = isfinite(value)
    except (TypeError, ValueError, OverflowError):
        is_finite = False
    if not is_finite:
        raise InputError(f"{name} must be a finite number, got {value!r}")


def check_name(kind: str, name: object, known: Iterable[str]) -> None:
    """Raises `unknown_name` unless `name` is a string in the closed list `known`."""
    if not isinstance(name, str) or name not in known:
        raise unknown_name(kind, name, known)


# ---- text of messages


def first_names(names: Sequence[str], most: int = 3) -> str:
    """ "a, b, c and 2 more"."""
    suffix = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + suffix


def counted(number: int, one: str, many: str | None = None) -> str:
    """ "1 frame", "1,200 frames"; many: the plural if it is not formed with "s"."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a real number of Python or numpy; truth values are not."""
    return isinstance(value, Real) and not isinstance(value, bool)
