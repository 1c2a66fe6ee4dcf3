"""Named joints: published orders, flips, trees, maps."""

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.skeleton import BODY26, HUMAN15, SKELETONS, SMPL24, WAYMO14, Skeleton, skeleton

# repeated here on purpose: a changed order would silently exchange joints in every file
SMPL = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot "
    "neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist "
    "left_hand right_hand"
).split()
# the parents of SMPL's kintree_table
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
HUMAN = (
    "pelvis left_hip right_hip left_knee right_knee left_ankle right_ankle neck head left_shoulder right_shoulder "
    "left_elbow right_elbow left_wrist right_wrist"
).split()
WAYMO = (
    "nose left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_hip right_hip left_knee "
    "right_knee left_ankle right_ankle head_center"
).split()

named = pytest.mark.parametrize("tree", SKELETONS.values(), ids=lambda s: s.name)


def test_skeletons_match_published_joint_orders():
    assert list(SMPL24.joints) == SMPL and SMPL24.parents == SMPL_PARENTS
    assert list(BODY26.joints) == [*SMPL, "nose", "head_center"]
    assert BODY26.parents == (*SMPL_PARENTS, 15, 15)
    assert list(HUMAN15.joints) == HUMAN
    assert list(WAYMO14.joints) == WAYMO
    assert list(SKELETONS) == ["smpl24", "human15", "waymo14", "itop14", "body26"]
    assert [len(s) for s in SKELETONS.values()] == [24, 15, 14, 14, 26]


@named
def test_skeleton_is_a_mirror_symmetric_tree(tree):
    assert [tree.flip[tree.flip[j]] for j in range(len(tree))] == list(range(len(tree)))
    for j, name in enumerate(tree.joints):
        swap = {"left": "right", "right": "left"}
        assert tree.joints[tree.flip[j]] == "_".join(swap.get(word, word) for word in name.split("_"))
    assert tree.parents[0] == -1
    assert all(0 <= p < j for j, p in enumerate(tree.parents) if j)
    # waymo14 has bones across the trunk, and joints of both sides have the nose as parent
    order = sorted if tree is WAYMO14 else tuple
    mirrored = {tuple(order((tree.flip[a], tree.flip[b]))) for a, b in tree.bones}
    assert mirrored == {tuple(order(bone)) for bone in tree.bones}
    assert len(tree.bones) == len(tree) - 1 + len(tree.extra_bones)
    for a, b in tree.bones:
        # only extra bones connect left and right joints
        sides = {tree.joints[j].split("_")[0] for j in (a, b)}
        assert not {"left", "right"} <= sides or (a, b) in tree.extra_bones


@named
def test_body26_maps_to_every_skeleton(tree):
    assert [BODY26.joints[j] for j in BODY26.map_to(tree)] == list(tree.joints)


def test_map_to_matches_names_and_reports_missing_joints():
    a = Skeleton(name="a", joints=("root", "left_x", "right_x"), parents=(-1, 0, 0))
    b = Skeleton(name="b", joints=("right_x", "root", "left_x"), parents=(-1, 0, 1))
    assert a.map_to(b).tolist() == [2, 0, 1] and b.map_to(a).tolist() == [1, 2, 0]
    with pytest.raises(InputError, match="smpl24 has no nose, head_center, which body26 needs"):
        SMPL24.map_to(BODY26)
    with pytest.raises(InputError, match="waymo14 has no pelvis, neck, head, which human15 needs"):
        WAYMO14.map_to(HUMAN15)


@pytest.mark.parametrize(
    "joints, parents, extra, message",
    [
        (("a", "a"), (-1, 0), (), "joint names must be unique"),
        (("a", "b"), (-1,), (), "2 joints but 1 parents"),
        (("a", "b", "c"), (-1, 2, 0), (), "joint 1 has parent 2"),
        (("a", "b"), (-1, 1), (), "joint 1 has parent 1"),
        (("a", "b"), (-1, -2), (), "joint 1 has parent -2"),
        (("a", "b"), (-1, -1), (), "joint 1 has parent -1"),
        (("a", "b"), (0, 0), (), "joint 0 has parent 0"),
        (("a", "b"), (-1, 0), ((0, 2),), "not within its 2 joints"),
        (("a",), (None,), (), "parents of indices"),
        (("a", "b"), (-1, 0), (("a", "b"),), "pairs of indices"),
        (("a", "b"), (-1, 0), ((0,),), r"extra bone \(0,\) must be a pair"),
        ((1, 2), (-1, 0), (), "joint names must be text"),
        ((), (), (), "joints are a list of names"),
        ("ab", (-1, 0), (), "joints are a list of names"),
    ],
)
def test_skeleton_rejects_invalid_trees(joints, parents, extra, message):
    with pytest.raises(InputError, match=message):
        Skeleton(name="bad", joints=joints, parents=parents, extra_bones=extra)


def test_unknown_joint_and_skeleton_suggest_nearest_name():
    with pytest.raises(InputError, match="did you mean left_knee"):
        SMPL24.index("left_kne")
    with pytest.raises(InputError, match="did you mean smpl24"):
        skeleton("smpl")
    assert skeleton("waymo14") is WAYMO14


def test_skeleton_accepts_lists():
    made = Skeleton(name="v", joints=["a", "b", "c"], parents=[-1, 0, 0], extra_bones=[[1, 2]])
    assert made == Skeleton(name="v", joints=("a", "b", "c"), parents=(-1, 0, 0), extra_bones=((1, 2),))
    assert len(made.bones) == 3 and hash(made)


@pytest.mark.parametrize("name", [["smpl24"], None, 24, np.zeros(2), {"smpl24"}])
def test_skeleton_lookup_rejects_non_string_names(name):
    with pytest.raises(InputError, match="unknown skeleton .*known are smpl24"):
        skeleton(name)


def test_flip_rejects_joint_without_counterpart():
    lame = Skeleton(name="lame", joints=("root", "left_leg"), parents=(-1, 0))
    with pytest.raises(InputError, match="right_leg"):
        _ = lame.flip
