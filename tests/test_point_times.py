"""Times of points: columns of files, arguments, and the pose of the newest of several scans."""

from dataclasses import replace

import numpy as np
import pytest
from hostile_files import las, npy, pcd_header
from hypothesis import given, strategies as st

import lidarpose
from lidarpose.data.rows import person_row, sample_of
from lidarpose.errors import InputError
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.eval.protocols import eval_setup
from lidarpose.eval.robustness import people_to_perturb
from lidarpose.inference import estimator
from lidarpose.inference.newest import newest_points, newest_scan
from lidarpose.inference.scan import Scan, read_scan
from lidarpose.inference.tta import average
from lidarpose.io.point_times import as_point_times, time_column, times_of_column
from lidarpose.io.sources.frame import Frame
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.synth.shard_job import SynthesisJob, write_dataset
from lidarpose.synth.street import street
from lidarpose.train.augment import add_disturbances

WIDE = replace(scene_config("wild"), sensors=("os1-64",), accumulated=1.0, distance=(4.0, 8.0))


@pytest.fixture(scope="module")
def model():
    return lidarpose.load(threads=1)


@pytest.fixture(scope="module")
def sample():
    """A person of several scans, with clutter."""
    generator = Generator(scene=replace(WIDE, noise=replace(WIDE.noise, clutter=1.0)), measure=False)
    return next(s for i in range(50) if len((s := generator.person(6, i).sample).points) > 300)


# --- columns


@pytest.mark.parametrize(
    ("names", "values", "seconds"),
    [
        # Ouster's and Livox's drivers count nanoseconds, PCL writes Velodyne's time in seconds
        ("x y z t", [0, 5e7, 1e8], [-0.1, -0.05, 0]),
        ("x y z offset_time line", [0, 2e8, 1e8], [-0.2, 0, -0.1]),
        ("x y z time ring", [-0.1, -0.05, 0.0], [-0.1, -0.05, 0]),
        ("x y z intensity tag line timestamp", [6e11, 6e11 + 1e8, 6e11 + 3e8], [-0.3, -0.2, 0]),
        ("x y z intensity tag line timestamp", [2e14, 2e14 + 1e8, 2e14 + 3e8], [-0.3, -0.2, 0]),
        ("x y z timestamp", [1.7e18, 1.7e18 + 2e8, 1.7e18 + 4e8], [-0.4, -0.2, 0]),
        ("x y z timestamp", [1.7e15, 1.7e15 + 2e5, 1.7e15 + 4e5], [-0.4, -0.2, 0]),
        ("x y z timestamp", [1.7e9 + 0.25, 1.7e9 + 0.5, 1.7e9], [-0.25, 0, -0.5]),
        ("x|y|z|TIMESTAMP (ns)", [0, 5e7, 1e8], [-0.1, -0.05, 0]),
        ("x|y|z|Time [ms]", [0, 50, 100], [-0.1, -0.05, 0]),
        ("x|y|z|time (us)", [0, 5e4, 1e5], [-0.1, -0.05, 0]),
        ("x y z adjustedtime timestamp", [0, 5e4, 1e5], [-0.1, -0.05, 0]),
        ("x y z time", [0.5, np.nan, 1.0], [-0.5, -np.inf, 0]),
        # whole numbers of an unknown unit, float32 seconds since 1970, milliseconds, one time for all
        ("x y z time", [0, 1, 2], None),
        ("x y z timestamp", np.float32([1.7e9, 1.7e9 + 200, 1.7e9 + 500]), None),
        ("x y z timestamp", np.float32([6e5 + 0.25, 6e5, 6e5 + 0.5]), None),
        ("x y z timestamp", [1.7e12 + 0.5, 1.7e12 + 1.5, 1.7e12], None),
        ("x y z gps_time", [3.5, 3.5, 3.5], None),
        ("x y z time", [np.nan] * 3, None),
        ("x|y|z|time (furlongs)", [0, 1, 2], None),
        ("x y z intensity", None, None),
    ],
)
def test_times_of_columns_by_name_and_unit(names, values, seconds):
    names = names.split("|" if "|" in names else " ")
    if values is None:
        assert time_column(names) is None
        return
    times = times_of_column(np.asarray(values, float), names)
    if seconds is None:
        assert times is None
    else:
        assert times.dtype == np.float32
        np.testing.assert_allclose(times, seconds, atol=1e-6)


