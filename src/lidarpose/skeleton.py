"""Skeletons: named joints and their indices, which no other module defines.

Every skeleton is a tree of named joints. A joint name has the same definition in all skeletons, so joints are mapped
between skeletons by name. `BODY26` is the superset that the network predicts: SMPL's 24 joints, nose and head center.

Definitions (each point moves rigidly with the bone named in brackets):
    SMPL names      the joint centers of SMPL's kinematic tree: the pelvis lies about 9.5 cm above the middle of the
                    hips, the hips about 15 cm and the shoulders about 37 cm apart on a mean adult
    head            the joint at the base of the skull, as in SMPL [head]
    nose            the tip of the nose [head]
    head_center     the middle of the head, halfway between the ears [head]
"""

from dataclasses import dataclass
from functools import cached_property
from operator import index

import numpy as np

from lidarpose.errors import InputError, check_name, unknown_name


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """A tree of named joints.

    Args:
        name: name of the skeleton.
        joints: names of the joints, unique.
        parents: index of each joint's parent, -1 for the root, which is joint 0; parents precede children.
        extra_bones: pairs of joint indices that are drawn in addition to the bones of the tree.

    Raises:
        InputError: joints, parents or bones that do not form a valid tree.
    """

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    extra_bones: tuple[tuple[int, int], ...] = ()

    def __post_init__(self):
        # accept lists instead of tuples
        try:
            if isinstance(self.joints, str) or not len(self.joints):
                raise TypeError(f"got {self.joints!r}")
            object.__setattr__(self, "joints", tuple(self.joints))
            object.__setattr__(self, "parents", tuple(map(index, self.parents)))
            object.__setattr__(self, "extra_bones", tuple(tuple(map(index, pair)) for pair in self.extra_bones))
        except TypeError as error:
            raise InputError(
                f"skeleton {self.name}: joints are a list of names, parents of indices, extra_bones of pairs of "
                f"indices ({error})"
            ) from None
        if not all(isinstance(name, str) for name in self.joints):
            raise InputError(f"skeleton {self.name}: joint names must be text, got {list(self.joints)}")
        if len(set(self.joints)) != len(self.joints):
            raise InputError(f"skeleton {self.name}: joint names must be unique, got {list(self.joints)}")
        if len(self.parents) != len(self.joints):
            raise InputError(f"skeleton {self.name}: {len(self.joints)} joints but {len(self.parents)} parents")
        for j, p in enumerate(self.parents):
            if not (0 <= p < j or j == 0 and p == -1):
                raise InputError(
                    f"skeleton {self.name}: joint 0 is the root (-1) and parents precede children, "
                    f"but joint {j} has parent {p}"
                )
        for pair in self.extra_bones:
            if len(pair) != 2:
                raise InputError(f"skeleton {self.name}: extra bone {pair} must be a pair of joints")
            if not all(0 <= j < len(self.joints) for j in pair):
                raise InputError(f"skeleton {self.name}: extra bone {pair} is not within its {len(self.joints)} joints")

    def __len__(self) -> int:
        return len(self.joints)

    def index(self, joint: str) -> int:
        """The index of a joint by name. Raises InputError for an unknown joint."""
        try:
            return self.joints.index(joint)
        except ValueError:
            raise unknown_name(f"joint of {self.name}", joint, self.joints) from None

    @cached_property
    def middle(self) -> tuple[int, ...]:
        """Indices of the joints whose mean is the middle of a person: the pelvis, or both hips if there is none."""
        names = ("pelvis",) if "pelvis" in self.joints else ("left_hip", "right_hip")
        return tuple(self.index(name) for name in names)

    @cached_property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """Pairs (parent, child) of joint indices to draw, followed by `extra_bones`."""
        return tuple((p, j) for j, p in enumerate(self.parents) if p >= 0) + self.extra_bones

    @property
    def is_two_sided(self) -> bool:
        """Whether the skeleton has the mirror image of each joint."""
        return all(_mirrored(name) in self.joints for name in self.joints)

    @cached_property
    def flip(self) -> tuple[int, ...]:
        """`flip[j]` is the index of joint j's mirror image: left and right are swapped by name. Raises InputError
        unless the skeleton `is_two_sided`."""
        return tuple(self.index(_mirrored(name)) for name in self.joints)

    def map_to(self, other: "Skeleton") -> np.ndarray:
        """(len(other),) int: for each joint of `other`, its index in this skeleton. Raises InputError if one is
        missing."""
        missing_joints = [name for name in other.joints if name not in self.joints]
        if missing_joints:
            raise InputError(f"skeleton {self.name} has no {', '.join(missing_joints)}, which {other.name} needs")
        return np.array([self.index(name) for name in other.joints])


