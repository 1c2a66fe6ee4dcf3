"""Evaluation of detectors: matching, recall at a number of false positives per scan, and the command."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st

from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.eval.detector import detection_pictures, evaluate_detector as run_module
from lidarpose.eval.detector.detection_scores import (
    CONDITIONS,
    FALSE,
    MATCH_RADIUS,
    NEITHER,
    OF_SCAN,
    PERSON,
    _groups_of_people,
    average_precision,
    exclusive_thresholds,
    match,
    score_detector,
    score_scan,
)
from lidarpose.eval.detector.labeled_scans import LabeledScan, ScanSet, heldout_scans, labeled_scans, synthetic_scan
from lidarpose.models.detector.detector import Detector
from lidarpose.sample import Box

SIZE = (0.8, 0.8, 1.8)


def row_of(result, figure, at="", group="all", of="all"):
    keys = {"figure": figure, "at": at, "group": group, "of": of}
    return next(row for row in result.rows if keys.items() <= row.items())


def box(x, y, height=1.8):
    return Box(center=(x, y, height / 2 - 1.7), size=(0.8, 0.8, height))


def scan(people, **more):
    """A labeled scan with a point cloud per person, each given as a dict or as x."""
    people = [{"x": entry} if isinstance(entry, float | int) else entry for entry in people]
    boxes = [box(entry["x"], entry.get("y", 0.0), entry.get("height", 1.8)) for entry in people]
    rng = np.random.default_rng(0)
    clouds = [own.center + rng.uniform(-0.3, 0.3, (60, 3)) for own in boxes]
    about = {
        "name": "made",
        "points": np.concatenate([*clouds, np.zeros((0, 3))]),
        "origin": np.zeros(3),
        "boxes": boxes,
        "num_points": np.array([entry.get("points", 60) for entry in people], int),
        "is_person": np.array([entry.get("is_person", True) for entry in people], bool),
        "mounted": np.array([entry.get("mounted", False) for entry in people], bool),
    }
    return LabeledScan(**about | more)


def scan_set(scans):
    return ScanSet(name="made", loaders=[lambda own=own: own for own in scans])


def answers(*scans):
    """A detector that returns the given (x, score) pairs, one list per call."""
    left = iter(scans)

    def detect(points, origin):
        found = next(left)
        return [box(x, 0.0) for x, _ in found], np.array([score for _, score in found])

    return detect


# ---- matching

places = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), max_size=7).map(lambda p: np.array(p).reshape(-1, 2))


def match_reference(centers, scores, people, wanted):
    """`match`, one pair at a time."""
    of_person = [-1] * len(centers)
    for d in sorted(range(len(centers)), key=lambda d: -scores[d]):
        for only_wanted in (True, False):
            best = None
            for p in range(len(people)):
                # the same arithmetic as in `match`, because squares of tiny distances underflow
                away = np.linalg.norm(centers[d] - people[p : p + 1], axis=1)[0]
                usable = p not in of_person and away <= MATCH_RADIUS and (wanted[p] or not only_wanted)
                if usable and (best is None or away < best[0]):
                    best = (away, p)
            if best is not None:
                of_person[d] = best[1]
                break
    return of_person


@given(places, places, st.data())
def test_match_is_one_to_one_within_radius_and_complete(centers, people, data):
    scores = np.array(
        data.draw(st.lists(st.sampled_from([0.1, 0.5, 0.9]), min_size=len(centers), max_size=len(centers)))
    )
    wanted = np.array(data.draw(st.lists(st.booleans(), min_size=len(people), max_size=len(people))), bool)
    of_person = match(centers, scores, people, wanted)
    assert of_person.tolist() == match_reference(centers, scores, people, wanted)
    matched = of_person >= 0
    assert len(set(of_person[matched])) == matched.sum()
    assert (np.linalg.norm(centers[matched] - people[of_person[matched]], axis=1) <= MATCH_RADIUS).all()
    free = np.setdiff1d(np.arange(len(people)), of_person)
    assert (np.linalg.norm(centers[~matched][:, None] - people[free][None], axis=-1) > MATCH_RADIUS).all()


def test_score_scan_counts_second_detection_as_false_positive():
    own = scan([5.0])
    people, detections = score_scan(0, own, [box(5.0, 0.0), box(5.3, 0.0)], np.array([0.4, 0.8]), max_range=40)
    assert detections.status.tolist() == [FALSE, PERSON]
    assert people.score.tolist() == [0.8] and people.detection.tolist() == [1]


def test_score_scan_ignores_few_points_objects_and_far_people():
    own = scan([{"x": 5, "points": 9}, {"x": 10, "is_person": False}, 45, {"x": 15, "mounted": True}, 20])
    hidden = replace(own, num_points=own.num_points * [0, 1, 1, 1, 1])
    found = [box(x, 0.0) for x in (5, 10, 45, 50, 15, 20, 30)]
    people, detections = score_scan(0, own, found, np.linspace(0.9, 0.3, 7), max_range=40)
    assert detections.status.tolist() == [NEITHER] * 4 + [PERSON, PERSON, FALSE]
    # a detection at a person without points is a false positive
    assert score_scan(0, hidden, found, np.ones(7), max_range=40)[1].status[0] == FALSE
    assert people.person.tolist() == [3, 4] and people.mounted.tolist() == [True, False]


def test_score_scan_matches_scored_people_first():
    own = scan([{"x": 5.0, "points": 3}, 5.4])
    people, detections = score_scan(0, own, [box(5.0, 0.0)], np.array([0.5]), max_range=40)
    assert people.detection.tolist() == [0] and detections.status.tolist() == [PERSON]


def test_score_scan_conditions_and_things_of_false_positives():
    points = np.concatenate([box(x, 0).center + np.random.default_rng(1).uniform(-0.3, 0.3, (40, 3)) for x in (5, 20)])
    thing, person = np.repeat([-1, 1], 40), np.repeat([0, -1], 40)
    about = {"points": points, "thing": thing, "things": ("hedge", "pillar"), "person": person}
    own = scan([{"x": 5}, {"x": 5.8, "height": 1.2}, 20.3], **about)
    found = [box(5.0, 0), box(4.4, 0), box(19.5, 0), box(20.0, 0), box(30.0, 0)]
    people, detections = score_scan(0, own, found, np.linspace(0.9, 0.5, 5), max_range=40)
    assert people[list(CONDITIONS)].to_numpy(int).tolist() == [[1, 0, 0, 0], [1, 0, 1, 0], [0, 1, 0, 0]]
    false = detections[detections.status == FALSE]
    assert false.thing.tolist() == ["part of a person", "pillar", "no points"]


def test_conditions_of_things_need_labeled_things():
    own = scan([{"x": 5}, {"x": 5.8, "height": 1.2}])
    people, _ = score_scan(0, own, [], np.zeros(0), max_range=40)
    assert [name for name in CONDITIONS if name in people] == ["person within 1 m", "under 1.4 m tall"]
    result = score_detector(answers([(5.0, 0.9)]), scan_set([own]))
    recall = {row["of"] for row in result.rows if (row["figure"], row["group"]) == ("recall", "condition")}
    assert recall == {"person within 1 m", "under 1.4 m tall"}


# ---- recall


def ten_scans():
    """Ten scans of two people, with 60 and 15 points, and a false positive; scores fall with the scan's number."""
    scans, found = [], []
    for k in range(10):
        people = [5, {"x": 10, "points": 15}]
        scans.append(scan(people, sensor="a" if k < 5 else "b", activities=("walk", "sit")))
        found.append([(5.1, 0.95 - 0.05 * k), (30.0, 0.93 - 0.05 * k)] + [(10.2, 0.2)] * (k == 9))
    return scan_set(scans), answers(*found)


