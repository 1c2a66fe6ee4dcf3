"""Data of clip networks: rotations, clouds around a person, and windows of consecutive frames."""

from collections import Counter

import dataset_files as files
import numpy as np
import pyarrow.parquet as pq
import pytest
from shard_files import write_shard

from lidarpose.body.rig import forward_kinematics
from lidarpose.body.smpl import load_body
from lidarpose.data.clips import MARGIN, MOST, consecutive, static_points, window_points, without_person
from lidarpose.data.prepare import prepare, reader
from lidarpose.data.readers import base
from lidarpose.data.readers.base import SceneClouds
from lidarpose.data.rows import person_row, sample_of
from lidarpose.data.shards import read_rows
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_vector
from lidarpose.sample import CLIP_FRAMES, LabeledSample, Sample, clip_windows
from lidarpose.skeleton import SMPL24
from lidarpose.synth.generator import Generator

NAMES = ("rotations", "translation", "background", "neighbors")


@pytest.fixture(scope="module")
def clip():
    return [person.sample for person in Generator(scene="wild", measure=False).clip(5, 2)]


def test_rotation_vector_round_trip_near_half_turn():
    axis = np.random.default_rng(0).normal(size=(200, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.concatenate([np.pi - np.geomspace(1e-9, 0.1, 199), [np.pi]])
    R = axis_angle_to_matrix(axis * angle[:, None])
    np.testing.assert_allclose(axis_angle_to_matrix(rotation_vector(R)), R, atol=2e-6)
    # in single precision, too
    np.testing.assert_allclose(axis_angle_to_matrix(rotation_vector(R.astype(np.float32))), R, atol=1e-3)
    assert np.abs(rotation_vector(np.eye(3))).max() == 0


# ---- synthesized clips


def test_synthesized_rotations_agree_with_joints(clip):
    """A bone is constant in the frame of its parent, in SMPL's axes: +x is left, +y is up."""
    joints = np.stack([sample.pose.joints[:24] for sample in clip]).astype(float)
    rotations = axis_angle_to_matrix(np.stack([sample.rotations for sample in clip]))
    world, _ = forward_kinematics(SMPL24.parents, np.zeros((1, 24, 3)), rotations, joints[:, 0])
    parents = np.array(SMPL24.parents[1:])
    bones = np.einsum("fjba,fjb->fja", world[:, parents], joints[:, 1:] - joints[:, parents])
    assert np.abs(bones - bones[0]).max() < 1e-4
    assert np.ptp(joints[:, SMPL24.index("left_knee")], axis=0).max() > 0.02, "a test of somebody who moves"
    hip, knee = (bones[0, SMPL24.index(name) - 1] for name in ("left_hip", "left_knee"))
    assert hip[0] > 0.04 and knee[1] < -0.3
    assert all((sample.translation == sample.pose.joints[0]).all() for sample in clip)


def _extent(points):
    return np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))


def test_synthesized_clouds_are_around_person(clip):
    for sample in clip:
        assert len(sample.background) > 20
        for name in ("background", "neighbors"):
            cloud = getattr(sample, name)
            assert len(cloud) <= MOST and cloud.dtype == np.float32
            if len(cloud):
                for own, other in zip(_extent(sample.points), _extent(cloud), strict=True):
                    assert other.min() > own.min() - 1.01 * MARGIN and other.max() < own.max() + 1.01 * MARGIN
        assert not sample.box.contains(sample.neighbors, -1e-3).any()
    # the sensor does not move, so points of the map stay in place, except for the window
    distances = np.linalg.norm(clip[0].background[:, None] - clip[1].background, axis=-1).min(1)
    assert np.median(distances) < 0.1


def test_single_person_has_no_clip_data():
    sample = Generator(scene="wild", measure=False).person(5, 2).sample
    assert all(getattr(sample, name) is None for name in NAMES)


# ---- columns


def test_clip_columns_round_trip_and_are_optional(clip, tmp_path):
    path = tmp_path / "people-00000.parquet"
    write_shard(path, "people", [person_row(sample, index=0, frame=k) for k, sample in enumerate(clip)])
    for row, sample in zip(read_rows(path, "people"), clip, strict=True):
        stored = sample_of(row, what="clips")
        for name in NAMES:
            np.testing.assert_array_equal(getattr(stored, name), getattr(sample, name))
    pq.write_table(pq.read_table(path).drop_columns(list(NAMES)), path)
    older = [sample_of(row) for row in read_rows(path, "people")]
    assert len(older) == len(clip) and older[0].rotations is older[0].neighbors is None


