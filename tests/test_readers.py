"""Readers of real datasets: joints, peculiarities of the formats, and reports of skipped data."""

import json
import pickle
import shutil
from collections import Counter

import dataset_files as files
import numpy as np
import pytest

from lidarpose.data.prepare import READERS, reader
from lidarpose.data.readers import sloper4d
from lidarpose.data.readers.base import Skipped, SmplJoints, read_cloud
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.sample import SEEN, UNLABELED, LabeledSample, center_of

WRITERS = {
    "humanm3": files.write_humanm3,
    "lidarhuman26m": files.write_lidarhuman26m,
    "sloper4d": files.write_sloper4d,
    "itop": files.write_itop,
    "lipd": files.write_lipd,
    "freemotion": files.write_freemotion,
    "noisemotion": lambda root, smpl: files.write_freemotion(root, smpl, name="FreeMotion_train.pkl", noise=True),
}


def made(name, smpl):
    return reader(name, smpl if READERS[name][2] else None)


def everything(name, root, smpl):
    """(items, skipped) of all parts."""
    source = made(name, smpl)
    found = [one for part in source.parts(root) for one in source.read(root, part)]
    return [x for x in found if isinstance(x, LabeledSample)], [x for x in found if isinstance(x, Skipped)]


def check(items, truth):
    """Each written person is read exactly once, with joints within 1 mm."""
    found = {(item.sequence, item.frame, item.track): item for item in items}
    assert len(found) == len(items) and found.keys() == truth.keys()
    for key, joints in truth.items():
        item = found[key]
        assert np.abs(item.joints - joints).max() < 1e-3, key
        points = item.points
        assert np.median(np.linalg.norm(points[:, None] - joints, axis=-1).min(1)) < 0.3
        np.testing.assert_array_equal(item.center, center_of(points))


def reasons(skipped):
    return Counter(one.reason for one in skipped)


@pytest.mark.parametrize("name", WRITERS)
def test_readers_return_written_joints(name, tmp_path, smpl):
    truth = WRITERS[name](tmp_path, smpl)
    items, _ = everything(name, tmp_path, smpl)
    check(items, truth)
    source = made(name, smpl)
    assert {len(item.joint_labels) for item in items} == {len(items[0].skeleton)}
    assert all(item.skeleton.name == source.skeleton for item in items)
    assert source.about["licence"] and source.about["get"] and source.about["notes"]
    # a second read gives the same samples in the same order
    again, _ = everything(name, tmp_path, smpl)
    for a, b in zip(items, again, strict=True):
        np.testing.assert_array_equal(a.points, b.points)


# --- HumanM3


def test_humanm3_sorts_frames_and_people_by_number(tmp_path, smpl):
    truth = files.write_humanm3(tmp_path, smpl, sequences=("basketball2",), digits=0, first=9)
    items, skipped = everything("humanm3", tmp_path, smpl)
    check(items, truth)
    # people are sorted by number, not by name
    assert not skipped and [item.track for item in items[:2]] == ["2", "10"]
    assert [item.time for item in items[::2]] == pytest.approx([0.0, 0.1, 0.2])


def test_humanm3_box_encloses_joints_and_crops_points(tmp_path, smpl):
    files.write_humanm3(tmp_path, smpl)
    items, _ = everything("humanm3", tmp_path, smpl)
    for item in items:
        joints, box = item.joints, item.box
        np.testing.assert_allclose(box.size, np.ptp(joints, 0) + 0.4, atol=1e-5)
        np.testing.assert_array_equal(item.centers["joints_box"], box.center)
        assert box.contains(item.points, 0.3001).all() and len(item.points) >= 150
        # the clouds are fused from four LiDARs
        assert not item.sensor_known and np.isnan(item.distance)
    # the box extends 20 cm beyond the joints; points within 30 cm of the box are kept
    top = items[0].box.center + [0, 0, items[0].box.size[2] / 2]
    path = tmp_path / items[0].sequence / f"pointcloud/{items[0].frame:06d}.pcd"
    files.write_pcd(path, [top + [0, 0, more] for more in (0.0, 0.28, 0.32)])
    (item,) = (one for one in everything("humanm3", tmp_path, smpl)[0] if one.frame_id == items[0].frame_id)
    assert len(item.points) == 2


