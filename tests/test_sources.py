"""Folders, patterns and files as sources of frames: order, times, datasets, and damaged files."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hostile_files import refusal
from hypothesis import given, settings, strategies as st

import lidarpose
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.inference.background import learn_background, read_background
from lidarpose.io.sources import DamagedFrame, FrameSource, is_single_scan, kitti, open_source
from lidarpose.io.sources.folders import in_order
from lidarpose.io.sources.frame import ChainedRecording, IndexedRecording, ReadingOptions, Sweep

POINTS = np.arange(1, 13, dtype=np.float32).reshape(4, 3)


def saved(folder, *names):
    """Writes a .npy file for each name; the k-th contains POINTS * (k + 1)."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        with open(folder / name, "wb") as file:
            np.save(file, POINTS * (k + 1))
    return folder


def ids(source):
    return [frame.id for frame in source]


def numbered(count, times=None, damaged=()):
    """A recording of `count` frames; the frames `damaged` cannot be decoded."""

    def read(i):
        if i in damaged:
            raise InputError(f"frame {i} is damaged")
        return Sweep(points=POINTS * (i + 1))

    return IndexedRecording(name="made", ids=[f"{i:03}" for i in range(count)], times=times, read=read)


def test_folder_is_sorted_by_number(tmp_path):
    saved(tmp_path, "frame_10.npy", "frame_2.npy", "Frame_1.npy", ".hidden.npy", "._frame_3.npy")
    (tmp_path / "frame_3.npy").mkdir()
    source = lidarpose.open_source(tmp_path)
    assert ids(source) == ["Frame_1", "frame_2", "frame_10"] and source.count == 3
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2] and np.allclose([f.time for f in frames], [0, 0.1, 0.2])
    assert np.array_equal(frames[1].points, POINTS * 2.0) and frames[1].points.dtype == np.float64
    assert source.warnings == (
        "has no times: read as 10 frames per second (change it with rate, on the command line --rate)",
    )
    assert not open_source(tmp_path, rate=20).warnings


@given(
    st.integers(0, 25),
    st.floats(0.5, 40),
    st.sets(st.integers(0, 24)),
    st.integers(1, 6),
    st.none() | st.floats(0, 1.5),
    st.none() | st.floats(1.6, 4),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_frame_selection_matches_plain_filter(first, rate, damaged, every, start, end, has_times):
    times = np.cumsum(np.linspace(0.05, 0.2, 25)) + 1e9 if has_times else np.arange(25) / rate
    recording = numbered(25, times if has_times else None, damaged)
    source = FrameSource(recording, rate=rate, start=start, end=end, every=every)
    since = times - times[0] if has_times else times
    chosen = [
        i
        for i in range(first, 25)
        if (start is None or since[i] >= start - 1e-6) and (end is None or since[i] <= end + 1e-6) and i % every == 0
    ]
    frames = list(source.frames(first))
    assert [frame.index for frame in frames] == chosen
    assert [isinstance(frame, DamagedFrame) for frame in frames] == [i in damaged for i in chosen]
    assert [frame.time for frame in frames] == list(times[chosen])
    assert source.count == len(list(source))


def test_start_and_end_are_exact_for_epoch_times():
    source = FrameSource(numbered(5, times=list(1_700_000_000 + np.arange(5) / 10)), start=0.1, end=0.2)
    assert [frame.index for frame in source] == [1, 2]


# ---- names


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=30, unique=True), st.sampled_from(["", "frame_", "a1-"]))
def test_in_order_sorts_names_by_number(numbers, prefix):
    ordered, _ = in_order([Path(f"{prefix}{number}.pcd") for number in numbers])
    assert [path.stem for path in ordered] == [f"{prefix}{number}" for number in sorted(numbers)]


