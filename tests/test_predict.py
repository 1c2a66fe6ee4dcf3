"""`predict` from Python: arrays, files, boxes, and warnings and errors for odd inputs."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

import lidarpose
from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_about, rotation_from_up, up_text
from lidarpose.inference import cloud_predictor, crop_search
from lidarpose.inference.backend import Raw
from lidarpose.inference.checks import flat_axis, is_lying, scan_unit_warning, unit_warning
from lidarpose.inference.crop_search import candidates, select_pose
from lidarpose.inference.inputs import MAX_POINTS, as_origin, clean
from lidarpose.inference.predict_scan import predictor_of
from lidarpose.inference.predictor import Predictor
from lidarpose.inference.result_panels import panels_of, person_label
from lidarpose.inference.results import PersonPose
from lidarpose.inference.scan import rows_inside
from lidarpose.io.boxes import read_boxes
from lidarpose.io.point_cloud import Cloud
from lidarpose.models import bundled_path
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import BODY26, SKELETONS, WAYMO14
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config

REAL = Path(__file__).parents[2] / "shared" / "data" / "real"


@pytest.fixture(scope="module")
def model():
    return lidarpose.load(tta=1)


@pytest.fixture(scope="module")
def standing():
    """A synthetic standing person, fully visible and without clutter, in the sensor's frame."""
    scene = replace(scene_config("wild").eased(0.0), sensors=("os1-128",), distance=(4.0, 8.0))
    generator = Generator(scene=scene)
    people = (generator.person(11, i) for i in range(64))
    return next(person for person in people if person.facts.plain)


@pytest.fixture(scope="module")
def points(standing):
    return standing.sample.points


def box_around(cloud, margin=0.05, **more):
    low, high = cloud.min(0), cloud.max(0)
    return {"center": ((low + high) / 2).tolist(), "size": (high - low + 2 * margin).tolist(), **more}


def records(points):
    """The points as records with another field first."""
    return np.rec.fromarrays([np.arange(len(points)), *points.T], names="ring,x,y,z")


def height(pose, joint):
    return pose.joints[pose.skeleton.index(joint), 2]


# ---- one array


def test_predict_easy_person_is_upright_and_accurate(model, standing):
    pose = model.predict(standing.sample.points)
    assert pose.joints.shape == (24, 3) and pose.confidence.shape == pose.spread.shape == (24,)
    assert height(pose, "head") > height(pose, "pelvis") > max(height(pose, "left_ankle"), height(pose, "right_ankle"))
    assert (pose.confidence >= 0).all() and (pose.confidence <= 1).all() and (pose.spread > 0).all()
    truth = standing.sample.pose.to(pose.skeleton)
    # the bundled weights have an error of 25 mm
    assert np.linalg.norm(pose.joints - truth.joints, axis=1).mean() < 0.05
    assert pose.warnings == () and pose.num_points == len(standing.sample.points)


@pytest.mark.parametrize(
    "kind",
    [
        lambda p: p.astype(np.float64),
        lambda p: p.astype(">f4"),
        lambda p: p.tolist(),
        lambda p: [tuple(row) for row in p],
        lambda p: list(p),
        lambda p: np.asfortranarray(p),
        lambda p: np.repeat(p, 2, axis=0)[::2],
        lambda p: np.column_stack([p, np.arange(len(p))]),
        lambda p: torch.from_numpy(p.copy()),
        lambda p: torch.from_numpy(p.copy()).requires_grad_(),
        lambda p: pd.DataFrame({"intensity": 0.5, "z": p[:, 2], "x": p[:, 0], "Y": p[:, 1]}),
        lambda p: pd.DataFrame(p),
        lambda p: records(p),
        lambda p: Cloud(points=p.astype(float)),
        lambda p: p.astype(object),
    ],
    ids="float64 big-endian rows tuples row-arrays fortran strided four-columns torch torch-grad table plain-table "
    "records read-from-file objects".split(),
)
def test_predict_accepts_all_kinds_of_arrays(model, points, kind):
    np.testing.assert_allclose(model.predict(kind(points)).joints, model.predict(points).joints, atol=1e-4)


@pytest.mark.parametrize("kind", [np.float16, np.int16, np.int64, np.uint8, torch.bfloat16])
def test_predict_accepts_low_precision_numbers(model, points, kind):
    near = 1 + 3 * (points - points.min(0))
    cloud = torch.from_numpy(near).to(kind) if kind is torch.bfloat16 else near.astype(kind)
    assert np.isfinite(model.predict(cloud).joints).all()


def test_predict_keeps_input(model, points):
    cloud = np.column_stack([points, np.full(len(points), np.nan)])
    cloud[3, 0] = np.nan
    before = cloud.copy()
    cloud.flags.writeable = False
    model.predict(cloud)
    np.testing.assert_array_equal(cloud, before)


@pytest.mark.parametrize(
    "bad, words",
    [
        (np.zeros((4, 2)), "shape (4, 2)"),
        (np.zeros(3), "shape (3,)"),
        (np.zeros((3, 60)), "shape (3, 60): give points.T"),
        (np.zeros((2, 2, 2, 3)), "shape (2, 2, 2, 3)"),
        (np.array([[1, 2, "a"]]), "<U"),
        (np.array([[1, 2, "a"]], object), "not all numbers"),
        (np.array([[True, False, True]]), "bool"),
        (np.array([[1j, 2, 3]]), "complex"),
        (np.zeros(4, [("a", "f4"), ("b", "f4"), ("c", "f4")]), "expected columns x, y and z, got a b c"),
        (pd.DataFrame({"range": [1.0], "x": 0.0, "y": 0.0}), "expected columns x, y and z, got range x y"),
        ([[1, 2, 3], [1, 2]], "unequal"),
        ([[[1, 2, 3], [1, 2]]], "points[0]"),
        ([np.zeros((9, 3)), np.zeros((9, 2))], "points[1]"),
        ([None], "points[0]"),
        ([[10**400, 0, 0]] * 9, "numbers below 1e+09 m, got a larger one"),
        ({"points": 1}, "dict"),
        (None, "NoneType"),
        (5, "shape ()"),
        ("sweep.pcd", "lidarpose.predict('sweep.pcd')"),
        (Path("sweep.pcd"), "lidarpose.predict('sweep.pcd')"),
    ],
)
def test_predict_rejects_bad_arrays_in_one_line(model, bad, words):
    with pytest.raises(InputError) as raised:
        model.predict(bad)
    assert words in str(raised.value) and "\n" not in str(raised.value) and "points" in str(raised.value)


def test_predict_of_one_scan_rejects_list_of_scans(points):
    for predict in (lidarpose.predict, lidarpose.detect):
        with pytest.raises(InputError, match=r"got a list of 2: one call per scan, or lidarpose.load\(\).predict"):
            predict([points, points[:50]])
        with pytest.raises(InputError, match=r"got a list of 2 paths: one call per file, or .*predict_recording"):
            predict(["a.pcd", Path("b.pcd")])


def test_predict_rejects_table_of_boxes(points):
    table = pd.DataFrame(np.zeros((1, 7)), columns=list("xyzlwhr"))
    with pytest.raises(InputError, match=r"got a table: give table\[\[x, y, z, l, w, h, yaw\]\].to_numpy"):
        lidarpose.predict(points, boxes=table)


