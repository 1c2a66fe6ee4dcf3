"""Waymo reader, both versions: points of all lasers and returns, joins of tables, invalid and damaged input."""

import re
import shutil
import subprocess
import sys
import tracemalloc
import zlib
from collections import Counter

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import waymo_files as files
from hypothesis import given, settings, strategies as st

from lidarpose.data.prepare import prepare, reader
from lidarpose.data.readers import waymo_frames, waymo_v1
from lidarpose.data.readers.base import Skipped
from lidarpose.data.readers.waymo import COMPONENTS, Waymo, images
from lidarpose.data.readers.waymo_frames import Calibration, points_of_image
from lidarpose.data.shards import open_dataset
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, LabeledSample

SEGMENT = "10017090168044687777_6380_000_6400_000"
TFRECORD = f"training/segment-{SEGMENT}_with_camera_labels.tfrecord"
TOP = files.LASERS[1].E[:3, 3]


@pytest.fixture(scope="module")
def v2(tmp_path_factory):
    root = tmp_path_factory.mktemp("v2")
    files.write_v2(root)
    return root


@pytest.fixture(scope="module")
def v1(tmp_path_factory):
    root = tmp_path_factory.mktemp("v1")
    files.write_v1(root)
    return root


@pytest.fixture
def copy(v2, tmp_path):
    """A copy of version 2 that tests may damage."""
    return shutil.copytree(v2, tmp_path / "raw")


def component(root, name, split="training"):
    return root / split / name / f"{SEGMENT}.parquet"


def everything(root, source=None):
    """(items, skipped) of all parts."""
    source = source or Waymo()
    found = [one for part in source.parts(root) for one in source.read(root, part)]
    return [x for x in found if isinstance(x, LabeledSample)], [x for x in found if isinstance(x, Skipped)]


def truth():
    """(time, track) -> Someone, for all people that must be read."""
    return {(f.time, one.track): one for f in files.scene() for one in f.people if one.points}


def check(items):
    """Each written person is read once: points of each laser and return, rows, joints and labels, within 1 mm."""
    want = truth()
    assert [(item.frame, item.track) for item in items] == sorted(want)
    for item in items:
        one, sample = want[item.frame, item.track], item
        ring = [39 - rows if laser == 1 else rows * 0 - 1 for (laser, _), (_, rows) in sorted(one.points.items())]
        np.testing.assert_array_equal(sample.ring, np.concatenate(ring))
        start = 0
        for (laser, which), (points, _) in sorted(one.points.items()):
            got = sample.points[start : start + len(points)]
            assert len(points) and np.abs(got - (points - TOP)).max() < 1e-3, (laser, which)
            start += len(points)
        np.testing.assert_allclose(sample.pose.joints, one.joints - TOP, atol=1e-3)
        np.testing.assert_array_equal(item.joint_labels, one.labels)
        np.testing.assert_allclose(sample.box.center, np.array(one.box[:3]) - TOP, atol=1e-9)
        np.testing.assert_allclose([*sample.box.size, sample.box.yaw], one.box[3:], atol=1e-9)
        np.testing.assert_array_equal(item.centers["box"], sample.box.center)
        assert sample.source == {2: "waymo/pedestrian", 4: "waymo/cyclist"}[one.kind]
        assert item.sequence == SEGMENT and item.time == pytest.approx((item.frame - 1_550_083_467_346_370) / 1e6)


# --- end to end


def test_version_2_is_read_with_all_people(v2):
    source = reader("waymo")
    assert source.parts(v2) == [f"training/{SEGMENT}"] and source.skeleton == "waymo14"
    items, skipped = everything(v2, source)
    check(items)
    assert [(one.reason, one.where.split("/")[-1]) for one in skipped] == [
        ("keypoints without a box", "ped-boxless"),
        ("no points in the box", "ped-far: the label counts 123"),
        ("no joint is labeled", "ped-unlabeled"),
    ]
    assert source.about["settings"] == {"box_margin_m": 0.2} and source.about["licence"] and source.about["notes"]
    labels = Counter(int(label) for item in items for label in item.joint_labels)
    assert labels == {SEEN: 2 * (14 + 9), HIDDEN: 6, UNLABELED: 4}


