"""Distances between predicted and true joints. Meters in, millimeters or percent out. Works on plain arrays of poses
from any source.

    n people, J joints, T frames
    pred, true (n, J, 3) m in one frame; any leading shape, (J, 3) too, and nested lists
    visible (n, J) bool or 0/1: which joints have a label; a joint whose true position is NaN has none

A score is the `mean` of a table (n, J) of joints; the tables are public too, for groups, slices and intervals.
dapt_compat=True (`legacy` is its old name): the arithmetic of the paper's released code, faults included; see
docs/evaluate.md.
"""

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError, check_name
from lidarpose.eval.metrics.aggregate import AVERAGES, Score, as_flags, as_numbers, check_positive, mean
from lidarpose.geometry import similarity_align
from lidarpose.skeleton import Skeleton, as_skeleton

# the released code's length of the torso, m, one value for all people; it comes from LiDARCap
TORSO = 0.5127067
# fractions of the torso within which a joint is correct: PCK-3 (15.4 cm), PCK-5 (25.6 cm)
PCK3, PCK5 = 0.3, 0.5
# a similarity has 7 unknowns; it always fits two joints exactly
LEAST_ALIGNED = 3


def mpjpe(
    pred: ArrayLike,
    true: ArrayLike,
    visible: ArrayLike | None = None,
    dapt_compat: bool = False,
    *,
    average: str = "person",
    legacy: bool = False,
) -> Score:
    """Mean per-joint position error in millimeters, not aligned.

    Args:
        pred: (n, J, 3) m.
        true: (n, J, 3) m, in the same frame.
        visible: (n, J), which joints have a label; None: all joints whose true position is not NaN.
        dapt_compat: people without a label count as having no error.
        average: "person" or "joint", see `mean`.
    """
    return _mean(joint_errors(pred, true, visible), average, dapt_compat or legacy, empty=0.0)


def root_mpjpe(
    pred: ArrayLike,
    true: ArrayLike,
    visible: ArrayLike | None = None,
    *,
    skeleton: Skeleton | str,
    average: str = "person",
) -> Score:
    """`mpjpe` relative to the root: the pelvis, or the middle of the hips in skeletons without one.

    People without a label of the root are skipped. LiDARCap's and NE's published figures are of this kind.

    Args:
        pred: (n, J, 3) m.
        true: (n, J, 3) m.
        visible: as in `mpjpe`.
        skeleton: of the joints, or its name.
        average: as in `mpjpe`.
    """
    return mean(root_aligned_errors(pred, true, visible, skeleton=skeleton), average)


def pa_mpjpe(
    pred: ArrayLike,
    true: ArrayLike,
    visible: ArrayLike | None = None,
    dapt_compat: bool = False,
    *,
    average: str = "person",
    legacy: bool = False,
) -> Score:
    """`mpjpe` after each person's prediction is aligned with the truth by the best similarity (Procrustes).

    The alignment uses the labeled joints; people with fewer than three are skipped.

    Args:
        pred: (n, J, 3) m.
        true: (n, J, 3) m.
        visible: as in `mpjpe`.
        average: as in `mpjpe`.
        dapt_compat: align all joints, labeled or not; for a batch of two or three people, align their transposed
            arrays.
    """
    table = aligned_errors(pred, true, visible, dapt_compat or legacy)
    return _mean(table, average, dapt_compat or legacy, empty=0.0)


def pck(
    pred: ArrayLike,
    true: ArrayLike,
    visible: ArrayLike | None = None,
    dapt_compat: bool = False,
    *,
    threshold: float = PCK3,
    torso: float = TORSO,
    average: str = "person",
    legacy: bool = False,
) -> Score:
    """Percentage of correct keypoints: joints nearer to the truth than threshold times torso, m.

    Args:
        pred: (n, J, 3) m.
        true: (n, J, 3) m, in the same frame.
        visible: as in `mpjpe`.
        average: as in `mpjpe`.
        dapt_compat: NaN as soon as one person has no label.
        threshold: a fraction of the torso; the default is PCK-3, 0.5 is PCK-5.
        torso: m, one value for all people.
    """
    table = joint_hits(pred, true, visible, threshold=threshold, torso=torso)
    return _mean(table, average, dapt_compat or legacy, empty=np.nan)


def acceleration_error(
    pred: ArrayLike, true: ArrayLike, rate: float, visible: ArrayLike | None = None, *, average: str = "person"
) -> Score:
    """Mean distance between predicted and true acceleration of joints, in mm/s^2; `rate` in frames per second.

    pred, true (n, T, J, 3) m, T >= 3 evenly spaced frames; visible (n, T, J). Accelerations are second differences
    times rate^2; rate=1 gives mm per frame^2, the score that most papers report. An acceleration counts if the joint is
    labeled in all three frames. With average="person" the mean is over sequences, and `people` counts sequences.
    """
    return mean(acceleration_errors(pred, true, rate, visible), average)


# ---- tables


def joint_errors(pred: ArrayLike, true: ArrayLike, visible: ArrayLike | None = None) -> np.ndarray:
    """(n, J) mm: each joint's distance from the truth, NaN where it has no label."""
    return _distances(*checked_poses(pred, true, visible))


