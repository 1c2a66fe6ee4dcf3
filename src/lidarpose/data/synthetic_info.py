"""What is known of a synthetic person besides the sample."""

from dataclasses import dataclass

import numpy as np

from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26

# points this close to the soles count as ground, not as clutter, m
_GROUND = 0.1


@dataclass(frozen=True, kw_only=True)
class Facts:
    """sensor; kind: what the person does, a name of `body.pose_prior.activities.KINDS`; distance m; visible:
    returns of body and clothes, as a share (at most 1) of those that the body alone has without any loss: what
    range or slant lost counts as hidden too; height_seen: share of the body's height between its lowest and highest
    return; clutter: share of the points that are neither body nor ground; upright: stands or walks."""

    sensor: str
    kind: str
    distance: float
    visible: float
    height_seen: float
    clutter: float
    upright: bool

    @property
    def plain(self) -> bool:
        """Upright, whole and uncluttered, most of the height seen."""
        return bool(is_plain(self.upright, self.visible, self.clutter) and self.height_seen > 0.85)


def is_plain(upright, visible, clutter):
    """Bools for arrays (N,) or one person's, as in `Facts`: upright, whole, uncluttered. NaN is not plain."""
    return upright & (visible > 0.8) & (clutter < 0.05)


def facts_of(
    sample: Sample, *, sensor: str, kind: str, distance: float, alone: int, soles: float, tall: float
) -> Facts:
    """Facts of a sample: `alone` returns would come from the body with nothing else around, the soles are at z =
    `soles` m, and the body is `tall` m as it stands."""
    seen = sample.points[sample.part > 0]
    clutter = (sample.part == 0) & (sample.points[:, 2] > soles + _GROUND)
    return Facts(
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