@pytest.mark.parametrize(
    "kinds",
    [
        {"wide": True, "index": False},
        {"shuffled": True, "group": 1000},
        {"shuffled": True, "wide": True, "group": 1},
        {"group": 1000},
        None,
    ],
    ids=str,
)
def test_all_variants_of_version_2_and_version_1_agree(v1, v2, tmp_path, kinds):
    if kinds is None:
        assert Waymo().parts(v1) == [TFRECORD]
    else:
        files.write_v2(tmp_path, **kinds)
    items, skipped = everything(v1 if kinds is None else tmp_path)
    check(items)
    want, also = everything(v2)
    assert skipped == also and len(items) == len(want)
    for x, y in zip(items, want, strict=True):
        assert (x.sequence, x.frame, x.track, x.time) == (y.sequence, y.frame, y.track, y.time)
        np.testing.assert_allclose(x.points, y.points, atol=1e-6)
        for name in ("ring", "joints", "joint_labels"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


def test_tables_of_two_segments_are_joined_by_segment(v2, tmp_path):
    # another segment with the same times and tracks, but people at other positions
    later = files.scene()[1:]
    files.write_v2(tmp_path)
    files.write_v2(tmp_path, segment="9999_0_000_20_000", split="validation", frames=later)
    for name in COMPONENTS:
        both = [tmp_path / "training" / name / f"{SEGMENT}.parquet"]
        both += [tmp_path / "validation" / name / "9999_0_000_20_000.parquet"]
        tables = [pq.read_table(path) for path in both]
        pq.write_table(pa.concat_tables(tables), both[0])
    source = Waymo()
    assert source.parts(tmp_path) == [f"training/{SEGMENT}", "validation/9999_0_000_20_000"]
    items, _ = everything(tmp_path, source)
    found = Counter((item.sequence, item.frame, item.time) for item in items)
    start, second = (frame.time for frame in files.scene()[:2])
    assert found == {(SEGMENT, start, 0.0): 2, (SEGMENT, second, 0.5): 2, ("9999_0_000_20_000", second, 0.0): 4}
    check([item for item in items if item.sequence == SEGMENT])


def test_box_margin_selects_points(v2, monkeypatch):
    wide, _ = everything(v2)
    monkeypatch.setattr(waymo_frames, "MARGIN", -0.1)
    tight, _ = everything(v2)
    for a, b in zip(tight, wide, strict=True):
        inside = b.box.contains(b.points, -0.1)
        np.testing.assert_array_equal(a.points, b.points[inside])
        assert 0 < inside.sum() < len(inside)
    assert Waymo().about["settings"] == {"box_margin_m": -0.1}


def test_prepare_writes_waymo_and_counts_corrupted_segment(v2, tmp_path):
    raw = shutil.copytree(v2, tmp_path / "raw")
    files.write_v2(raw, segment="damaged", frames=files.scene()[:1])
    path = raw / "training/lidar_hkp/damaged.parquet"
    path.write_bytes(path.read_bytes()[:-50])
    summary = prepare("waymo", raw, tmp_path / "out", progress=False)
    assert summary["people"] == 4 and summary["skipped"]["the rest of a part cannot be read"] == 1
    assert "damaged" in summary["skipped_first"]["the rest of a part cannot be read"]
    dataset = open_dataset(tmp_path / "out")
    assert dataset.card.settings["box_margin_m"] == 0.2
    check([item for item in dataset.items()])


# --- range images to points, by hand


def top(T=None, **given):
    given = {"laser": 1, "inclinations": np.array([-0.3, -0.1, 0.2]), "low": 0.0, "high": 0.0} | given
    return Calibration(T_vehicle_laser=np.eye(4) if T is None else T, **given)


def test_pixel_poses_rotate_about_x_then_y_then_z():
    image = np.zeros((3, 4))
    image[1, 1] = 2.0
    before, _ = points_of_image(image, top(), None, np.eye(4))
    poses = np.zeros((3, 4, 6))
    poses[1, 1] = 0.3, -0.2, 1.1, 5.0, 6.0, 7.0
    turned = rotation_about("z", 1.1) @ rotation_about("y", -0.2) @ rotation_about("x", 0.3)
    T = files.rigid(4.0, 6.5, 7.0, 1.0)
    after, _ = points_of_image(image, top(), poses, T)
    want = np.linalg.inv(T) @ [*(turned @ before[0] + [5, 6, 7]), 1]
    np.testing.assert_allclose(after[0], want[:3], atol=1e-12)


def test_only_finite_positive_ranges_are_returns():
    image = np.array([[0.0, -1.0, np.nan, np.inf], [1.0, 2.0, 0.0, 3.0], [0.0] * 4])
    points, row = points_of_image(image, top(), None, np.eye(4))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), [1, 2, 3])
    assert row.tolist() == [1, 1, 1]