def test_sample_of_rejects_damaged_clip_columns(clip):
    flat = {
        name: np.ravel(value) if np.ndim(value) == 2 else value for name, value in person_row(clip[0], index=0).items()
    }
    for name, value in (("rotations", np.full(72, np.nan, np.float32)), ("background", np.full(3, 1e10, np.float32))):
        with pytest.raises(InputError, match=f"column {name}"):
            sample_of(flat | {name: value})
    with pytest.raises(InputError, match=r"rotations must be \(24, 3\)"):
        Sample(points=clip[0].points, center=np.zeros(3), rotations=np.zeros((23, 3)))


# ---- readers


@pytest.mark.parametrize("name", ["lidarhuman26m", "sloper4d"])
def test_readers_give_rotations_in_sensor_frame(name, tmp_path, smpl):
    mounted = {"R_sensor_level": axis_angle_to_matrix([0.0, 0.5, 0.0])} if name == "lidarhuman26m" else {}
    writer = getattr(files, f"write_{name}")
    writer(tmp_path, smpl, **({"frames": 120} | mounted if mounted else {}))
    source, body = reader(name, smpl), load_body(smpl)
    for part in source.parts(tmp_path):
        items = [item for item in source.read(tmp_path, part) if isinstance(item, LabeledSample)]
        rotations = axis_angle_to_matrix(np.stack([item.rotations for item in items]))
        joints = np.stack([item.joints for item in items]).astype(float)
        # bones are constant in the frames of their parents, because the shape is that of one person
        world, _ = forward_kinematics(SMPL24.parents, np.zeros((1, 24, 3)), rotations, joints[:, 0])
        parents = np.array(SMPL24.parents[1:])
        bones = np.einsum("fjba,fjb->fja", world[:, parents], joints[:, 1:] - joints[:, parents])
        assert np.abs(bones - bones[0]).max() < 1e-4 and len(body.parents) == 24
        assert all((item.translation == item.centers["trans"]).all() for item in items)
        assert items[0].background is None and items[0].neighbors is None


def test_lidarhuman26m_scans_give_background_and_neighbors(tmp_path, smpl, monkeypatch):
    files.write_lidarhuman26m(tmp_path, smpl, sequences=("7",), frames=6)
    rng = np.random.default_rng(0)
    source = reader("lidarhuman26m", smpl)
    people = [item.points for item in source.read(tmp_path, "7")]
    wall = np.stack([np.full(4000, 25.0), rng.uniform(0, 12, 4000), rng.uniform(-2, 4, 4000)], 1)
    for f, person in enumerate(people):
        # another person walks in front of the wall
        passer = person[:50] * 0.8 + [0.0, 0.2 * f - 0.4, 0.0]
        files.write_pcd(tmp_path / f"pointclouds/7/{f + 1:06d}.pcd", np.concatenate([person, wall, passer]))
    (tmp_path / "pointclouds/7/000006.pcd").write_bytes(b"cut off")
    read, read_points = Counter(), base.read_points
    monkeypatch.setattr(base, "read_points", lambda path: read.update([path.suffix]) or read_points(path))
    items = list(source.read(tmp_path, "7"))
    # each file once for its frame, and once for the map of static points, if its scan is not damaged
    assert read == {".ply": 11, ".pcd": 12}
    # the static points are known without the frame's own scan
    assert [item.neighbors is None for item in items] == [False] * 5 + [True]
    for item in items:
        assert len(item.background) > 50 and np.abs(item.background[:, 0] - 25).max() < 1e-3
    for item in items[:5]:
        assert (item.neighbors[:, 0] < 24).sum() > 5
        assert np.linalg.norm(item.neighbors[:, None] - item.points, axis=-1).min() > 0


def test_prepare_counts_people_without_whole_scans(tmp_path, smpl):
    files.write_lidarhuman26m(tmp_path / "raw", smpl, sequences=("7",), frames=4)
    warning = "the whole scans of 1 person are missing or damaged: their neighbors are not known"
    summary = prepare("lidarhuman26m", tmp_path / "raw", tmp_path / "alone", smpl=smpl)
    assert summary["without_scan"] is None and warning not in summary["warnings"]
    for f, item in enumerate(reader("lidarhuman26m", smpl).read(tmp_path / "raw", "7")):
        files.write_pcd(tmp_path / f"raw/pointclouds/7/{f + 1:06d}.pcd", item.points)
    (tmp_path / "raw/pointclouds/7/000002.pcd").write_bytes(b"cut off")
    summary = prepare("lidarhuman26m", tmp_path / "raw", tmp_path / "prepared", smpl=smpl)
    assert summary["people"] == 4 and summary["without_scan"] == 1 and warning in summary["warnings"]