def test_score_detector_recall_equals_counting():
    scans, detect = ten_scans()
    result = score_detector(detect, scans, default_score=0.69)
    # three false positives in ten scans, of scores 0.93, 0.88 and 0.83, lie above the detection of the fifth person
    assert row_of(result, "recall", "0.3")["value"] == 100 * 4 / 20
    assert row_of(result, "recall", "0.3", "points", "50 and more")["value"] == 40
    assert row_of(result, "recall", "0.3", "points", "10 to 20")["value"] == 0
    assert row_of(result, "recall", "1", "points", "10 to 20")["value"] == 10
    assert row_of(result, "recall", "1")["value"] == 55 and row_of(result, "recall", "10")["value"] == 55
    assert row_of(result, "recall", "0.3", "sensor, 50 points and more", "a")["value"] == 80
    assert row_of(result, "recall", "0.3", "distance, m", "0 to 10")["value"] == 40
    assert row_of(result, "recall", "0.3", "activity", "walk")["value"] == 40
    assert result.thresholds["0.3"] == pytest.approx(0.78) and result.thresholds["0.3"] > 0.93 - 0.05 * 3
    assert result.thresholds["default"] == 0.69
    assert row_of(result, "recall", "default")["value"] == 100 * 6 / 20
    assert row_of(result, "false_people", "0.3")["value"] == 0.3
    assert row_of(result, "false_people", "0.3", "sensor", "a")["value"] == 0.6
    assert row_of(result, "false_people", "1", "worst", "scan")["value"] == 1
    row = row_of(result, "recall", "1", "points", "10 to 20")
    assert row["low"] == 0 and 10 <= row["high"] <= 50 and row["count"] == 10
    # there is no interval if none or all are found in each draw
    row = row_of(result, "recall", "0.3", "points", "10 to 20")
    assert row["low"] is None and row["high"] is None
    # at a recall of k / 20, k of 2 k - 1 detections are people
    expected = sum(k / (2 * k - 1) for k in range(1, 11)) / 20 + (11 / 21) / 20
    assert row_of(result, "average_precision")["value"] == pytest.approx(100 * expected, abs=0.01)