POINTS = np.round(np.random.default_rng(0).normal(0, 1, (6, 3)), 3)
SECONDS = np.array([0.0, 0.1, 0.05, 0.4, 0.3, 0.2])


def ouster_pcd():
    rows = np.zeros(6, "<f4, <f4, <f4, <u4")
    rows.dtype.names = ("x", "y", "z", "t")
    for name, column in zip("xyz", POINTS.T, strict=True):
        rows[name] = column
    rows["t"] = SECONDS * 1e9
    return pcd_header("x y z t", kind="F F F U", points=6) + rows.tobytes()


def records(name):
    rows = np.zeros(6, [(axis, "f8") for axis in "xyz"] + [(name, "f8")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        rows[axis] = column
    rows[name] = 1.7e9 + SECONDS
    return npy(rows)


def text(times):
    rows = (f"{x},{y},{z},{time}\n" for (x, y, z), time in zip(POINTS, times, strict=True))
    return ("x,y,z,timestamp\n" + "".join(rows)).encode()


FILES = {
    "ouster.pcd": ouster_pcd(),
    "hesai.npy": records("timestamp"),
    "old.las": las(POINTS, kind=1, times=3e5 + SECONDS),
    "new.las": las(POINTS, version="1.4", kind=6, times=3e5 + SECONDS),
    "hesai.csv": text(1.7e9 + SECONDS),
    "ply.ply": (
        "ply\nformat ascii 1.0\nelement vertex 6\n"
        + "".join(f"property double {name}\n" for name in ("x", "y", "z", "time"))
        + "end_header\n"
        + "".join(f"{x} {y} {z} {time}\n" for (x, y, z), time in zip(POINTS, SECONDS, strict=True))
    ).encode(),
}


@pytest.mark.parametrize("name", FILES)
def test_read_points_reads_times_of_points(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name])
    cloud = lidarpose.read_points(tmp_path / name)
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(cloud.point_times, SECONDS - 0.4, atol=1e-6)


def test_times_that_are_no_numbers_do_not_matter(tmp_path):
    (tmp_path / "dates.csv").write_bytes(text(["2026-01-01T00:00:00"] * 6))
    cloud = lidarpose.read_points(tmp_path / "dates.csv")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.point_times is None and cloud.fields[-1] == "timestamp"
    (tmp_path / "missing.csv").write_bytes(text([0.5, "", 0.25, 0.125, 1.0, 0.75]).replace(b"x,y,z,timestamp", b""))
    assert lidarpose.read_points(tmp_path / "missing.csv").point_times is None
    (tmp_path / "bad.csv").write_bytes(b"x,y,z,time\n1,2,3,0.5\n1,2,oops,0.6\n")
    with pytest.raises(InputError, match="numbers for x, y and z"):
        lidarpose.read_points(tmp_path / "bad.csv")


def test_dropped_points_have_no_times(tmp_path):
    rows = np.column_stack([POINTS, SECONDS])
    rows[2, 1] = np.nan
    (tmp_path / "a.csv").write_text("x,y,z,time\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist()))
    cloud = lidarpose.read_points(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.point_times, np.delete(SECONDS, 2) - 0.4, atol=1e-6)
    # at 0, 0, 0 twice: dropped when a scan is read, with their times
    points = np.concatenate([np.zeros((2, 3)), POINTS])
    scan = read_scan(Scan(points=np.zeros((0, 3))), points, None, np.concatenate([[9, 9], SECONDS]))
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.point_times, SECONDS - 9, atol=1e-6)


@pytest.mark.parametrize(
    "times", [[0.1], np.zeros((6, 1)), "noon", np.zeros(6, "datetime64[ns]"), [None] * 6, [True] * 6]
)
def test_times_must_be_a_number_of_seconds_per_point(times):
    with pytest.raises(InputError, match="point_times: expected 6 numbers of seconds, one per point, got"):
        as_point_times(times, 6)
    with pytest.raises(InputError, match="6 numbers of seconds"):
        lidarpose.predict(POINTS, point_times=times)


def test_times_of_32_bits_that_are_too_coarse_are_refused():
    times = np.float32(1.7e9 + SECONDS)
    with pytest.raises(
        InputError, match=r"point_times: float32 seconds from 1.7e\+09 on are rounded to 1.3e\+02 s: give"
    ):
        lidarpose.predict(POINTS, point_times=times)
    # a map of days, whose newest points have fine times
    assert as_point_times(np.float32([-2e5, -1, 0, np.nan]), 4).tolist() == [-2e5, -1, 0, -np.inf]


def test_times_may_be_missing_or_huge():
    with np.errstate(all="raise"):
        assert as_point_times([1e300, -1e300, np.nan, np.inf, 0, 1], 6).tolist()[0] == 0
    nobody = np.full(6, -np.inf, np.float32)
    with np.errstate(all="raise"):
        assert newest_points(POINTS, nobody, np.zeros(3)) is None
        assert newest_scan(POINTS, nobody, np.zeros(3)) is None


# --- the newest points


@given(st.lists(st.floats(0, 0.5, width=32), min_size=1, max_size=60), st.integers(0, 5), st.integers(0, 99))
def test_newest_points_are_within_one_scan_of_the_newest(times, copies, seed):
    points = np.random.default_rng(seed).normal((8, 0, 0), (0.2, 0.2, 0.5), (len(times), 3))
    points, times = np.concatenate([points, points[:copies]]), np.array([*times, *times[:copies]], np.float32)
    newest = newest_points(points, times, np.zeros(3))
    is_newest = times > times.max() - 0.09
    angles = np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], np.hypot(*points[:, :2].T))
    if newest is not None:
        assert is_newest.mean() <= 0.8 and len(newest) >= 5
        np.testing.assert_array_equal(np.unique(newest, axis=0), np.unique(points[is_newest], axis=0))
    elif is_newest.mean() <= 0.8 and len(np.unique(points[is_newest], axis=0)) >= 5:
        # measured side by side: in some direction hardly any new point lies among the older ones
        old, new = np.stack(angles)[:, ~is_newest], np.stack(angles)[:, is_newest]
        is_among = (new > old.min(1, keepdims=True)) & (new < old.max(1, keepdims=True))
        assert is_among.mean(1).min() < 0.2
    assert newest_points(points, times, None) is None


