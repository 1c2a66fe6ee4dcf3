"""Files of motion whose format says rotations, folders, and what is wrong with files."""

import json
import pickle

import motion_files as files
import numpy as np
import pytest

from lidarpose.body.mocap import digest, load_motion
from lidarpose.errors import InputError
from lidarpose.synth.shard_job import Job


def check_same(motion, rotations, way):
    """The joints come out where they went in, within 1 mm."""
    assert motion.rotations.dtype == motion.translation.dtype == np.float32
    np.testing.assert_allclose(
        files.joints_of(motion.rotations, motion.translation), files.joints_of(rotations, way), atol=1e-3
    )


@pytest.mark.parametrize("width, rate", [(156, "mocap_framerate"), (165, "mocap_frame_rate"), (72, "fps"), (66, "fps")])
def test_amass_comes_back(tmp_path, width, rate):
    rotations, way = files.a_clip()
    if width != 72:
        rotations[:, [files.J["left_hand"], files.J["right_hand"]]] = np.eye(3)
    motion = load_motion(files.write_amass(tmp_path / "02_01_poses.npz", rotations, way, width=width, rate=rate))
    check_same(motion, rotations, way)
    assert motion.names == ("02_01_poses",) and motion.fps == 60 and motion.dropped == 0
    assert motion.source.startswith("AMASS: ")


def test_amass_in_parts_and_of_another_up(tmp_path):
    rotations, way = files.a_clip(5)
    pose = files.to_smpl(rotations, "y")
    path = tmp_path / "a_stageii.npz"
    np.savez(
        path, root_orient=pose[:, :3], pose_body=pose[:, 3:66], trans=way @ files.C, mocap_frame_rate=np.array(120.0)
    )
    with pytest.raises(InputError, match="stand along y, not z; give load_motion up='y'"):
        load_motion(path)
    check_same(load_motion(path, up="y"), rotations, way)
    assert load_motion(path, up="y", fps=30).fps == 30
    assert load_motion(path, up="y", hz=60).rotations.shape[0] == 3


def test_a_recording_is_told_from_another_by_what_it_holds(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name / "02").mkdir(parents=True)
        files.write_amass(tmp_path / name / "02" / "a_poses.npz", *files.a_clip(3))
    (tmp_path / "two" / "notes.txt").write_text("no motion")
    one, two = tmp_path / "one", tmp_path / "two"
    was = digest(one)
    assert digest(two) == was and digest(one / "02" / "a_poses.npz") not in (was, digest(one / "02"))
    card = Job(what="people", count=3, motion=str(one)).card()
    assert card == Job(what="people", count=3, motion=str(two)).card()
    files.write_amass(one / "02" / "b_poses.npz", *files.a_clip(4))
    assert digest(one) != was and card != Job(what="people", count=3, motion=str(one)).card()
    with pytest.raises(InputError, match="none.npz: no such file"):
        digest(tmp_path / "none.npz")


def test_people_may_lie_where_somebody_says_what_is_up(tmp_path):
    rotations, way = files.a_clip(5)
    lie = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    rotations = rotations.copy()
    rotations[:, 0] = lie @ rotations[:, 0]
    path = files.write_amass(tmp_path / "lies_poses.npz", rotations, way)
    with pytest.raises(InputError, match="people stand along"):
        load_motion(path)
    check_same(load_motion(path, up="z"), rotations, way)


@pytest.mark.parametrize("up", ["z", "y"])
def test_lidarhuman26m_comes_back(tmp_path, up):
    rotations, way = files.a_clip(12)
    folder = files.write_pose_json(tmp_path / "labels/3d/pose/24", rotations, way, up=up, first=5)
    (folder / "notes.json").write_text("[]")
    motion = load_motion(folder, up=up)
    check_same(motion, rotations, way)
    assert motion.fps == 10 and motion.names == ("24",)
    assert load_motion(folder / "000007.json", up=up).names == ("000007",)
    (folder / "000009.json").unlink()
    motion = load_motion(tmp_path, up=up)
    assert motion.names == ("labels/3d/pose/24", "labels/3d/pose/24#2") and tuple(motion.length) == (4, 7)


def labels(rotations, way, **changes):
    pose = files.to_smpl(rotations)
    person = {"pose": pose, "trans": way, "beta": np.zeros(10), "gender": "male"}
    return {"framerate": 20, "first_person": {"lidar_traj": np.zeros((3, 9))}, "second_person": person} | changes


@pytest.fixture
def sloper4d(tmp_path):
    """Writes a label file."""

    def write(content):
        path = tmp_path / "seq007_garden_001_labels.pkl"
        path.write_bytes(pickle.dumps(content))
        return path

    return write