def test_scene_reveals_wrong_conversions():
    """Each likely mistake moves the points by a few centimeters, so that `check` detects it."""
    frame, laser = files.scene()[1], files.LASERS[1]
    for which in (1, 2):
        image = frame.images[1, which][..., 0]
        of = top(laser.E, inclinations=laser.beams)
        right, _ = points_of_image(image, of, frame.poses, frame.pose)
        near = (image > 0) & (image < 25)
        keep = near[image > 0]
        assert keep.sum() > 100
        wrong = [
            points_of_image(image, of, None, frame.pose)[0],
            points_of_image(image, top(laser.E, inclinations=laser.beams[::-1]), frame.poses, frame.pose)[0],
            points_of_image(image[:, ::-1], of, frame.poses[:, ::-1], frame.pose)[0],
            points_of_image(image, top(files.rigid(*TOP, 0.0), inclinations=laser.beams), frame.poses, frame.pose)[0],
            points_of_image(image, top(laser.E, inclinations=None, low=-0.42, high=0.13), frame.poses, frame.pose)[0],
        ]
        for other in wrong:
            assert np.median(np.linalg.norm(other[keep] - right[keep], axis=1)) > 0.02


# --- version 2: wrong input, memory


def rewritten(path, change):
    """Rewrites a table with `change` applied to its rows."""
    table = pq.read_table(path)
    pq.write_table(pa.Table.from_pylist(change(table.to_pylist()), schema=table.schema), path)


def without(*names):
    return lambda root: [shutil.rmtree(root / "training" / name) for name in names]


def without_people(root):
    path = component(root, "lidar_hkp")
    pq.write_table(pq.read_table(path).slice(0, 0), path)


@pytest.mark.parametrize(
    ("change", "below", "message"),
    [
        (
            without("lidar_pose", "vehicle_pose"),
            "",
            "lacks vehicle_pose, lidar_pose; fetch with: gcloud storage cp -r "
            "gs://waymo_open_dataset_v_2_0_1/training/{vehicle_pose,lidar_pose} ROOT/training/",
        ),
        (
            lambda root: component(root, "lidar").rename(root / "training/lidar/other.parquet"),
            "",
            "lacks 1 of the 1 segments with keypoints; fetch the first with: gcloud storage cp "
            f"gs://waymo_open_dataset_v_2_0_1/training/lidar/{SEGMENT}.parquet ROOT/training/lidar/ ",
        ),
        (without_people, "", "has no segment with laser keypoints"),
        (
            lambda root: files.write_v1(root, split="validation", frames=files.scene()[:1]),
            "",
            f"mixes versions of Waymo: {TFRECORD.replace('training', 'validation')} is version 1, training/",
        ),
        (lambda root: (root / "empty").mkdir(), "empty", "is not the root of Waymo: expected "),
        (lambda root: (root / "empty").mkdir(), "empty", "got nothing; get it at waymo.com"),
        (lambda root: None, "training", "the root is likely ROOT"),
        (lambda root: None, "training/lidar", "is not the root of Waymo"),
        (lambda root: (root / "v1/individual_files/training").mkdir(parents=True), "v1", "ROOT/v1/individual_files"),
    ],
)
def test_wrong_root_error_suggests_fix(copy, change, below, message):
    change(copy)
    with pytest.raises(InputError, match=re.escape(message.replace("ROOT", str(copy)))) as caught:
        Waymo().parts(copy / below)
    assert "\n" not in str(caught.value)