@pytest.mark.parametrize("axis", [1, 2])
def test_person_cut_by_the_beginning_of_a_turn_is_of_one_scan(axis):
    """The halves are 0.1 s apart. So are parts of people whom a slow scan passes; people scanned again overlap."""
    points = np.random.default_rng(0).normal((-8, 0, 0), (0.2, 0.2, 0.5), (400, 3))
    halves = np.where(points[:, axis] > 0.05, 0.0, 0.1).astype(np.float32)
    slow = ((points[:, axis] - points[:, axis].min()) * 0.3).astype(np.float32)
    for times in (halves, slow):
        assert newest_points(points, times, np.zeros(3)) is None
    walking = points + [0, 0.3, 0]
    both, times = np.concatenate([points, walking]), np.repeat(np.float32([0, 0.1]), 400)
    np.testing.assert_array_equal(newest_points(both, times, np.zeros(3)), walking)


def test_accumulated_people_know_when_each_point_was_measured(sample):
    frames = len(np.unique(sample.point_times))
    assert sample.point_times.max() == 0 and 2 <= frames <= 5
    np.testing.assert_allclose(np.unique(sample.point_times), -0.1 * np.arange(frames)[::-1], atol=1e-6)
    # clutter is of all scans
    assert len(np.unique(sample.point_times[sample.ring == -1])) == frames
    # the body's points of a scan are where it was
    middles = [
        sample.points[(sample.point_times == t) & (sample.part > 0)].mean(0) for t in (0, sample.point_times.min())
    ]
    assert np.linalg.norm(middles[0] - middles[1]) > 0.02
    row = person_row(sample, index=3)
    np.testing.assert_array_equal(sample_of(_flat(row)).point_times, sample.point_times)
    with pytest.raises(InputError, match="point_times has"):
        sample_of(_flat(row) | {"point_times": sample.point_times[1:]})
    # disturbances move and add points
    disturbed = add_disturbances(sample, strays=1.0, noise=1.0, rng=np.random.default_rng(0))
    assert len(disturbed.points) > len(sample.points) and disturbed.point_times is None
    single = Generator(scene=replace(WIDE, accumulated=0.0), measure=False).person(6, 0).sample
    assert single.point_times is None and sample_of(_flat(person_row(single, index=0))).point_times is None


