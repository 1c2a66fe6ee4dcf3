"""Walking and running: angles of a stride as functions of its phase."""

import numpy as np

from lidarpose.body.activities import ANGLES

_A = {name: i for i, name in enumerate(ANGLES)}

# sagittal angles of level walking, degrees (Perry, Gait Analysis; events of the stride): phase, hip flexion from the
# vertical, knee flexion, ankle dorsiflexion. Phase 0 is the heel strike of the leg.
_STRIDE = np.array(
    [
        [0.00, 24.0, 4.0, 0.0],
        [0.12, 20.0, 18.0, -6.0],
        [0.31, 2.0, 6.0, 5.0],
        [0.50, -16.0, 8.0, 10.0],
        [0.62, -8.0, 38.0, -14.0],
        [0.75, 16.0, 62.0, -5.0],
        [0.87, 27.0, 26.0, 0.0],
    ]
)
_HARMONICS = 3  # seven events and seven coefficients: the curve runs through them all
_ARM_LAG = 0.03  # of a stride: the arms trail the legs a little


def _basis(phase: np.ndarray) -> np.ndarray:
    """Fourier basis (n, 7) at phase (n,)."""
    turns = 2 * np.pi * np.arange(1, _HARMONICS + 1) * phase[:, None]
    return np.concatenate([np.ones((len(phase), 1)), np.cos(turns), np.sin(turns)], 1)


_COEFFICIENTS = np.linalg.solve(_basis(_STRIDE[:, 0]), _STRIDE[:, 1:])


def stride_curves(phase: np.ndarray) -> np.ndarray:
    """phase (n,) in strides, any number -> (n, 3) degrees: hip and knee flexion, ankle dorsiflexion."""
    return _basis(phase) @ _COEFFICIENTS


def gait_angles(kind: str, phase: np.ndarray, style: np.ndarray) -> np.ndarray:
    """Angles (n, 27), degrees, of "walk" or "run" to be added to the activity's table.

    phase (n,) in strides, 0 at the left heel's strike; style (n, 8) in [0, 1]: length of the stride, lift of the knee,
    swing of the arms, bend of the elbow, its swing, crouch, turn of the hips, asymmetry of the arms.
    """
    length, lift, swing, elbow, elbow_swing, crouch, turn, uneven = style.T
    if kind == "run":
        length, lift, crouch = 1.0 + 0.7 * length, 1.0 + 0.6 * lift, 10 + 14 * crouch
        swing, elbow, elbow_swing = 20 + 30 * swing, 55 + 50 * elbow, 10 + 15 * elbow_swing
    else:
        length, lift, crouch = 0.35 + 1.0 * length, 0.8 + 0.4 * lift, 14 * crouch
        swing, elbow, elbow_swing = 4 + 30 * swing * (0.4 + 0.6 * length), 6 + 40 * elbow**1.5, 3 + 14 * elbow_swing
    angles = np.zeros((len(phase), len(ANGLES)))
    for side, offset, sign in (("left", 0.0, 1), ("right", 0.5, -1)):
        hip, knee, ankle = stride_curves(phase + offset).T
        angles[:, _A[f"{side}_hip"]] = length * (hip - 4) + 4 + 0.45 * crouch
        # slow steps bend the knee less
        angles[:, _A[f"{side}_knee"]] = knee * lift * np.clip(0.45 + 0.55 * length, 0, 1.4) + crouch
        angles[:, _A[f"{side}_ankle"]] = ankle * np.clip(length, 0.5, 1.2) + 0.5 * crouch
        forward = -np.cos(2 * np.pi * (phase + offset - _ARM_LAG))  # against the leg of the same side
        own = swing * (1 + sign * 0.5 * (uneven - 0.5))
        angles[:, _A[f"{side}_raise"]] = own * forward
        angles[:, _A[f"{side}_elbow"]] = elbow + elbow_swing * (forward + 1) / 2
    # the hips turn with the leading leg and drop over the swinging one, the chest turns against them
    angles[:, _A["yaw"]] = -(2 + 5 * turn) * length * np.cos(2 * np.pi * phase)
    angles[:, _A["twist"]] = -1.8 * angles[:, _A["yaw"]]
    angles[:, _A["roll"]] = (1 + 3 * turn) * np.sin(2 * np.pi * (phase + 0.05))
    angles[:, _A["side"]] = -angles[:, _A["roll"]]
    return angles