def test_segments_without_keypoints_need_no_other_files(copy):
    pq.write_table(pq.read_table(component(copy, "lidar_hkp")).slice(0, 0), copy / "training/lidar_hkp/nobody.parquet")
    assert Waymo().parts(copy) == [f"training/{SEGMENT}"]


@pytest.mark.parametrize("name", ["lidar", "lidar_pose"])
@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_damaged_range_images_skip_all_people_and_name_file(copy, name, damage):
    path = component(copy, name)
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[4:2000] = bytes(1996)
    path.write_bytes(data[: len(data) // 2] if damage == "cut" else data)
    items, skipped = everything(copy)
    found = Counter(one.reason for one in skipped)
    assert not items and found["range image cannot be read"] == 5 and found["no joint is labeled"] == 1
    where = next(one.where for one in skipped if one.reason == "range image cannot be read")
    assert f"{name}/{SEGMENT}.parquet: cannot be read as Parquet" in where and "\n" not in where


def test_damaged_labels_raise(copy):
    component(copy, "lidar_box").write_bytes(b"PAR1 no table")
    with pytest.raises(InputError, match=r"lidar_box/.*: cannot be read as Parquet .*; fetch it again$"):
        everything(copy)


@pytest.mark.parametrize("name", COMPONENTS)
def test_file_of_other_component_is_reported(copy, name):
    other = "lidar_box" if name != "lidar_box" else "lidar_hkp"
    shutil.copy(component(copy, other), component(copy, name))
    if name in ("lidar", "lidar_pose"):
        _, skipped = everything(copy)
        assert any(f"{name}/{SEGMENT}.parquet: has no column" in one.where for one in skipped)
    else:
        with pytest.raises(InputError, match=f"{name}/.*: has no column"):
            everything(copy)


FIRST = files.START
_KEYPOINT = "[LiDARHumanKeypointsComponent].lidar_keypoints[*]"
_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_BEAMS, _TIME = "[LiDARCalibrationComponent].beam_inclination.values", "key.frame_timestamp_micros"
_SHAPE, _POSE_SHAPE = (f"[{name}Component].range_image_return1.shape" for name in ("LiDAR", "LiDARPose"))


@pytest.mark.parametrize(
    "name, change, reason, lost",
    [
        # change: new values of the first row, or a function of all rows
        ("lidar_pose", lambda rows: [row for row in rows if row[_TIME] != FIRST], "no pixel poses of the top laser", 2),
        ("vehicle_pose", lambda rows: [row for row in rows if row[_TIME] != FIRST], "no vehicle pose of the frame", 2),
        ("lidar", lambda rows: [row for row in rows if row[_TIME] != FIRST], "no range image of the frame", 2),
        ("lidar", lambda rows: [*rows, *rows[:2]], "no points in the box", 0),
        ("lidar_calibration", lambda rows: rows[1:], "range image cannot be read", 4),
        ("lidar_calibration", {_BEAMS: [0.1] * 39}, "range image cannot be read", 4),
        ("vehicle_pose", {_POSE: [0.0] * 16}, "frame cannot be read", 2),
        ("vehicle_pose", {_POSE: [1.0] * 15 + [None]}, "frame cannot be read", 2),
        ("vehicle_pose", {_POSE: np.diag([1.0, 1, -1, 1]).ravel()}, "frame cannot be read", 2),
        # of determinant 1 but not a rotation; and one whose products overflow
        ("vehicle_pose", {_POSE: (np.eye(4) + np.diag([1, 0, 0], 1)).ravel()}, "frame cannot be read", 2),
        ("vehicle_pose", {_POSE: np.diag([1e200, 1e200, 1, 1]).ravel()}, "frame cannot be read", 2),
        ("vehicle_pose", {_TIME: None}, "no vehicle pose of the frame", 2),
        ("lidar", {_SHAPE: [1, 2, 3]}, "range image cannot be read", 2),
        ("lidar", {_SHAPE: [1, None, 3]}, "range image cannot be read", 2),
        ("lidar_pose", {_POSE_SHAPE: [600, 40, 6]}, "range image cannot be read", 2),
        ("lidar_hkp", {_TIME: None}, "label in another format", 1),
        ("lidar_hkp", {"key.laser_object_id": None}, "label in another format", 1),
        ("lidar_hkp", {f"{_KEYPOINT}.keypoint_3d.location_m.y": [1.0]}, "label in another format", 1),
        ("lidar_hkp", {f"{_KEYPOINT}.keypoint_3d.location_m.y": [np.nan] * 16}, "no joint is labeled", 1),
        ("lidar_hkp", {f"{_KEYPOINT}.keypoint_3d.location_m.y": [1e300] * 16}, "no joint is labeled", 1),
        ("lidar_box", {"[LiDARBoxComponent].box.center.x": 1e10}, "label in another format", 1),
        ("lidar_box", {"[LiDARBoxComponent].box.size.z": 0.0}, "label in another format", 1),
    ],
)
def test_bad_value_skips_one_frame_or_person(copy, name, change, reason, lost):
    rewritten(component(copy, name), change if callable(change) else lambda rows: [rows[0] | change, *rows[1:]])
    items, skipped = everything(copy)
    assert len(items) == 4 - lost
    # if all people are lost, the one without points is counted, too; two reasons occur in intact files as well
    usual = 1 if lost == 4 or reason.startswith("no joint") or reason.startswith("no points") else 0
    assert Counter(one.reason for one in skipped)[reason] == lost + usual
    if not lost:
        check(items)


@pytest.mark.parametrize(
    "name, column",
    [("lidar_box", "[LiDARBoxComponent].box.center.x"), ("lidar_hkp", f"{_KEYPOINT}.keypoint_3d.location_m.x")],
)
def test_text_instead_of_numbers_is_skipped(copy, name, column):
    path = component(copy, name)
    table = pq.read_table(path)
    values = ["a" if not isinstance(v, list) else ["a"] * len(v) for v in table[column].to_pylist()]
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, pa.array(values)), path)
    items, skipped = everything(copy)
    assert not items and Counter(one.reason for one in skipped)["label in another format"] >= 4