def _flat(row):
    """As read from a shard, where lists are flat."""
    return {
        name: value.ravel() if isinstance(value, np.ndarray) and value.ndim > 1 else value
        for name, value in row.items()
    }


def test_pose_of_several_scans_is_averaged_with_that_of_the_newest(sample, model):
    """The slow way: two predictions, the newer one weighted three times."""
    points, times = sample.points.astype(float), sample.point_times
    options = {"sensor_origin": (0, 0, 0), "skeleton": "body26"}
    both = model.predict(points, point_times=times + 100.0, **options)
    unknown = model.predict(points, point_times=times, skeleton="body26")
    np.testing.assert_array_equal(unknown.joints, model.predict(points, skeleton="body26").joints)
    every = model.predict(points, **options)
    pelvis = every.pose.joints[:1]
    newest = newest_points(points, times, np.zeros(3))
    newest = newest[np.hypot(*(newest - pelvis)[:, :2].T) < 1.25]
    (alone,) = model.poses([newest], np.zeros(3), box_centers=pelvis)
    expected = average([every.pose, alone], (1.0, 3.0))
    np.testing.assert_allclose(both.joints, expected.joints, atol=1e-4)
    np.testing.assert_allclose(both.pose.confidence, expected.confidence, atol=1e-5)
    weights = np.array([every.pose.confidence.mean(), alone.confidence.mean()]) ** 8 * [1, 3]
    slow = np.einsum("k,kjc->jc", weights / weights.sum(), np.stack([every.pose.joints, alone.joints]))
    np.testing.assert_allclose(both.joints, slow, atol=1e-4)
    # of points of one scan, nothing changes
    for same in (np.zeros(len(points)), np.linspace(0, 0.1, len(points))):
        np.testing.assert_array_equal(model.predict(points, point_times=same, **options).joints, every.joints)
    # a list of clouds
    listed = model.predict([points, points], point_times=[None, times], **options)
    np.testing.assert_allclose(listed.to_numpy()[:, 0], [every.joints[0], both.joints[0]], atol=1e-4)
    with pytest.raises(InputError, match="list with the times of each of 2 clouds"):
        model.predict([points, points], point_times=times)
    with pytest.raises(InputError, match=r"point_times\[1\]: expected"):
        model.predict([points, points], point_times=[None, times[1:]])