def test_humanm3_database_gives_same_people_as_folders(tmp_path, smpl):
    truth = files.write_humanm3(tmp_path, smpl)
    files.write_humanm3_database(tmp_path, truth)
    folders, _ = everything("humanm3", tmp_path, smpl)
    for folder in tmp_path.glob("**/pose_calib"):
        shutil.rmtree(folder)
    # if two clouds match a path, the one that matches more of its folders is used
    files.write_pcd(tmp_path / "000007.pcd", np.zeros((1, 3)))
    source = made("humanm3", smpl)
    assert source.parts(tmp_path) == ["train.pkl"]
    items = list(source.read(tmp_path, "train.pkl"))
    assert len(items) == len(folders) == len(truth)
    for a, b in zip(sorted(items, key=lambda item: item.sequence), folders, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.joints, b.joints)
        assert (a.sequence, a.frame) == (b.sequence, b.frame)
    # clouds may be in the folder of the database
    flat = tmp_path / "flat"
    flat.mkdir()
    shutil.copy(tmp_path / "train.pkl", flat)
    shutil.copy(tmp_path / folders[0].sequence / "pointcloud/000007.pcd", flat)
    found = [one for one in source.read(flat, "train.pkl") if isinstance(one, LabeledSample)]
    assert found and {(item.sequence, item.frame) for item in found} == {(".", 7)}
    (tmp_path / "train.pkl").unlink()
    with pytest.raises(InputError, match="got .*plaza/seg0 without pose_calib"):
        source.parts(tmp_path)


def test_humanm3_database_gives_joint_visibility(tmp_path, smpl):
    files.write_humanm3_database(tmp_path, files.write_humanm3(tmp_path, smpl, frames=1))
    frames = pickle.loads((tmp_path / "train.pkl").read_bytes())["db"]
    for k, camera in enumerate(frames[0]["info"]):
        camera["joints_3d_vis"] = camera["joints_3d_vis"].copy()
        camera["joints_3d_vis"][0, 5] = 0
        camera["joints_3d_vis"][1, 6] = k == 2
    frames.append({"pcd": None, "info": [{"joints_3d": [[1, 2]]}]})
    frames.append({"pcd": "nowhere/000001.pcd", "info": frames[0]["info"]})
    joints = frames[0]["info"][0]["joints_3d"]
    frames += [{"pcd": None, "info": info} for info in (joints, [[]], [5], 5)] + [{"pcd": "a\0", "info": [{}]}, None]
    (tmp_path / "test.pkl").write_bytes(pickle.dumps({"db": frames}))
    found = list(made("humanm3", smpl).read(tmp_path, "test.pkl"))
    items = [one for one in found if isinstance(one, LabeledSample)]
    # a joint is labeled if at least one camera sees it
    assert [int((item.joint_labels == UNLABELED).sum()) for item in items] == [1, 0, 0, 0]
    assert np.isnan(items[0].joints[5]).all()
    assert reasons(found[len(items) :]) == {"entry in another format": 7, "labels without a cloud": 1}