def test_predict_drops_and_counts_nonfinite_and_huge_points(model, points):
    cloud = np.concatenate([points, np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 1e300]])])
    pose = model.predict(cloud)
    assert pose.warnings == (f"dropped 3 of {len(cloud)} points that were NaN, infinite or beyond 1e+09 m",)
    np.testing.assert_allclose(pose.joints, model.predict(points).joints, atol=1e-4)
    mask = np.zeros(points.shape, bool)
    mask[::3, 1] = True
    masked = model.predict(np.ma.masked_array(np.where(mask, 9.0, points), mask))
    np.testing.assert_array_equal(masked.joints, model.predict(points[~mask.any(1)]).joints)
    nothing = model.predict(np.full((9, 3), np.nan))
    assert nothing.joints is None and len(nothing.warnings) == 2


@pytest.mark.parametrize(
    "cloud, words",
    [
        *((np.eye(3)[[0, 1, 2, 0]][:count], "under 5 points") for count in (0, 1, 4)),
        (np.ones((5, 3)), "under 5 different points"),
        (np.ones((300, 3)), "under 5 different points"),
        (np.eye(3)[[0, 1, 2, 0] * 9] * 1e8, "under 5 different points"),
        (50.0 * np.arange(18).reshape(6, 3), "under 5 points within 2 m of the person's middle"),
    ],
)
def test_predict_gives_no_pose_for_too_few_points(model, cloud, words):
    pose = model.predict(cloud)
    assert pose.joints is None and pose.confidence is None and pose.spread is None
    assert pose.warnings[-1] == f"no pose: {words}" and (words != "under 5 points" or len(pose.warnings) == 1)
    assert json.loads(pose.to_json())["people"][0]["joints"] is None


def test_predict_drops_points_at_origin(model, points, tmp_path):
    empty = np.zeros((300, 3))
    pose = model.predict(np.concatenate([empty, points]))
    assert pose.warnings == (f"dropped 300 of {len(points) + 300} points at 0,0,0, which are not returns",)
    np.testing.assert_array_equal(pose.points, points)
    assert model.predict(empty).joints is None
    np.save(tmp_path / "empty.npy", empty)
    with pytest.raises(InputError, match="expected points in meters, got only 0,0,0"):
        lidarpose.predict(tmp_path / "empty.npy", model=model)
    # a single one may be a point of a centered cloud
    alone, notes = clean(np.concatenate([empty[:1], points - points.mean(0)]))
    assert len(alone) == len(points) + 1 and not notes


# ---- several people


def test_predict_list_matches_single_calls(model, points, standing):
    other = points @ rotation_about("z", 2.0).T.astype(np.float32) + np.float32(4)
    people = model.predict([points, other[:3], other], skeleton="human15")
    assert [person.joints is None for person in people] == [False, True, False]
    assert people.skeleton.name == people[0].skeleton.name == "human15"
    for person, cloud in zip(people, (points, None, other), strict=True):
        if cloud is not None:
            np.testing.assert_allclose(
                person.joints, model.predict(cloud, skeleton="human15").joints, atol=1e-3, rtol=1e-4
            )


def test_predict_accepts_lists_of_row_lists(model, points):
    people = model.predict([list(points), points.tolist()])
    np.testing.assert_array_equal(people.to_numpy(), model.predict([points, points]).to_numpy())


def test_predict_accepts_empty_lists_and_stacks(model, points):
    assert len(model.predict([])) == 0 and json.loads(model.predict([]).to_json())["people"] == []
    assert len(model.predict((points, points))) == len(model.predict(list(np.stack([points] * 2)))) == 2
    assert len(model.predict([records(points)] * 2)) == 2
    assert len(model.predict([points.tolist()])) == len(model.predict([torch.from_numpy(points.copy())])) == 1
    assert [person.joints for person in model.predict([points[:0], [], np.zeros((0, 3))])] == [None] * 3
    # people without points may be anywhere in the list
    for empty in ([], np.zeros(0), np.zeros((0, 3)), ()):
        for clouds in ([empty, points], [points, empty], [empty, empty]):
            found = [person.joints is not None for person in model.predict(clouds)]
            assert found == [cloud is points for cloud in clouds]


# ---- crops with clutter


def cluttered(points, seed=0):
    """A crop 3.9 m wide: a person away from its center, ground, a wall, a post and a tree above."""
    rng = np.random.default_rng(seed)
    low = points.min(0)
    middle = np.append(np.median(points[:, :2], axis=0), low[2])
    u = rng.random((3, 4000))
    ground = np.column_stack([u[0] * 3.9 - 1.2, u[1] * 3.9 - 1.4, 0.02 * u[2]])
    wall = np.column_stack([u[0] * 2.5 - 0.5, 2.2 + 0.1 * u[1], 2.2 * u[2]])
    post = np.column_stack([2.0 + 0.1 * u[0], 0.1 * u[1], 2.4 * u[2]])[:500]
    tree = np.column_stack([u[0] - 0.5, u[1] - 0.5, 2.5 + u[2]])[:500]
    return np.concatenate([points, middle + ground, middle + wall, middle + post, middle + tree])


def test_candidates_include_person_among_clutter(points):
    clouds = candidates(cluttered(points))
    assert 2 <= len(clouds) <= 4 and len(clouds[0]) == len(points) + 9000
    own = {tuple(row) for row in points}
    shares = [sum(tuple(row) in own for row in cloud.astype(np.float32)) / len(points) for cloud in clouds[1:]]
    assert max(shares) > 0.95
    assert all(np.ptp(cloud, axis=0).max() < 2.5 for cloud in clouds[1:])


def test_predict_finds_person_among_clutter(model, standing, points):
    pose = model.predict(cluttered(points))
    pelvis = standing.sample.pose.joints[0]
    assert np.linalg.norm(pose.joints[0] - pelvis) < 0.4


def test_candidates_keep_crop_of_person_width(points):
    arms_out = np.concatenate([points, np.median(points, axis=0) + [[0.95, 0, 0.4], [-0.95, 0, 0.4]]])
    assert [len(cloud) for cloud in candidates(arms_out)] == [len(arms_out)]


@pytest.mark.parametrize("wide, least", [(4.0, 4), (20.0, 4), (300.0, 1)])
def test_candidates_search_is_bounded_for_large_clouds(wide, least, monkeypatch):
    cells, heights = [], crop_search._heights
    monkeypatch.setattr(crop_search, "_heights", lambda grid, *ring: cells.append(grid.size) or heights(grid, *ring))
    cloud = np.random.default_rng(0).random((50_000, 3)) * (wide, wide, 2.5)
    assert least <= len(candidates(cloud)) <= 1 + crop_search._COLUMNS
    # 20 x 20 x 2.3 m in cells of 10 cm
    assert len(cells) == 2 and max(cells) < 1_000_000


def test_candidates_accept_strays_and_flat_crops():
    rng = np.random.default_rng(0)
    stray = np.concatenate([rng.random((50, 3)), [[1e8, -1e8, 1e8]]])
    assert len(candidates(stray)[0]) == 51
    assert len(candidates(rng.random((50, 3)) * (4, 4, 0.1))) == 1
    assert len(candidates(np.array([[0.0, 0, 0], [1e8, 0, 0]]))) == 1


