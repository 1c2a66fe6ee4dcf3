"""Metrics of 3D human pose on plain arrays, for predictions of any method.

    from lidarpose import metrics
    metrics.mpjpe(pred, true, visible)          # (n, J, 3), (n, J, 3) m, (n, J) -> mm
    metrics.pck(pred, true, visible)            # PCK-3, percent
    table = metrics.joint_errors(pred, true)    # (n, J) mm, for groups, slices and intervals
    metrics.by_group(table, "human15")["wrists"]
    metrics.interval(table, np.random.default_rng(0), clusters=sequence)

Inputs are in meters, results in millimeters or percent. docs/evaluate.md defines every metric.
"""

from lidarpose.eval.metrics.aggregate import (
    AVERAGES,
    DISTANCE_EDGES,
    GROUPS,
    OCCLUSION_EDGES,
    POINT_EDGES,
    Interval,
    Score,
    Slice,
    auroc,
    by_group,
    by_span,
    calibration_error,
    interval,
    joint_groups,
    mean,
    paired_interval,
)
from lidarpose.eval.metrics.joint_errors import (
    LEAST_ALIGNED,
    TORSO,
    acceleration_error,
    acceleration_errors,
    aligned_errors,
    joint_errors,
    joint_hits,
    mpjpe,
    pa_mpjpe,
    pck,
    root_aligned_errors,
    root_mpjpe,
)
from lidarpose.eval.metrics.keypoints import (
    OKS_THRESHOLDS,
    PCK_THRESHOLDS,
    PENALTY,
    Pem,
    box_hits,
    oks,
    oks_ap,
    oks_hits,
    oks_sigmas,
    pck_box,
    pem,
)

__all__ = [
    "AVERAGES", "DISTANCE_EDGES", "GROUPS", "Interval", "LEAST_ALIGNED", "OCCLUSION_EDGES", "OKS_THRESHOLDS",
    "PCK_THRESHOLDS", "PENALTY", "POINT_EDGES", "Pem", "Score", "Slice", "TORSO", "acceleration_error",
    "acceleration_errors", "aligned_errors", "auroc", "box_hits", "by_group", "by_span", "calibration_error",
    "interval", "joint_errors", "joint_groups", "joint_hits", "mean", "mpjpe", "oks", "oks_ap", "oks_hits",
    "oks_sigmas", "pa_mpjpe", "paired_interval", "pck", "pck_box", "pem",
    "root_aligned_errors", "root_mpjpe",
]  # fmt: skip