def test_files_boxes_and_recordings_use_times_of_points(sample, model, tmp_path, monkeypatch):
    points, times = sample.points.astype(float), sample.point_times.astype(float)
    known = {"sensor_origin": (0, 0, 0), "skeleton": "body26"}
    both = model.predict(points, point_times=times, **known).joints
    rows = np.column_stack([points, 1.7e9 + 0.015625 + times])
    for k in range(2):
        path = tmp_path / "frames" / f"{k}.csv"
        path.parent.mkdir(exist_ok=True)
        path.write_text("x,y,z,timestamp\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist()))
    options = {"model": model} | known
    cloud = lidarpose.read_points(path)
    for source in (path, cloud):
        np.testing.assert_allclose(lidarpose.predict(source, crop=True, **options).people[0].joints, both, atol=2e-3)
    np.testing.assert_allclose(model.predict(cloud, **known).joints, both, atol=2e-3)
    with pytest.raises(InputError, match="point_times are for arrays, a file has its own"):
        lidarpose.predict(path, point_times=times)
    # the person's points among others of a scan, in another order, with copies
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-9, 9, (3000, 2)), np.full(3000, sample.points[:, 2].min() - 1.0)])
    order = rng.permutation(len(ground) + len(points))
    scan, scan_times = (
        np.concatenate([ground, points])[order],
        np.concatenate([rng.choice(np.unique(times), len(ground)), times])[order],
    )
    boxed = lidarpose.predict(scan, point_times=scan_times, boxes=[sample.box], **options).people[0].joints
    own = model.predict(scan, point_times=scan_times, boxes=[sample.box], **known).people[0].joints
    np.testing.assert_array_equal(own, boxed)
    without = lidarpose.predict(scan, boxes=[sample.box], **options).people[0].joints
    assert np.linalg.norm(boxed - without, axis=-1).max() > 0.01
    np.testing.assert_allclose(boxed, both, atol=0.05)
    # frames of a recording
    given = lidarpose.predict_recording(tmp_path / "frames", track=False, **options)
    for frame in given:
        np.testing.assert_allclose(frame.poses.people[0].joints, both, atol=2e-3)
    frames = [Frame(points=points, point_times=times, index=0, id="0")]
    (frame,) = lidarpose.predict_recording(frames, track=False, **options)
    np.testing.assert_allclose(frame.poses.people[0].joints, both, atol=2e-3)
    with monkeypatch.context() as patch:
        patch.setattr(estimator, "_NEWEST_WEIGHT", 0.0)
        (unused,) = lidarpose.predict_recording(frames, track=False, **options)
    assert np.linalg.norm(unused.poses.people[0].joints - both, axis=-1).max() > 0.01


def test_evaluation_uses_times_of_points(model, tmp_path, monkeypatch):
    """The setup gets them from the dataset, cropped as the points; perturbed points have none."""
    job = SynthesisJob(what="people", count=10, sensors=("os1-64",), set=("accumulated=1.0",), seed=3)
    write_dataset(job, tmp_path / "people")
    setup = eval_setup(model, open_eval_dataset(tmp_path / "people"))
    people = list(setup.dataset)
    crops = [setup.crop_sample(person)[0] for person in people]
    assert all(len(crop.points) == len(crop.point_times) for crop in crops)
    timed, untimed = (
        setup.predict([replace(crop, **change) for crop in crops]) for change in ({}, {"point_times": None})
    )
    clouds = [newest_points(crop.points, crop.point_times, np.zeros(3)) for crop in crops]
    has_newest = np.array([cloud is not None for cloud in clouds])
    changed = np.abs(timed.pred - untimed.pred).max((1, 2)) > 1e-3
    assert has_newest.sum() > 5 and (changed[has_newest]).mean() > 0.9 and not changed[~has_newest].any()
    assert all(person.shown.point_times is None for person in people_to_perturb(setup))


# --- whole scans


def turn_times(points, start, seconds=0.1):
    """Times of a turn of a sensor whose beam has the azimuth `start` rad when it begins."""
    return ((np.arctan2(points[:, 1], points[:, 0]) - start) / (2 * np.pi) % 1) * seconds


@pytest.fixture(scope="module")
def turns():
    """Three turns of a sensor that stands still, at 10 Hz: points within 25 m, to save time; and the people's joints
    in the last one."""
    frames = street(5150, 1, sensor="os1-64", people=(6, 8), frames=3).frames
    clouds = [frame.points[np.hypot(*frame.points[:, :2].T) < 25].astype(float) for frame in frames]
    return clouds, frames[-1].joints


def joined(turns, start):
    """Points and times of three turns; without a start, all points of a turn have one time."""
    own = [np.zeros(len(turn)) if start is None else turn_times(turn, start) for turn in turns]
    return np.concatenate(turns), np.concatenate([times + 0.1 * k for k, times in enumerate(own)]).astype(np.float32)


@pytest.mark.parametrize("start", [None, -np.pi, 0.7])
def test_newest_scan_is_the_last_turn_wherever_it_begins(turns, start):
    points, times = joined(turns[0], start)
    is_newest, is_last = (
        newest_scan(points, times, np.zeros(3)),
        np.arange(len(points)) >= len(points) - len(turns[0][-1]),
    )
    # but for the sector in which the turn begins
    assert (is_newest != is_last).mean() < 0.002
    # one stray later time does not matter
    stray = np.append(times, np.float32(500))
    assert newest_scan(np.concatenate([points, points[:1]]), stray, np.zeros(3))[:-1].sum() >= is_newest.sum() - 200
    assert newest_scan(points, times, None) is None and newest_scan(points, None, np.zeros(3)) is None