def _mirrored(name: str) -> str:
    for side, other_side in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other_side + name.removeprefix(side)
    return name


def _tree(name: str, edges: str, extra: str = "") -> Skeleton:
    """Builds a skeleton from words `joint<parent`, the root without `<`; `extra` has words `joint<joint`."""
    pairs = [word.partition("<") for word in edges.split()]
    joints = tuple(joint for joint, _, _ in pairs)
    parents = tuple(joints.index(parent) if parent else -1 for _, _, parent in pairs)
    extra_bones = tuple((joints.index(b), joints.index(a)) for a, _, b in (w.partition("<") for w in extra.split()))
    return Skeleton(name=name, joints=joints, parents=parents, extra_bones=extra_bones)


_SMPL = """pelvis left_hip<pelvis right_hip<pelvis spine1<pelvis left_knee<left_hip right_knee<right_hip
spine2<spine1 left_ankle<left_knee right_ankle<right_knee spine3<spine2 left_foot<left_ankle right_foot<right_ankle
neck<spine3 left_collar<spine3 right_collar<spine3 head<neck left_shoulder<left_collar right_shoulder<right_collar
left_elbow<left_shoulder right_elbow<right_shoulder left_wrist<left_elbow right_wrist<right_elbow
left_hand<left_wrist right_hand<right_wrist"""

# SMPL's kinematic tree (Loper et al. 2015), joints in its published order
SMPL24 = _tree("smpl24", _SMPL)

# SMPL's tree and the two head points that Waymo labels; predicted by the bundled networks
BODY26 = _tree("body26", _SMPL + " nose<head head_center<head")

# the subset of SMPL's joints used for pre-training in the paper, with the joints and order of HumanM3
HUMAN15 = _tree(
    "human15",
    """pelvis left_hip<pelvis right_hip<pelvis left_knee<left_hip right_knee<right_hip left_ankle<left_knee
    right_ankle<right_knee neck<pelvis head<neck left_shoulder<neck right_shoulder<neck left_elbow<left_shoulder
    right_elbow<right_shoulder left_wrist<left_elbow right_wrist<right_elbow""",
)

# Waymo's 14 laser keypoints, in the order of its own keypoint tables
WAYMO14 = _tree(
    "waymo14",
    """nose left_shoulder<nose right_shoulder<nose left_elbow<left_shoulder right_elbow<right_shoulder
    left_wrist<left_elbow right_wrist<right_elbow left_hip<left_shoulder right_hip<right_shoulder left_knee<left_hip
    right_knee<right_hip left_ankle<left_knee right_ankle<right_knee head_center<nose""",
    extra="right_shoulder<left_shoulder right_hip<left_hip",
)

# ITOP's 15 joints in its order, without the torso, for which SMPL has no joint. Hands and feet map to SMPL's by name,
# although ITOP's are some centimeters away, due to its sensor and annotation
ITOP14 = _tree(
    "itop14",
    """head_center neck<head_center right_shoulder<neck left_shoulder<neck right_elbow<right_shoulder
    left_elbow<left_shoulder right_hand<right_elbow left_hand<left_elbow right_hip<neck left_hip<neck
    right_knee<right_hip left_knee<left_hip right_foot<right_knee left_foot<left_knee""",
)

SKELETONS = {s.name: s for s in (SMPL24, HUMAN15, WAYMO14, ITOP14, BODY26)}


def skeleton(name: str) -> Skeleton:
    """A named skeleton: smpl24, human15, waymo14, itop14 or body26."""
    check_name("skeleton", name, SKELETONS)
    return SKELETONS[name]


def as_skeleton(of: Skeleton | str) -> Skeleton:
    """Converts a skeleton or its name to a skeleton. Raises InputError for anything else."""
    return of if isinstance(of, Skeleton) else skeleton(of)