@pytest.mark.parametrize(
    "names, times",
    {
        "seconds": (["1700000000.5", "1700000000.25", "1700000001"], [1700000000.25, 1700000000.5, 1700000001.0]),
        "fractions": (["1641234567_123", "1641234567_223"], [1641234567.123, 1641234567.223]),
        "ms": (["a_1700000000123", "a_1700000000023"], [1700000000.023, 1700000000.123]),
        "us": (
            ["n015__LIDAR_TOP__1532402927647951.pcd", "n015__LIDAR_TOP__1532402927697999.pcd"],
            [1532402927.647951, 1532402927.697999],
        ),
        "ns": (["1700000000000000000", "1700000000100000000"], [1700000000.0, 1700000000.1]),
        "numbers of ten digits": (["0000000000", "0000000001"], None),
        "dates": (["2018072411224500", "2018072411224510"], None),
        "twice": (["a_1700000000", "a_1700000000.0"], None),
        "two sensors": (["a_1700000000", "a_1700000002", "b_1700000001"], None),
        "nanoseconds or fractions": (["1700000000_5", "1700000000_10"], None),
        "not all": (["1700000000", "1700000001", "readme"], None),
    }.values(),
)
def test_in_order_reads_times_from_names(tmp_path, names, times):
    saved(tmp_path, *(f"{name}.bin" for name in names))
    assert in_order(list(tmp_path.iterdir()))[1] == times


# ---- folders, patterns, files


def test_damaged_file_gives_damaged_frame(tmp_path):
    saved(tmp_path, *(f"{k}.npy" for k in range(6)))
    (tmp_path / "2.npy").write_bytes(b"")
    (tmp_path / "4.npy").write_bytes((tmp_path / "4.npy").read_bytes()[:-7])
    frames = list(open_source(tmp_path))
    assert [type(frame).__name__ for frame in frames] == ["Frame"] * 2 + ["DamagedFrame", "Frame"] * 2
    assert [frame.index for frame in frames] == list(range(6)) and frames[2].id == "2" and frames[2].time == 0.2
    assert "2.npy: is empty" in frames[2].error and "4.npy" in frames[4].error


def test_folder_of_mixed_files_selects_format(tmp_path):
    saved(tmp_path, "1.npy", "2.npy", "10.NPY")
    for name in ("4.xyz", "poses.txt", "times.txt", "a.csv", "b.csv", "c.csv", "d.csv", "picture.png", "a.mcap"):
        (tmp_path / name).write_text("1 2 3\n")
    source = open_source(tmp_path, rate=10)
    assert ids(source) == ["1", "2", "10"] and source.warnings == (
        "only its 3 .npy files are read, not 1 .mcap: give a pattern to read those",
    )
    (tmp_path / "a.mcap").unlink()
    assert open_source(tmp_path, rate=10).warnings == ()
    # files given by name are always read
    named = open_source([tmp_path / "1.npy", tmp_path / "poses.txt"])
    assert ids(named) == ["1", "poses"] and "mixes .npy, .txt files" in named.warnings[0]
    np.savez(tmp_path / "3.npz", POINTS)
    source = open_source(tmp_path, rate=10)
    assert (
        ids(source) == ["1", "2", "3", "10"] and len(source.warnings) == 1 and "mixes .npy, .npz" in source.warnings[0]
    )
    np.savez(tmp_path / "2.npz", POINTS)
    source = open_source(tmp_path, rate=10)
    assert ids(source) == ["1", "2", "10"] and "only its 3 .npy files are read, not 2 .npz" in source.warnings[0]
    np.savez(tmp_path / "10.npz", POINTS)
    # as many .npy, which may be boxes
    assert "only its 3 .npz files are read, not 3 .npy" in open_source(tmp_path, rate=10).warnings[0]
    for path in tmp_path.glob("*.[nN][pP]?"):
        path.unlink()
    source = open_source(tmp_path, rate=10)
    assert ids(source) == ["a", "b", "c", "d"] and "4 .csv" in source.warnings[0]