def test_sloper4d_comes_back(sloper4d):
    rotations, way = files.a_clip()
    motion = load_motion(sloper4d(labels(rotations, way)))
    check_same(motion, rotations, way)
    assert motion.fps == 20 and motion.names == ("seq007_garden_001_labels_second",)
    other, path = files.a_clip(4, seed=1)
    first = {"pose": files.to_smpl(other), "trans": path}
    second = labels(rotations, way)["second_person"] | {
        "opt_pose": files.to_smpl(rotations) * 0.5, "opt_trans": way + [1, 0, 0]
    }  # fmt: skip
    motion = load_motion(sloper4d(labels(rotations, way, first_person=first, second_person=second)))
    assert motion.names == ("seq007_garden_001_labels_first", "seq007_garden_001_labels_second")
    np.testing.assert_allclose(motion.translation[motion.frames(1)], way + [1, 0, 0], atol=1e-5)
    check_same(motion.of("seq007_garden_001_labels_first"), other, path)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c: 3, "a dict, got int"),
        (lambda c: {}, "expected second_person .* got nothing"),
        (lambda c: {k: v for k, v in c.items() if k != "framerate"}, "frame rate"),
        (lambda c: c | {"framerate": "fast"}, "frame rate"),
        (lambda c: c | {"framerate": -20}, "above 0"),
        (lambda c: c | {"second_person": {"pose": np.zeros((3, 71)), "trans": np.zeros((3, 3))}}, r"\(3, 71\)"),
        (lambda c: c | {"second_person": {"pose": [[1, 2], [3]], "trans": np.zeros((3, 3))}}, "rows of equal length"),
        (lambda c: c | {"second_person": {"pose": np.zeros((0, 72)), "trans": np.zeros((0, 3))}}, "no frame"),
    ],
)
def test_wrong_labels_are_named(sloper4d, change, message):
    with pytest.raises(InputError, match=message) as caught:
        load_motion(sloper4d(change(labels(*files.a_clip(3)))))
    assert "_labels.pkl: " in str(caught.value) and "\n" not in str(caught.value)


class Counter(dict):
    """A class that no label file needs."""


def test_a_class_off_the_list_is_refused_by_name(sloper4d):
    with pytest.raises(InputError, match="Counter"):
        load_motion(sloper4d(labels(*files.a_clip(3)) | {"extra": Counter()}))


def test_own_clips_are_retargeted(tmp_path):
    rotations, way = files.a_clip(40)
    joints = files.joints_of(rotations, way)
    path = tmp_path / "clips.npz"
    content = dict(
        joints=joints, clip=np.array(["002_01", "005_01"]), clip_start=np.array([0, 15]),
        clip_length=np.array([15, 25]), fps=np.array(10.0),
    )  # fmt: skip
    np.savez(path, **content)
    motion = load_motion(path)
    assert motion.names == ("002_01", "005_01") and motion.fps == 10 and tuple(motion.length) == (15, 25)
    error = np.linalg.norm(files.joints_of(motion.rotations, motion.translation) - joints, axis=-1)
    assert error.mean() < 0.010 and error.max() < 0.06
    np.testing.assert_array_equal(motion.rotations, load_motion(path, format="clips").rotations)

    for change, message in (
        ({"joints": 1e3 * joints}, "998 times as tall"),
        ({"fps": np.array(1e5)}, "people move at"),
    ):
        np.savez(path, **content | change)
        with pytest.raises(InputError, match=message):
            load_motion(path)

    joints[3, 4] = joints[3, 1]  # a thigh without length
    np.savez(path, **content | {"joints": joints})
    motion = load_motion(path)
    assert (
        motion.dropped == 1 and motion.names == ("002_01", "002_01#2", "005_01") and tuple(motion.length) == (3, 11, 25)
    )
    assert motion.of("002").names == ("002_01", "002_01#2")
    joints[15:25, 4] = joints[15:25, 1]
    np.savez(path, **content | {"joints": joints})
    with pytest.raises(InputError, match="10 of 25 frames"):
        load_motion(path)


def test_a_folder_of_everything(tmp_path, sloper4d):
    rotations, way = files.a_clip(13)
    files.write_amass(tmp_path / "b_poses.npz", rotations, way, fps=60)
    (tmp_path / "02").mkdir()
    (tmp_path / "02/02_01.bvh").write_text(files.bvh_text(rotations, way, fps=120))
    skeleton, axes = files.asf_text()
    (tmp_path / "02/02.asf").write_text(skeleton)
    (tmp_path / "02/02_02.amc").write_text(files.amc_text(rotations, way, axes))
    files.write_pose_json(tmp_path / "pose/7", rotations, way)
    sloper4d(labels(rotations, way))
    (tmp_path / "shape.npz").write_bytes(b"nothing to read here")
    (tmp_path / "README.txt").write_text("hello")
    motion = load_motion(tmp_path)
    assert motion.names == ("02/02_01", "02/02_02", "b_poses", "pose/7", "seq007_garden_001_labels_second")
    assert motion.fps == 10 and tuple(motion.length) == (2, 2, 3, 13, 7)
    assert motion.of("02").names == ("02/02_01", "02/02_02")
    assert tuple(load_motion(tmp_path, hz=20).length) == (3, 3, 5, 25, 13)
    assert load_motion(tmp_path, format="bvh").names == ("02/02_01",)
    assert load_motion(tmp_path, format="lidarhuman26m").names == ("pose/7",)