def test_humanm3_names_incomplete_folder_and_likely_root(tmp_path, smpl):
    files.write_humanm3(tmp_path / "HumanM3", smpl, sequences=("train/a", "train/plaza/p1", "test/c"), frames=1)
    with pytest.raises(
        InputError, match="is a folder above HumanM3's root, which is likely .*HumanM3: give that folder"
    ):
        made("humanm3", smpl).parts(tmp_path)
    assert made("humanm3", smpl).parts(tmp_path / "HumanM3") == ["test/c", "train/a", "train/plaza/p1"]
    shutil.rmtree(tmp_path / "HumanM3/train/a/pose_calib")
    # an SMPL file is not a database, and a database is not used if another sequence is complete
    for name in ("SMPL_NEUTRAL.pkl", "train.pkl"):
        (tmp_path / "HumanM3" / name).write_bytes(pickle.dumps({}))
        with pytest.raises(InputError, match="has .*train/a without pose_calib: add what is missing"):
            made("humanm3", smpl).parts(tmp_path / "HumanM3")


@pytest.mark.parametrize("too_deep", ["train", "train/a"])
def test_humanm3_folder_inside_root_names_likely_root(tmp_path, smpl, too_deep):
    root = tmp_path / "train/HumanM3"
    files.write_humanm3(root, smpl, sequences=("train/a", "test/c"), frames=1)
    assert made("humanm3", smpl).parts(root) == ["test/c", "train/a"]
    with pytest.raises(InputError, match=f"lies in HumanM3's root, which is likely {root}: give that folder"):
        made("humanm3", smpl).parts(root / too_deep)


def test_humanm3_names_sequence_without_clouds_and_labels(tmp_path, smpl):
    files.write_humanm3(tmp_path, smpl, sequences=("train/a", "test/c"), frames=1)
    (tmp_path / "test/intersection/smpl_estimated").mkdir(parents=True)
    with pytest.raises(InputError, match="intersection without pointcloud and pose_calib: add what is missing"):
        made("humanm3", smpl).parts(tmp_path)


def test_humanm3_null_joint_is_unlabeled(tmp_path, smpl):
    files.write_humanm3(tmp_path, smpl, sequences=("train/a",), frames=1)
    (path,) = (tmp_path / "train/a/pose_calib").glob("*.json")
    bodies = json.loads(path.read_text())
    track = sorted(bodies)[0]
    bodies[track][3] = [None] * 3
    path.write_text(json.dumps(bodies))
    items, _ = everything("humanm3", tmp_path, smpl)
    (item,) = (one for one in items if one.track == track)
    assert np.isnan(item.joints[3]).all() and item.joint_labels[3] == 0 and (np.delete(item.joint_labels, 3) > 0).all()


def test_humanm3_counts_and_names_skipped_frames(tmp_path, smpl):
    truth = files.write_humanm3(tmp_path, smpl, sequences=("train/a",), frames=9, first=0)
    here = tmp_path / "train/a"
    (here / "pointcloud/000000.pcd").write_bytes((here / "pointcloud/000000.pcd").read_bytes()[:300])
    (here / "pointcloud/000001.pcd").unlink()
    (here / "pose_calib/0002.json").unlink()
    (here / "pose_calib/0003.json").write_text("{")
    (here / "pose_calib/4.json").write_text("{}")
    content = json.loads((here / "pose_calib/0005.json").read_text())
    content["2"] = content["2"][:14]
    content["10"] = (np.array(content["10"]) + 500).tolist()
    (here / "pose_calib/0005.json").write_text(json.dumps(content))
    (here / "pose_calib/0006.json").write_text("{}")
    content = json.loads((here / "pose_calib/0008.json").read_text())
    content["2"][0][0] = 1e10
    (here / "pose_calib/0008.json").write_text(json.dumps(content))
    items, skipped = everything("humanm3", tmp_path, smpl)
    check(items, {key: joints for key, joints in truth.items() if key[1:] in ((7, "2"), (7, "10"), (8, "10"))})
    assert reasons(skipped) == {
        "cloud cannot be read": 2, "labels without a cloud": 2, "cloud without labels": 1, "labels cannot be read": 1,
        "several files of one frame": 1, "not 15 joints": 1, "no points in the box": 1, "frame without people": 1,
        "joints out of range": 1,
    }  # fmt: skip
    assert any("000000.pcd" in one.where and "cut off" in one.where for one in skipped)
    assert all("\n" not in one.where for one in skipped)