def test_score_detector_reports_mounted_people_separately():
    others = [scan([5, {"x": 10, "mounted": True}]), scan([5, {"x": 10, "mounted": True}])]
    result = score_detector(answers([(5, 0.9), (10, 0.8)], [(5, 0.7)]), scan_set(others))
    assert row_of(result, "recall", "1")["value"] == 100 and row_of(result, "recall", "1")["count"] == 2
    assert row_of(result, "recall", "1", "mounted, all")["value"] == 50
    assert row_of(result, "average_precision")["value"] == 100 and row_of(result, "false_people", "10")["value"] == 0
    assert row_of(result, "said_mounted", "1", "mounted")["value"] == 0


def test_score_detector_said_mounted_for_riders_and_pedestrians():
    scans = scan_set([scan([5, {"x": 10, "mounted": True}, {"x": 15, "mounted": True}, 20])])
    plain = answers([(5, 0.9), (10, 0.8), (15, 0.7), (20, 0.1), (30, 0.6)])

    def detect(points, origin):
        boxes, scores = plain(points, origin)
        return [replace(box, mounted=box.center[0] in (10, 20, 30)) for box in boxes], scores

    result = score_detector(detect, scans, default_score=0.5)
    shares = {group: row_of(result, "said_mounted", "default", group) for group in ("mounted", "on foot")}
    assert shares["mounted"]["value"] == 50 and shares["mounted"]["count"] == 2
    # people below the default score are not counted
    assert shares["on foot"]["value"] == 0 and shares["on foot"]["count"] == 1
    assert row_of(result, "said_mounted", "10", "on foot")["value"] == 50


def test_calibration_error_uses_people_and_false_positives():
    scans = scan_set([scan([5, 10, {"x": 15, "points": 2}])])
    found = [(5, 0.75), (30, 0.75), (10, 1.0), (15, 0.4), (35, 0.0), (38, 0.0)]
    result = score_detector(answers(found), scans, default_score=1.0)
    # detections of score 0 are not counted
    assert row_of(result, "calibration_error")["value"] == pytest.approx(100 * (2 * 0.25) / 3, abs=0.01)
    assert row_of(result, "calibration_error")["count"] == 3
    assert result.reliability == [
        {"score": 0.0, "people": 0.0, "detections": 2},
        {"score": 0.75, "people": 0.5, "detections": 2},
        {"score": 1.0, "people": 1.0, "detections": 1},
    ]