def test_raw_float_columns_follow_first_file(tmp_path):
    rows = np.random.default_rng(0).normal(0, 9, (40, 5)).astype(np.float32)
    rows[:, 4] = np.arange(40) % 16
    for k in range(4):
        (tmp_path / f"{k}.bin").write_bytes(rows.tobytes())
    # this file has no ring numbers, so 4 and 5 columns are both possible
    (tmp_path / "2.bin").write_bytes((rows + 0.25).tobytes())
    source = open_source(tmp_path, rate=10)
    assert [len(frame.points) for frame in source] == [40] * 4
    assert len(source.warnings) == 1 and "(nuScenes)" in source.warnings[0]
    assert not any(frame.warnings for frame in source)
    assert [len(frame.points) for frame in open_source(tmp_path, columns=4)] == [50] * 4


def test_invalid_rows_are_dropped():
    points = np.array([[0, 0, 0], [1, 2, 3], [np.nan, 1, 1], [0, 0, 1], [np.inf, 0, 0]])
    recording = IndexedRecording(
        name="a", ids=["0"], times=None, read=lambda i: Sweep(points=points, ring=np.arange(5))
    )
    (frame,) = FrameSource(recording)
    assert frame.points.tolist() == [[1, 2, 3], [0, 0, 1]] and frame.ring.tolist() == [1, 3]


def test_open_source_accepts_patterns_lists_and_recursion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "day" / "a", "f_10.npy", "f_2.npy")
    saved(tmp_path / "day" / "b", "f_2.npy")
    assert ids(open_source("day/a/f_*.npy")) == ["f_2", "f_10"]
    Path("day/a/f_2.json").write_text("{}")
    assert ids(open_source("day/a/*")) == ["f_2", "f_10"]
    assert ids(open_source(["day/a/f_10.npy", Path("day/a/f_2.npy")])) == ["f_2", "f_10"]
    assert ids(open_source("day/**/*.npy")) == [str(Path(p)) for p in ("a/f_2.npy", "a/f_10.npy", "b/f_2.npy")]
    # folders match, too, and their files are not read twice
    assert ids(open_source("day/**")) == ids(open_source("day/**/*.npy"))
    # results are read only if a pattern matches nothing else
    Path("day/a/f.poses.csv").write_text("1,2,3\n")
    assert ids(open_source("day/a/*")) == ["f_2", "f_10"] and ids(open_source("day/a/*.csv")) == ["f.poses"]
    folders = open_source(["day/b", "day/a"])
    assert ids(folders) == ["a/f_2", "a/f_10", "b/f_2"]
    assert folders.count == 3 and [frame.index for frame in folders.frames(2)] == [2]
    if os.name == "posix":
        Path("day/b/f_3.npy").symlink_to("gone.npy")
        frame, damaged = open_source("day/b/*.npy")
        assert "f_3.npy: no such file" in damaged.error


def test_is_single_scan_for_one_plain_file(tmp_path):
    saved(tmp_path, "a.npy", "b[1].npy")
    for single in ("a.npy", "b[1].npy", "missing.pcd", "a.laz"):
        assert is_single_scan(tmp_path / single) and is_single_scan([str(tmp_path / single)])
    for many in (tmp_path, tmp_path / "*.npy", tmp_path / "a.mcap", tmp_path / "a.PCAP"):
        assert not is_single_scan(many), many
    assert not is_single_scan([tmp_path / "a.npy", tmp_path / "b[1].npy"])
    (frame,) = source = open_source(tmp_path / "b[1].npy")
    assert frame.id == "b[1]" and source.warnings == ()


def piped(folder):
    os.mkfifo(folder / "a.mcap")
    return folder / "a.mcap"