# --- LiDARHuman26M


def test_lidarhuman26m_bad_file_skips_one_frame(tmp_path, smpl):
    truth = files.write_lidarhuman26m(tmp_path, smpl, sequences=("7",), frames=11)
    pose, segment = tmp_path / "labels/3d/pose/7", tmp_path / "labels/3d/segment/7"

    def changed(frame, change):
        path = pose / f"{frame:06d}.json"
        path.write_text(json.dumps(change(json.loads(path.read_text()))))

    for frame in (1, 2, 5):
        (segment / f"{frame:06d}.ply").unlink()
    (segment / "000001.ply").symlink_to(tmp_path / "nowhere.ply")
    (segment / "000002.ply").mkdir()
    changed(3, lambda content: content | {"trans": [1e60, 0, 0]})
    (pose / "000004.json").unlink()
    (segment / "000006.ply").write_bytes((segment / "000006.ply").read_bytes()[:200])
    files.write_ply(segment / "000007.ply", np.zeros((0, 3)))
    changed(8, lambda content: {k: v for k, v in content.items() if k != "beta"})
    shutil.copy(segment / "000009.ply", segment / "9.ply")
    for name in ("notes.ply", "000010.txt"):
        (segment / name).write_text("mine")
    items, skipped = everything("lidarhuman26m", tmp_path, smpl)
    check(items, {key: joints for key, joints in truth.items() if key[1] > 9})
    assert reasons(skipped) == {
        "cloud cannot be read": 3, "joints out of range": 1, "cloud without labels": 1, "labels without a cloud": 1,
        "empty cloud": 1, "labels cannot be read": 1, "several files of one frame": 1,
    }  # fmt: skip
    told = " | ".join(one.where for one in skipped)
    for words in ("it is a link to a missing file", "got a folder", "000008.json: expected beta, pose and trans, "):
        assert words in told


@pytest.mark.parametrize("bad", [1e30, np.finfo(np.float32).max, -1e10])
def test_readers_drop_points_out_of_range(tmp_path, smpl, bad):
    """Such points moved the center by up to 1e18 m."""
    root = tmp_path / "lidarhuman26m"
    files.write_lidarhuman26m(root, smpl, sequences=("5",), frames=1)
    path = root / "labels/3d/segment/5/000001.ply"
    points = read_cloud(path)
    files.write_ply(path, np.concatenate([[[bad, 0, 0], [0, bad, 0]], points]))
    content, _ = files.sloper4d_labels(smpl, "seq001", frames=1, without=())
    content["second_person"]["point_clouds"][0][0] = bad
    write_labels(tmp_path / "sloper4d", content)
    files.write_lipd(tmp_path / "lipd", smpl)
    path = tmp_path / "lipd/LIPD_train.pkl"
    entries = pickle.loads(path.read_bytes())[1:2]
    entries[0]["pc"][0] = bad
    path.write_bytes(pickle.dumps(entries))
    for name, count in (("lidarhuman26m", 150), ("sloper4d", 149), ("lipd", 149)):
        (item,), skipped = everything(name, tmp_path / name, smpl)
        assert len(item.points) == count and not skipped
        assert np.abs(item.center - item.joints.mean(0)).max() < 1


def test_lidarhuman26m_trans_is_a_center(tmp_path, smpl):
    files.write_lidarhuman26m(tmp_path, smpl)
    items, _ = everything("lidarhuman26m", tmp_path, smpl)
    for item in items:
        path = tmp_path / f"labels/3d/pose/{item.sequence}/{item.frame:06d}.json"
        assert item.centers["trans"].tolist() == json.loads(path.read_text())["trans"]
        apart = np.linalg.norm(item.centers["trans"] - item.joints[0])
        assert 0.01 < apart < 0.5 and (item.joint_labels == SEEN).all()
    assert [item.sequence for item in items] == ["5"] * 3 + ["7"] * 3 and items[1].time == pytest.approx(0.1)


