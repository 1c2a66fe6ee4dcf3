"""In which unit a recording is: told by the size of people, who are not too fast in it either."""

import numpy as np

from lidarpose.body.mocap.retarget import mean_adult_joints
from lidarpose.io.files import file_error
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}

# how many metres a file's number is: metres, centimetres, millimetres, inches, and CMU's unit (inches / 0.45)
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "inch/0.45": 0.0254 / 0.45}
# people are this much smaller or larger than the mean adult
_SMALLEST, _LARGEST = 0.4, 1.45
_TYPICAL = 0.85  # between children and tall adults: inches and centimetres must be told apart for both
_UNEVEN = 2.0  # legs whose lengths are further apart than this were not measured in one unit
_FASTEST = 50.0  # m/s


def metres_of(path: object, joints: np.ndarray, unit_m: float | None = None) -> float:
    """Metres of a number of SMPL's joints (F, 24, 3): the unit that gives the person the most usual size, or `unit_m`.
    Raises InputError where that is nobody's size, and for legs of different lengths."""
    left, right, trunk = (_size(joints, side) for side in ("left", "right", None))
    if not (np.isfinite([left, right, trunk]).all() and min(left, right, trunk) > 0):
        raise file_error(path, "the legs or the trunk have no length; expected the offsets of a person's bones")
    if max(left, right) > _UNEVEN * min(left, right):
        raise file_error(path, f"the left leg is {left:.4g} long, the right {right:.4g}; expected one unit throughout")
    rest = mean_adult_joints()[None]
    ratio = ((left + right) / 2 + trunk) / (_size(rest, "left") + _size(rest, None))
    scale = unit_m or min(UNITS.values(), key=lambda m: abs(np.log(ratio * m / _TYPICAL)))
    if not _SMALLEST < ratio * scale < _LARGEST:
        remedy = f"known units are {', '.join(UNITS)}: scale the skeleton to one of them"
        if unit_m:
            remedy = f"a number is taken for {unit_m:.4g} m: scale the recording to that"
        raise file_error(path, f"the person is {ratio * scale:.3g} times as tall as an adult; {remedy}")
    return scale


def _size(joints: np.ndarray, side: str | None) -> float:
    """Median length of a leg, or without side of the line hips -> neck -> head."""
    if side:
        line = [joints[:, _J[f"{side}_{n}"]] for n in ("hip", "knee", "ankle")]
    else:
        middle = (joints[:, _J["left_hip"]] + joints[:, _J["right_hip"]]) / 2
        line = [middle, joints[:, _J["neck"]], joints[:, _J["head"]]]
    return float(sum(np.median(np.linalg.norm(b - a, axis=-1)) for a, b in zip(line, line[1:], strict=False)))


def check_speed(path: object, joints: np.ndarray, start: np.ndarray, fps: float) -> None:
    """Raises InputError where people, joints (F, 24, 3) m, are faster than any; clips begin at frames `start`."""
    steps = np.linalg.norm(np.diff(joints[:, _J["pelvis"]], axis=0), axis=-1) * fps
    # from the end of a clip to the next is no step
    steps = np.delete(steps, start[start > 0] - 1)
    if len(steps) and np.median(steps) > _FASTEST:
        raise file_error(
            path, f"people move at {np.median(steps):.4g} m/s: are positions and bones in one unit, and is fps right?"
        )
