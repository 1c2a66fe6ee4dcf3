"""Verification of detections: their points and features, and boxes from poses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lidarpose.inference import verification
from lidarpose.inference.backend import bundled_backend
from lidarpose.inference.estimator import PoseEstimator
from lidarpose.inference.known_places import KnownPlaces
from lidarpose.inference.tta import MIRRORED, average
from lidarpose.inference.verification import Crops, box_about, inside_column
from lidarpose.models import DEFAULT
from lidarpose.models.detector.detector import Detections
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config

# facing +x, left is +y, m
STANDING = {
    "pelvis": (0, 0, 0.95), "neck": (0, 0, 1.45), "head": (0.05, 0, 1.6),
    "hip": (0, 0.1, 0.9), "knee": (0.02, 0.1, 0.5), "ankle": (0, 0.1, 0.08),
    "shoulder": (0, 0.2, 1.4), "elbow": (0, 0.3, 1.15), "wrist": (0.1, 0.32, 0.9),
}  # fmt: skip


def standing(yaw, place):
    """Pose of a standing person with heading `yaw` rad at place (3,) m."""
    joints = []
    for name in HUMAN15.joints:
        side, _, part = name.partition("_")
        x, y, z = STANDING[part if part in STANDING else name]
        joints.append((x, -y if side == "right" else y, z))
    c, s = np.cos(yaw), np.sin(yaw)
    return Pose(joints=np.array(joints) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + place, skeleton=HUMAN15)


@pytest.mark.parametrize("yaw", [-3.0, -1.2, 0.0, 0.4, 2.5])
def test_box_about_encloses_pose_and_has_its_heading(yaw):
    place = np.array([7.0, -3.0, -1.7])
    pose = standing(yaw, place)
    box = box_about(pose, np.inf)
    assert abs(np.angle(np.exp(1j * (box.yaw - yaw)))) < 1e-3
    # 0.15 m of margin around the joints: (depth, width, height)
    np.testing.assert_allclose(box.size, [0.1 + 0.3, 0.64 + 0.3, 1.52 + 0.3], atol=1e-3)
    assert box.contains(pose.joints).all() and box.center[2] == pytest.approx(-1.7 + 0.84 + 0.03, abs=1e-3)
    # the box is narrower next to another person
    np.testing.assert_allclose(box_about(pose, 0.6).size[:2], box.size[:2] - 0.1, atol=1e-3)


def test_inside_column_limits():
    center, size = np.array([5.0, 2.0, 1.0]), np.array([0.8, 0.8, 1.8])
    sides = [[0.59, 0, 0], [0, -0.59, 0], [0.61, 0, 0], [0.5, 0.5, 0]]
    heights = [[0, 0, -0.9 - 0.14], [0, 0, -0.9 - 0.16], [0, 0, 0.9 + 0.24], [0, 0, 0.9 + 0.26]]
    is_inside = inside_column(center + np.array(sides + heights), center, size)
    assert is_inside.tolist() == [True, True, False, False, True, False, True, False]


def detections_at(*places):
    count = len(places)
    sizes, logit = np.full((count, 3), [0.8, 0.8, 1.8]), np.arange(float(count))
    return Detections(
        centers=np.array(places),
        sizes=sizes,
        logit=logit,
        score=logit,
        mounted=logit,
        ground=None,
        base=0.0,
        has_ground=True,
    )


def test_verification_features_and_score_bound(monkeypatch):
    """Columns with fewer than five points are not verified."""
    places = [(5.0, 0.0, 1.0), (9.0, 0.0, 1.0), (13.0, 0.0, 1.0)]
    clouds = {
        k: np.repeat([place], count, axis=0) for k, (place, count) in enumerate(zip(places, (9, 4, 20), strict=True))
    }
    outputs = {9: [20.0, 0.0], 20: [-2.0, np.log(3)]}

    class Verifier:
        batch = 8

        def run(self, clouds, view):
            return SimpleNamespace(person=np.array([outputs[len(cloud)] for cloud in clouds]))

    monkeypatch.setattr(verification, "bundled_backend", lambda name: Verifier())
    features, mounted = Crops(detections_at(*places), clouds, None).verdicts()
    np.testing.assert_allclose(features[:, 0], [0, 1, 2])
    np.testing.assert_allclose(features[:, 1], [6 + 0.2, np.nan, -2 - 0.02])
    np.testing.assert_allclose(features[:, 2], np.log([10, 5, 21]))
    np.testing.assert_allclose(mounted, [0.5, np.nan, 0.75])
    # the bound holds for any output of the verifier
    header = {"verification": {"bias": -1.0, "logit": 1.0, "verifier": 0.5, "log_points": 0.1}}
    highest = verification._highest_score(detections_at(*places), header)
    for odds in (-6.5, 0.0, 6.5):
        for log_points in np.log1p([5, 100, 1e5]):
            possible = np.column_stack([np.arange(3.0), np.full(3, odds), np.full(3, log_points)])
            assert (verification.final_score(possible, header) <= highest).all()


def test_posed_rows_have_the_mean_of_two_passes():
    """The slow way, one person at a time; other rows and columns with under five points have no pose."""
    rng, estimator = np.random.default_rng(0), PoseEstimator(bundled_backend(DEFAULT))
    person = Generator(scene=replace(scene_config("wild"), sensors=("os1-128",)), measure=False).person(5, 3).sample
    centers = person.box.center + rng.normal(0, 0.05, (4, 3))
    clouds = [person.points.astype(float), person.points.astype(float)[::2], person.points[:4], person.points]
    joints = verification._posed(clouds, centers, np.zeros(3), np.array([0, 1, 2])).joints
    assert np.isnan(joints[2:]).all()
    for i in (0, 1):
        first = estimator._transformed(MIRRORED, [clouds[i]], centers[[i]], np.zeros(3), None)
        shift = np.round(first.joints[:, BODY26.index("pelvis")], 2)
        second = estimator.outputs([clouds[i]], centers[[i]] + shift, np.zeros(3))
        second = replace(second, joints=second.joints + shift)
        np.testing.assert_allclose(joints[i], average([second, first]).joints[0] + centers[i], atol=1e-4)


def fitted(monkeypatch, scores, places, mounted=0.0, sure=0.5, known=None, fit=verification._fit_boxes):
    """Boxes of standing people at places (x, y), fitted to a grid of points around all of them."""
    network = SimpleNamespace(header=SimpleNamespace(skeleton=HUMAN15))
    monkeypatch.setattr(verification, "bundled_backend", lambda name: network)
    joints = np.array([standing(0.0, np.array([*place, 0.0])).joints for place in places])
    axes = np.arange(-3, 3, 0.1), np.arange(-3, 3, 0.1), np.arange(0, 1.8, 0.1)
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    detections = verification._ScoredDetections(
        scores=np.array(scores), logits=np.array(scores), mounted=np.broadcast_to(mounted, len(scores)), joints=joints,
        pelvises=joints[:, HUMAN15.index("pelvis")], near_rows=[np.arange(len(points))] * len(scores),
    )  # fmt: skip
    people = fit(detections, points, sure, known or {})
    for _, box, rows in people:
        if not known:
            np.testing.assert_array_equal(rows, np.flatnonzero(box.contains(points)))
    return people


def test_fit_boxes_keeps_score_and_mounted_without_duplicates(monkeypatch):
    people = fitted(monkeypatch, [0.6, 0.9, 0.7], [(0, 0), (0, 2), (0.2, 2)], mounted=[0.4, 0.6, 0.1])
    # the third detection duplicates the second
    assert [(row, box.score, box.mounted) for row, box, _ in people] == [(1, 0.9, True), (0, 0.6, False)]


def test_fit_boxes_keeps_person_whose_points_are_in_anothers_box_but_not_on_the_body(monkeypatch):
    network = SimpleNamespace(header=SimpleNamespace(skeleton=HUMAN15))
    monkeypatch.setattr(verification, "bundled_backend", lambda name: network)
    joints = np.array([standing(0.0, np.array([0.0, y, 0.0])).joints for y in (0.0, 0.32)])
    pelvises = joints[:, HUMAN15.index("pelvis")]
    axes = np.linspace(-0.05, 0.05, 4), np.linspace(0.33, 0.38, 4), np.linspace(0.05, 0.5, 6)
    shin = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    first = joints[0].repeat(5, 0)
    points = np.concatenate([first, shin])
    values = {name: np.array([0.9, 0.6]) for name in ("scores", "logits", "mounted")}
    near_rows = [np.arange(len(points))] * 2
    places = verification._ScoredDetections(**values, joints=joints, pelvises=pelvises, near_rows=near_rows)
    people = verification._fit_boxes(places, points, 0.5, {})
    assert [row for row, _, _ in people] == [0, 1] and people[0][1].contains(shin).all()
    # on the body
    points[-len(shin) :] = joints[0, HUMAN15.index("left_shoulder")]
    assert [row for row, _, _ in verification._fit_boxes(places, points, 0.5, {})] == [0]


@pytest.mark.parametrize(("scores", "narrow"), [((0.9, 0.6), (1, 1)), ((0.9, 0.4), (0, 1)), ((0.4, 0.3), (0, 1))])
def test_fit_boxes_narrows_boxes_beside_neighbors(scores, narrow, monkeypatch):
    people = fitted(monkeypatch, scores, [(0, 0), (0, 0.6)])
    widths = [0.64 + 2 * (0.1 if is_narrow else 0.15) for is_narrow in narrow]
    np.testing.assert_allclose([box.size[1] for _, box, _ in people], widths, atol=1e-3)


def test_dropped_duplicates_do_not_narrow_boxes(monkeypatch):
    def without(people, *_):
        return [person for person in people if person[0] != 1]

    def distinct(places, points, sure, known):
        return verification._distinct_people(places, points, None, sure, known)

    monkeypatch.setattr(verification, "_without_repeats", without)
    ((row, box, _),) = fitted(monkeypatch, [0.9, 0.6], [(0, 0), (0, 0.6)], fit=distinct)
    assert row == 0 and box.size[1] == pytest.approx(0.64 + 2 * 0.15, abs=1e-3)


def test_fit_boxes_keeps_known_box(monkeypatch):
    box = Box(center=(0, 0, 0.9), size=(0.6, 0.6, 1.8), mounted=True)
    ((row, kept, rows),) = fitted(monkeypatch, [0.9], [(0, 0)], known={0: box})
    assert row == 0 and kept.mounted and kept.score == 0.9
    np.testing.assert_array_equal(kept.size, box.size)
    # with a margin of 15 cm: 9 x 9 columns of the grid
    assert len(rows) == 9 * 9 * 18


def test_on_people_uses_bones_or_known_boxes(monkeypatch):
    monkeypatch.setattr(
        verification, "bundled_backend", lambda name: SimpleNamespace(header=SimpleNamespace(skeleton=HUMAN15))
    )
    joints = np.stack([standing(0.0, np.array([x, 0.0, 0.0])).joints for x in (0.0, 5.0)])
    # at the left knee, 17 and 19 cm in front of it, between bones, and two points far from the first person
    points = np.array([[0, 0.1, 0.5], [0.19, 0.1, 0.5], [0.21, 0.1, 0.5], [0.05, 0.32, 0.5], [0, 0, 3], [5, 1, 1]])
    places = SimpleNamespace(joints=joints, near_rows=[np.array([4, 3, 2, 1, 0]), np.array([5])])
    box = Box(center=(0, 0, 1), size=(1, 1, 2))
    people = [(0, box, np.array([0])), (1, box, np.array([5]))]
    known = verification._on_people(places, people, points, {1: box})
    assert known.tolist() == [True, True, False, False, False, True]
    assert verification._on_people(places, people, points, {}).tolist() == [True, True, False, False, False, False]


def test_joined_detections_map_rows_to_all_points():
    def scored(count, rows):
        values = {name: np.arange(float(count)) for name in ("scores", "logits", "mounted")}
        places = {"joints": np.zeros((count, 15, 3)), "pelvises": np.zeros((count, 3))}
        return verification._ScoredDetections(**values, **places, near_rows=rows)

    some = scored(1, [np.array([0, 2])])
    joined = scored(2, [np.array([3]), np.array([1, 2])]).joined(some, np.array([4, 6, 9]))
    assert [rows.tolist() for rows in joined.near_rows] == [[3], [1, 2], [4, 9]] and joined.joints.shape == (3, 15, 3)
    assert joined.scores.tolist() == [0, 1, 0]


def test_known_people_keep_the_score_of_their_verification():
    box = Box(center=(5, 0, 1), size=(0.6, 0.6, 1.8), score=0.7, mounted=True)
    places = box.center[None]
    known = KnownPlaces(boxes=[box], pelvises=places, tracks=places, reach=np.ones(1), rejected=np.zeros((0, 3)))
    points = np.random.default_rng(0).uniform((4.8, -0.2, 0.2), (5.2, 0.2, 1.8), (50, 3))
    people = verification.verified(detections_at((5.1, 0, 1)), points, None, {}, 0.5, known=known)
    ((kept, is_verified),) = zip(people.boxes, people.verified, strict=True)
    assert (kept.score, kept.mounted, is_verified) == (0.7, True, False) and not len(people.rejected)


def test_thresholds_of_known_places_posing_and_neighbors(monkeypatch):
    asked, posed_from = [], []
    header = {"verification": {"logit": 1.0, "verifier": 0.0}, "default_score": 0.75}
    scored = verification._score_detections
    monkeypatch.setattr(verification, "_score_detections", lambda *of: posed_from.append(of[4].tolist()) or scored(*of))
    monkeypatch.setattr(verification, "_distinct_people", lambda *of: asked.append(of[3]) or [])
    known = SimpleNamespace(boxes=[], pelvises=np.zeros((0, 3)))
    known.index_of = lambda centers, is_sure: asked.append(is_sure.tolist()) or np.array([-1, -1])
    known.least_scores = lambda centers, index, least: np.full(2, least)
    given = detections_at((5.0, 0, 1), (9.0, 0, 1)), np.zeros((0, 3)), None, header, 0.6
    verification.verified(*given, known=known)
    # the scores of these detections are at most 0.5 and 0.73
    assert asked == [[False, True], 0.75] and posed_from == [[0.6, 0.6]]
    # surer ones than the threshold are posed if people beside them are searched for
    verification.verified(*given, detect_beside=lambda *_: None)
    assert posed_from[1] == [0.5, 0.5]