@given(
    st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0.1, 0.2, 0.5, 0.8])), max_size=12),
    st.lists(st.integers(0, 3), min_size=4, max_size=4).filter(any),
    st.sampled_from([0.3, 1.0, 3.0]),
)
def test_exclusive_thresholds_are_lowest_within_budget(found, weights, budget):
    false = pd.DataFrame(found, columns=["scan", "score"]).sort_values("score", ascending=False)
    weights = np.array([weights])

    def above(bound):
        return sum(weights[0, k] for k, score in found if score > bound)

    bound = exclusive_thresholds(false, weights, budget)[0]
    assert above(bound) <= budget * weights.sum()
    lower = [other for other in (-1.0, *false.score) if other < bound]
    assert all(above(other) > budget * weights.sum() for other in lower)


def test_average_precision_ignores_order_of_equal_scores():
    detections = pd.DataFrame({"scan": 0, "score": [0.5] * 4, "status": [PERSON, FALSE, FALSE, PERSON]})
    people = pd.DataFrame({"scan": [0, 0, 0, 0]})
    for order in ([0, 1, 2, 3], [1, 2, 0, 3]):
        assert average_precision(detections.iloc[order], people, np.ones((1, 1))) == 0.5 * 0.5


def test_score_detector_compares_poses_in_found_and_given_boxes():
    joints = np.stack([np.full((26, 3), (5.0, 0, 0)), np.full((26, 3), (10.0, 0, 0))])

    def predict(points, *, boxes, sensor_origin, skeleton):
        assert skeleton == "human15" and (sensor_origin == 0).all()
        joints = [np.tile(own.center * [1, 1, 0], (15, 1)) for own in boxes]
        return [SimpleNamespace(has_pose=own[0, 0] < 9, joints=own) for own in joints]

    predictor = SimpleNamespace(predict=predict)
    scans = scan_set([scan([5, 10], joints=joints)])
    result = score_detector(answers([(5.03, 0.9), (10.0, 0.8)]), scans, predictor=predictor)
    values = [row_of(result, name, "1") for name in ("mpjpe_found", "mpjpe_given", "mpjpe_difference")]
    assert [row["value"] for row in values] == pytest.approx([30, 0, 30]) and values[0]["count"] == 1


def test_score_detector_passes_unknown_sensor_to_poses():
    origins = []

    def predict(points, *, boxes, sensor_origin, skeleton):
        origins.append(sensor_origin)
        return [SimpleNamespace(has_pose=True, joints=np.zeros((15, 3))) for _ in boxes]

    scans = scan_set([scan([5], joints=np.zeros((1, 26, 3)))])
    predictor = SimpleNamespace(predict=predict)
    score_detector(answers([(5, 0.9)]), scans, predictor=predictor, sensor_unknown=True)
    assert origins == ["unknown"] * 2


def test_score_detector_rejects_scans_without_people():
    with pytest.raises(InputError, match="made has no people of 10 or more points within 3 m"):
        score_detector(answers([]), scan_set([scan([5])]), max_range=3.0)


# ---- the frozen scenes


def test_heldout_scans_are_labeled_and_changes_are_counted():
    scans = heldout_scans(limit=120)
    first = scans.loaders[2]()
    wanted = first.num_points >= 10
    assert scans.name == "heldout" and len(scans.loaders) == 120 and wanted.any() and not first.changed
    assert len(first.joints) == len(first.boxes) == len(first.activities) == len(first.mounted)
    of_person = [(first.person == k).sum() for k in range(len(first.boxes))]
    assert first.num_points.tolist() == of_person and first.thing.max() < len(first.things)

    def perfect(points, origin):
        return first.boxes, np.where(wanted, 0.9, 0.2)

    other = replace(first, changed=True)
    result = score_detector(perfect, scan_set([first, other]), max_range=100)
    # another person's detection can be nearer only if two people stand in one place
    assert row_of(result, "recall", "0.3")["value"] == 100 and result.changed == 1 and not result.things


