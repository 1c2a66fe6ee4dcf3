"""Named joints: published orders, flips, trees, maps."""

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.skeleton import BODY26, HUMAN15, SKELETONS, SMPL24, WAYMO14, Skeleton, skeleton

# written out here a second time on purpose: a changed order would silently exchange joints in every file
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


def test_the_published_orders():
    assert list(SMPL24.joints) == SMPL and SMPL24.parents == SMPL_PARENTS
    assert list(BODY26.joints) == [*SMPL, "nose", "head_center"]
    assert BODY26.parents == (*SMPL_PARENTS, 15, 15)
    assert list(HUMAN15.joints) == HUMAN
    assert list(WAYMO14.joints) == WAYMO
    assert list(SKELETONS) == ["smpl24", "human15", "waymo14", "body26"]
    assert [len(s) for s in SKELETONS.values()] == [24, 15, 14, 26]


@named
def test_the_flip_is_an_involution_that_exchanges_the_sides_by_name(tree):
    flip = tree.flip
    assert [flip[flip[j]] for j in range(len(tree))] == list(range(len(tree)))
    for j, name in enumerate(tree.joints):
        across = tree.joints[flip[j]]
        if "left" in name or "right" in name:
            assert across != name
            assert across.replace("left", "right") == name.replace("left", "right")
        else:
            assert across == name


@named
def test_the_tree_is_one_tree_whose_mirror_is_itself(tree):
    assert tree.parents[0] == -1
    assert all(0 <= p < j for j, p in enumerate(tree.parents) if j)
    mirrored = {(tree.flip[a], tree.flip[b]) for a, b in tree.bones}
    drawn = set(tree.bones)
    if tree is WAYMO14:
        # its trunk is drawn from side to side, and the tree hangs both sides on the nose
        mirrored = {tuple(sorted(bone)) for bone in mirrored}
        drawn = {tuple(sorted(bone)) for bone in drawn}
    assert mirrored == drawn
    assert len(tree.bones) == len(tree) - 1 + len(tree.extra_bones)


@named
def test_bones_never_cross_from_side_to_side_but_across_the_trunk(tree):
    for a, b in tree.bones:
        sides = {name.split("_")[0] for name in (tree.joints[a], tree.joints[b])}
        if {"left", "right"} <= sides:
            assert (a, b) in tree.extra_bones


@pytest.mark.parametrize("other", [SMPL24, HUMAN15, WAYMO14, BODY26], ids=lambda s: s.name)
def test_body26_speaks_every_skeleton_by_name(other):
    pick = BODY26.map_to(other)
    assert [BODY26.joints[j] for j in pick] == list(other.joints)
    # there and back where both directions exist
    if set(BODY26.joints) == set(other.joints):
        np.testing.assert_array_equal(other.map_to(BODY26)[pick], np.arange(len(other)))


def test_a_map_that_lacks_joints_names_them():
    with pytest.raises(InputError, match="smpl24 has no nose, head_center, which body26 needs"):
        SMPL24.map_to(BODY26)
    with pytest.raises(InputError, match="waymo14 has no pelvis, neck, head, which human15 needs"):
        WAYMO14.map_to(HUMAN15)
    np.testing.assert_array_equal(SMPL24.map_to(HUMAN15)[:3], [0, 1, 2])


def test_a_map_goes_both_ways_between_two_orders_of_the_same_joints():
    a = Skeleton(name="a", joints=("root", "left_x", "right_x"), parents=(-1, 0, 0))
    b = Skeleton(name="b", joints=("right_x", "root", "left_x"), parents=(-1, 0, 1))
    np.testing.assert_array_equal(a.map_to(b), [2, 0, 1])
    np.testing.assert_array_equal(b.map_to(a), [1, 2, 0])


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
    ],
)
def test_what_is_no_tree_is_refused(joints, parents, extra, message):
    with pytest.raises(InputError, match=message):
        Skeleton(name="bad", joints=joints, parents=parents, extra_bones=extra)


def test_unknown_names_offer_the_nearest():
    with pytest.raises(InputError, match="did you mean left_knee"):
        SMPL24.index("left_kne")
    with pytest.raises(InputError, match="did you mean smpl24"):
        skeleton("smpl")
    assert skeleton("waymo14") is WAYMO14


def test_a_tree_of_lists_is_one_of_tuples():
    made = Skeleton(name="v", joints=["a", "b", "c"], parents=[-1, 0, 0], extra_bones=[[1, 2]])
    assert made == Skeleton(name="v", joints=("a", "b", "c"), parents=(-1, 0, 0), extra_bones=((1, 2),))
    assert len(made.bones) == 3 and hash(made)


@pytest.mark.parametrize("name", [["smpl24"], None, 24, np.zeros(2), {"smpl24"}])
def test_what_is_no_name_is_an_unknown_one(name):
    with pytest.raises(InputError, match="unknown skeleton .*known are smpl24"):
        skeleton(name)


def test_a_side_without_its_other_side_has_no_flip():
    lame = Skeleton(name="lame", joints=("root", "left_leg"), parents=(-1, 0))
    with pytest.raises(InputError, match="right_leg"):
        _ = lame.flip