# --- SLOPER4D


def test_sloper4d_prefers_refined_poses(tmp_path, smpl):
    for refined, which in ((True, "opt_pose"), (False, "pose")):
        root = tmp_path / which
        truth = files.write_sloper4d(root, smpl, refined=refined, total=3, frames=5)
        items, skipped = everything("sloper4d", root, smpl)
        # frames 3 and 4 are beyond total_frames
        check(items, {key: value for key, value in truth.items() if key[1] < 115})
        assert {item.source for item in items} == {f"sloper4d/{which}, male by the given body"}
        assert reasons(skipped) == {"labels without a cloud": 2, "frame beyond total_frames": 4}
        assert [item.time for item in items[:2]] == pytest.approx([0.0, 0.1], abs=1e-6)


def test_sloper4d_joints_are_level_and_relative_to_sensor(tmp_path, smpl):
    content, _ = files.sloper4d_labels(smpl, "seq001", without=())
    write_labels(tmp_path, content)
    for k, item in enumerate(everything("sloper4d", tmp_path, smpl)[0]):
        # SMPL's trans is transformed like the joints
        place, heading = content["first_person"]["lidar_traj"][k, 1:4], 0.4 + 0.1 * k
        trans = rotation_about("z", -heading) @ (content["second_person"]["opt_trans"][k] - place)
        np.testing.assert_allclose(item.centers["trans"], trans, atol=1e-6)
        # the head is above the feet for any tilt of the sensor; the person is a few meters away
        joints = item.joints
        assert joints[15, 2] > joints[[10, 11], 2].max() + 0.8
        assert 1 < np.linalg.norm(item.center) < 8


def test_sloper4d_uses_body_model_of_gender(tmp_path):
    for k, gender in enumerate(("NEUTRAL", "MALE")):
        files.write_smpl(tmp_path / f"SMPL_{gender}.npz", seed=k)
    root = tmp_path / "data"
    truth = files.write_sloper4d(root, tmp_path / "SMPL_MALE.npz", sequences=("seq002",), gender="male")
    truth |= files.write_sloper4d(root, tmp_path / "SMPL_NEUTRAL.npz", sequences=("seq003_",), gender="female")
    items, _ = everything("sloper4d", root, tmp_path)
    check(items, truth)
    assert {item.source.partition(", ")[2] for item in items} == {
        "male by the male body", "female by the neutral body"
    }  # fmt: skip
    (tmp_path / "SMPL_NEUTRAL.npz").unlink()
    with pytest.raises(InputError, match="expected SMPL_NEUTRAL"):
        reader("sloper4d", tmp_path)


def test_sloper4d_rejects_two_releases_in_one_folder(tmp_path, smpl):
    for release in ("v0", "v1"):
        files.write_sloper4d(tmp_path / release, smpl, sequences=("seq003_street_002",))
    with pytest.raises(InputError, match="has seq003_street_002_labels.pkl twice"):
        made("sloper4d", smpl).parts(tmp_path)
    # the folder of a sequence is also accepted as root
    assert made("sloper4d", smpl).parts(tmp_path / "v1/seq003_street_002") == ["seq003_street_002"]


def write_labels(root, content):
    root.mkdir(parents=True, exist_ok=True)
    (root / "seq001_labels.pkl").write_bytes(pickle.dumps(content))


def test_sloper4d_matches_scans_by_time(tmp_path):
    folder = tmp_path / "lidar_data" / "lidar_frames_rot"
    folder.mkdir(parents=True)
    for name in ("1641234567_500", "1641234567_550", "notes"):
        (folder / f"{name}.pcd").touch()
    times = {1: 1641234567.485, 2: 1641234567.524, 3: 1641234567.535}
    found = sloper4d._scans(tmp_path, times)
    assert {frame: path.stem for frame, path in found.items()} == {1: "1641234567_500", 3: "1641234567_550"}