@pytest.mark.long
@pytest.mark.parametrize(
    "number, scores",
    [
        (0, [0.999, 0.013, 0.992, 0.901, 0.999, 0.707, 0.999, 0.999, 0.999, 0.956, -np.inf, 0.993]),
        (7, [0.17, 0.633, 0.973]),
        (184, [0.976, 0.974, 0.836]),
        (205, [0.999, 0.999, 0.994, 0.997, 0.98, 0.999, 0.999, 0.999, 0.999, 0.999, 0.926]),
    ],
)
def test_detector_scores_people_of_frozen_scenes_as_stored(number, scores):
    # if these change, the tables of docs/results.md are out of date: run lidarpose evaluate detector again
    scene = heldout_scans().loaders[number]()
    boxes, found = run_module.detector_of("detector", None, max_range=40.0)(scene.points, scene.origin)
    people, _ = score_scan(number, scene, boxes, found, max_range=40.0)
    np.testing.assert_allclose(people.score, scores, atol=0.05)


# ---- methods


@pytest.mark.parametrize("method", run_module.METHODS)
def test_methods_find_single_person_on_plane(method):
    def most_points(arrays):
        count = arrays["scalars"][:, 2]
        return np.stack([4 * count, *np.zeros((3, len(count))), 1.7 + 0 * count, -9 + 0 * count], 1).astype(np.float32)

    fake_detector = Detector(most_points)
    fake_detector.header |= {"version": "0", "default_score": 0.5, "calibration": [[-9.0, 9.0], [0.0, 1.0]]}
    plane = np.stack(np.meshgrid(np.arange(-3, 12, 0.2), np.arange(-6, 6, 0.2), [-1.7]), -1).reshape(-1, 3)
    own = scan([5.0])
    body = np.random.default_rng(2).uniform(-1, 1, (300, 3)) * [0.2, 0.25, 0.85] + [5.0, 0, -0.85]
    boxes, scores = run_module.detector_of(method, fake_detector, max_range=20.0)(
        np.concatenate([plane, body]), np.zeros(3)
    )
    people, _ = score_scan(0, own, boxes, scores, max_range=20)
    assert people.detection.tolist() == [int(np.argmax(scores))] and (0 <= scores).all() and (scores <= 1).all()


# ---- the command


@pytest.mark.parametrize("method", run_module.METHODS)
def test_methods_reject_infinite_range(method):
    with pytest.raises(InputError, match="max_range .--range.: expected meters"):
        run_module.run_detector(method, max_range=np.inf, limit=1)


