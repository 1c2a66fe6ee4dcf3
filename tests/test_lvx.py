"""Recordings of Livox Viewer: .lvx and .lvx2."""

import struct

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lidarpose
from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.io.sources import lvx

MAGIC = 0xAC0EA767
# number of points and bytes of a package by type of data, in version 1
COUNTS = {0: (100, 13), 1: (100, 9), 2: (96, 14), 3: (96, 10), 4: (48, 28), 5: (48, 16), 6: (1, 24), 7: (30, 42)}
COUNTS[8] = (30, 22)


def rows_of(points, size, unit=1e-3):
    """Points as rows of `size` bytes that begin with x, y, z."""
    kind = "<3i" if unit == 1e-3 else "<3h"
    rows = [struct.pack(kind, *np.rint(point / unit).astype(int)) for point in points]
    return b"".join(row + b"\7" * (size - len(row)) for row in rows)


def spherical_rows(points, size, is_dual):
    rows = []
    for x, y, z in points:
        r = np.sqrt(x * x + y * y + z * z)
        theta = np.degrees(np.arccos(z / r)) * 100 if r else 0
        angles = struct.pack("<2H", round(theta), round(np.degrees(np.arctan2(y, x)) % 360 * 100))
        depth = struct.pack("<I", round(1e3 * r))
        row = angles + depth if is_dual else depth + angles
        rows.append(row + b"\7" * (size - len(row)))
    return b"".join(rows)


def package(major, kind, data, device=1, stamp_type=0, seconds=5):
    stamp = seconds * 10**9
    if major == 1:
        return struct.pack("<5BI2BQ", device, 5, 0, 0, 0, 0, stamp_type, kind, stamp) + data
    return struct.pack("<BIBBQHBIB4x", 0, device, 0, stamp_type, stamp, 0, kind, len(data), 0) + data


def recording(major, frames, devices=((1, 0, (0.0,) * 6),), duration=50, minor=1):
    """The bytes of a file. frames: the packages of each; devices: (id, whether the pose is used, the pose)."""
    version = (1, minor, 0, 0) if major == 1 else (2, 0, 0, 0)
    content = struct.pack("<16s4BI", b"livox_tech", *version, MAGIC) + struct.pack("<IB", duration, len(devices))
    for device, is_used, pose in devices:
        kind = "<32sBBB6f" if major == 1 else "<32sIBBB6f"
        content += struct.pack(kind, b"serial", device, *((9,) if major == 1 else (0, 9)), is_used, *pose)
    for index, packages in enumerate(frames):
        end = len(content) + 24 + len(packages)
        content += struct.pack("<3q", len(content), end, index) + packages
    return content


def frames_of(tmp_path, content, suffix=".lvx2", **options):
    path = tmp_path / f"walk{suffix}"
    path.write_bytes(content)
    return list(lidarpose.open_source(path, **options))


def cloud(count, seed=0):
    return np.round(np.random.default_rng(seed).uniform(-20, 20, (count, 3)), 3)


def test_lvx2_frames_are_joined_to_a_tenth_of_a_second(tmp_path):
    clouds = [cloud(30, seed=k) for k in range(5)]
    frames = frames_of(tmp_path, recording(2, [package(2, 1, rows_of(points, 14)) for points in clouds]))
    assert [frame.time for frame in frames] == pytest.approx([5.0, 5.1, 5.2])
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.points, np.concatenate(clouds[2 * k : 2 * k + 2]), atol=1e-9)
        assert frame.origin.tolist() == [0, 0, 0] and frame.T_world_sensor is None and frame.warnings == ()
    assert [len(f.points) for f in frames_of(tmp_path, (tmp_path / "walk.lvx2").read_bytes(), start=0.05, end=0.1)] == [
        60
    ]
    slow = frames_of(tmp_path, recording(2, [package(2, 1, rows_of(clouds[0], 14))] * 3, duration=200))
    assert [frame.time for frame in slow] == pytest.approx([5.0, 5.2, 5.4])