def test_sloper4d_counts_skipped_frames(tmp_path, smpl):
    content, truth = files.sloper4d_labels(smpl, "seq001", frames=7, without=())
    person = content["second_person"]
    person["point_clouds"][0] = np.zeros((0, 3))
    person["point_clouds"][1] = np.full((5, 3), np.nan)
    person["point_clouds"][2] = [["x", 1, 2]]
    person["opt_pose"][3, 5] = np.nan
    person["opt_pose"], person["opt_trans"] = person["opt_pose"][:6], person["opt_trans"][:6]
    content["first_person"]["lidar_traj"][4, 4:8] *= 1.02
    # a fourth column must not shift the values that follow
    person["point_clouds"][3] = np.hstack([person["point_clouds"][3], np.ones((150, 1))])
    person["point_clouds"].append(person["point_clouds"][5][:9])
    person["point_clouds"].append(person["point_clouds"][5])
    person["point_frame"] = [*person["point_frame"], 7777, person["point_frame"][5]]
    person["point_clouds"][5] = np.concatenate([person["point_clouds"][5][:9], [[1.0, np.nan, 2.0]]])
    write_labels(tmp_path, content)
    items, skipped = everything("sloper4d", tmp_path, smpl)
    # nine points are kept here; protocols exclude such people later
    assert [(item.frame, len(item.points)) for item in items] == [(125, 9)]
    assert reasons(skipped) == {
        "empty cloud": 2, "cloud cannot be read": 2, "cloud without a pose": 1, "cloud without the LiDAR's position": 1,
        "cloud of a frame without labels": 1, "another cloud of the same frame": 1,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: [], "expected labels of SLOPER4D 1.0, with second_person, got others"),
        (lambda c: {"SMPL_info": {}, "RGB_frames": {}}, "a release before 1.0"),
        (lambda c: c | {"extra": Counter}, "Counter"),
        ({"frame_num": None}, "frame_num is missing"),
        ({"first_person": {}}, "lidar_traj is missing"),
        ({"first_person": {"lidar_traj": np.zeros((3, 8))}}, r"lidar_traj must be \(-1, 9\)"),
        *[({"total_frames": value}, "total_frames") for value in ([1, 2], "x", float("nan"))],
        (lambda c: c | {"second_person": {"beta": 1}}, "no pose and trans"),
        ({"opt_trans": np.zeros((2, 3))}, "4 frames and opt_tra"),
        ({"beta": "tall"}, "beta must be numbers"),
        ({"beta": [[1], [1, 2]]}, "beta must be numbers"),
        ({"point_frame": [1]}, "3 point_clouds for 1 frames"),
        ({"point_frame": 5}, "3 point_clouds for 1 frames"),
        ({"point_frame": ["a", "b", "c"]}, "point_frame must be numbers"),
        ({"point_frame": [1, 2, float("nan")]}, "point_frame has values that are not finite"),
        ({"point_clouds": None}, "another release"),
        ({"point_clouds": 5}, "point_clouds should be a list"),
        ({"point_clouds": np.array(5.0)}, "should be a list"),
    ],
)
def test_sloper4d_rejects_invalid_labels(tmp_path, smpl, change, message):
    content = files.sloper4d_labels(smpl, "seq001")[0]
    if callable(change):
        content = change(content)
    else:
        of_all = change.keys() <= {"frame_num", "first_person", "total_frames"}
        (content if of_all else content["second_person"]).update(change)
    write_labels(tmp_path, content)
    with pytest.raises(InputError, match=message) as caught:
        everything("sloper4d", tmp_path, smpl)
    assert "seq001_labels.pkl: " in str(caught.value) and "\n" not in str(caught.value)


# --- corpora