def write_scans(folder):
    """Two scans: one of two people and a stroller, one of a rider; both with a false positive."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    for name, xs, categories in (
        ("a", (5, 8, 12), ("PEDESTRIAN", "PEDESTRIAN", "STROLLER")),
        ("b", (6,), ("BICYCLIST",)),
    ):
        clouds = [box(x, 0).center + rng.uniform(-0.3, 0.3, (60, 3)) for x in (*xs, 20)]
        np.save(folder / f"{name}.npy", np.concatenate(clouds).astype(np.float32))
        people = [
            {"center": [x, 0, -0.8], "size": SIZE, "category": category}
            for x, category in zip(xs, categories, strict=True)
        ]
        people[0]["num_points"] = 12
        (folder / f"{name}.json").write_text(json.dumps({"sensor": "os1-32", "people": people}))


def fake(points, origin):
    """A detection at each whole meter with points on the x axis, with scores that fall with distance."""
    found = sorted(set(np.round(points[:, 0]).tolist()) - {12.0})
    assert origin is not None
    return [box(x, 0.0) for x in found], np.array([0.9 - 0.03 * x for x in found])


def test_evaluate_detector_command_scores_labeled_scans(tmp_path, capsys, monkeypatch):
    write_scans(tmp_path / "labeled")
    monkeypatch.setattr(run_module, "detector_of", lambda method, detector, max_range: fake)
    arguments = ["evaluate", "detector", "--method", "pose", "--scans", str(tmp_path / "labeled"), "--range", "30"]
    arguments += ["--out", str(tmp_path / "out"), "--pictures", str(tmp_path / "look")]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("labeled: 2 scans; recall") and "mounted, all" in printed and "at 0.3 (score" in printed
    document = json.loads((tmp_path / "out" / "detector.json").read_text())
    assert document["schema"] == "lidarpose.detector-scores/1" and document["max_range"] == 30
    assert document["command"].startswith("lidarpose evaluate detector --scans ")
    rows = document["results"][0]["rows"]
    recall = {(row["at"], row["group"], row["of"]): row for row in rows if row["figure"] == "recall"}
    assert recall["1", "points", "10 to 20"]["count"] == 1 and recall["1", "points", "50 and more"]["value"] == 100
    assert recall["1", "sensor", "os1-32"]["value"] == 100 and recall["1", "mounted, all", "all"]["value"] == 100
    false = next(row for row in rows if (row["figure"], row["at"], row["group"]) == ("false_people", "1", "all"))
    assert false["value"] == 1
    # no person is missed, so there is no picture of missed people
    assert [path.name for path in (tmp_path / "look").iterdir()] == ["labeled-false.png"]
    assert next((tmp_path / "look").iterdir()).read_bytes().startswith(b"\x89PNG")


def test_evaluate_detector_command_draws_missed_people(tmp_path, monkeypatch):
    write_scans(tmp_path / "labeled")
    monkeypatch.setattr(
        run_module, "detector_of", lambda method, detector, max_range: lambda points, origin: ([], np.zeros(0))
    )
    arguments = ["evaluate", "detector", "--method", "pose", "--scans", str(tmp_path / "labeled")]
    assert main([*arguments, "--out", str(tmp_path / "out"), "--pictures", str(tmp_path / "look")]) == 0
    assert [path.name for path in (tmp_path / "look").iterdir()] == ["labeled-missed.png"]
    rows = json.loads((tmp_path / "out" / "detector.json").read_text())["results"][0]["rows"]
    assert {row["value"] for row in rows if row["figure"] == "recall"} <= {0, None}


def test_labeled_scans_match_whole_category_names(tmp_path):
    on_foot = "PEDESTRIAN human.pedestrian.police_officer TYPE_PEDESTRIAN Person_sitting OFFICIAL_SIGNALER".split()
    mounted = ["BICYCLIST", "WHEELED_RIDER", "human.pedestrian.wheelchair", "Cyclist"]
    neither = ["STROLLER", "human.pedestrian.stroller", "vehicle.bicycle", "MOTORCYCLE", "static_object.bicycle_rack"]
    absent = ["MOBILE_PEDESTRIAN_CROSSING_SIGN", "vehicle.car", "BOLLARD", "bus driver"]
    names = [*absent, *on_foot, *mounted, *neither]
    people = [{"center": [3 * k, 0, 0], "size": SIZE, "category": name} for k, name in enumerate(names)]
    np.save(tmp_path / "a.npy", np.zeros((1, 3), np.float32))
    (tmp_path / "a.json").write_text(json.dumps({"people": people}))
    # results of `detect` and `predict` are not labels
    for name in ("a.boxes.json", "a.poses.json"):
        (tmp_path / name).write_text(json.dumps({"people": []}))
    own = labeled_scans(tmp_path).loaders[0]()
    assert [box.center[0] / 3 for box in own.boxes] == list(range(len(absent), len(names)))
    shares = len(on_foot), len(mounted), len(neither)
    assert own.is_person.tolist() == np.repeat([True, True, False], shares).tolist()
    assert own.mounted.tolist() == np.repeat([False, True, False], shares).tolist()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            ["detector", "heldout", "bench"],
            "expected heldout or nothing as the detector's dataset, got bench: use --scans",
        ),
        (["detector", "--protocol", "dapt"], "--protocol is an option for pose networks, got the detector: omit it"),
        (["detector", "--method", "yolo"], "method"),
        (["detector", "--limit", "0"], "limit must be a whole number of at least 1, got 0"),
        (
            ["small", "bench", "--range", "20"],
            "--range is an option of lidarpose evaluate detector, got the network small",
        ),
        (["small"], "expected a dataset to evaluate on"),
        (["detector", "--scans", "."], "expected labeled scans"),
    ],
)
def test_evaluate_command_rejects_invalid_options(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_labeled_scans_take_null_as_absent_and_reject_other_types(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((1, 3), np.float32))

    def read(person, **document):
        people = [{"center": [0, 0, 0], "size": SIZE} | person]
        (tmp_path / "a.json").write_text(json.dumps({"people": people} | document))
        return labeled_scans(tmp_path).loaders[0]()

    own = read({"category": None, "num_points": None}, sensor=None, kind=None)
    assert own.is_person.tolist() == [True] and own.num_points.tolist() == [1] and own.sensor == own.kind == ""
    for value in (3, ["PEDESTRIAN"]):
        for name in ("category", "sensor", "kind"):
            entry = {name: value}
            with pytest.raises(InputError, match=rf"a\.json.*expected text as {name}, got"):
                read(entry) if name == "category" else read({}, **entry)


def test_labeled_scans_may_have_kind_indoors(tmp_path):
    """It is also the name of all kinds of rooms together."""
    people = pd.DataFrame(
        {"mounted": False, "points": 60, "distance": 5.0, "activity": "", "kind": ["indoors", "room"]}
    )
    people = people.assign(**{name: "" for name in OF_SCAN if name != "kind"})
    groups = [(group, of) for group, of, _ in _groups_of_people(people)]
    assert len(groups) == len(set(groups)) and ("kind", "indoors") in groups
    (mask,) = (
        mask for group, of, mask in _groups_of_people(people.assign(kind="room")) if (group, of) == ("kind", "indoors")
    )
    assert mask.all()


def test_labeled_scans_rejects_missing_scan_and_wrong_labels(tmp_path):
    write_scans(tmp_path / "labeled")
    (tmp_path / "labeled" / "a.npy").unlink()
    with pytest.raises(InputError, match=r"a\.json.*expected its scan beside it"):
        labeled_scans(tmp_path / "labeled")
    (tmp_path / "labeled" / "a.json").unlink()
    path = tmp_path / "labeled" / "b.json"
    content = json.loads(path.read_text())
    for key, value, message in (
        *(("num_points", value, "num_points") for value in ("many", float("inf"), 1e30, -1)),
        ("sensor_origin", "here", "sensor origin"),
        *(("up", value, "z up, got up") for value in ("-z", 3)),
    ):
        changed = json.loads(json.dumps(content))
        (changed["people"][0] if key == "num_points" else changed)[key] = value
        path.write_text(json.dumps(changed))
        with pytest.raises(InputError, match=rf"b\.json.*{message}"):
            labeled_scans(tmp_path / "labeled").loaders[0]()
    # the up axis of a lidarpose document and of a single box
    for changed in (
        content | {"schema": "lidarpose.boxes/1", "up": "-y"},
        {"people": [content["people"][0] | {"up": "x"}]},
    ):
        path.write_text(json.dumps(changed))
        with pytest.raises(InputError, match=r"b\.json.*z up, got up"):
            labeled_scans(tmp_path / "labeled").loaders[0]()
    path.write_text(json.dumps(content | {"up": "z"}))
    assert len(labeled_scans(tmp_path / "labeled").loaders[0]().boxes) == 1


def test_score_detector_groups_by_mount_with_unknown_origin():
    scans = [scan([8.0, 12.0], height="under 1 m", tilt="under 3 degrees"), scan([9.0], height="1 to 2.2 m")]
    origins = []

    def detect(points, origin):
        origins.append(origin)
        return [box(8.0, 0.0), box(9.0, 0.0)], np.array([0.9, 0.8])

    result = score_detector(detect, scan_set(scans), sensor_unknown=True)
    assert origins == [None, None]
    recall = {name: row_of(result, "recall", "10", "height", name)["value"] for name in ("under 1 m", "1 to 2.2 m")}
    assert recall == {"under 1 m": 50.0, "1 to 2.2 m": 100.0}
    assert row_of(result, "recall", "10", "tilt", "under 3 degrees")["count"] == 2
    score_detector(detect, scan_set(scans))
    assert all(origin is not None for origin in origins[2:])
    # the mount of synthesized scenes is known
    made = synthetic_scan(0, 3)
    assert made.height.endswith(("m", "more")) and "degrees" in made.tilt


def test_run_detector_rejects_unused_file_and_repeated_names(tmp_path):
    with pytest.raises(InputError, match="a detector's file is for the methods detector and scorer, got candidates"):
        run_module.run_detector("candidates", weights=tmp_path / "x.onnx")
    with pytest.raises(InputError, match="two sets of scans are called heldout"):
        run_module.run_detector("candidates", heldout=True, folders=[_scans_called(tmp_path / "heldout")])


def _scans_called(folder):
    """A folder with one scan without people."""
    folder.mkdir()
    np.save(folder / "0.npy", np.random.default_rng(0).uniform(-9, 9, (50, 3)))
    (folder / "0.json").write_text('{"people": []}')
    return folder


def test_labels_that_are_no_people_and_things_above_are_no_company():
    own = scan([5, {"x": 5.5, "is_person": False}], things=("lamp",), person=np.full(122, -1))
    # a lamp above the person and the ground below
    points = np.concatenate([own.points, [[5, 0, 0.3], [5, 0, -1.75]]])
    own = replace(own, points=points, thing=np.repeat([-1, 0], [120, 2]))
    people, _ = score_scan(0, own, [], np.zeros(0), max_range=40)
    assert people[list(CONDITIONS)].to_numpy(int).tolist() == [[0, 0, 0, 1]]


def test_range_is_measured_from_the_sensor():
    own = scan([45.0, 5.0], origin=np.array([50.0, 0, 0]))
    people, detections = score_scan(0, own, [box(45, 0), box(8, 0)], np.array([0.9, 0.8]), max_range=40)
    assert (
        people.person.tolist() == [0]
        and people.distance.tolist() == [5]
        and detections.status.tolist() == ["person", "neither"]
    )


def test_people_of_exactly_the_default_score_are_found():
    result = score_detector(answers([(5, 0.5)]), scan_set([scan([5])]), default_score=0.5)
    assert row_of(result, "recall", "default")["value"] == 100


def test_scores_of_1_are_in_the_last_bin():
    result = score_detector(answers([(5, 0.96), (10, 1.0)]), scan_set([scan([5, 10])]))
    assert result.reliability == [{"score": 0.98, "people": 1.0, "detections": 2}]


def test_people_of_50_points_are_in_the_groups_of_50_and_more():
    people = pd.DataFrame({"mounted": False, "points": [49, 50], "distance": 5.0, "activity": ""})
    people = people.assign(**{name: "a" for name in OF_SCAN})
    masks = {(group, of): mask.tolist() for group, of, mask in _groups_of_people(people)}
    assert masks["kind, 50 points and more", "a"] == masks["points", "50 and more"] == [False, True]


def test_tilt_of_scenes_is_in_degrees(monkeypatch):
    names = "points origin boxes mounted activities sensor kind thing things person joints".split()
    up = np.array([0.0, np.sin(np.radians(5)), np.cos(np.radians(5))])
    scene = SimpleNamespace(**dict.fromkeys(names, ()), height=1.5, up=up, points_digest=str)
    scene.person = np.zeros(0, int)
    monkeypatch.setattr("lidarpose.synth.detection_scene.detection_scene", lambda *_, **__: scene)
    assert synthetic_scan(0, 0).tilt == "3 to 10 degrees" and synthetic_scan(0, 0).height == "1 to 2.2 m"


def test_only_the_detector_has_a_default_score(tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "score_detector", lambda *_, default_score, **__: default_score)
    folder = _scans_called(tmp_path / "a")
    found = [run_module.run_detector(name, heldout=False, folders=[folder])[0] for name in ("detector", "scorer")]
    assert found == [[Detector().header["default_score"]], [None]]


def test_candidates_are_ranked_by_their_order(monkeypatch):
    monkeypatch.setattr(run_module, "propose", lambda points, ground: np.array([[5.0, 0, -1.7], [9.0, 0, -1.7]]))
    boxes, scores = run_module.detector_of("candidates", None, max_range=20.0)(np.ones((9, 3)), np.zeros(3))
    assert [box.center[0] for box in boxes] == [5, 9] and scores.tolist() == [1, 0.5]


def test_crops_are_drawn_as_seen_from_the_sensor(monkeypatch):
    """What is to the right as seen from the sensor is drawn to the right."""
    views, own = [], scan([5])
    monkeypatch.setattr(detection_pictures, "_draw_crop", lambda ax, crop, right, up: views.append((right, up)))
    monkeypatch.setattr(detection_pictures, "png_of", lambda figure: b"")
    detection_pictures._sheet([detection_pictures._crop(own, own.boxes[0], ("a",))], "title")
    np.testing.assert_allclose(views, [[[0, -1, 0], [1, 0, 0]], [[0, -1, 0], [0, 0, 1]]], atol=1e-9)