@pytest.mark.parametrize("seconds", [0.1, 0.125, 0.2, 0.5, 2.0])
def test_single_scans_are_not_several(turns, seconds):
    points = turns[0][-1]
    for start in np.arange(0, 2 * np.pi, 0.9):
        assert newest_scan(points, turn_times(points, start, seconds).astype(np.float32), np.zeros(3)) is None
    elevation = np.arctan2(points[:, 2], np.hypot(*points[:, :2].T))
    nodding = (elevation - elevation.min()) / np.ptp(elevation) * seconds
    assert newest_scan(points, nodding.astype(np.float32), np.zeros(3)) is None
    # a map: the same scene, an hour later
    both, hour = np.concatenate([points, points]), np.repeat(np.float32([0, 3600]), len(points))
    assert newest_scan(both, hour, np.zeros(3)) is None


@pytest.mark.long
@pytest.mark.parametrize("start", [None, 0.7])
def test_newest_of_several_scans_is_searched(turns, model, start):
    """The boxes are those of the newest scan; people in them keep older points."""
    points, times = joined(turns[0], start)
    last, true = turns[0][-1], turns[1]
    order = np.random.default_rng(0).permutation(len(points))
    boxes, alone = lidarpose.detect(points[order], point_times=times[order]), lidarpose.detect(last)
    assert len(boxes) == len(alone) >= 3 and "people are searched for in the newest" in boxes.warnings[0]
    assert not alone.warnings
    places = [np.array(sorted(box.center.tolist() for box in group)) for group in (boxes, alone)]
    np.testing.assert_allclose(*places, atol=0.05)
    poses = model.predict(points[order], find=True, point_times=times[order], skeleton="body26")
    num_alone = sum(len(person.points) for person in model.predict(last, find=True))
    assert len(poses.scan) == len(points) and sum(len(person.points) for person in poses) > 1.5 * num_alone
    for person in poses:
        assert person.box.contains(person.points).all()
        assert np.linalg.norm(true - person.joints, axis=-1).mean(1).min() < 0.12
    # turned so that y points up: rows of older points are those in the level boxes
    turned = points[order] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
    found = lidarpose.predict(turned, find=True, point_times=times[order], up="-y", model=model, skeleton="body26")
    counts = (sorted(len(person.points) for person in people) for people in (found, poses))
    np.testing.assert_allclose(*counts, rtol=0.1)


def test_newest_scan_is_found_about_the_sensor(turns):
    """Wherever it stands in the frame of the points."""
    points, times = joined(turns[0], 0.7)
    origin = np.array([32.0, -16.0, 2.0])
    np.testing.assert_array_equal(newest_scan(points + origin, times, origin), newest_scan(points, times, np.zeros(3)))


def test_person_cut_by_a_turn_is_seen_from_the_sensor():
    points = np.random.default_rng(0).normal((-8, 0, 0), (0.2, 0.2, 0.5), (400, 3))
    halves = np.where(points[:, 1] > 0.05, 0.0, 0.1).astype(np.float32)
    assert newest_points(points + [8, 8, 0], halves, np.array([8.0, 8, 0])) is None


def test_newest_points_are_distinct_and_none_of_a_map():
    points = np.random.default_rng(0).normal((-8, 0, 0), (0.2, 0.2, 0.5), (400, 3))
    walking = points + [0, 0.3, 0]
    both, times = np.concatenate([points, walking]), np.repeat(np.float32([0, 1]), 400)
    # second returns
    twice = newest_points(np.concatenate([both, walking]), np.append(times, times[400:]), np.zeros(3))
    np.testing.assert_array_equal(twice, walking)
    # over two seconds
    assert newest_points(both, 1.9 * times, np.zeros(3)) is not None
    assert newest_points(both, 2.1 * times, np.zeros(3)) is None
