"""Frames that cannot be used are left out, and a clip falls into pieces there, so that no motion jumps over a gap."""

import numpy as np

from lidarpose.io.files import file_error

# more frames than this that are no numbers: the file is broken, not the odd frame
MOST_DROPPED = 0.2


def cut(
    path: object, name: str, good: np.ndarray, number: np.ndarray | None = None
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The clips that are left of one: names, start and length among the good frames.

    good (F,) bool; number (F,) int: the frames' numbers in the recording, by default none is missing. A piece after
    the first is called NAME#2 and so on. Raises InputError without frames, or if more than `MOST_DROPPED` are bad.
    """
    bad = len(good) - int(good.sum())
    if len(good) == 0:
        raise file_error(path, "holds no frame of motion")
    if bad > MOST_DROPPED * len(good):
        raise file_error(
            path,
            f"{bad} of {len(good)} frames have values that are no numbers or bones without length "
            f"(at most {MOST_DROPPED:.0%} can be left out); repair the recording",
        )
    number = (np.arange(len(good)) if number is None else number)[good]
    start = np.flatnonzero(np.diff(number, prepend=number[0] - 2) != 1)
    length = np.diff(start, append=len(number))
    return tuple(name if k == 0 else f"{name}#{k + 1}" for k in range(len(start))), start, length