def test_lipd_source_records_how_joints_are_placed(tmp_path, smpl):
    files.write_lipd(tmp_path, smpl)
    items, skipped = everything("lipd", tmp_path, smpl)
    assert [item.source for item in items] == [
        "lipd/gt_joint + trans", "lipd/gt_joint + trans + mean", "lipd/gt_joint"
    ]  # fmt: skip
    assert reasons(skipped) == {"joints are far from the points": 1}


def test_corpus_entry_in_other_format_is_skipped(tmp_path, smpl):
    files.write_freemotion(tmp_path, smpl, frames=5)
    path = tmp_path / "fm_test2.pkl"
    entries = pickle.loads(path.read_bytes())
    del entries[0]["shape"], entries[1]["T_2"], entries[2]["pc_3"]
    entries[3] = 5
    entries[4]["gt"] = np.zeros(71)
    entries.append({name: value for name, value in entries[0].items() if not name.startswith("pc")})
    # the only cloud may be pc, also beside an empty pc_1
    entries.append(entries[0] | {"pc": entries[0]["pc_1"]} | dict.fromkeys(("pc_1", "pc_2", "pc_3")))
    path.write_bytes(pickle.dumps(entries))
    items, skipped = everything("freemotion", tmp_path, smpl)
    assert reasons(skipped) == {"no T_2": 1, "entry in another format": 2, "no pc": 1} and len(items) == 8
    assert [item.track for item in items] == ["1", "2", "3", "1", "3", "1", "2", "1"]
    assert [item.source for item in items[:7]] == ["freemotion/mean shape"] * 3 + ["freemotion"] * 4
    path.unlink()
    files.write_lipd(tmp_path, smpl)
    path = tmp_path / "LIPD_train.pkl"
    entries = pickle.loads(path.read_bytes())[:3]
    clouds = ["x/y.bin", "/a/" + "x" * 300 + ".bin", "/a/x\0.bin", [[1, 2, 3], [1, 2]], np.ones((3, 40))]
    broken = [entries[0] | {"pc": cloud} for cloud in clouds]
    path.write_bytes(pickle.dumps([*broken, {"gt_joint": np.zeros((24, 3))}, *entries]))
    items, skipped = everything("lipd", tmp_path, smpl)
    assert len(items) == 3 and reasons(skipped) == {"entry in another format": 5, "no pc": 1}
    assert "y.bin is not in" in skipped[0].where


@pytest.mark.parametrize("meaning", ["trans", "the pelvis"])
def test_noisemotion_placement_is_the_one_nearer_to_a_files_points(tmp_path, smpl, meaning):
    """Even where the other one is nearer to the points of a person."""
    # as of SMPL itself, the pelvis of the body at rest is not at the origin
    model = dict(np.load(smpl, allow_pickle=False))
    model["v_template"] = model["v_template"] + [0.3, 0.0, 0.0]
    shifted = tmp_path / "shifted.npz"
    np.savez(shifted, **model)
    truth = files.write_freemotion(tmp_path, shifted, name="FreeMotion_train.pkl", noise=True)
    path = tmp_path / "FreeMotion_train.pkl"
    entries = pickle.loads(path.read_bytes())
    for number, entry in enumerate(entries):
        pelvis = SmplJoints(shifted, "")(entry["shape"][1:2], entry["gt"][1:2], np.zeros((1, 3)))[0, 0]
        for view in (1, 2, 3):
            if meaning == "trans" and f"T_{view}" in entry:
                entry[f"T_{view}"] = entry[f"T_{view}"] - pelvis
            if number == 0 and view == 1:
                # a few points, nearer to the other placement
                entry["pc_1"] = entry["pc_1"][:5] + 0.6 * (pelvis if meaning == "the pelvis" else -pelvis)
    path.write_bytes(pickle.dumps(entries))
    items, skipped = everything("noisemotion", tmp_path, shifted)
    assert not skipped and len(items) == len(truth)
    for item in items:
        assert item.source == f"noisemotion/T is {meaning}"
        np.testing.assert_allclose(item.joints, truth[item.sequence, item.frame, item.track], atol=1e-5)