def test_predict_counts_duplicates_once(model, points):
    """As second returns are; invalid rows are counted as given."""
    rows = np.concatenate([points[:60].repeat(2, 0), np.zeros((5, 3))])
    pose, expected = model.predict(rows), model.predict(points[:60])
    np.testing.assert_array_equal(pose.joints, expected.joints)
    # before many points are thinned
    many = points[:60].repeat(MAX_POINTS // 100, 0)
    many = many + np.random.default_rng(0).normal(0, 0.01, many.shape)
    pose_of_many = model.predict(np.concatenate([many, many]))
    assert pose_of_many.num_points == len(many) and not any("thinned" in line for line in pose_of_many.warnings)
    assert pose.num_points == 60 and any(line.startswith("dropped 5 ") for line in pose.warnings), pose.warnings


def test_predict_thins_million_points_with_warning(model, points):
    rng = np.random.default_rng(0)
    cloud = points[rng.integers(len(points), size=1_000_000)] + rng.normal(0, 0.005, (1_000_000, 3))
    pose = model.predict(cloud)
    assert pose.joints is not None and pose.num_points == MAX_POINTS
    assert pose.warnings[0].startswith(f"thinned from 1000000 to {MAX_POINTS} points")
    # points are removed evenly
    x = clean(np.linspace([0.1, 0, 0], [1.1, 0, 0], 3 * MAX_POINTS))[0][:, 0]
    assert len(x) == MAX_POINTS and np.diff(x).max() < 1e-4 and x[0] == 0.1 and x[-1] > 1.0999


def test_predict_warns_about_rounded_clouds_of_list(model, points):
    far = (points + [5e6, 0, 0]).astype(np.float32)
    warnings = [person.warnings for person in model.predict([points, far, far.astype(float) + 0.01])]
    assert [any("coordinates are rounded to 0.5 m" in line for line in own) for own in warnings] == [False, True, False]
    half = model.predict((points + [500, 0, 0]).astype(np.float16))
    assert "coordinates are rounded to 0.25 m, the precision of 16-bit floats" in half.warnings[0]
    assert not any("rounded" in line for line in model.predict(np.rint(1000 * (points + 1))).warnings)


def test_predict_is_accurate_in_map_coordinates(model, points):
    offset = np.array([5e5, 5e6, 300.0])
    moved = model.predict(points.astype(float) + offset)
    # the coordinates themselves are kept to a nanometer
    assert np.abs(moved.joints - offset - model.predict(points).joints).max() < 1e-5


# ---- units, axes, sensor origin


@pytest.mark.parametrize(
    "size, unit",
    [
        *((np.array([0.5, 0.6, tall]) * 1000, "millimeters") for tall in (0.9, 1.75)),
        *((np.array([0.5, 0.6, tall]) * 100, "centimeters") for tall in (0.9, 1.75)),
        *((np.array([0.5, 0.6, tall]) * 0.001, "kilometers") for tall in (0.9, 1.75)),
        *((np.array([0.5, 0.6, tall]) * factor, None) for tall in (0.9, 1.75) for factor in (1, 1.3)),
        # flat or wide
        *((np.array(size), None) for size in ([0.4, 0.3, 0.0], [150.0, 200.0, 33.0], [0.0, 0, 0])),
    ],
)
def test_unit_warning_names_unit(size, unit):
    warning = unit_warning(size, what="it")
    assert warning is None if unit is None else unit in warning


def test_predict_sensor_origin_formats(model, points):
    for given in (5, "1,2", "1,2,x", (1, 2, np.nan), "", [1, 2, 3, 4], "nowhere", object(), np.eye(3)):
        with pytest.raises(InputError, match="sensor origin: expected x,y,z in meters or unknown") as raised:
            model.predict(points, sensor_origin=given)
        assert "\n" not in str(raised.value)
    assert as_origin(None) is None and as_origin("unknown") is None
    for given in ("1,-2,3e0", (1, -2, 3), np.array([1, -2, 3]), ["1", "-2", 3]):
        np.testing.assert_array_equal(as_origin(given), [1, -2, 3])


def test_predict_uses_sensor_origin(model, points):
    known, unknown = model.predict(points, sensor_origin=(0, 0, 0)), model.predict(points)
    assert not np.allclose(known.joints, unknown.joints, atol=1e-6)
    np.testing.assert_array_equal(unknown.joints, model.predict(points, sensor_origin="unknown").joints)


def test_is_lying(standing, points):
    pose, none = standing.sample.pose, np.zeros((0, 3))
    assert not is_lying(pose, points) and not is_lying(pose, none)
    assert is_lying(pose, points[:, [0, 2, 1]]) and is_lying(pose, points[:, [2, 1, 0]])
    # one ring on a distant person, and a cluttered crop
    assert not is_lying(pose, points[:, :3] * (1, 1, 0)) and not is_lying(pose, cluttered(points))
    laid = replace(pose, joints=pose.joints @ rotation_about("x", np.pi / 2).T)
    assert is_lying(laid, points) and is_lying(laid.to(SKELETONS["waymo14"]), none)
    assert not is_lying(pose.to(SKELETONS["waymo14"]), none)
    # without the joints of the trunk, the points alone count
    ankles = laid.to(lidarpose.Skeleton(name="ankles", joints=("left_ankle", "right_ankle"), parents=(-1, 0)))
    assert not is_lying(ankles, points) and is_lying(ankles, points[:, [2, 1, 0]])


def test_flat_axis_of_sweep_is_up_axis(points):
    rng = np.random.default_rng(0)
    street = rng.normal(0, 1, (2000, 3)) * (40, 15, 1.5)
    for axis, shift in (("z", 0), ("x", 1), ("y", 2)):
        assert flat_axis(np.roll(street, shift, axis=1)) == axis
    assert flat_axis(rng.normal(0, 1, (2000, 3)) * (3, 3, 0.5)) is None and flat_axis(points) is None
    assert flat_axis(rng.random((2000, 3)) * (60, 12, 15)) is None


# ---- files


@pytest.fixture
def sweep(tmp_path, points):
    """A file of two people 5 m apart, their clouds, and their boxes."""
    there = (points + np.array([0, 5, 0])).astype(np.float32)
    path = tmp_path / "sweep.npy"
    np.save(path, np.concatenate([points, there]))
    return path, (points, there), [box_around(points, id="a"), box_around(there, track=7, category="PEDESTRIAN")]


def test_predict_numbers_boxes_without_id(model, sweep):
    path, _, boxes = sweep
    bare = {name: boxes[0][name] for name in ("center", "size")}
    for ids, expected in (([None, None], [0, 1]), ([None, 0, None], [3, 0, 2]), ([1, None, 3, None], [1, 4, 3, 5])):
        given = [bare if id is None else {**bare, "id": id} for id in ids]
        assert [person.id for person in lidarpose.predict(path, boxes=given, model=model)] == expected


def test_predict_keeps_order_and_ids_of_boxes(model, sweep):
    path, clouds, boxes = sweep
    people = lidarpose.predict(path, boxes={"people": boxes[::-1]}, model=model)
    assert [person.id for person in people] == [7, "a"]
    assert [person.num_points for person in people] == [len(cloud) for cloud in clouds]
    for person, cloud, box in zip(people, clouds[::-1], boxes[::-1], strict=True):
        # the center of the box may add a pass
        center = np.array([box["center"]])
        (alone,) = model.predict_in([cloud], np.zeros(3), "smpl24", box_centers=center)
        np.testing.assert_allclose(person.joints, alone.joints, atol=1e-3)
    document = json.loads(people.to_json())
    assert document["people"][0]["box"]["center"] == pytest.approx(boxes[1]["center"])
    assert document["source"] == str(path)
    assert set(document["timing_ms"]) == {"read", "load", "crop", "predict", "per_person"}


@pytest.mark.parametrize(
    "boxes",
    [
        [([0.9, 0.8, 2.2], 0.3 + turn) for turn in (0, np.pi, -np.pi, 2 * np.pi)],
        [([2.5, 2.5, 2.5], 0.0), ([2.6, 3.1, 4], 1.1), ([3, 2.6, 3], -2.7)],
    ],
    ids=["turned", "wider"],
)
def test_predict_depends_only_on_points_in_box(model, sweep, boxes):
    path, _, (box, _) = sweep
    given = [{"center": box["center"], "size": size, "yaw": yaw} for size, yaw in boxes]
    # one call each, since people share a batch
    poses = [lidarpose.predict(path, boxes=[each], model=model)[0] for each in given]
    for pose in poses[1:]:
        assert pose.num_points == poses[0].num_points
        np.testing.assert_array_equal(pose.joints, poses[0].joints)


def test_rows_inside_checks_few_points_per_box(monkeypatch):
    rng = np.random.default_rng(0)
    points = rng.uniform(-40, 40, (20_000, 3))
    boxes = [Box(center=rng.uniform(-40, 40, 3), size=rng.uniform(0.5, 9, 3), yaw=rng.uniform(-7, 7)) for _ in "ab" * 9]
    expected = [np.flatnonzero(box.contains(points)) for box in boxes]
    looked, contains = [], Box.contains
    monkeypatch.setattr(Box, "contains", lambda box, near: looked.append(len(near)) or contains(box, near))
    for rows, wanted in zip(rows_inside(boxes, points), expected, strict=True):
        np.testing.assert_array_equal(rows, wanted)
    assert sum(map(len, expected)) > 50 and np.mean(looked) < 0.3 * len(points)


def test_predict_empty_box_does_not_affect_others(model, sweep):
    path, _, boxes = sweep
    nowhere = {"center": [0, 0, 50], "size": [1, 1, 1]}
    people = lidarpose.predict(path, boxes=[boxes[0], nowhere, boxes[1]], model=model)
    assert [person.joints is None for person in people] == [False, True, False]
    assert people[1].id == 1 and people[1].warnings == ("no pose: under 5 points",) and people.warnings == ()


def test_predict_accepts_empty_list_of_boxes(model, sweep):
    people = lidarpose.predict(sweep[0], boxes={"people": []}, model=model)
    assert len(people) == 0 and people.warnings == () and len(people.picture()) > 1000


def scaled(box, center, size):
    return {**box, "center": [center * v for v in box["center"]], "size": [size * v for v in box["size"]]}


@pytest.mark.parametrize(
    "scale, change, words, alone",
    [
        (1, lambda box: scaled(box, 1000, 1), "no box holds 5 points: expected", False),
        (1000, lambda box: scaled(box, 1000, 1000), "a person's box .* millimeters", False),
        (1, lambda box: {**box, "size": box["size"][::-1]}, "m\\): size is length, width, height", True),
        (
            1,
            lambda box: {**box, "center": np.subtract(box["center"], [0, 0, box["size"][2] / 2])},
            "center at the feet",
            True,
        ),
    ],
    ids=["elsewhere", "millimeters", "height first", "feet"],
)
def test_predict_warns_of_boxes_in_other_unit_or_convention(model, sweep, tmp_path, scale, change, words, alone):
    _, clouds, boxes = sweep
    np.save(tmp_path / "scan.npy", np.concatenate(clouds) * scale)
    warnings = lidarpose.predict(tmp_path / "scan.npy", boxes=[change(box) for box in boxes], model=model).warnings
    assert any(re.search(words, warning) for warning in warnings)
    assert not alone or len(warnings) == 1 and "--up" not in warnings[0]


def test_predict_does_not_warn_of_tree_above_box(model, tmp_path, points):
    """Hidden legs cause no warning either."""
    box = box_around(points)
    upper = points[points[:, 2] > box["center"][2]]
    tree = box["center"] + np.random.default_rng(0).uniform((-0.3, -0.3, 1), (0.3, 0.3, 3), (len(points), 3))
    np.save(tmp_path / "a.npy", np.concatenate([upper, tree]))
    assert lidarpose.predict(tmp_path / "a.npy", boxes=[box], model=model).warnings == ()


def test_predict_ignores_default_origin_far_from_people(model, sweep, tmp_path):
    path, clouds, boxes = sweep
    offset = np.array([5e5, 5e6, 0])
    np.save(tmp_path / "utm.npy", np.concatenate(clouds).astype(float) + offset)
    moved = [{**box, "center": (offset + box["center"]).tolist()} for box in boxes]
    people = lidarpose.predict(tmp_path / "utm.npy", boxes=moved, model=model)
    assert any("treated as unknown" in warning for warning in people.warnings)
    blind = lidarpose.predict(path, boxes=boxes, sensor_origin="unknown", model=model)
    assert np.abs(people[0].joints - offset - blind[0].joints).max() < 1e-5
    given = lidarpose.predict(tmp_path / "utm.npy", boxes=moved, sensor_origin=offset, model=model)
    assert given.warnings == ()


def test_predict_takes_small_file_as_crop(model, sweep, tmp_path, points):
    np.save(tmp_path / "crop.npy", points)
    people = lidarpose.predict(tmp_path / "crop.npy", model=model)
    assert len(people) == 1 and people[0].id == 0 and people[0].box is None
    # unknown is the default for a crop, 0,0,0 for boxes
    np.testing.assert_allclose(people[0].joints, model.predict(points).joints, atol=1e-4)
    assert len(lidarpose.predict(sweep[0], crop=True, model=model)) == 1
    with pytest.raises(InputError, match="got both"):
        lidarpose.predict(sweep[0], crop=True, boxes=[], model=model)


def test_predict_warns_of_crop_in_millimeters(model, tmp_path, points):
    np.save(tmp_path / "mm.npy", points * 1000)
    people = lidarpose.predict(tmp_path / "mm.npy", crop=True, model=model)
    assert any("millimeters" in warning for warning in people[0].warnings)


TILTED = axis_angle_to_matrix([0.0, np.radians(20), 0.0])


@pytest.mark.parametrize(
    "up, R_input_level",
    [
        *((up, UP_AXES[up].T) for up in ("y", "x", "-y")),
        (TILTED[:, 2], TILTED),
        (",".join(map(repr, TILTED[:, 2].tolist())), TILTED),
    ],
    ids=["y", "x", "-y", "direction", "direction as text"],
)
def test_predict_with_up_gives_same_person_in_frame_of_file(model, sweep, tmp_path, up, R_input_level):
    path, clouds, boxes = sweep
    turned = tmp_path / "turned.npy"
    np.save(turned, np.concatenate(clouds) @ R_input_level.T)
    # with a direction, boxes are along the file's z: large enough for a person who is tilted in it
    boxes = [{**box, "yaw": 0.1, "size": [2.5, 2.5, 3.0]} for box in boxes]
    moved = [{**box, "center": (R_input_level @ box["center"]).tolist()} for box in boxes]
    for origin in (np.zeros(3), np.array([1.0, 2, 3])):
        expected = lidarpose.predict(path, boxes=boxes, sensor_origin=origin, model=model)
        people = lidarpose.predict(turned, boxes=moved, up=up, sensor_origin=R_input_level @ origin, model=model)
        for a, b in zip(expected, people, strict=True):
            assert a.num_points == b.num_points
            np.testing.assert_allclose(a.joints @ R_input_level.T, b.joints, atol=2e-3)
            np.testing.assert_allclose(a.points @ R_input_level.T, b.points, atol=1e-4)
            np.testing.assert_allclose(b.box.center, R_input_level @ a.box.center)
        assert people.warnings == ()
    assert people[0].picture().startswith(b"\x89PNG")


def test_predict_crops_tilted_file_in_its_own_frame(model, tmp_path, points):
    R_input_level = axis_angle_to_matrix([0.0, np.radians(30), 0.0])
    tilted = points @ R_input_level.T
    low, high = tilted.min(0), tilted.max(0)
    stray = (low + high) / 2 + [(high - low)[0] / 2 + 0.05, 0, 0]
    np.save(tmp_path / "a.npy", np.concatenate([tilted, stray[None]]))
    box = {"center": ((low + high) / 2).tolist(), "size": (high - low + 0.02).tolist()}
    (person,) = lidarpose.predict(tmp_path / "a.npy", boxes=[box], up=R_input_level[:, 2], model=model)
    assert person.num_points == len(points)


def test_predict_warns_of_up_axis_if_all_people_lie(model, tmp_path, points):
    np.save(tmp_path / "crop.npy", points)
    assert lidarpose.predict(tmp_path / "crop.npy", model=model).warnings == ()
    np.save(tmp_path / "crop.npy", points @ UP_AXES["y"])
    (warning,) = lidarpose.predict(tmp_path / "crop.npy", model=model).warnings
    assert warning == (
        "the person lies down: if that is wrong, z is not the input's up axis: "
        "try --up y, or --up -y where y points down (cameras), or --up x"
    )
    assert lidarpose.predict(tmp_path / "crop.npy", up="y", model=model).warnings == ()


def test_predict_warns_of_up_axis_of_sweep(model, tmp_path, points):
    street = np.random.default_rng(0).normal(0, 1, (9000, 3)) * (40, 15, 0.5)
    np.save(tmp_path / "sweep.npy", np.concatenate([points, street]) @ UP_AXES["x"])
    box = {"center": (np.median(points, axis=0) @ UP_AXES["x"]).tolist(), "size": [0.8, 0.8, 2]}
    (warning,) = lidarpose.predict(tmp_path / "sweep.npy", boxes=[box], model=model).warnings
    assert warning.endswith("try --up x")
    assert lidarpose.predict(tmp_path / "sweep.npy", boxes=[box], up="x", model=model).warnings == ()


# ---- loading, results


@pytest.mark.long
def test_load_accepts_names_and_paths(points, tmp_path, monkeypatch):
    expected = lidarpose.load("tiny", tta=1).predict(points).joints
    copy = tmp_path / "mine.safetensors"
    copy.write_bytes(bundled_path("tiny").read_bytes())
    (tmp_path / "odd.name").write_bytes(copy.read_bytes())
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny").mkdir()
    for weights in (copy, str(copy), "mine.safetensors", Path("odd.name"), "odd.name", "tiny"):
        joints = lidarpose.load(weights, tta=1).predict(points).joints
        np.testing.assert_allclose(joints, expected, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.7, 1.6, 2.2])