def root_aligned_errors(
    pred: ArrayLike, true: ArrayLike, visible: ArrayLike | None = None, *, skeleton: Skeleton | str
) -> np.ndarray:
    """`joint_errors` after each person's root is moved to the true one, see `root_mpjpe`; all NaN for people without a
    label of it."""
    pred, true, is_labeled = checked_poses(pred, true, visible)
    skeleton = as_skeleton(skeleton)
    if pred.shape[1] != len(skeleton):
        raise InputError(f"{skeleton.name} has {len(skeleton)} joints, got {pred.shape[1]}")
    root = list(skeleton.middle)
    has_root = is_labeled[:, root].all(1, keepdims=True)
    offset = (pred - true)[:, root].mean(1, keepdims=True)
    return _distances(pred - offset, true, is_labeled & has_root)


def aligned_errors(
    pred: ArrayLike,
    true: ArrayLike,
    visible: ArrayLike | None = None,
    dapt_compat: bool = False,
    *,
    legacy: bool = False,
) -> np.ndarray:
    """`joint_errors` after the best similarity of each person's labeled joints (Umeyama 1991, no reflections).

    All NaN for people with fewer than three labeled joints. dapt_compat: as in `pa_mpjpe`.
    """
    pred, true, is_labeled = checked_poses(pred, true, visible)
    if dapt_compat or legacy:
        if np.isnan(true).any():
            raise InputError("dapt_compat aligns all joints, labeled or not: true must hold no NaN")
        # the released code decides by the number of people whether the array is transposed
        axes = (0, 2, 1) if len(pred) in (2, 3) else (0, 1, 2)
        aligned_pred = similarity_align(pred.transpose(axes), true.transpose(axes)).transpose(axes)
        return _distances(aligned_pred, true, is_labeled)
    is_labeled &= (is_labeled.sum(1) >= LEAST_ALIGNED)[:, None]
    # joints without a label are placed at the mean of the others, where they do not affect the alignment
    joint_mask, count = is_labeled[..., None], np.maximum(is_labeled.sum(1), 1)[:, None, None]
    pred, filled_true = (
        np.where(joint_mask, joints, np.where(joint_mask, joints, 0.0).sum(1, keepdims=True) / count)
        for joints in (pred, true)
    )
    return _distances(similarity_align(pred, filled_true), true, is_labeled)


def acceleration_errors(pred: ArrayLike, true: ArrayLike, rate: float, visible: ArrayLike | None = None) -> np.ndarray:
    """(n, (T - 2) J) mm/s^2: errors of acceleration, see `acceleration_error`; NaN where there is none."""
    pred, true, is_labeled = checked_poses(pred, true, visible, trailing=("frames", "joints", "3"))
    if pred.shape[1] < 3:
        raise InputError(f"acceleration needs sequences of 3 frames or more, got {pred.shape[1]}")
    check_positive("rate", rate)
    offset = np.where(is_labeled[..., None], pred - true, 0.0)
    has_acceleration = is_labeled[:, :-2] & is_labeled[:, 1:-1] & is_labeled[:, 2:]
    error = np.linalg.norm(offset[:, :-2] - 2 * offset[:, 1:-1] + offset[:, 2:], axis=-1) * rate**2 * 1e3
    return np.where(has_acceleration, error, np.nan).reshape(len(error), error.shape[1] * error.shape[2])


def joint_hits(
    pred: ArrayLike, true: ArrayLike, visible: ArrayLike | None = None, *, threshold: float = PCK3, torso: float = TORSO
) -> np.ndarray:
    """(n, J) percent: 100 if a joint is nearer to the truth than threshold * torso, m, else 0; NaN without a label."""
    check_positive("threshold", threshold)
    check_positive("torso", torso)
    error = joint_errors(pred, true, visible)
    return np.where(np.isnan(error), np.nan, 100.0 * (error < threshold * torso * 1e3))


def _distances(pred: np.ndarray, true: np.ndarray, is_labeled: np.ndarray) -> np.ndarray:
    offset = np.where(is_labeled[..., None], pred - true, 0.0)
    return np.where(is_labeled, np.linalg.norm(offset, axis=-1) * 1e3, np.nan)


def _mean(table: np.ndarray, average: str, dapt_compat: bool, *, empty: float) -> Score:
    check_name("average", average, AVERAGES)
    if dapt_compat and average != "person":
        raise InputError('dapt_compat=True averages over people, as the released code does: pass average="person"')
    return mean(table, average, empty=empty if dapt_compat else None)


# ---- validation of arguments


def checked_poses(pred, true, visible, trailing=("joints", "3")) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """pred, true (n, ..., 3), is_labeled (n, ...) bool, a new array; the trailing axes are those in `trailing`."""
    pred, true = as_numbers("pred", pred), as_numbers("true", true)
    if pred.shape != true.shape or pred.ndim < len(trailing) or pred.shape[-1] != 3 or not pred.shape[-2]:
        expected_shape = ", ".join(("...", *trailing))
        raise InputError(f"pred and true must both be ({expected_shape}), got {pred.shape} and {true.shape}")
    if not np.isfinite(pred).all():
        num_joints = int((~np.isfinite(pred).all(-1)).sum())
        remedy = "leave out people without a pose (has_pose), and predict every joint"
        raise InputError(f"pred must be finite, got NaN or infinity in {num_joints} joints: {remedy}")
    if np.isinf(true).any():
        raise InputError("true must be finite, or NaN where a joint has no label; got infinity")
    is_labeled = ~np.isnan(true).any(-1)
    if visible is not None:
        is_labeled &= as_flags("visible", visible, is_labeled.shape)
    shape = (int(np.prod(pred.shape[: -len(trailing)])), *pred.shape[-len(trailing) :])
    return pred.reshape(shape), true.reshape(shape), is_labeled.reshape(shape[:-1])