def test_sloper4d_scans_are_found_by_time(tmp_path, smpl):
    content, _ = files.sloper4d_labels(smpl, "seq001", without=())
    folder = tmp_path / "seq001"
    folder.mkdir()
    (folder / "seq001_labels.pkl").write_bytes(files.pickle.dumps(content, protocol=4))
    rng = np.random.default_rng(0)
    walker, clouds = content["first_person"]["lidar_traj"], content["second_person"]["point_clouds"]
    ground = np.concatenate([rng.uniform([100, -53, 1.9], [115, -47, 2.0], (6000, 3))])
    for row, cloud in zip(walker[:3], clouds[:3], strict=True):
        name = f"{row[8] + 0.004:.3f}".replace(".", "_")
        files.write_pcd(folder / f"lidar_data/lidar_frames_rot/{name}.pcd", np.concatenate([cloud, ground]))
    items = [item for item in reader("sloper4d", smpl).read(tmp_path, "seq001") if isinstance(item, LabeledSample)]
    assert [item.neighbors is None for item in items] == [False] * 3 + [True]
    for item in items:
        # the ground at z = 1.95 m, the sensor at z = 3.7 m
        assert len(item.background) > 20 and np.abs(item.background[:, 2] + 1.75).max() < 0.06


# ---- clouds around a person


def test_window_points_wraps_around_back_and_limits_count():
    person = np.array([[-5.0, 0.3, 0.0], [-5.0, -0.3, 1.0]])
    inside, outside = [-9.0, 0.0, 0.5], [[9.0, 0.0, 0.5], [-9.0, 2.0, 0.5], [-9.0, 0.0, 3.0]]
    assert window_points(np.array([inside, *outside]), person).tolist() == [inside]
    many = np.tile(inside, (2000, 1)) + np.linspace(0, 0.1, 2000)[:, None]
    chosen = window_points(many, person)
    assert len(chosen) == MOST and np.ptp(chosen[:, 0]) > 0.099
    assert len(window_points(many, np.zeros((0, 3)))) == len(window_points(np.zeros((0, 3)), person)) == 0


def test_static_points_need_three_scans_and_exclude_person():
    rng = np.random.default_rng(1)
    still = rng.uniform(-20, 20, (500, 3))
    scans = [np.concatenate([still, rng.uniform(50, 60, (100, 3)) + 100 * k]) for k in range(3)]
    static = static_points(scans)
    assert len(static) > 450 and np.abs(static).max() < 21
    assert len(static_points(scans[:2])) == len(static_points([])) == 0
    # coordinates may be rounded to float32
    assert len(without_person(np.concatenate([still, still[:7] + 30]), still.astype(np.float32).astype(float))) == 7


# ---- windows


def test_consecutive_splits_at_gaps_and_tracks():
    tracks = ["a", "b"] * 6
    frames = [5, 7, 10, 8, 15, 9, 20, 10, 45, 11, 50, 30]
    runs = [run.tolist() for run in consecutive(tracks, frames)]
    assert runs == [[0, 2, 4, 6], [8, 10], [1, 3, 5, 7, 9], [11]]
    # most of the frames of a sparse track are missing
    assert [run.tolist() for run in consecutive(["a"] * 6, [0, 5, 6, 11, 12, 20])] == [[0], [1, 2], [3, 4], [5]]
    assert [run.tolist() for run in consecutive(["a"], [7])] == [[0]]
    order = np.random.default_rng(0).permutation(12)
    shuffled = consecutive([tracks[k] for k in order], [frames[k] for k in order])
    assert sorted([order[run].tolist() for run in shuffled]) == sorted(runs)


@pytest.mark.parametrize("count", [16, 17, 31, 32, 1])
def test_clip_windows_repeat_last_frame_at_end(count):
    rows = 100 + np.arange(count)
    clips = clip_windows(rows)
    assert clips.shape == (-(-count // CLIP_FRAMES), CLIP_FRAMES)
    flat = clips.ravel()
    assert (flat[:count] == rows).all() and (flat[count:] == rows[-1]).all()
    longer = clip_windows(rows, following=3)
    np.testing.assert_array_equal(longer[:, :CLIP_FRAMES], clips)
    np.testing.assert_array_equal(longer[:, CLIP_FRAMES:], np.minimum(clips[:, -1:] + [1, 2, 3], rows[-1]))


def test_map_of_a_sequence_uses_scans_with_a_person(tmp_path):
    still = np.random.default_rng(0).uniform(-20, 20, (200, 3))
    np.save(tmp_path / "scan.npy", still)
    paths = dict.fromkeys(range(240), tmp_path / "scan.npy")
    read = []
    clouds = SceneClouds(paths, lambda frame: read.append(frame) or still[:3], range(0, 240, 12))
    assert len(clouds._static) > 150 and sorted(set(read)) == list(range(0, 240, 12))
    assert not len(SceneClouds(paths, lambda frame: still[:3], ())._static)