@pytest.mark.parametrize("meant", [0, 1])
def test_predict_warns_of_two_people_and_poses_nearer_to_center(model, standing, tmp_path, meant, gap):
    # beyond 1 m the box is so wide that its columns are predicted separately
    apart = np.array([0, gap, 0])
    both = np.concatenate([standing.sample.points, standing.sample.points + apart])
    pelvises = standing.sample.pose.joints[0] + [np.zeros(3), apart]
    center = 0.9 * pelvises[meant] + 0.1 * pelvises[1 - meant]
    box = {"center": center.tolist(), "size": (2 * np.abs(both - center).max(0) + 0.1).tolist()}
    boxed = model.predict(both, boxes=[box], sensor_origin=(0, 0, 0))[0]
    for person, who in (
        (boxed, "of the one nearer to the center of the box"),
        (model.predict(both, sensor_origin=(0, 0, 0)), "of one of them: give a box to choose one"),
    ):
        assert person.second_person > 0.5 and person.person > 0.5
        assert any("two people" in line and line.endswith(who) for line in person.warnings)
    assert np.linalg.norm(boxed.joints[0] - pelvises[meant]) < 0.1
    # with another up axis
    R_input_level = UP_AXES["y"].T
    moved = {**box, "center": (R_input_level @ center).tolist()}
    turned = lidarpose.predict(both @ R_input_level.T, boxes=[moved], up="y", sensor_origin=(0, 0, 0), model=model)[0]
    assert np.linalg.norm(turned.joints[0] - R_input_level @ pelvises[meant]) < 0.1
    boxed.save(tmp_path / "two.json")
    (entry,) = json.loads((tmp_path / "two.json").read_text())["people"]
    assert entry["second_person"] == round(boxed.second_person, 4) and entry["warnings"] == list(boxed.warnings)


