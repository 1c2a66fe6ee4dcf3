"""Poses after captured motion: a mixture of Gaussians over the angles of a pose, fitted by tools/fit_motion.py.

Its features (27, degrees) are `ANGLES` with each shoulder's three angles replaced by the rotation vector from a
hanging arm, which is smooth where arms usually are. The mixture was fitted to subjects 2 and 5 of the CMU Graphics
Lab Motion Capture Database (mocap.cs.cmu.edu, NSF EIA-0196217); no pose of it is stored.
"""

from functools import cache
from importlib import resources

import numpy as np

from lidarpose.body.pose_prior.activities import ANGLES, ARM_ANGLES
from lidarpose.body.pose_prior.joint_angles import shoulder_angles, shoulder_matrix
from lidarpose.geometry import axis_angle_to_matrix

_FIRST_ARM_ANGLE = {side: ANGLES.index(f"{side}_raise") for side in ("left", "right")}
# columns of each shoulder's three angles, and the side's sign
SHOULDERS = tuple((slice(i, i + 3), sign) for i, sign in zip(_FIRST_ARM_ANGLE.values(), (1.0, -1.0), strict=True))
# deviations are drawn this much smaller than fitted: the fit's ridge and few components make it wider than the motion
_SPREAD = 0.75
# an arm is another pose's this often: one subject's poses then cover another's better
_OTHER_ARM = 0.4
_ARMS = tuple(np.arange(i, i + len(ARM_ANGLES)) for i in _FIRST_ARM_ANGLE.values())
# where a Cholesky factor's numbers are
LOWER = np.tril_indices(len(ANGLES))


def captured_angles(rng: np.random.Generator, n: int) -> np.ndarray:
    """n pairs of poses of one component of the mixture: angles (n, 2, 27), degrees, in the order of `ANGLES`; limits
    are not applied. The first of a pair is distributed as the mixture; to move is to go towards the second."""
    cumulative, means, roots = _mixture()
    component = np.searchsorted(cumulative, rng.random(n))
    normal = rng.standard_normal((n, 2, len(ANGLES)))
    features = means[component, None] + _SPREAD * normal @ np.swapaxes(roots[component], -1, -2)
    pair = np.arange(2)
    for shift, arm in enumerate(_ARMS, 1):
        rows = np.flatnonzero(rng.random(n) < _OTHER_ARM)
        features[np.ix_(rows, pair, arm)] = features[np.ix_((rows + shift) % n, pair, arm)]
    return from_features(features.reshape(-1, len(ANGLES))).reshape(n, 2, len(ANGLES))


def from_features(features: np.ndarray) -> np.ndarray:
    """The mixture's features (n, 27) -> angles (n, 27), degrees."""
    angles = np.array(features, float)
    for part, sign in SHOULDERS:
        angles[:, part] = shoulder_angles(axis_angle_to_matrix(np.radians(angles[:, part])) @ hanging_arm(sign), sign)
    return angles


def hanging_arm(sign: float) -> np.ndarray:
    """(3, 3): the shoulder's rotation from the T-pose to a hanging arm, sign 1 for the left and -1 for the right."""
    return shoulder_matrix(np.zeros((1, 3)), sign)[0]


@cache
def _mixture() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cumulative weights (K,), means (K, 27) and Cholesky factors (K, 27, 27), degrees."""
    with resources.files("lidarpose.body").joinpath("assets/motion_prior.npz").open("rb") as file:
        stored = dict(np.load(file, allow_pickle=False))
    weights = stored["weights"].astype(float)
    roots = np.zeros((len(weights), len(ANGLES), len(ANGLES)))
    roots[:, *LOWER] = stored["roots"]
    cumulative = np.cumsum(weights / weights.sum())
    cumulative[-1] = 1.0
    return cumulative, stored["means"].astype(float), roots
