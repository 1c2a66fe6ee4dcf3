"""How the released DAPT code crops and centers a dataset's people: with the labels' help."""

import numpy as np

from lidarpose.sample import Box

# how much larger than the labelled joints the released box of HumanM3 is
_ROOM = 1.25
# of a box, m
_LEAST_EDGE = 1e-6


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
    crop = released_box(joints, centers, box)
    for name in ("joints_box", "box"):
        if name in centers:
            return everything if crop is None else crop.contains(points), centers[name]
    return everything, None


def released_box(joints: np.ndarray, centers: dict[str, np.ndarray], box: Box | None) -> Box | None:
    """The box that `released_view` crops by; where it crops nothing, the dataset's own, if any."""
    if "trans" in centers or "joints_box" not in centers:
        return box
    low, high = np.nanmin(joints, 0), np.nanmax(joints, 0)
    # of a single labelled joint too
    return Box(center=(low + high) / 2, size=np.maximum(_ROOM * (high - low), _LEAST_EDGE))