def test_predict_warns_of_crop_without_person(model, tmp_path, capsys):
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(400, 6.0), rng.uniform(-0.5, 0.5, 400), rng.uniform(-1, 1, 400)])
    person = model.predict(wall, sensor_origin=(0, 0, 0))
    assert person.person < 0.05
    assert any("look unlike a person" in line and f"{person.person:.2f}" in line for line in person.warnings)
    # a box with a score has no such warning
    box = {"center": [6, 0, 0], "size": [0.6, 1.2, 2.2]}
    for score, is_flagged in ((None, True), (0.9, False)):
        boxed = model.predict(wall, boxes=[box | {"score": score}], sensor_origin=(0, 0, 0))[0]
        assert boxed.person < 0.05 and any("unlike a person" in line for line in boxed.warnings) is is_flagged
    np.save(tmp_path / "wall.npy", wall)
    assert main(["predict", str(tmp_path / "wall.npy"), "--crop", "--out", str(tmp_path / "wall.json")]) == 0
    assert "look unlike a person" in capsys.readouterr().err
    (entry,) = json.loads((tmp_path / "wall.json").read_text())["people"]
    assert entry["person"] < 0.05 and any("unlike a person" in line for line in entry["warnings"])


@pytest.mark.parametrize("name", ["smpl24", "human15", "waymo14"])
def test_saved_results_follow_schema(model, points, tmp_path, name):
    pose = model.predict(points, skeleton=name)
    pose.save(tmp_path / "new" / "pose.json")
    document = json.loads((tmp_path / "new" / "pose.json").read_text())
    joints = list(SKELETONS[name].joints)
    assert document["schema"] == "lidarpose.poses/1" and document["frame"] == "input" and document["unit"] == "m"
    assert document["skeleton"]["name"] == name and document["skeleton"]["joints"] == joints
    assert all(0 <= i < len(joints) and 0 <= j < len(joints) for i, j in document["skeleton"]["bones"])
    assert set(document["model"]) == {"name", "version", "backend", "decode"}
    (person,) = document["people"]
    keys = "id box score mounted num_points person second_person facing joints confidence spread visible"
    assert list(person) == [*keys.split(), "out_of_range", "warnings"]
    np.testing.assert_allclose(person["facing"], pose.facing, atol=1e-4)
    np.testing.assert_allclose(person["joints"], pose.joints, atol=1e-4)
    assert len(person["confidence"]) == len(person["spread"]) == len(person["visible"]) == len(joints)
    assert set(person["out_of_range"]) <= set(joints)
    assert pose.picture(tmp_path / "pose.png") == (tmp_path / "pose.png").read_bytes()