@pytest.mark.parametrize(
    "make, words",
    {
        "missing": (lambda folder: folder / "no", ["no such file or folder"]),
        "no match": (lambda folder: folder / "*.pcd", ["no file matches the pattern"]),
        "nothing": (lambda folder: [], ["got none"]),
        "empty": (lambda folder: folder, ["an empty folder", ".pcd", ".mcap"]),
        "pictures": (
            lambda folder: (folder / "a.png").touch() or (folder / "b").mkdir() or folder,
            ["1 .png", "1 folders (b; give one of them)"],
        ),
        **({"pipe": (piped, ["a.mcap: expected a file or folder, got a pipe"])} if hasattr(os, "mkfifo") else {}),
        "hidden": (lambda folder: (folder / ".a.pcd").touch() or folder, ["an empty folder"]),
    }.values(),
)
def test_source_without_points_error_lists_contents(tmp_path, make, words):
    refusal(open_source, make(tmp_path), words=words)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"rate": 0}, ["rate must be positive"]),
        ({"rate": float("nan")}, ["rate must be a finite"]),
        ({"start": 2, "end": 1}, ["end must be later than start", "2 to 1"]),
        ({"every": 0}, ["every", "at least 1"]),
        ({"columns": 2}, ["columns", "at least 3"]),
    ],
)
def test_open_source_rejects_invalid_options(tmp_path, options, words):
    refusal(open_source, saved(tmp_path, "a.npy"), words=words, **options)


# ---- recordings


def test_times_that_jump_back_are_counted_and_order_is_kept():
    source = FrameSource(numbered(6, times=[5.0, 5.1, 4.0, 4.1, 3.0, 5.2]))
    for _ in range(2):
        assert ids(source) == [f"{i:03}" for i in range(6)]
        assert source.warnings == ("time jumps back 2 times: the order of the recording is kept",)


def test_truncated_recording_keeps_frames_before_error():
    class Cut(IndexedRecording):
        def lazy_frames(self, first=0):
            for i, frame in enumerate(super().lazy_frames(first), first):
                if i == 3:
                    raise InputError("a.bag: is cut off")
                yield frame

    made = numbered(6)
    frames = list(FrameSource(Cut(name="a", ids=made.ids, times=None, read=made.read)))
    assert [frame.index for frame in frames] == [0, 1, 2, 3] and "a.bag: is cut off" in frames[3].error


@given(st.lists(st.integers(0, 4), min_size=1, max_size=4), st.integers(0, 12), st.booleans())
def test_chained_recording_concatenates_parts(lengths, first, counted):
    class Uncounted(IndexedRecording):
        count = None

    kind = IndexedRecording if counted else Uncounted
    parts = [kind(name=f"p{k}", ids=[str(i) for i in range(n)], times=None, read=repr) for k, n in enumerate(lengths)]
    chain = ChainedRecording(os.curdir, parts)
    expected = [f"p{k}/{i}" for k, n in enumerate(lengths) for i in range(n)]
    assert [frame.id for frame in chain.lazy_frames(first)] == expected[first:]
    assert chain.count == (sum(lengths) if counted else None)


def test_damaged_recording_does_not_affect_others(tmp_path):
    saved(tmp_path / "a", "0.npy", "1.npy")
    (tmp_path / "b").mkdir()
    saved(tmp_path / "c", "0.npy")
    source = open_source([tmp_path / name for name in "abc"], rate=10)
    assert ids(source) == ["a/0", "a/1", "c/0"]
    assert len(source.warnings) == 1 and "left out: " in source.warnings[0] and "an empty folder" in source.warnings[0]

    def read(i):
        return Sweep(points=POINTS)

    class Cut(IndexedRecording):
        count = None

        def lazy_frames(self, first=0):
            yield from super().lazy_frames(first)
            raise InputError("a.bag: is cut off")

    made = [
        kind(name=name, ids=["0", "1"], times=None, read=read) for kind, name in ((Cut, "a"), (IndexedRecording, "b"))
    ]
    chain = FrameSource(ChainedRecording(os.curdir, made))
    assert [isinstance(frame, DamagedFrame) for frame in chain] == [False, False, True, False, False]
    assert [frame.index for frame in chain.frames(3)] == [3, 4]


def test_unreadable_part_does_not_use_times_of_next_part():
    def refused(first=0):
        raise InputError("a.bag: is damaged")

    times = np.array([100.0, 100.5])
    made = [IndexedRecording(name=name, ids=["0", "1"], times=times, read=repr) for name in "ab"]
    object.__setattr__(made[0], "lazy_frames", refused)
    frames = list(ChainedRecording(os.curdir, made).lazy_frames())
    assert [frame.time for frame in frames] == [None, 100.0, 100.5]