def test_missing_second_return_is_accepted(copy):
    names = [f"[LiDARComponent].range_image_return2.{part}" for part in ("values", "shape")]
    rewritten(component(copy, "lidar"), lambda rows: [row | dict.fromkeys(names) for row in rows])
    items, _ = everything(copy)
    for item in items:
        points = truth()[item.frame, item.track].points
        want = np.concatenate([points[key][0] for key in sorted(points) if key[1] == 1]) - TOP
        np.testing.assert_allclose(item.points, want, atol=1e-3)


def test_range_images_are_read_incrementally(tmp_path):
    shape, frames = (32, 256, 6), 150
    column = "[LiDARPoseComponent].range_image_return1"
    values = np.random.default_rng(0).random((frames, *shape), np.float32)
    lists = pa.ListArray.from_arrays(np.arange(frames + 1, dtype=np.int32) * values[0].size, values.ravel())
    rows = {
        "key.segment_context_name": ["s"] * frames,
        "key.frame_timestamp_micros": list(range(frames)),
        "key.laser_name": [1] * frames,
        f"{column}.values": lists,
        f"{column}.shape": pa.array([list(shape)] * frames, pa.list_(pa.int32(), 3)),
    }
    path = tmp_path / "all.parquet"
    # a single row group has to be read incrementally
    pq.write_table(pa.table(rows), path)
    del rows, lists
    most, seen = 0, 0
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    for (_, k, _), (image,) in images(path, (column,), {("s", k) for k in range(frames)}):
        np.testing.assert_array_equal(image, values[k])
        most, seen = max(most, pa.total_allocated_bytes() - before), seen + 1
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert seen == frames and most + held < values.nbytes / 4
    # only wanted rows are returned
    assert [key for key, _ in images(path, (column,), {("s", 7), ("s", 3)})] == [("s", 3, 1), ("s", 7, 1)]