@pytest.mark.parametrize("up", ["z", "-y", "x", (0.1, -0.2, 0.9)])
def test_facing_is_level_in_the_frame_of_the_input(up):
    joints = np.full((len(WAYMO14.joints), 3), np.nan)
    for side, y in (("left", 0.2), ("right", -0.2)):
        for part, z in (("hip", 0.9), ("shoulder", 1.4)):
            joints[WAYMO14.joints.index(f"{side}_{part}")] = 0.0, y, z
    R_input_level = rotation_from_up(up).T
    heading = rotation_about("z", 0.7)
    pose = Pose(joints=joints @ (R_input_level @ heading).T, skeleton=WAYMO14)
    person = PersonPose(pose=pose, skeleton=WAYMO14, points=np.zeros((0, 3)), up=up_text(up))
    np.testing.assert_allclose(person.facing, (R_input_level @ heading)[:, 0], atol=1e-9)
    on_the_side = replace(pose, joints=joints @ (R_input_level @ rotation_about("x", 1.5)).T)
    assert replace(person, pose=on_the_side).facing is None
    assert replace(person, pose=None).facing is None


def test_predict_file_matches_array_by_default(points, tmp_path):
    np.save(tmp_path / "crop.npy", points)
    (person,) = lidarpose.predict(tmp_path / "crop.npy", sensor_origin=(0, 0, 0), crop=True)
    np.testing.assert_array_equal(person.joints, lidarpose.load().predict(points, sensor_origin=(0, 0, 0)).joints)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the real sweeps are not at {REAL}")
@pytest.mark.parametrize("name", ["sweep_0.pcd", "sweep_1.bin", "sweep_2.ply"])
def test_predict_real_sweeps(model, name):
    path = REAL / name
    boxes = json.loads(path.with_suffix(".json").read_text())
    people = lidarpose.predict(path, boxes=path.with_suffix(".json"), model=model)
    assert [person.id for person in people] == [box["track"] for box in boxes["people"]]
    assert people.warnings == ()
    for person, box in zip(people, boxes["people"], strict=True):
        assert abs(person.num_points - box["num_points"]) <= max(2, 0.05 * box["num_points"])
        assert (person.joints is None) == (person.num_points < 5)
        if person.num_points >= 50:
            assert np.linalg.norm(person.joints[0] - box["center"]) < 0.6
            assert height(person, "head") > height(person, "pelvis") > height(person, "left_ankle")


def test_poses_contain_their_people(model, points):
    poses = model.predict([points, points[:0]])
    assert poses[1] in poses and poses != model.predict([points[:0]]) and len({*poses, poses[0], poses}) == 3


@pytest.mark.long
def test_predict_accepts_array_instead_of_file(tmp_path, points):
    path = tmp_path / "person.npy"
    np.save(path, points)
    from_file, from_array = lidarpose.predict(path, model="tiny"), lidarpose.predict(points, model="tiny")
    np.testing.assert_array_equal(from_file[0].joints, from_array[0].joints)
    assert from_array.source is None and from_array[0].id == from_file[0].id == 0
    # an array is searched if it is wide or if that is requested
    wide = np.concatenate([points, points.min(0) + [[0, 0, 0], [30, 30, 0]]])
    assert lidarpose.predict(wide, model="tiny").scan is not None
    assert lidarpose.predict(points, find=True, min_score=0.99, model="tiny").scan is not None
    for not_points in (None, 7, "points", np.zeros((3, 2)), np.zeros((2, 300, 3))):
        with pytest.raises(InputError, match="expected|no such file|must be"):
            lidarpose.predict(not_points, model="tiny")


def test_predict_finds_no_people_without_points(model):
    empty, nan = np.zeros((0, 3)), np.full((300, 3), np.nan)
    for points in (empty, nan, np.zeros((300, 3))):
        for options in ({}, {"find": True}, {"boxes": []}):
            people = lidarpose.predict(points, model=model, **options)
            assert len(people) == 0 and (points is empty or "dropped 300 of 300" in people.warnings[0])
    assert lidarpose.predict(empty, model=model, find=True).warnings == model.predict(empty, find=True).warnings
    assert not lidarpose.predict(empty, crop=True, model=model)[0].has_pose


@pytest.mark.parametrize("records", [False, True])
def test_predict_rejects_range_image(model, records):
    image = np.zeros((32, 1024), [(name, "f4") for name in "xyz"]) if records else np.zeros((32, 1024, 3))
    expected = "got (32, 1024, 3): one scan is points." + ("ravel()" if records else "reshape(-1, 3), several people")
    for predict in (model.predict, lidarpose.predict, lidarpose.detect, lambda a: model.predict(a, find=True)):
        with pytest.raises(InputError, match=re.escape(expected)):
            predict(image)
    assert len(model.predict(list(np.zeros((2, 9, 3))))) == len(model.predict_clip(np.zeros((2, 9, 3)))) == 2


def test_predictor_of_caches_only_bundled_networks(tmp_path):
    assert predictor_of("tiny") is predictor_of("tiny")
    path = shutil.copy(bundled_path("tiny", ".onnx"), tmp_path)
    assert predictor_of(path) is not predictor_of(path)


@pytest.mark.parametrize("wrong", [torch.nn.Linear(3, 3), lambda points: points, lambda: None, object()])
def test_predict_rejects_bad_model(points, wrong):
    with pytest.raises(InputError, match="^model: expected a predictor, weights .*: make one with lidarpose.load$"):
        lidarpose.predict(points, crop=True, model=wrong)


def test_predict_rejects_boxes_of_other_up_axis(model, points):
    boxes = lidarpose.read_boxes({"schema": "lidarpose.boxes/1", "up": "y", "people": [box_around(points)]})
    with pytest.raises(InputError, match="the up axis of the boxes is y, not z: give --up y"):
        lidarpose.predict(points, boxes=boxes, up="z", model=model)
    assert lidarpose.predict(points, boxes=boxes, up=[0, 1, 1e-3], model=model).up == "0.0,1.0,0.001"


def test_predict_accepts_skeleton_or_its_name(model, points):
    pair = lidarpose.Skeleton(name="ankles", joints=("left_ankle", "right_ankle"), parents=(-1, 0))
    pose = model.predict(points, skeleton=pair)
    assert pose.joints.shape == (2, 3) and pose.skeleton is pair
    np.testing.assert_array_equal(
        lidarpose.predict(points, crop=True, skeleton=WAYMO14, model=model)[0].joints,
        lidarpose.predict(points, crop=True, skeleton="waymo14", model=model)[0].joints,
    )
    named = lidarpose.Pose(joints=np.zeros((26, 3)), skeleton="body26")
    assert named.skeleton is BODY26 and named.to("waymo14").skeleton is WAYMO14
    for wrong in (5, "waymo"):
        with pytest.raises(InputError, match="unknown skeleton"):
            model.predict(points, skeleton=wrong)