@pytest.mark.parametrize("wrong", [5, b"drive", None])
def test_open_source_and_background_reject_non_paths(wrong):
    for read in (open_source, learn_background):
        with pytest.raises(InputError, match="expected"):
            read(wrong)


def test_background_is_learned_from_any_source(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    wall = rng.uniform((5, -3, 0), (5.01, 3, 3), (4000, 3))
    for k in range(12):
        np.save(tmp_path / f"{k}.npy", wall + rng.normal(0, 0.02, wall.shape))
    expected = learn_background([tmp_path / f"{k}.npy" for k in range(12)])
    for source in (tmp_path, str(tmp_path / "*.npy"), [tmp_path]):
        assert np.array_equal(read_background(source), expected)
    # of many frames, a subset from the first to the last is read
    monkeypatch.setattr("lidarpose.inference.background._MOST_SCANS", 4)
    some = learn_background([tmp_path / f"{k}.npy" for k in (0, 4, 7, 11)])
    assert np.array_equal(read_background(tmp_path), some) and not np.array_equal(some, expected)


def test_background_skips_damaged_scans(tmp_path, monkeypatch):
    wall = np.random.default_rng(0).uniform((5, -3, 0), (5.01, 3, 3), (4000, 3))
    for k in range(5):
        np.save(tmp_path / f"{k}.npy", wall)
    (tmp_path / "3.npy").write_bytes(b"damaged")
    whole = learn_background([tmp_path / f"{k}.npy" for k in (0, 1, 2, 4)])
    with pytest.warns(UserWarning, match=r"background: 1 of 5 scans left out, the first: .*3.npy: "):
        assert np.array_equal(read_background(tmp_path), whole)

    class Cut(IndexedRecording):
        count = None

        def lazy_frames(self, first=0):
            yield from super().lazy_frames(first)
            raise InputError("a.pcap: is cut off")

    cut = FrameSource(Cut(name="a.pcap", ids=["0", "1"], times=None, read=lambda i: Sweep(points=wall)))
    monkeypatch.setattr("lidarpose.inference.background.open_source", lambda *_, **__: cut)
    with pytest.warns(UserWarning, match="1 of 3 scans left out, the first: a.pcap: is cut off"):
        assert np.array_equal(read_background("a.pcap"), whole)
    monkeypatch.undo()
    for k in range(5):
        (tmp_path / f"{k}.npy").write_bytes(b"damaged")
    with pytest.raises(InputError, match="background: none of 5 scans can be read, the first: .*0.npy: "):
        read_background(tmp_path)


# ---- datasets

LANDMARKS = np.random.default_rng(3).uniform(-30, 30, (200, 3)) * (1, 1, 0.1)


def rigid(yaw, pitch, roll, place):
    T = np.eye(4)
    T[:3, :3] = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
    T[:3, 3] = place
    return T


def drive(count=5):
    """T_world_vehicle of frames along a curve."""
    return [rigid(0.5 + 0.1 * k, 0.02 * k, -0.01 * k, (2.0 * k, 0.3 * k**2, 0.1 * k)) for k in range(count)]


def seen(T_world_sensor, width):
    """LANDMARKS in the frame of a sensor, as bytes of float32 rows."""
    rows = np.zeros((len(LANDMARKS), width), np.float32)
    rows[:, :3] = (LANDMARKS - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]
    rows[:, width - 1] = np.arange(len(rows)) % 32
    return rows.tobytes()


def in_world(frame):
    return frame.points @ frame.T_world_sensor[:3, :3].T + frame.T_world_sensor[:3, 3]


def text(values):
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


T_VELO_IMU = rigid(0.01, -0.02, 0.005, (-0.81, 0.32, -0.8))
RADIUS = 6378137.0


def write_raw_drive(folder, poses, *, missing=(), latitude=49.0, oxts_rate=1):
    """Writes a raw drive of KITTI, without the scans `missing`."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    scans, oxts = drive / "velodyne_points" / "data", drive / "oxts" / "data"
    scans.mkdir(parents=True)
    oxts.mkdir(parents=True)
    (drive.parent / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {text(T_VELO_IMU[:3, :3])}\nT: {text(T_VELO_IMU[:3, 3])}\n"
    )
    scale = np.cos(np.radians(latitude))
    north = scale * RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    for k, T_world_imu in enumerate(poses):
        if k not in missing:
            (scans / f"{k:010}.bin").write_bytes(seen(T_world_imu @ np.linalg.inv(T_VELO_IMU), 4))
        x, y, z = T_world_imu[:3, 3]
        place = np.degrees(
            [2 * np.arctan(np.exp((north + y) / (scale * RADIUS))) - np.pi / 2, 0.1 + x / (scale * RADIUS)]
        )
        R = T_world_imu[:3, :3]
        angles = [np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])]
        (oxts / f"{k * oxts_rate:010}.txt").write_text(text([*place, 100 + z, *angles, *np.zeros(24)]))
    lines = [f"2011-09-26 13:02:{25 + 0.1 * k:012.9f}" for k in range(len(poses))]
    (drive / "velodyne_points" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    lines = [f"2011-09-26 13:02:{25 + 0.1 * k / oxts_rate:012.9f}" for k in range(oxts_rate * len(poses))]
    (drive / "oxts" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    return drive


@pytest.mark.parametrize("named, oxts_rate", [(".", 1), ("velodyne_points", 1), ("velodyne_points/data", 10)])
def test_kitti_raw_drive_has_times_and_poses(tmp_path, named, oxts_rate):
    poses = drive()
    folder = write_raw_drive(tmp_path, poses, missing=(2,), oxts_rate=oxts_rate)
    source = open_source(folder / named)
    frames = list(source)
    assert source.warnings == () and [frame.id for frame in frames] == [f"{k:010}" for k in (0, 1, 3, 4)]
    assert np.allclose([f.time - 1317042145 for f in frames], [0, 0.1, 0.3, 0.4], atol=1e-6)
    for frame in frames:
        np.testing.assert_allclose(in_world(frame), LANDMARKS, atol=2e-4)
        assert np.array_equal(frame.origin, np.zeros(3)) and frame.warnings == ()


def test_kitti_raw_drive_with_damaged_tables_keeps_scans(tmp_path):
    folder = write_raw_drive(tmp_path, drive())
    (folder / "oxts" / "data" / f"{3:010}.txt").write_text("1 2 3")
    frames = list(open_source(folder))
    assert [frame.T_world_sensor is None for frame in frames] == [False, False, False, True, False]
    assert frames[3].warnings == ("the sensor's pose is not known",)
    (folder / "velodyne_points" / "timestamps.txt").write_text("yesterday\n" * 5)
    (folder.parent / "calib_imu_to_velo.txt").unlink()
    source = open_source(folder)
    assert [frame.T_world_sensor for frame in source] == [None] * 5 and [frame.time for frame in source][1] == 0.1
    assert len(source.warnings) == 3 and "timestamps.txt" in source.warnings[0] and "oxts" in source.warnings[1]


def write_sequence(folder, T_world_velo, *, semantic=False):
    """Writes a sequence of KITTI odometry or SemanticKITTI, with cameras that look forward."""
    T_cam_velo = np.array([[0.01, -1, 0, 0.02], [0, 0, -1, -0.06], [1, 0.01, 0, -0.33], [0, 0, 0, 1.0]])
    T_cam_velo[:3, :3] = np.linalg.svd(T_cam_velo[:3, :3])[0] @ np.linalg.svd(T_cam_velo[:3, :3])[2]
    sequence = folder / "sequences" / "07"
    (sequence / "velodyne").mkdir(parents=True)
    (folder / "poses").mkdir()
    for k, T in enumerate(T_world_velo):
        (sequence / "velodyne" / f"{k:06}.bin").write_bytes(seen(T, 4))
    identity = text(np.eye(3, 4))
    (sequence / "calib.txt").write_text(f"P0: {identity}\nP1: {identity}\nTr: {text(T_cam_velo[:3])}\n")
    (sequence / "times.txt").write_text("".join(f"{0.1037 * k:e}\n" for k in range(len(T_world_velo))))
    first = np.linalg.inv(T_world_velo[0])
    rows = [(T_cam_velo @ first @ T @ np.linalg.inv(T_cam_velo))[:3] for T in T_world_velo]
    table = sequence / "poses.txt" if semantic else folder / "poses" / "07.txt"
    table.write_text("".join(text(row) + "\n" for row in rows))
    return sequence


def test_kitti_sequence_may_be_directly_below_root(monkeypatch):
    monkeypatch.setattr(kitti, "scan_files", lambda folder: ([folder / "000000.bin"], []))
    assert "poses are not known" in kitti._open_sequence(Path("/data"), ReadingOptions()).warnings[-1]


@pytest.mark.parametrize("semantic", [False, True])
def test_kitti_sequence_has_times_and_poses_in_first_frame(tmp_path, semantic):
    poses = drive()
    sequence = write_sequence(tmp_path, poses, semantic=semantic)
    for folder in (sequence, sequence / "velodyne"):
        source = open_source(folder)
        frames = list(source)
        assert source.warnings == () and [frame.id for frame in frames] == [f"{k:06}" for k in range(5)]
        assert np.allclose([frame.time for frame in frames], 0.1037 * np.arange(5), atol=1e-6)
        assert np.allclose(frames[0].T_world_sensor, np.eye(4))
        for frame in frames:
            np.testing.assert_allclose(in_world(frame), frames[0].points, atol=1e-4)
    for path in (sequence / "velodyne").iterdir():
        rows = np.fromfile(path, "f4").reshape(-1, 4)
        np.pad(rows, ((0, 0), (0, 1)), constant_values=np.nan).tofile(path)
    source = open_source(sequence, columns=5, topic="/points", meta="a.json")
    for frame, expected in zip(source, frames, strict=True):
        np.testing.assert_array_equal(frame.points, expected.points)
    assert source.warnings == ("options that this kind of source does not have are ignored: topic, meta",)
    (sequence / "calib.txt").write_text("Tr: 1 2 3\n")
    source = open_source(sequence)
    assert source.count == 5 and "poses are not known" in source.warnings[0]
    # nanoseconds since 1970
    np.savetxt(sequence / "times.txt", 1.7e18 + 1e8 * np.arange(5))
    source = open_source(sequence, rate=5)
    assert [frame.time for frame in source] == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert "has times that are not seconds: read as 5 frames per second" in source.warnings


def quaternion(R):
    w = np.sqrt(1 + np.trace(R)) / 2
    return [w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))]


def write_nuscenes(root, scenes=("scene-0061", "scene-0103"), version="v1.0-mini", apart=10**9):
    """Writes nuScenes tables and LiDAR sweeps: five frames per scene, of which the second is not a key frame.

    apart: us between the starts of scenes.
    """
    T_ego_sensor = rigid(-1.57, 0.02, 0.01, (0.94, 0, 1.84))
    tables = {name: [] for name in ("sample_data", "sample", "scene", "ego_pose", "calibrated_sensor", "sensor")}
    for channel in ("CAM_FRONT", "LIDAR_TOP"):
        tables["sensor"].append({"token": channel, "channel": channel, "modality": channel[:5].lower()})
        tables["calibrated_sensor"].append(
            {
                "token": f"mount {channel}",
                "sensor_token": channel,
                "translation": T_ego_sensor[:3, 3].tolist(),
                "rotation": quaternion(T_ego_sensor[:3, :3]),
            }
        )
    for number, scene in enumerate(scenes):
        tables["scene"].append({"token": f"token {scene}", "name": scene})
        tables["sample"].append({"token": f"sample {scene}", "scene_token": f"token {scene}"})
        # the later scene comes first in the tables
        begin = 1533151603547590 + (len(scenes) - number) * apart
        for k, T_world_ego in reversed(list(enumerate(drive()))):
            stamp = begin + 50_000 * k
            T = {"translation": T_world_ego[:3, 3].tolist(), "rotation": quaternion(T_world_ego[:3, :3])}
            tables["ego_pose"].append({"token": f"pose {stamp}", "timestamp": stamp, **T})
            for channel, suffix in (("LIDAR_TOP", "pcd.bin"), ("CAM_FRONT", "jpg")):
                part = "sweeps" if k == 1 else "samples"
                name = f"{part}/{channel}/n015-2018-07-24-11-22-45+0800__{channel}__{stamp}.{suffix}"
                tables["sample_data"].append(
                    {
                        "token": f"{channel} {stamp}",
                        "sample_token": f"sample {scene}",
                        "ego_pose_token": f"pose {stamp}",
                        "calibrated_sensor_token": f"mount {channel}",
                        "timestamp": stamp,
                        "filename": name,
                    }
                )
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                (root / name).write_bytes(seen(T_world_ego @ T_ego_sensor, 5))
    (root / version).mkdir()
    for name, rows in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows))
    return root


def test_nuscenes_is_read_by_scene_with_poses(tmp_path):
    root = write_nuscenes(tmp_path)
    for folder in (root, root / "v1.0-mini"):
        source = open_source(folder)
        frames = list(source)
        assert source.warnings == () and source.count == 10
        assert [frame.id.split("/")[0] for frame in frames] == ["scene-0103"] * 5 + ["scene-0061"] * 5
        assert np.allclose(np.diff([frame.time for frame in frames[:5]]), 0.05, atol=1e-6)
        for frame in frames:
            np.testing.assert_allclose(in_world(frame), LANDMARKS, atol=1e-4)
            assert np.array_equal(frame.ring, np.arange(200) % 32)
    one = open_source(root, topic="scene-0061")
    assert one.count == 5 and frames[5].id == next(iter(one)).id
    refusal(open_source, root, topic="scene-0062", words=["unknown scene", "scene-0061"])


def test_nuscenes_keeps_overlapping_scenes_apart(tmp_path):
    frames = list(open_source(write_nuscenes(tmp_path, apart=25_000)))
    assert [frame.id.split("/")[0] for frame in frames] == ["scene-0103"] * 5 + ["scene-0061"] * 5


@pytest.mark.parametrize("damage", [None, {}, {"rotation": [0, 0, 0, 0]}, {"translation": [1, float("nan"), 0]}])
def test_nuscenes_damaged_pose_gives_damaged_frame(tmp_path, damage):
    root = write_nuscenes(tmp_path)
    path = root / "v1.0-mini" / "ego_pose.json"
    rows = json.loads(path.read_text())
    first = min(range(len(rows)), key=lambda i: rows[i]["timestamp"])
    rows[first] = rows[first] | damage if damage else {"token": rows[first]["token"] if damage == {} else "another"}
    path.write_text(json.dumps(rows))
    frames = list(open_source(root))
    assert [isinstance(frame, DamagedFrame) for frame in frames] == [i == 0 for i in range(10)]
    assert "pose in the tables is damaged" in frames[0].error


def test_nuscenes_reads_only_sweeps_on_disk(tmp_path):
    root = write_nuscenes(tmp_path)
    for path in (root / "sweeps" / "LIDAR_TOP").iterdir():
        path.unlink()
    damaged = sorted((root / "samples" / "LIDAR_TOP").iterdir())[2]
    damaged.write_bytes(damaged.read_bytes()[:-3])
    source = open_source(root)
    assert [isinstance(frame, DamagedFrame) for frame in source] == [i == 2 for i in range(8)]
    assert source.warnings == ("2 of 10 sweeps in its tables are not on the disk",)
    os.rename(root / "samples", root / "gone")
    refusal(open_source, root, words=["holds none of the 10 sweeps"])
    (root / "v1.0-mini" / "sample.json").write_text("[{}]")
    refusal(open_source, root, words=["not nuScenes tables"])
    (root / "v1.0-test").mkdir()
    (root / "v1.0-test" / "sample_data.json").write_text("[]")
    refusal(open_source, root, words=["v1.0-mini, v1.0-test"])
