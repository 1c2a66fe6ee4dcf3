"""What is known of a synthetic person besides the sample."""

import numpy as np

from lidarpose.sample import PersonInfo, Sample
from lidarpose.skeleton import BODY26

# points this close to the soles count as ground, not as clutter, m
_GROUND = 0.1


def person_info(
    sample: Sample, *, sensor: str, kind: str, distance: float, alone: int, soles: float, tall: float
) -> PersonInfo:
    """What is known of a sample. alone: returns of the body with nothing else around; soles: their z, m; tall: height
    of the standing body, m."""
    seen = sample.points[sample.part > 0]
    clutter = (sample.part == 0) & (sample.points[:, 2] > soles + _GROUND)
    return PersonInfo(
        sensor=sensor,
        kind=kind,
        distance=distance,
        visible=min(len(seen) / max(alone, 1), 1.0),
        height_seen=float(np.ptp(seen[:, 2])) / max(tall, 1e-6) if len(seen) else 0.0,
        clutter=float(clutter.mean()) if len(clutter) else 0.0,
        upright=_upright(sample.pose.joints),
    )


def _upright(joints: np.ndarray) -> bool:
    """Stands or walks: trunk within 35 degrees of upright, and a hip above its ankle by over four fifths of the leg."""
    pelvis, neck = joints[BODY26.index("pelvis")], joints[BODY26.index("neck")]
    if (neck - pelvis)[2] < np.cos(np.radians(35)) * np.linalg.norm(neck - pelvis):
        return False
    for side in ("left", "right"):
        hip, knee, ankle = (joints[BODY26.index(f"{side}_{name}")] for name in ("hip", "knee", "ankle"))
        leg = np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle)
        if (hip - ankle)[2] > 0.8 * leg:
            return True
    return False
