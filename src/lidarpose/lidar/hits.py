"""What a cast of a sensor's beams returns."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Hits:
    """What a sensor saw through a window, ordered by column, then ring.

    points (n, 3) float32 m in the sensor's frame; face (n,) int32; column (n,) int32 counted from the window's first,
    so it runs on over the +-pi seam; ring (n,) int32, the sensor's own number, 0 the lowest; columns, rows: the
    window's size; column0, row0: where it starts, `(column + column0) % sensor.columns` is the sensor's column.
    """

    points: np.ndarray
    face: np.ndarray
    column: np.ndarray
    ring: np.ndarray
    columns: int
    rows: int
    column0: int
    row0: int