def test_frames_that_are_no_numbers_end_a_clip(tmp_path):
    rotations, way = files.a_clip(20)
    path = files.write_amass(tmp_path / "a.npz", rotations, way)
    content = dict(np.load(path))
    content["poses"][7, 3] = np.nan
    content["trans"][12] = np.inf
    np.savez(path, **content)
    motion = load_motion(path)
    assert motion.dropped == 2 and motion.names == ("a", "a#2", "a#3") and tuple(motion.length) == (7, 4, 7)
    check_same(motion, *(np.delete(x, [7, 12], 0) for x in (rotations, way)))
    content["poses"][:5] = np.nan
    np.savez(path, **content)
    with pytest.raises(InputError, match="a.npz: 7 of 20 frames have values that are not finite"):
        load_motion(path)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"drop": ("trans",)}, "holds betas, dmpls, gender, mocap_framerate, poses; an npz of motion needs"),
        ({"drop": ("poses",)}, "root_orient"),
        ({"drop": ("mocap_framerate",)}, "does not give its frame rate .* give load_motion fps="),
        ({"fps": 0}, "above 0"),
        ({"fps": np.nan}, "above 0"),
        ({"mocap_framerate": np.array(["x"])}, "as one number"),
        ({"mocap_framerate": np.array([1.0, 2])}, "as one number"),
        ({"poses": np.zeros((4, 60))}, r"\(4, 60\)"),
        ({"poses": np.zeros((4, 2, 156))}, r"\(4, 2, 156\)"),
        ({"poses": np.array([["a"] * 156])}, "must be numbers"),
        ({"poses": np.full((4, 156), 90.0)}, "radians, not degrees"),
        ({"trans": np.zeros((5, 3))}, r"\(4, 72\).*\(5, 3\)"),
        ({"trans": np.array(["a"])}, "trans must be numbers"),
        ({"trans": np.full((4, 3), 1e30)}, "expected meters"),
        ({"poses": np.array([{}] * 4)}, "plain arrays"),
        ({"drop": ("poses",), "root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 60))}, r"\(4, 60\)"),
        ({"drop": ("poses",), "root_orient": np.zeros((4, 3)), "pose_body": np.zeros(())}, "pose_body"),
    ],
)
def test_a_wrong_amass_file_is_named(tmp_path, changes, message):
    path = files.write_amass(tmp_path / "wrong.npz", *files.a_clip(4), **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_motion(path)
    assert "wrong.npz: " in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content, message",
    [
        ("{", "is not JSON"),
        ("[" * 100000, "is not JSON"),
        ("3", r"expected pose \(72 numbers\) and trans \(3 numbers\), got 3"),
        ("{}", "expected pose .* got {}"),
        ('{"pose": [1, 2], "trans": [1, 2, 3]}', "expected pose"),
        ('{"pose": "x", "trans": [1, 2, 3]}', "expected pose"),
        (json.dumps({"pose": [0] * 72, "trans": [1, {}, 3]}), "expected pose"),
        (json.dumps({"pose": [0] * 72, "trans": [None] * 3}), "expected pose|not finite"),
        (json.dumps({"pose": [10**400] * 72, "trans": [0] * 3}), "expected pose"),
        ('{"pose": NaN, "trans": [1, 2, 3]}', "expected pose"),
    ],
)
def test_a_wrong_pose_file_is_named(tmp_path, content, message):
    folder = files.write_pose_json(tmp_path / "7", *files.a_clip(3))
    (folder / "000002.json").write_text(content)
    for path in (folder, folder / "000002.json"):
        if path is folder and "not finite" in message:
            continue
        with pytest.raises(InputError, match=message) as caught:
            load_motion(path)
        assert "000002.json: " in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_no_motion_at_all(tmp_path):
    for name, content, message in (
        ("a.npz", b"", "is empty"),
        ("b.npz", b"hello", "plain arrays"),
        ("c.fbx", b"hello", "expected a file of motion, one of .npz, .bvh"),
        ("d", b"hello", "format="),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_motion(tmp_path / name)
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    with pytest.raises(InputError, match="not an npz"):
        load_motion(tmp_path / "one.npz")
    whole = files.write_amass(tmp_path / "e.npz", *files.a_clip(4)).read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        (tmp_path / "e.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="copied completely"):
            load_motion(tmp_path / "e.npz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: holds no file of motion; read are .npz, .bvh"):
        load_motion(tmp_path / "empty")
    with pytest.raises(InputError, match="no such file"):
        load_motion(tmp_path / "none.bvh")
    with pytest.raises(InputError, match="no such file"):
        load_motion(tmp_path / "none.json")
    with pytest.raises(InputError, match="expected the path"):
        load_motion(3)
    with pytest.raises(InputError, match="did you mean bvh"):
        load_motion(tmp_path / "e.npz", format="bhv")
    with pytest.raises(InputError, match="unknown up axis"):
        load_motion(tmp_path / "e.npz", up="w")
    for rates in ({"fps": 0}, {"hz": -1}, {"fps": float("nan")}):
        with pytest.raises(InputError, match="above 0"):
            load_motion(tmp_path / "e.npz", **rates)