# --- version 1


def test_corrupted_record_ends_file_and_is_reported(v1, tmp_path):
    data = (v1 / TFRECORD).read_bytes()
    first = 16 + int.from_bytes(data[:8], "little")
    flipped = lambda k: data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :]  # noqa: E731
    (tmp_path / "training").mkdir()
    for damaged, people, what in (
        (flipped(first + 500), 2, "is damaged in record 1"),
        (flipped(first + 3), 2, "is damaged at record 1"),
        (data[: first + 500], 2, "is cut off in record 1"),
        (data[: first + 5], 2, "is cut off in record 1"),
        (b"\x1f\x8b gzip, or anything else", 0, "is not a TFRecord file"),
    ):
        (tmp_path / TFRECORD).write_bytes(damaged)
        items, skipped = everything(tmp_path)
        assert [item.frame for item in items] == [FIRST] * people
        assert [one.reason for one in skipped] == ["the rest of a part cannot be read"]
        assert what in skipped[0].where and TFRECORD in skipped[0].where and "\n" not in skipped[0].where


def test_records_that_are_not_frames_are_skipped(v1, tmp_path):
    (tmp_path / "training").mkdir()
    scenario = files.record(files.block(5, "a scenario of the motion dataset") + files.double(1, 2.0))
    cut = files.record(files.v1_frame(files.scene()[0], SEGMENT)[:-30])
    (tmp_path / TFRECORD).write_bytes(scenario + cut + (v1 / TFRECORD).read_bytes())
    items, skipped = everything(tmp_path)
    check(items)
    assert [one.reason for one in skipped[:2]] == ["frame cannot be read"] * 2
    assert "record 0: " in skipped[0].where and "record 1: message Frame is cut off" in skipped[1].where


@pytest.mark.parametrize("damage", [lambda data: data[:-9], lambda data: data[:9] + b"\0" + data[10:]])
def test_range_image_with_damaged_zlib_data_skips_frame(tmp_path, damage, monkeypatch):
    pack, first = files.matrix_float, []

    def broken(image):
        data = pack(image)
        first.append(data)
        return damage(data) if len(first) == 3 else data

    monkeypatch.setattr(files, "matrix_float", broken)
    files.write_v1(tmp_path)
    items, skipped = everything(tmp_path)
    assert [item.frame for item in items] == [files.scene()[1].time] * 2
    assert [one.reason for one in skipped[:2]] == ["range image cannot be read"] * 2