def test_lvx2_types_of_points(tmp_path):
    points = np.round(cloud(40), 2)
    packages = package(2, 2, rows_of(points, 8, unit=1e-2)) + package(2, 0, b"\1" * 24)
    packages += package(2, 3, spherical_rows(points, 10, False)) + package(2, 1, rows_of(np.zeros((3, 3)), 14))
    (frame,) = frames_of(tmp_path, recording(2, [packages]))
    np.testing.assert_allclose(frame.points[:40], points, atol=1e-9)
    # angles are in hundredths of a degree; missing returns are left out
    np.testing.assert_allclose(frame.points[40:], points, atol=5e-3)


@pytest.mark.parametrize("kind", sorted(set(COUNTS) - {6}))
def test_lvx_types_of_points(tmp_path, kind):
    count, size = COUNTS[kind]
    points = cloud(count)
    is_spherical = kind in (1, 3, 5, 8)
    data = spherical_rows(points, size, kind in (5, 8)) if is_spherical else rows_of(points, size)
    packages = package(1, 6, b"\1" * 24) + package(1, kind, data) + package(1, 6, b"\1" * 24)
    (frame,) = frames_of(tmp_path, recording(1, [packages]), ".lvx")
    np.testing.assert_allclose(frame.points, points, atol=5e-3 if is_spherical else 1e-9)


@pytest.mark.parametrize("major", [1, 2])
def test_poses_of_sensors_apply_if_they_are_used(tmp_path, major):
    points, pose = cloud(96), (10.0, -20.0, 90.0, 1.0, 2.0, 3.0)
    kind = 2 if major == 1 else 1
    data = rows_of(points, 14)
    packages = package(major, kind, data, device=1) + package(major, kind, data, device=2)
    turns = zip("zyx", np.radians(pose[2::-1]), strict=True)
    R = np.linalg.multi_dot([rotation_about(axis, angle) for axis, angle in turns])
    there = points @ R.T + pose[3:]
    alone = recording(major, [package(major, kind, data)], devices=[(1, 1, pose)])
    (frame,) = frames_of(tmp_path, alone)
    np.testing.assert_allclose(frame.points, there, atol=1e-5)
    assert frame.origin.tolist() == [1, 2, 3] and not frame.is_origin_unknown
    both = recording(major, [packages], devices=[(1, 1, pose), (2, 0, pose)])
    (frame,) = frames_of(tmp_path, both)
    np.testing.assert_allclose(frame.points, np.concatenate([there, points]), atol=1e-5)
    assert frame.origin is None and frame.is_origin_unknown
    warning = "1 of 2 sensors have no pose in use, so their points may overlap"
    source = lidarpose.open_source(tmp_path / "walk.lvx2", topic="/points", meta="a.json")
    assert source.warnings == (warning, "options that this kind of source does not have are ignored: topic, meta")


def test_recordings_of_a_folder_follow_one_another(tmp_path):
    for k, name in enumerate("abc"):
        packages = package(2, 1, rows_of(cloud(30, seed=k), 14), seconds=10 * k)
        (tmp_path / f"{name}.lvx2").write_bytes(recording(2, [packages] * 4))
    source = lidarpose.open_source(tmp_path)
    assert [frame.time for frame in source] == pytest.approx([0, 0.1, 10, 10.1, 20, 20.1]) and not source.warnings
    # a date instead of nanoseconds
    dated = recording(1, [package(1, 2, rows_of(cloud(96), 14), stamp_type=3)] * 2)
    assert frames_of(tmp_path, dated)[0].time == 0