def test_noisemotion_without_poses_names_authors_script(tmp_path, smpl):
    (tmp_path / "pc_1/train/run1").mkdir(parents=True)
    with pytest.raises(InputError, match="SURREAL: run the authors' dataloader_NoiseMotion.py") as caught:
        made("noisemotion", smpl).parts(tmp_path)
    assert "\n" not in str(caught.value)


# --- roots and SMPL models


@pytest.mark.parametrize("name", WRITERS)
def test_wrong_root_error_names_expected_files_and_source(name, tmp_path, smpl):
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="is not the root of .*expected .* got .* get it at ") as caught:
        made(name, smpl).parts(tmp_path)
    assert "\n" not in str(caught.value)
    if name == "lidarhuman26m":
        (tmp_path / "labels/3d/pose/5").mkdir(parents=True)
        with pytest.raises(InputError, match="got no labels/3d/segment"):
            made(name, smpl).parts(tmp_path)
        (tmp_path / "labels/3d/segment").mkdir()
        assert made(name, smpl).parts(tmp_path) == ["5"]


def test_reader_requires_matching_smpl_model(tmp_path, smpl):
    for name in ("lidarhuman26m", "sloper4d", "freemotion"):
        with pytest.raises(InputError, match=f"{name} has SMPL poses.*register at smpl.is.tue.mpg.de"):
            reader(name)
    with pytest.raises(InputError, match="no such file; expected an SMPL model"):
        reader("sloper4d", tmp_path / "none.pkl")
    with pytest.raises(InputError, match="omit the SMPL model"):
        reader("humanm3", smpl)
    with pytest.raises(InputError, match="unknown dataset 'humanm4': did you mean humanm3"):
        reader("humanm4")
    np.savez(tmp_path / "x.npz", **files.synthetic(52, 16))
    with pytest.raises(InputError, match="24 joints, got 52"):
        SmplJoints(tmp_path / "x.npz", "x")(np.zeros((1, 10)), np.zeros((1, 72)), np.zeros((1, 3)))
    np.savez(tmp_path / "y.npz", **files.synthetic(24, 4))
    with pytest.raises(InputError, match="has 4 shape coefficients, the labels 10"):
        SmplJoints(tmp_path / "y.npz", "x")(np.zeros((1, 10)), np.zeros((1, 72)), np.zeros((1, 3)))


def test_published_smpl_file_names_are_recognized(tmp_path):
    names = ("basicModel_f_lbs_10_207_0_v1.0.0", "basicmodel_m_lbs_10_207_0_v1.1.0", "SMPL_NEUTRAL", "other")
    for name in names:
        (tmp_path / f"{name}.pkl").write_bytes(b"x")
    # the neutral model is read immediately
    (tmp_path / f"{names[2]}.pkl").unlink()
    files.write_smpl(tmp_path / f"{names[2]}.npz")
    found = SmplJoints(tmp_path, "x")
    assert {kind: path.stem for kind, path in found.files.items()} == {
        "female": names[0], "male": names[1], "neutral": names[2]
    }  # fmt: skip
    assert [found.kind(g) for g in ("male", "female", "robot")] == ["male", "female", "neutral"]


def test_corpora_have_ten_frames_a_second_and_joints_at_their_points(tmp_path, smpl):
    files.write_lipd(tmp_path, smpl)
    path = tmp_path / "LIPD_train.pkl"
    entries = pickle.loads(path.read_bytes())
    entries[2]["gt_joint"] = entries[2]["gt_joint"] + np.tile([0.9, 0, 0], 24)
    path.write_bytes(pickle.dumps(entries))
    items, skipped = everything("lipd", tmp_path, smpl)
    assert [item.time for item in items] == pytest.approx([0.0, 0.1])
    assert reasons(skipped) == {"joints are far from the points": 2}
