"""From a user's cloud to one person's points: checks, the center of the person, what looks wrong about the input."""

import numpy as np

from lidarpose.errors import InputError
from lidarpose.sample import Pose, center_of

# joints that every skeleton has
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")

# fewer points than this say nothing about a pose
MIN_POINTS = 5
# a person of more points is thinned: no sensor sees so many, and no voxel needs them
MAX_POINTS = 50_000

# a crop wider than this holds more than a person, so the person is looked for in it, m
_TIGHT = 1.7
# the person is looked for with a column of this radius, in cells of this size, m
_RADIUS, _CELL = 0.4, 0.1
# a person's share of a column: from above the ground to a raised arm, m
_ABOVE_GROUND, _REACH = 0.25, 2.3


def as_points(points: object, what: str = "points") -> np.ndarray:
    """Anything array-like (n, 3+) as (n, 3) float64. Raises InputError for another shape or type; n = 0 is legal."""
    try:
        array = np.asarray(points)
    except (ValueError, TypeError) as error:
        raise InputError(f"{what} must be an (n, 3) array of numbers, got rows of unequal length ({error})") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{what} must be an (n, 3) array of numbers, got {array.dtype} of shape {array.shape}")
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"{what} must be (n, 3) or (n, 3 + more) with x, y, z first, got shape {array.shape}")
    return array[:, :3].astype(np.float64)


def clean(points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """points (n, 3) without NaN and infinite rows and at most `MAX_POINTS`, and a warning for each thing done."""
    notes = []
    finite = np.isfinite(points).all(1)
    if not finite.all():
        notes.append(f"dropped {int((~finite).sum())} of {len(points)} points that were NaN or infinite")
        points = points[finite]
    if len(points) > MAX_POINTS:
        notes.append(
            f"thinned from {len(points)} to {MAX_POINTS} points: crop closer to the person if there are others"
        )
        points = points[np.arange(MAX_POINTS) * len(points) // MAX_POINTS]
    return points, notes


def find_center(points: np.ndarray) -> np.ndarray:
    """points (n, 3) m, z up, n >= 1 -> (3,) m: the middle of the person in a crop that may hold ground and clutter.

    A crop of a person's width is all person. In a wider one the person is the upright column that fills most height
    above the local ground; nothing else that is as tall as a person and as slim is told apart from one.
    """
    if (np.ptp(points[:, :2], axis=0) < _TIGHT).all():
        return center_of(points)
    ground = np.percentile(points[:, 2], 2)
    up = points[(points[:, 2] > ground + _ABOVE_GROUND) & (points[:, 2] < ground + _REACH)]
    if len(up) < MIN_POINTS:
        return center_of(points)
    cells = np.unique(np.floor(up / _CELL).astype(np.int64), axis=0)
    places = np.unique(cells[:, :2], axis=0)
    # a cell counts once a height, however many of its neighbours are filled at that height
    near = ((places[:, None] - cells[None, :, :2]) ** 2).sum(-1) <= (_RADIUS / 2 / _CELL) ** 2
    heights = [len(np.unique(cells[row, 2])) for row in near]
    place = (places[int(np.argmax(heights))] + 0.5) * _CELL
    around = up[np.hypot(*(up[:, :2] - place).T) < _RADIUS]
    return center_of(around if len(around) >= MIN_POINTS else up)


def unit_warning(height: float, *, what: str) -> str | None:
    """What is likely wrong where a person's extent `height` (largest of the three axes) is no person's in metres."""
    if height > 1000:
        cause = "millimetres"
        factor = 1000
    elif height > 50:
        cause = "centimetres"
        factor = 100
    elif height > 4:
        return None
    elif height < 0.02:
        return f"{what} is {height:.2g} m tall: are the units kilometres? expected metres"
    else:
        return None
    return f"{what} is {height:,.0f} m tall: are the units {cause}? divide all coordinates by {factor}"


def lies(pose: Pose) -> bool:
    """The trunk of a pose, z up, is nearer to level than to upright."""
    at = {name: pose.joints[pose.skeleton.index(name)] for name in _TRUNK}
    trunk = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    return bool(abs(trunk[2]) < np.sin(np.radians(35)) * np.linalg.norm(trunk))
