"""Test-time augmentation: transforms, their inverses, and averages of estimates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import lidarpose
from lidarpose.errors import InputError
from lidarpose.inference.backend import Raw
from lidarpose.inference.estimator import PoseEstimator
from lidarpose.inference.tta import IDENTITY, TRANSFORMS, TTATransform, apply, average, invert, tta_transforms
from lidarpose.sample import Pose, center_of
from lidarpose.skeleton import HUMAN15, WAYMO14
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config

LEFT = np.array([name.startswith("left_") for name in HUMAN15.joints])
RIGHT = np.array([name.startswith("right_") for name in HUMAN15.joints])


def answer(about, features):
    """A network that is exact by construction: joints about the mean of the points, left joints to the left of a person
    who faces the sensor, each pair of joints at its own height."""
    mean = np.stack([points.mean(0) for points in about])
    aside = np.cross([0, 0, 1.0], features[:, :3]) * 0.2
    side = LEFT.astype(float) - RIGHT
    # left and right joint of a pair have the same height
    height = np.array([0.05 * min(j, HUMAN15.flip[j]) for j in range(len(HUMAN15))])
    joints = mean[:, None] + side[:, None] * aside[:, None] + height[:, None] * [0, 0, 1]
    confidence = np.broadcast_to(0.5 + 0.3 * LEFT, joints.shape[:2])
    return Pose(joints=joints, skeleton=HUMAN15, confidence=confidence, in_range=confidence > 0.6)


@settings(max_examples=40, deadline=None)
@given(
    turns=st.integers(0, 3),
    mirrored=st.booleans(),
    shift=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    seed=st.integers(0, 1000),
)
def test_invert_undoes_apply(turns, mirrored, shift, seed):
    rng = np.random.default_rng(seed)
    centers = rng.normal(0, 5, (3, 3)) + [20, 0, 0]
    clouds = [center + rng.normal(0, 0.4, (30, 3)) for center in centers]

    def seen_by(transform):
        # the sensor is so far away that shifts do not change the view direction
        return invert(answer(*apply(transform, clouds, centers, np.array([1e7, 3e6, 0]))), transform)

    plain, other = seen_by(TTATransform()), seen_by(TTATransform(turns, mirrored, shift))
    np.testing.assert_allclose(other.joints, plain.joints, atol=1e-5)
    # mirroring swaps left and right joints
    flip = np.array(HUMAN15.flip) if mirrored else np.arange(len(HUMAN15))
    np.testing.assert_array_equal(other.confidence, plain.confidence[:, flip])
    np.testing.assert_array_equal(other.in_range, plain.in_range[:, flip])
    assert other.spread is None and other.visible is None


def estimate(value, confidence, people=2):
    each = None if confidence is None else np.full((people, 15), confidence)
    return Pose(joints=np.full((people, 15, 3), float(value)), skeleton=HUMAN15, confidence=each, spread=each)


def test_average_weights_estimates_by_confidence():
    joints = average([estimate(0.0, 0.9), estimate(1.0, 0.45)]).joints
    assert 0 < joints.max() < 0.01
    # without confidence, or with equal confidence, all estimates have the same weight
    for confidence in (0.5, None):
        assert (average([estimate(0.0, confidence), estimate(1.0, confidence)]).joints == 0.5).all()
    # a person with zero confidence gets the plain mean, and other people are not affected
    sure, unsure = estimate(0.0, 0.5), estimate(1.0, 0.5)
    unsure.confidence[1] = sure.confidence[1] = 0.0
    assert (average([sure, unsure]).joints == 0.5).all()
    assert average([sure]) is sure


def test_average_in_range_is_majority_vote():
    joints, in_range = np.zeros((1, 15, 3)), np.zeros((3, 1, 15), bool)
    in_range[:1, 0, 0] = in_range[:2, 0, 1] = in_range[:, 0, 2] = True
    found = average([Pose(joints=joints, skeleton=HUMAN15, in_range=own) for own in in_range])
    assert found.in_range[0, :4].tolist() == [False, True, True, False]


def test_apply_shifts_then_rotates_then_mirrors():
    np.testing.assert_array_equal(TTATransform(1, True).R_view_person @ [1, 2, 3], [-2, -1, 3])
    # a sensor two meters ahead and one to the left of the shifted center
    transform, center = TTATransform(1, True, (0.05, 0.1, 0.0)), np.array([[4.0, 5.0, 1.0]])
    (points,), view = apply(transform, [np.array([[5.05, 7.1, 4.0]])], center, np.array([6.05, 6.1, 1.0]))
    np.testing.assert_allclose(points, [[-2, -1, 3]], atol=1e-9)
    np.testing.assert_allclose(view[0, :3] * np.exp(view[0, 3]), [-1, -2, 0], atol=1e-6)


def test_tta_transforms_are_distinct_and_start_with_identity():
    assert tta_transforms(1) == (TTATransform(),) and tta_transforms(np.int64(3)) == tta_transforms(3)
    assert len(set(TRANSFORMS)) == len(TRANSFORMS) == len(tta_transforms(8))
    # no two transforms shift the fine grid to the same position
    assert len({tuple(np.round(np.mod(each.shift, 0.06), 6)) for each in TRANSFORMS}) == len(TRANSFORMS)
    for tta in (0, 9, -1, 1.5, True, "four"):
        with pytest.raises(InputError, match="tta must be a whole number from 1 to 8"):
            lidarpose.load(tta=tta)


def people(count):
    # of spinning sensors, for which averaging gains most
    sensors = ("os1-128", "hdl-64e", "vlp-32c", "pandar64")
    generator = Generator(scene=replace(scene_config("wild"), sensors=sensors), measure=False)
    samples = [generator.person(4711, k).sample for k in range(count)]
    return [sample.points for sample in samples], np.stack([sample.pose.joints for sample in samples])


def error(model, clouds, truth):
    joints = model.predict(clouds, sensor_origin=(0, 0, 0), skeleton="body26").to_numpy()
    return np.linalg.norm(joints - truth, axis=-1).mean(), joints


@pytest.mark.long
def test_more_passes_reduce_error_and_are_recorded():
    """The pass that finds the pelvis is averaged, too; `alone` uses only the pass after it."""
    # the gain is 1 to 2 mm of 50, so it takes many people
    clouds, truth = people(300)
    alone = lidarpose.load()
    alone._averaged, alone._first = False, IDENTITY
    least, _ = error(alone, clouds, truth)
    for tta in (1, 4):
        model = lidarpose.load(tta=tta)
        mean_error, joints = error(model, clouds, truth)
        assert mean_error < least and model.model.get("tta", 1) == tta
    one = model.predict(clouds[1], sensor_origin=(0, 0, 0), skeleton="body26")
    np.testing.assert_allclose(joints[1], one.joints, atol=1e-5)


def test_box_center_selects_one_of_two_people():
    """The box matters if the network sees two people; an equally confident pose about it does not replace another."""
    rng = np.random.default_rng(0)
    clouds = [rng.normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3)), rng.normal((9, 0, 0), (0.2, 0.2, 0.5), (200, 3))]
    boxes = np.array([[5.3, 0.3, 0.0], [9.2, 0.1, 0.1]])
    estimator = PoseEstimator(TwoPeople(sure=(True, False)))
    asked = estimator.poses(clouds, np.zeros(3), box_centers=boxes)
    plain = estimator.poses(clouds, np.zeros(3))
    # the fake backend always returns the middle of the crop
    np.testing.assert_allclose(asked[0].joints, np.broadcast_to([5.3, 0.3, 0.0], (15, 3)), atol=0.011)
    np.testing.assert_array_equal(asked[1].joints, plain[1].joints)
    assert np.linalg.norm(plain[0].joints[0] - boxes[0]) > 0.2


@pytest.mark.parametrize(
    ("sure", "beside", "expected"),
    [(0.9, 0.0, 1.0), (0.5, 0.0, 0.0), (0.5, 0.9, 1.0), (0.2, 0.9, 0.0)],
    ids=["surer", "less sure", "less sure beside another", "far less sure beside another"],
)
def test_box_center_far_from_the_pose_selects_another_person(sure, beside, expected):
    """One person stands at the middle of the points, x = 5, the other at x = 6, where the box is."""
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3))
    middle = center_of(cloud)[0]

    def pose_at(x):
        # about the middle of the points, the network sees only the person there, with a confidence of 0.6
        is_first = abs(x - middle) < 0.3
        return (middle if is_first else middle + 1), 0.6 if is_first else sure, 0.0 if is_first else beside

    estimator = PoseEstimator(PoseAt(pose_at, cloud.mean(0)[0]))
    (pose,) = estimator.poses([cloud], np.zeros(3), box_centers=np.array([[middle + 1.1, 0, 0]]))
    np.testing.assert_allclose(pose.joints[:, 0], middle + expected, atol=0.011)
    # a box at the pose, and no box
    for box_centers in (np.array([[middle + 0.1, 0, 0]]), None):
        (pose,) = estimator.poses([cloud], np.zeros(3), box_centers=box_centers)
        np.testing.assert_allclose(pose.joints[:, 0], middle, atol=0.011)


@pytest.mark.parametrize(("confidence", "passes"), [(0.9, 2), (0.6, 3)])
def test_uncertain_pose_is_averaged_with_one_about_the_box_center(confidence, passes):
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3))
    middle, count = center_of(cloud)[0], iter(range(9))
    # each pass is off by another error
    errors = [0.0, 0.09, 0.03] if passes == 3 else [0.0, 0.03]
    backend = PoseAt(lambda x: (middle + errors[next(count)], confidence, 0.0), cloud.mean(0)[0])
    (pose,) = PoseEstimator(backend).poses([cloud], np.zeros(3), box_centers=np.array([[middle + 0.05, 0, 0]]))
    np.testing.assert_allclose(pose.joints[:, 0], middle + np.mean(errors), atol=1e-4)
    assert next(count) == passes


def test_first_pass_is_about_the_given_center():
    """The second pass is about the pelvis that the first one finds."""
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3))
    passes = []

    def pose_at(x):
        passes.append(x)
        return 5.4 + 0.02 * len(passes), 0.9, 0.0

    estimator = PoseEstimator(PoseAt(pose_at, cloud.mean(0)[0]))
    (pose,) = estimator.poses([cloud], np.zeros(3), first_centers=np.array([[6.0, 0.0, 0.0]]))
    np.testing.assert_allclose(passes, [6.0, 5.42], atol=0.006)
    np.testing.assert_allclose(pose.joints[:, 0], (5.42 + 5.44) / 2, atol=1e-4)


class PoseAt:
    """Fake backend. pose_at: x m of the crop's center -> x m of the joints, their confidence, and that of a second
    person; mean_x m: of the cloud."""

    name, batch = "fake", 64
    header = SimpleNamespace(skeleton=HUMAN15, network="pose")

    def __init__(self, pose_at, mean_x):
        self.pose_at, self.mean_x = pose_at, mean_x

    def run(self, clouds, view):
        joints, confidence, person = np.zeros((len(clouds), 15, 3)), np.zeros((len(clouds), 15)), []
        for k, cloud in enumerate(clouds):
            center = self.mean_x - cloud[:, 0].mean()
            x, sure, second = self.pose_at(center)
            joints[k, :, 0], confidence[k] = x - center, logit(sure)
            person.append([9.0, logit(second)])
        raw = Raw.from_joints(joints)
        each = np.zeros(confidence.shape)
        return replace(raw, confidence=confidence, log_spread=each, visible=each, person=np.array(person))


def logit(probability):
    return np.log((probability + 1e-9) / (1 - probability + 1e-9))


class TwoPeople:
    """Fake backend: joints at the middle of the crop; two people in the clouds where `sure` is True."""

    name, batch = "fake", 64
    header = SimpleNamespace(skeleton=HUMAN15, network="pose")

    def __init__(self, sure):
        self.sure = dict(zip((300, 200), sure, strict=True))

    def run(self, clouds, view):
        each = np.zeros((len(clouds), 15))
        person = np.array([[9.0, 9.0 if self.sure[len(cloud)] else -9.0] for cloud in clouds])
        raw = Raw.from_joints(np.zeros((len(clouds), 15, 3)))
        return replace(raw, confidence=each, log_spread=each, visible=each, person=person)


def test_sure_pose_far_from_the_box_is_repeated_about_the_box():
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3))
    middle = center_of(cloud)[0]
    backend = PoseAt(
        lambda x: (middle, 0.8, 0.0) if abs(x - middle) < 0.3 else (middle + 1, 0.9, 0.0), cloud.mean(0)[0]
    )
    (pose,) = PoseEstimator(backend).poses([cloud], np.zeros(3), box_centers=np.array([[middle + 1.1, 0, 0]]))
    np.testing.assert_allclose(pose.joints[:, 0], middle + 1, atol=0.011)


def test_second_pass_is_about_the_middle_of_the_hips():
    """Of skeletons without a pelvis, whose first joint is the nose."""
    cloud, centers = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3)), []

    class Hips:
        name, batch, header = "fake", 1, SimpleNamespace(skeleton=WAYMO14, network="dapt")

        def run(self, clouds, view):
            center = cloud.mean(0) - clouds[0].mean(0)
            centers.append(center)
            joints = np.zeros((1, 14, 3))
            joints[0, WAYMO14.index("nose")] = [0.3, 0, 0.7]
            return Raw.from_joints(joints - (center - [5, 0, 0]))

    PoseEstimator(Hips()).poses([cloud], np.zeros(3), first_centers=np.array([[5.4, 0.2, 0.1]]))
    np.testing.assert_allclose(centers, [[5.4, 0.2, 0.1], [5, 0, 0]], atol=0.006)


def test_pose_needs_points_near_its_center():
    """In all three axes: the cloud is beside the center."""
    cloud = np.random.default_rng(0).normal((5, 0, 0), 0.1, (50, 3))
    estimator = PoseEstimator(PoseAt(lambda x: (x, 0.9, 0.0), cloud.mean(0)[0]))
    for offset, has_pose in ((0.0, True), (3.0, False)):
        (pose,) = estimator.poses([cloud], np.zeros(3), centers=np.array([[5.0 + offset, 0, 0]]))
        assert (pose is not None) == has_pose


def test_newest_points_far_from_the_person_are_left_out(monkeypatch):
    """A crop may show others, too."""
    cloud = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (300, 3))
    estimator, given = PoseEstimator(PoseAt(lambda x: (5.0, 0.9, 0.0), cloud.mean(0)[0])), []
    (pose,) = estimator.poses([cloud], np.zeros(3))
    monkeypatch.setattr(estimator, "poses", lambda clouds, *_, **__: given.extend(clouds) or [None])
    (same,) = estimator.averaged_with_newest([pose], [np.concatenate([cloud, cloud + [0, 3, 0]])], np.zeros(3))
    np.testing.assert_array_equal(given, [cloud])
    assert same is pose
