"""Scores by joint group: joints are found by name, in any skeleton."""

from collections.abc import Mapping, Sequence

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.metrics.aggregate import Score, mean, table_of
from lidarpose.skeleton import Skeleton, skeleton

# the groups that the paper and Waymo report (head to ankles), and groups for the joints that only SMPL has
GROUPS = {
    "head": ("head", "nose", "head_center"),
    "shoulders": ("left_shoulder", "right_shoulder"),
    "elbows": ("left_elbow", "right_elbow"),
    "wrists": ("left_wrist", "right_wrist"),
    "hips": ("left_hip", "right_hip"),
    "knees": ("left_knee", "right_knee"),
    "ankles": ("left_ankle", "right_ankle"),
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"),
    "hands": ("left_hand", "right_hand"),
    "feet": ("left_foot", "right_foot"),
}


def joint_groups(of: Skeleton | str, groups: Mapping[str, Sequence[str]] = GROUPS) -> dict[str, np.ndarray]:
    """Group -> indices of its joints in the skeleton, by name; groups without a joint there are left out, "all" is
    last. of: a skeleton or its name."""
    of = skeleton(of) if isinstance(of, str) else of
    found = {
        name: np.array([of.index(joint) for joint in members if joint in of.joints], int)
        for name, members in groups.items()
    }
    return {name: index for name, index in found.items() if len(index)} | {"all": np.arange(len(of))}


def by_group(
    table: np.ndarray,
    of: Skeleton | str,
    average: str = "person",
    *,
    groups: Mapping[str, Sequence[str]] = GROUPS,
    empty: float | None = None,
) -> dict[str, Score]:
    """`mean` of a table (n, J) for each joint group of the skeleton. A group that nobody has a label in is NaN."""
    table = table_of(table)
    of = skeleton(of) if isinstance(of, str) else of
    if table.shape[1] != len(of):
        raise InputError(f"a table of {of.name} has {len(of)} columns, one a joint, got {table.shape[1]}")
    return {name: mean(table[:, index], average, empty=empty) for name, index in joint_groups(of, groups).items()}