def test_predict_accepts_poses_as_boxes(model, sweep):
    path, _, boxes = sweep
    people = lidarpose.predict(path, boxes=boxes, model=model)
    again = lidarpose.read_boxes(people)
    assert [box.id for box in again] == ["a", 7] and again.up == people.up
    np.testing.assert_array_equal(lidarpose.predict(path, boxes=people, model=model)[1].joints, people[1].joints)
    with pytest.raises(InputError, match="a cloud of one person has no box"):
        lidarpose.read_boxes(lidarpose.predict(path, crop=True, model=model))


def test_box_id_is_text_or_whole_number(model, sweep):
    path, boxes = sweep[:2]
    box = Box(center=[0, 0, 0], size=[9, 9, 9], id=np.int64(3))
    assert box.id == 3 and type(box.id) is int
    assert read_boxes([{"center": [0, 0, 0], "size": [1, 1, 1], "id": np.int64(3)}])[0].id == 3
    for wrong in (1.5, True, ["a"]):
        with pytest.raises(InputError, match="Box.id must be text or a whole number"):
            Box(center=[0, 0, 0], size=[9, 9, 9], id=wrong)
    json.loads(lidarpose.predict(path, boxes=[box], model=model).to_json())


def answers(*people):
    """Poses of candidates (x m, confidence, probability of a person), each with its part of the cloud."""
    for k, (x, confidence, person) in enumerate(people):
        joints, confidences = np.zeros((26, 3)) + [x, 0, 0], np.full(26, confidence)
        known = {"person": np.array(person), "second_person": np.array(0.1)}
        yield Pose(joints=joints, skeleton=BODY26, confidence=confidences, **known), np.full((1, 3), float(k))


@pytest.mark.parametrize(
    ("people", "box_x", "best", "second"),
    [
        # the most confident pose; confident poses beside it count as a second person
        ([(0, 0.5, 0.9), (1, 0.9, 0.8), (5, 0.2, 1.0)], None, 1, 0.1),
        ([(0, 0.6, 0.9), (1, 0.9, 0.8)], None, 1, 0.9),
        # with a box, the most confident pose of the nearest person among confident poses
        ([(0, 0.6, 0.9), (0.2, 0.7, 0.5), (1, 0.9, 0.8)], 0.1, 1, 0.8),
        ([(0.1, 0.3, 0.9), (1, 0.9, 0.8), (2, 0.95, 0.7)], 0.1, 1, 0.7),
        ([(0, 0.6, 0.05), (1, 0.9, 0.05)], 0.8, 1, 0.1),
    ],
)
def test_select_pose_by_confidence_and_box_center(people, box_x, best, second):
    pose, part = select_pose(list(answers(*people)), None if box_x is None else np.array([box_x, 0, 0]))
    assert part[0, 0] == best and pose.joints[0, 0] == people[best][0] and pose.second_person == second


def test_predict_without_confidence_uses_whole_cloud(points):
    """Not the smallest candidate, which is processed first."""

    class Counting:
        name, header, batch = (
            "counting",
            SimpleNamespace(skeleton=SKELETONS["smpl24"], network="pose", version="0", card={}),
            8,
        )

        def run(self, clouds, view):
            vote = np.zeros((len(clouds), 24, 3), np.float32)
            vote[:, 1:, 2] = np.array([len(cloud) for cloud in clouds])[:, None] * 1e-3
            return Raw(vote=vote, heatmaps=None, low=np.zeros(3), step=np.ones(3))

    cloud = cluttered(points)
    assert len({len(each) for each in candidates(cloud)}) > 1
    joints = Predictor(Counting(), name="counting").predict(cloud).joints
    assert joints[1, 2] - joints[0, 2] == pytest.approx(len(cloud) * 1e-3, abs=1e-3)


@pytest.mark.parametrize(("confidence", "is_searched"), [(0.3, True), (0.9, False)])
def test_predict_searches_narrow_crop_of_unsure_pose(points, confidence, is_searched, monkeypatch):
    """1.8 m wide: narrower than crops that are always searched. With a box, its center tells who is meant."""
    clouds = []

    def poses(self, given, origin, **settings):
        clouds.append([len(cloud) for cloud in given])
        sure = [confidence if len(cloud) > 0.9 * len(crop) else 0.8 for cloud in given]
        own = [np.zeros((26, 3)) + cloud.mean(0) for cloud in given]
        pairs = zip(own, sure, strict=True)
        return [Pose(joints=joints, skeleton=BODY26, confidence=np.full(26, value)) for joints, value in pairs]

    wide = cluttered(points)
    crop = wide[(np.abs(wide[:, :2] - np.median(points[:, :2], axis=0)) < 0.9).all(1)]
    assert len(candidates(crop)) == 1 and len(candidates(crop, 1.3)) > 1
    monkeypatch.setattr(Predictor, "poses", poses)
    model = lidarpose.load("tiny")
    person = model.predict_in([crop], None, check_upside_down=False)[0]
    assert clouds[0] == [len(crop)] and bool(clouds[1:] and clouds[1]) == is_searched
    assert (person.confidence.mean() > confidence + 0.1) == is_searched
    del clouds[:]
    model.predict_in([crop], None, box_centers=crop.mean(0)[None], check_upside_down=False)
    assert [each for each in clouds if each] == [[len(crop)]]


# ---- results in Python and in notebooks


@pytest.fixture(scope="module")
def poses(model, points):
    return model.predict([points, points[:3], points + [0, 4, 0]])


def test_repr_of_predictor_and_results_is_short(model, poses):
    assert repr(model).startswith("Predictor('small', body26, onnx, tta=1")
    # the person's own warnings count
    assert repr(poses) == "Poses(2 of 3 people, smpl24, 1 warning)"
    assert repr(replace(poses, warnings=("a",))) == "Poses(2 of 3 people, smpl24, 2 warnings)"
    assert re.fullmatch(r"PersonPose\(smpl24, confidence [01]\.\d\d, 590 points\)", repr(poses[0]))
    assert repr(replace(poses[1], id="b")) == "PersonPose(id='b', no pose, 3 points, 1 warning)"


def test_person_label_names_score_and_rider():
    assert person_label("a", 0.954, True) == "a · score 0.95 · rides"
    assert person_label(3, None, None) == "3" and person_label(None, 0.5, False) == "score 0.50"


def test_notebooks_show_table_of_poses_and_picture_of_person(poses):
    picture = poses[0].picture()
    assert poses[0]._repr_png_() == picture[:] == picture._repr_png_() and picture.startswith(b"\x89PNG")
    assert isinstance(picture, bytes) and repr(picture) == f"<PNG, {len(picture):,} bytes>"
    named = replace(poses, people=(replace(poses[0], id="<b>"), poses[1]))
    assert "&lt;b&gt;" in named._repr_html_() and "no pose" in named._repr_html_()
    assert "score" not in named._repr_html_()
    rider = replace(poses[0], id=3, box=Box(center=np.zeros(3), size=np.ones(3), score=0.876, mounted=True))
    table = replace(poses, people=(rider, poses[1]))._repr_html_()
    assert "<th>score</th><th>mounted</th>" in table and "<td>0.88</td><td>yes</td>" in table
    assert [panel.label for panel in panels_of(rider.alone())[0]] == ["3 · score 0.88 · rides"]


def test_poses_indexed_by_id_and_slice(poses):
    named = replace(poses, people=tuple(replace(p, id=i) for p, i in zip(poses, ("a", "b", 7), strict=True)))
    assert named["b"] is named[1] and named["7"] is named[2]
    assert isinstance(named[1:], type(poses)) and [p.id for p in named[1:]] == ["b", 7]
    with pytest.raises(KeyError, match="no person has the id 'c'"):
        named["c"]
    with pytest.raises(
        IndexError, match=r"no person at 7: there are 3 people, counted from 0, and ids are text, \['7'\]"
    ):
        named[7]


