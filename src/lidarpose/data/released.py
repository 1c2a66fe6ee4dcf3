"""How the released DAPT code crops and centers a dataset's people: with the labels' help."""

import numpy as np

from lidarpose.sample import Box

# how much larger than the labelled joints the released box of HumanM3 is
_ROOM = 1.25


def released_view(
    points: np.ndarray, joints: np.ndarray, centers: dict[str, np.ndarray], box: Box | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """points (n, 3) m, joints (J, 3) m, NaN without a label -> (n,) bool of what is kept, and the center (3,) m.

    "trans" (LiDARHuman26M, SLOPER4D): all points, about SMPL's translation; "joints_box" (HumanM3): an upright box of
    1.25 times the joints' extent; "box" (Waymo): the labelled box. All true and None for a dataset with none of these.
    """
    everything = np.ones(len(points), bool)
    if "trans" in centers:
        return everything, centers["trans"]
    if "joints_box" in centers:
        low, high = np.nanmin(joints, 0), np.nanmax(joints, 0)
        inside = np.abs(points - (low + high) / 2) <= _ROOM * (high - low) / 2
        return inside.all(1), centers["joints_box"]
    if "box" in centers:
        return everything if box is None else box.contains(points), centers["box"]
    return everything, None