@pytest.mark.parametrize("empty", [0, 2, 5])
def test_frames_may_be_empty(tmp_path, empty):
    packages = [package(2, 1, rows_of(cloud(30, seed=k), 14)) for k in range(6)]
    packages[empty] = b""
    frames = frames_of(tmp_path, recording(2, packages))
    assert [len(frame.points) for frame in frames] == [60 - 30 * (empty // 2 == k) for k in range(3)]
    assert not lidarpose.open_source(tmp_path / "walk.lvx2").warnings


def test_damaged_lvx2_recordings(tmp_path):
    packages = [package(2, 1, rows_of(cloud(30, seed=k), 14)) for k in range(6)]
    content = recording(2, packages)
    frame_size = 24 + len(packages[0])
    first, second = frames_of(tmp_path, content[: -2 * frame_size - 50])
    assert len(first.points) == 60 and second.warnings == ("a package is cut off",) and 30 < len(second.points) < 60
    # an unknown type of points loses only its frame
    unknown = recording(2, [packages[0], packages[1], package(2, 9, b"1234"), packages[2], packages[3], packages[4]])
    frames = frames_of(tmp_path, unknown)
    assert "type 9" in frames[1].error
    assert len(frames[0].points) == len(frames[2].points) == 60


@pytest.mark.parametrize("offset, place", [(5, 0), (0, 8), (5, 8), (-1, 8), (2**40, 8)])
def test_frames_after_a_wrong_offset_are_lost(tmp_path, monkeypatch, offset, place):
    packages = [package(2, 1, rows_of(cloud(30, seed=k), 14)) for k in range(6)]
    content = recording(2, packages)
    frame_size = 24 + len(packages[0])
    start = len(content) - 2 * frame_size + place
    path = tmp_path / "offset.lvx2"
    path.write_bytes(content[:start] + struct.pack("<q", offset) + content[start + 8 :])
    monkeypatch.setattr(lvx, "_MOST_BYTES", len(packages[0]))
    source = lidarpose.open_source(path)
    # the frame whose own offset is wrong is lost, too
    assert [len(frame.points) for frame in source] == [60, 60] + [30] * (place > 0)
    seconds = "0.20" if place == 0 else "0.25"
    assert source.warnings == (f"ends after {seconds} s, within a damaged or cut off frame",)


@pytest.mark.parametrize(
    "content, problem",
    [
        (b"", "expected a recording of Livox Viewer"),
        (b"x,y,z\n1,2,3\n" * 20, "expected a recording of Livox Viewer"),
        (recording(1, [b""], minor=0), "expected a recording of version 1.1 or 2.0, got 1.0.0.0"),
        (recording(2, [b""]).replace(struct.pack("<I", MAGIC), b"1234"), "damaged in its first bytes"),
        (recording(2, [b""], duration=0), "damaged in its first bytes"),
        (recording(2, [b""], devices=[(1, 1, (np.nan,) * 6)]), "damaged in its first bytes"),
        (recording(2, []), "has no frames"),
    ],
)
def test_other_files_are_refused(tmp_path, capsys, content, problem):
    path = tmp_path / "a.lvx2"
    path.write_bytes(content)
    with pytest.raises(InputError, match=problem):
        lidarpose.open_source(path)
    assert main(["predict", str(path), "--quiet"]) == 2
    assert problem in capsys.readouterr().err and not list(tmp_path.glob("*.json*"))


@given(major=st.sampled_from([1, 2]), place=st.integers(0, 700), value=st.integers(0, 255), length=st.integers(0, 3000))
def test_changed_bytes_raise_no_other_errors(tmp_path_factory, major, place, value, length):
    points, pose = cloud(96), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    packages = package(major, 1 if major == 2 else 2, rows_of(points, 14)) + package(major, 0, b"\0" * 1300)
    content = bytearray(recording(major, [packages, b"", packages], devices=[(1, 1, pose)]))
    content[place] = value
    path = tmp_path_factory.mktemp("lvx") / "a.lvx2"
    path.write_bytes(bytes(content[:length]))
    try:
        frames = list(lidarpose.open_source(path))
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert not any(frame.error.startswith("cannot be read") for frame in frames if hasattr(frame, "error"))