def test_poses_to_numpy_and_to_dataframe(poses, tmp_path):
    joints = poses.to_numpy()
    assert joints.shape == (3, 24, 3) and np.isnan(joints[1]).all() and not poses[1].has_pose
    np.testing.assert_array_equal(joints[0], poses[0].joints)
    np.testing.assert_array_equal(poses[0].to_numpy(), poses[0].joints)
    table = poses.to_dataframe()
    assert list(table.person.unique()) == [0, 2] and len(table) == 48
    np.testing.assert_array_equal(table[["x", "y", "z"]].to_numpy()[24:], poses[2].joints)
    np.testing.assert_array_equal(table.confidence[:24], poses[0].confidence)
    with pytest.raises(InputError, match="give a name that ends in .json"):
        poses.save(tmp_path / "poses.xyz")
    poses.save(tmp_path / "poses.csv")
    read = pd.read_csv(tmp_path / "poses.csv")
    assert list(read) == list(table) and list(read.joint) == list(table.joint)
    # the decimals of the JSON file
    np.testing.assert_array_equal(read[["x", "y", "z"]][:24], poses[0].to_dict()["joints"])
    np.testing.assert_array_equal(read.confidence[:24], poses[0].to_dict()["confidence"])


def test_predict_boxes_of_array_match_boxes_of_file(model, points, tmp_path):
    np.save(tmp_path / "sweep.npy", points)
    box = {"center": points.mean(0).tolist(), "size": [1.5, 1.5, 2.2], "id": "a"}
    of_file = lidarpose.predict(tmp_path / "sweep.npy", boxes=[box], model=model)
    of_points = model.predict(points, boxes=[box])
    assert of_points["a"].box.size.tolist() == box["size"]
    np.testing.assert_array_equal(of_points.to_numpy(), of_file.to_numpy())


def test_predict_warns_of_one_box_in_other_unit(model, points):
    meters = {"center": points.mean(0).tolist(), "size": [1.5, 1.5, 2.2]}
    wrong = meters | {"size": [60, 60, 180], "id": "c"}
    # with a street around, whose points do not matter
    people = model.predict(np.concatenate([points, STREET]), boxes=[meters, wrong, meters])
    (line,) = people.warnings
    assert line.startswith("box c is unlike the others: it is 180 m tall: are the units")
    assert people["c"].has_pose and people["c"].warnings == ()
    assert not any("unlike" in line for line in model.predict(points, boxes=[meters, meters]).warnings)
    # two boxes have no median to compare with
    (line,) = model.predict(np.concatenate([points, STREET]), boxes=[meters, wrong]).warnings
    assert line.startswith("box c is unlike the others: it is 180 m tall")
    (line,) = model.predict(np.concatenate([points, STREET]), boxes=[wrong, wrong | {"id": "d"}, meters]).warnings
    assert line.startswith("a person's box is 180 m tall")


STREET = np.random.default_rng(0).uniform([-200, -200, -2], [200, 200, -1.9], (3000, 3))


@pytest.mark.parametrize(
    "change, words",
    [
        *((lambda p, scale=scale: p * scale, "taller than a person: expected meters") for scale in (1 / 0.3048, 2, 10)),
        (lambda p: p * [1, -1, -1], "try --up -z"),
        (lambda p: np.concatenate([p, STREET]), "expected a crop of one person"),
        # wider than tall
        (lambda p: np.concatenate([p, p + [0, 1.7, 0]]) / 0.3048, "taller than a person: expected meters"),
    ],
    ids=["feet", "twice", "ten times", "upside down", "sweep", "two in feet"],
)
def test_predict_warns_of_wrong_unit_axis_or_extent(model, points, change, words):
    assert any(words in line for line in model.predict(change(points)).warnings)
    assert model.predict(points).warnings == ()


def test_predict_checks_upside_down_people_in_one_batch(model, points, monkeypatch):
    batches, origins, run, poses = [], [], model.backend.run, model.poses

    def noted(clouds, origin, *arguments, **options):
        origins.append(origin)
        return poses(clouds, origin, *arguments, **options)

    monkeypatch.setattr(model.backend, "run", lambda clouds, view: batches.append(len(clouds)) or run(clouds, view))
    monkeypatch.setattr(model, "poses", noted)
    people = model.predict([points * [1, -1, -1]] * 3, sensor_origin=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(origins, [(0.1, 0.2, 0.3), (0.1, -0.2, -0.3)])
    assert ["try --up -z" in person.warnings[-1] for person in people] == [True] * 3
    # two passes as given, two upside down
    assert batches == [3] * 4
    # the check can be disabled
    batches.clear()
    same = model.predict_in([points * [1, -1, -1]] * 3, np.array([0.1, 0.2, 0.3]), check_upside_down=False)
    assert batches == [3] * 2
    np.testing.assert_array_equal(same.to_numpy(), people.to_numpy())
    # lying people get no warning of their own
    monkeypatch.setattr(cloud_predictor, "is_lying", lambda pose, part: True)
    assert not any("try --up" in line for line in model.predict(points * [1, -1, -1]).warnings)


def test_predict_warns_once_of_boxes_in_millimeters(model, sweep):
    """The distance of the boxes to sensor and points follows from their unit."""
    _, clouds, boxes = sweep
    scaled = [
        {**box, "center": (1000 * np.array(box["center"])).tolist(), "size": [1000 * value for value in box["size"]]}
        for box in boxes
    ]
    poses = lidarpose.predict(np.concatenate(clouds), boxes=scaled, model=model)
    (warning,) = poses.warnings
    assert "a person's box is" in warning and "millimeters" in warning


def test_predict_warns_of_few_scored_people_upside_down_only_if_most_are(model, points):
    flipped = points * [1, -1, -1]
    for clouds, count in (([flipped, points, points], 0), ([flipped, flipped, points], 2)):
        centers = np.array([cloud.mean(0) for cloud in clouds])
        people = model.predict_in(clouds, None, box_centers=centers, is_scored=True)
        assert sum("try --up -z" in " ".join(person.warnings) for person in people) == count
        people = model.predict_in(clouds, None, box_centers=centers)
        assert sum("try --up -z" in " ".join(person.warnings) for person in people) == max(count, 1)


def test_predict_rejects_objects_that_hold_points(model):
    frame = lidarpose.Frame(points=np.zeros((9, 3)), index=0, id="0")
    with pytest.raises(InputError, match=r"got Frame, its points are in .points$"):
        lidarpose.predict(frame, model=model)
    with pytest.raises(InputError, match=r"array of numbers, got NoneType$"):
        model.predict(None)


def test_scan_unit_warning_of_person_in_millimeters():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (500, 3)) * [500, 300, 950]
    assert "are the units millimeters? divide all coordinates by 1000" in scan_unit_warning(points, len(points))


def test_notes_of_reading_a_crop_belong_to_its_person(model):
    points = np.random.default_rng(0).normal((5, 0, 0), (0.2, 0.2, 0.5), (99, 3))
    poses = lidarpose.predict(np.concatenate([points, [[np.nan] * 3]]), crop=True, model=model)
    assert poses.warnings == () and sum("dropped 1 of 100 points" in text for text in poses[0].warnings) == 1