@pytest.mark.parametrize(
    "values, shape, told",
    [
        (10, files.number(1, 3), "a range image has 10 values, its stated shape is [3]"),
        # dimensions whose product is 0 in 64 bits
        (
            0,
            files.number(1, 1 << 32) * 2 + files.number(1, 1),
            "0 values, its stated shape is [4294967296, 4294967296, 1]",
        ),
        # very many dimensions
        (1, files.number(1, 1) * 1000, "a range image has 1 values, its stated shape is [1, 1, 1, 1, 1, 1, ...]"),
        (1, files.block(1, b"\1" * 65536), "message Shape has 65,540 bytes, more than 65,536: damaged"),
        (None, b"", "no pixel poses of the top laser"),
    ],
)
def test_range_image_of_wrong_size_is_reported(tmp_path, monkeypatch, values, shape, told):
    pack = files.matrix_float
    wrong = b"" if values is None else zlib.compress(files.block(1, bytes(4 * values)) + files.block(2, shape))
    # without values: only the pixel poses are missing
    monkeypatch.setattr(files, "matrix_float", lambda image: wrong if wrong or image.shape[2] == 6 else pack(image))
    files.write_v1(tmp_path, frames=files.scene()[:1])
    items, skipped = everything(tmp_path)
    assert not items and len(skipped) == 2
    assert all(told in f"{one.reason} {one.where}" for one in skipped)


# --- TFRecord and protobuf


def test_records_are_read_with_crc32c_checksums(tmp_path):
    # the usual check value of CRC-32C, masked by hand
    assert files.masked(b"123456789") == (0xE3069283 >> 15 | (0xE3069283 & 0x7FFF) << 17) + 0xA282EAD8 & 0xFFFFFFFF
    written = [b"", b"a", np.random.default_rng(0).bytes(5000), b"last"]
    (tmp_path / "a").write_bytes(b"".join(map(files.record, written)))
    assert list(waymo_v1.records(tmp_path / "a")) == written
    (tmp_path / "empty").write_bytes(b"")
    assert list(waymo_v1.records(tmp_path / "empty")) == []
    with pytest.raises(InputError, match="cannot be read"):
        list(waymo_v1.records(tmp_path / "none"))


def test_frames_above_size_limit_are_not_parsed(v1, monkeypatch):
    monkeypatch.setattr(waymo_v1, "_LARGEST_FRAME", 1000)
    items, skipped = everything(v1)
    assert not items and skipped[0].reason == "frame cannot be read" and "message Frame has" in skipped[0].where


@pytest.mark.long
@pytest.mark.parametrize(
    "field", [b"\x2a\x00", b"\x32\x00", b"\x38\x01", b"\x0a\x00"], ids=["lasers", "labels", "?", "one"]
)
def test_parse_limits_memory_for_hostile_frames(field):
    code = f"""
import resource
from lidarpose.data.readers.waymo_v1 import parse
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
data = {field!r} * (1 << 21)
before = peak()
parse("Frame", data, len(data))
print((peak() - before) / len(data))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert float(ran.stdout) < 25


def test_parse_reads_packed_and_unpacked_numbers():
    data = files.doubles(1, [1.0, 2.0]) + files.block(1, np.array([3.0, 4.0], "<f8").tobytes())
    assert list(waymo_v1.parse("Transform", data, 100).transform) == [1, 2, 3, 4]
    data = files.number(1, 300) + files.block(1, files.varint(7) + files.varint(-1))
    assert list(waymo_v1.parse("Shape", data, 100).dims) == [300, 7, -1]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(["Frame", "Label", "MatrixFloat"]), st.binary(max_size=60), st.integers(0, 400))
def test_parse_raises_only_input_error(name, data, end):
    for kind, content in ((name, data), ("Frame", files.v1_frame(files.scene()[2], "s")[:end])):
        try:
            waymo_v1.parse(kind, content, 400)
        except InputError as error:
            assert "\n" not in str(error) and "is cut off or damaged" in str(error)


def test_parse_rejects_truncated_frame():
    whole = files.v1_frame(files.scene()[2], "s")[:400]
    with pytest.raises(InputError, match="is cut off or damaged"):
        waymo_v1.parse("Frame", whole[:333], 400)
