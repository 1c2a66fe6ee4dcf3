"""Files of captured motion in every format: round trips on our body, and errors that name the fault."""

import json
import pickle
import re

import motion_files as files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from lidarpose.body.mocap import digest, joint_tree, load_motion, retarget, skeleton_files
from lidarpose.body.mocap.smpl_poses import load_betas
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES, rotation_about
from lidarpose.synth.shard_job import SynthesisJob

J, MAIN = files.J, files.MAIN
ROTATIONS, WAY = files.a_clip(20)
JOINTS = files.joints_of(ROTATIONS, WAY)
BVH = files.bvh_text(ROTATIONS, WAY, names=files.CMU_NAMES)
ASF, AXES = files.asf_text()
AMC = files.amc_text(ROTATIONS, WAY, AXES)


def errors(motion, joints=JOINTS):
    """Distances (F, 24) m of the joints from the written ones."""
    return np.linalg.norm(files.joints_of(motion.rotations, motion.translation) - joints, axis=-1)


def check_same(motion, rotations, way):
    """The joints equal the written ones within 1 mm."""
    assert motion.rotations.dtype == motion.translation.dtype == np.float32
    assert errors(motion, files.joints_of(rotations, way)).max() < 1e-3


def written(folder, text, name="a.bvh"):
    (folder / name).write_text(text)
    return folder / name


def refused(path, message, named=None, **options):
    """`load_motion` raises an InputError of one line that names the file."""
    with pytest.raises(InputError, match=message) as caught:
        load_motion(path, **options)
    assert re.search(rf"{named or re.escape(path.name)}: ", str(caught.value)) and "\n" not in str(caught.value)


# BVH, ASF and AMC: positions within 0.1 mm, on our body within the error of retargeting by positions


@pytest.mark.parametrize("skeleton", files.NAMES)
def test_load_motion_bvh_with_any_joint_names(tmp_path, skeleton):
    motion = load_motion(written(tmp_path, files.bvh_text(ROTATIONS, WAY, names=files.NAMES[skeleton])))
    assert motion.names == ("a",) and motion.fps == pytest.approx(30) and motion.dropped == 0
    assert errors(motion)[:, MAIN].mean() < 0.010 and errors(motion).max() < 0.05


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YXZ", "ZYX", "YZX", "XZY"])
def test_read_bvh_positions_for_any_channel_order(tmp_path, order):
    """The tree's own positions, in centimeters and y up, without retargeting."""
    tree, values, rate = skeleton_files.read_bvh(written(tmp_path, files.bvh_text(ROTATIONS, WAY, order=order)))
    assert rate == pytest.approx(30)
    index = [tree.names.index(name) for name in J]
    np.testing.assert_allclose(tree.positions(values)[:, index] / 100 @ UP_AXES["y"].T, JOINTS, atol=1e-4)


@pytest.mark.parametrize("unit, up", [(1.0, "y"), (0.01, "z"), (0.0254, "y"), (0.001, "x"), (0.0254 / 0.45, "y")])
def test_load_motion_detects_unit_and_up_axis(tmp_path, unit, up):
    path = written(tmp_path, files.bvh_text(ROTATIONS, WAY, names=files.CMU_NAMES, unit=unit, up=up))
    for motion in (load_motion(path), load_motion(path, up=up)):
        assert errors(motion)[:, MAIN].mean() < 0.010


def test_meters_per_unit_of_children_and_tall_people():
    for size in (0.62, 0.8, 1.0, 1.2):
        for name, meters in retarget.UNITS.items():
            assert retarget.meters_per_unit("x", JOINTS[:1] * size / meters) == meters, (size, name)


def test_load_motion_skeletons_with_missing_joints(tmp_path):
    """Without hands, feet, collars and spine joints; estimated joints are plausible."""
    feet = ("left_foot", "right_foot")
    text = files.bvh_text(ROTATIONS, WAY, names=files.CMU_NAMES, drop=("left_hand", "right_hand", *feet))
    error = errors(load_motion(written(tmp_path, text)))
    no_ankle = [j for j in MAIN if "ankle" not in list(J)[j]]
    assert error[:, no_ankle].mean() < 0.012 and error[:, [J[foot] for foot in feet]].mean() < 0.12
    matched = {n: i for n, i in J.items() if n.endswith(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))}
    matched["head"] = J["head"]
    way = dict(offset=np.zeros(3), channels=("tx", "ty", "tz"))
    less = [joint_tree.Joint(name=name, parent=0 if i else -1, **way) for name, i in J.items()]
    values = np.concatenate([JOINTS[:, :1], JOINTS[:, 1:] - JOINTS[:, :1]], 1).reshape(-1, 72)
    motion = joint_tree.tree_motion(
        "x", joint_tree.JointTree(joints=less), values, fps=10, up="z", kind="test", matched=matched
    )
    limbs = [J[f"{side}_{name}"] for side in ("left", "right") for name in ("hip", "knee", "elbow")]
    assert errors(motion)[:, limbs].mean() < 0.09


@pytest.mark.parametrize("length", [0.45, 1.0])
def test_load_motion_amc_round_trip(tmp_path, length):
    skeleton, axes = files.asf_text(length=length)
    written(tmp_path, skeleton, "02.asf")
    path = written(tmp_path, files.amc_text(ROTATIONS, WAY, axes, length=length), "02_05.amc")
    tree, values, _, unit_m = skeleton_files.read_amc(path)
    positions = tree.positions(values) * unit_m @ UP_AXES["y"].T
    for i, bone in enumerate(tree.names):
        if bone in files.ASF_ENDS:
            np.testing.assert_allclose(positions[:, i], JOINTS[:, J[files.ASF_ENDS[bone]]], atol=1e-4)
    motion = load_motion(path)
    assert motion.names == ("02_05",) and motion.fps == 120
    # both collars are one point in this format
    error = errors(motion)
    assert error[:, MAIN].mean() < 0.05 and error[:, [J["left_ankle"], J["right_ankle"]]].mean() < 0.02


def test_load_motion_amc_is_cut_where_frame_numbers_jump(tmp_path):
    written(tmp_path, ASF, "02.asf")
    cut = re.sub(r"(?m)^(\d+)$", lambda found: str(int(found[1]) + 500 * (int(found[1]) > 12)), AMC)
    motion = load_motion(written(tmp_path, cut, "02_05.amc"))
    assert motion.names == ("02_05", "02_05#2") and motion.length.tolist() == [12, 8]
    # numbers that do not rise say nothing
    same = re.sub(r"(?m)^\d+$", "1", AMC)
    assert load_motion(written(tmp_path, same, "02_05.amc")).length.tolist() == [20]


def test_load_motion_reads_clip_names_of_bytes(tmp_path):
    clips = {"joints": JOINTS, "clip": np.array([b"002_01"]), "clip_start": [0], "clip_length": [20], "fps": 30.0}
    np.savez(tmp_path / "a.npz", **clips)
    assert load_motion(tmp_path / "a.npz").names == ("002_01",)


def test_load_betas_of_selected_clips(tmp_path):
    for sequence, beta in (("5", 1.0), ("50", 2.0)):
        (tmp_path / "pose" / sequence).mkdir(parents=True)
        for frame in (1, 2):
            content = {"pose": [0.0] * 72, "trans": [0.0] * 3, "beta": [beta] * 10}
            written(tmp_path / "pose" / sequence, json.dumps(content), f"{frame:06}.json")
    person = {"pose": np.zeros((2, 72)), "trans": np.zeros((2, 3))}
    labels = {"framerate": 20.0}
    labels |= {f"{k}_person": person | {"beta": [b] * 10} for k, b in (("first", 3.0), ("second", 4.0))}
    (tmp_path / "s_labels.pkl").write_bytes(pickle.dumps(labels))
    for path, subjects, expected in (
        ("pose", ("5",), [1.0]), ("pose/5", ("5",), [1.0]), ("pose/5", (), [1.0]), ("pose", (), [1.0, 2.0]),
        (".", ("s_labels_second",), [4.0]), (".", ("pose/50", "s_labels"), [2.0, 3.0, 4.0]),
        ("s_labels.pkl", ("s_labels_first",), [3.0]),
    ):  # fmt: skip
        assert load_betas(tmp_path / path, subjects)[:, 0].tolist() == expected, (path, subjects)


def test_load_motion_amc_finds_its_asf(tmp_path):
    path = written(tmp_path, AMC, "02_05.amc")
    refused(path, "put 02.asf or 02_05.asf beside it")
    written(tmp_path, ASF, "any.ASF")
    expected = load_motion(path).rotations
    written(tmp_path, "nonsense", "02.asf")
    refused(path, "02.asf: an ASF file has :root", named="02.asf")
    written(tmp_path, ASF, "02_05.asf")
    np.testing.assert_array_equal(load_motion(path).rotations, expected)
    for name in ("02.asf", "02_05.asf"):
        (tmp_path / name).unlink()
    written(tmp_path, ASF, "other.asf")
    refused(path, "there are any.asf, other.asf")
    # of several people's skeletons the one whose name begins the file's, also in the folder above
    for folder in (tmp_path / "a", tmp_path / "a/walk"):
        folder.mkdir()
        written(folder, AMC, "HDM_bd_walk_01_120.amc")
    written(tmp_path / "a", "nonsense", "HDM_bk.asf")
    refused(tmp_path / "a/walk/HDM_bd_walk_01_120.amc", "put HDM_bd.asf or HDM_bd_walk_01_120.asf beside it")
    written(tmp_path / "a", ASF, "HDM_bd.asf")
    for folder in (tmp_path / "a", tmp_path / "a/walk"):
        np.testing.assert_array_equal(load_motion(folder / "HDM_bd_walk_01_120.amc").rotations, expected)


def changed(text, old, new, count=1):
    assert old in text
    return text.replace(old, new, count)


ROW = BVH.splitlines()[-1]


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "is empty"), ("hello", "starts with HIERARCHY, got 'hello'"),
        (BVH[: BVH.index("MOTION")], "no MOTION part"),
        (BVH[:-400], "expected 20 frames of 75 numbers, got .* copied completely"),
        *((BVH[: BVH.index(cut)], "must begin with Frames: and Frame Time:") for cut in ("Frame Time", "Frames")),
        *((changed(BVH, "Frames: 20", f"Frames: {n}"), f"whole number of 0 or more, got ' {n}'") for n in ("x", "-1")),
        (changed(BVH, "Frames: 20", "Frames: 0")[: BVH.index(ROW)], "frames of 75|no frame"),
        (re.sub(r"CHANNELS.*", "CHANNELS 0", BVH), "no joint has CHANNELS"),
        *((re.sub("Time: .*", f"Time: {seconds}", BVH), "no frame time above 0") for seconds in ("0", "x", "1e-300")),
        (BVH.replace(ROW, ROW.replace(ROW.split()[7], "abc")), "MOTION must be numbers"),
        (re.sub(r"OFFSET.*", "OFFSET 0 0 0", BVH), "have no length"),
        *((changed(BVH, old, new), message) for old, new, message in (
            ("OFFSET", "OFFSET nan", "3 finite numbers"), ("}", "", "not complete"),
            ("3 Zrotation", "3 Wrotation", "the channel 'Wrotation'"),
            ("CHANNELS 3", "CHANNELS 4", "a count and as many names"))),
        (re.sub(r"OFFSET.*", "", BVH, count=1), "joint Hips has no OFFSET|stands where"),
        *((changed(BVH, old, new), "is in a wrong place; expected one ROOT") for old, new in (
            ("OFFSET", "OFFSETS"), ("{", ""), ("\nMOTION", "\n}\nMOTION"), ("JOINT", "ROOT"), ("CHY", "CHY\n{"))),
        (BVH.replace("LeftUpLeg", "Banana").replace("RightForeArm", "Apple"), "joint for left_hip, right_elbow among"),
        (BVH.replace("Head", "Skulptur"), "no joint for head among Hips, .*; expected left and right"),
        (files.bvh_text(ROTATIONS, WAY, unit=0.5), "times as tall as an adult; known units are m, cm"),
        (files.bvh_text(ROTATIONS, WAY * [100, 100, 1]), "m/s: are positions and bones in one unit"),
        (files.bvh_text(ROTATIONS, WAY * 1e9), "100 km|m/s"),
    ],
)  # fmt: skip
def test_load_motion_reports_bad_bvh(tmp_path, text, message):
    refused(written(tmp_path, text), message)


def test_load_motion_bvh_mixed_units_upside_down_and_no_rate(tmp_path):
    lines = BVH.splitlines()
    at = next(i for i, line in enumerate(lines) if "LeftLeg" in line)
    lines[at + 2] = re.sub(r"(-?[\d.]+)", lambda m: str(float(m[0]) * 100), lines[at + 2])
    refused(written(tmp_path, "\n".join(lines)), "left leg is .* long, the right .* one unit throughout")
    over = ROTATIONS.copy()
    over[:, 0] = np.diag([1.0, -1, -1]) @ over[:, 0]
    path = written(tmp_path, files.bvh_text(over, WAY, names=files.CMU_NAMES))
    refused(path, "people stand along -y; give load_motion up='-y'")
    assert errors(load_motion(path, up="y"), files.joints_of(over, WAY))[:, MAIN].mean() < 0.01
    assert load_motion(written(tmp_path, re.sub("Frame Time: .*", "Frame Time: 0", BVH)), fps=25).fps == 25


def test_load_motion_drops_bad_frames_of_bvh(tmp_path):
    lines = BVH.splitlines()
    lines[-6] = "nan " + lines[-6].partition(" ")[2]
    lines[-3] = lines[-3].rpartition(" ")[0] + " 1e999"
    motion = load_motion(written(tmp_path, "\n".join(lines)))
    assert motion.dropped == 2 and tuple(motion.length) == (14, 2, 2)
    lines[-20:-6] = ["nan " * 75] * 14
    refused(written(tmp_path, "\n".join(lines)), "16 of 20 frames")


@pytest.mark.parametrize(
    "asf, amc, message",
    [
        (ASF, "", "is empty"), ("", AMC, "is empty"), (ASF, AMC[:-300], "copied completely"),
        (ASF, "hello world\n", "numbered frames of bones, got 'hello world'"),
        (ASF, ":FULLY-SPECIFIED\n", "no frame"), (ASF, "1\n2\n3\n", "moves no bone"),
        (ASF, AMC.replace("lfemur", "banana"), "moves banana, which s.asf does not have"),
        (ASF, re.sub("lfemur .*", "lfemur 1 2", AMC), "lfemur has 2 numbers per frame, its skeleton 3"),
        (ASF, re.sub("lfemur .*", "lfemur 1 2 x", AMC), "numbers of lfemur must be"),
        *((changed(ASF, old, new), AMC, message) for old, new, message in (
            (":bonedata", ":bones", ":bonedata is missing"), ("length 0.45", "length x", "length of :units"),
            ("length 0.45", "length 0", "length of :units must be above 0"), (" XYZ\n", " XYY\n", "order such as XYZ"),
            ("angle deg", "angle grad", "deg or rad, got 'grad'"), ("order TX", "order TW", "order of :root"),
            ("name lfemur", "name", "has no name"), ("name lfemur", "name rfemur", "rfemur twice"),
            ("   direction", "   direktion", "lowerback has no direction"),
            ("dof rx", "dof l", "the degree of freedom 'l'"),
            ("  end\n:hierarchy", ":hierarchy", "stops inside a bone"),
            ("root lower", "root nobody lower", "names 'nobody'"),
            ("root lowerback", "root", "lowerback.*: no parent in :hierarchy"))),
        (ASF + "  root ltibia\n", AMC, "ltibia twice"),
        (ASF.replace("ltibia", "lshin"), AMC.replace("ltibia", "lshin"), "s.asf: has no bone ltibia among"),
        (re.sub(r"     length \S+", "     length 0", ASF), AMC, "have no length"),
        (re.sub(r"     length (\S+)", "     length 1e300", ASF), AMC, "expected finite joint positions"),
    ],
)  # fmt: skip
def test_load_motion_reports_bad_amc_or_asf(tmp_path, asf, amc, message):
    written(tmp_path, asf, "s.asf")
    refused(written(tmp_path, amc, "s_1.amc"), message, named=r"s(_1\.amc|\.asf)")


# damaged files raise only InputError

SHORT = files.bvh_text(ROTATIONS[:2], WAY[:2], names=files.CMU_NAMES)
SHORT_AMC = files.amc_text(ROTATIONS[:2], WAY[:2], AXES)
ODD = st.sampled_from(
    ["", "{", "}", "nan", "1e308", "-1e308", "inf", "0", "9" * 30, "\x00", "JOINT x", "End Site", "MOTION", "OFFSET",
     "XYZ", ":root", "begin", "end", "root", "lfemur", "name", "dof rx", "ROOT", "Frames: 3", "\n", "é", "Hips"]
)  # fmt: skip


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    which=st.sampled_from(["a.bvh", "s.asf", "s_1.amc"]),
    odd=st.lists(st.tuples(st.floats(0, 1), ODD), max_size=4),
    cut=st.one_of(st.just(1.1), st.floats(0, 1)),
)
def test_load_motion_of_damaged_text_raises_only_input_error(tmp_path, which, odd, cut):
    texts = {"a.bvh": SHORT, "s.asf": ASF, "s_1.amc": SHORT_AMC}
    words = re.split(r"(\s+)", texts[which])
    for place, word in odd:
        words[int(place * (len(words) - 1))] = word
    texts[which] = "".join(words)[: int(cut * len(texts[which])) + 1]
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    try:
        motion = load_motion(tmp_path / ("a.bvh" if which == "a.bvh" else "s_1.amc"))
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(motion.rotations).all()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200), suffix=st.sampled_from([".bvh", ".amc", ".json", ".npz"]))
def test_load_motion_of_random_bytes_raises_input_error(tmp_path, data, suffix):
    for name in ("a.asf", f"a{suffix}"):
        (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError):
        load_motion(tmp_path / f"a{suffix}")


# formats with SMPL's rotations, which are kept


@pytest.mark.parametrize("width, rate", [(156, "mocap_framerate"), (165, "mocap_frame_rate"), (72, "fps"), (66, "fps")])
def test_load_motion_amass_round_trip(tmp_path, width, rate):
    rotations, way = files.a_clip()
    if width != 72:
        rotations[:, [J["left_hand"], J["right_hand"]]] = np.eye(3)
    motion = load_motion(files.write_amass(tmp_path / "02_01_poses.npz", rotations, way, width=width, rate=rate))
    check_same(motion, rotations, way)
    assert motion.names == ("02_01_poses",) and motion.fps == 60 and motion.dropped == 0
    assert motion.source.startswith("AMASS: ")


def test_load_motion_amass_in_parts_and_other_up_axis(tmp_path):
    rotations, way = files.a_clip(5)
    pose, path = files.to_smpl(rotations, "y"), tmp_path / "a_stageii.npz"
    rate = np.array(120.0)
    np.savez(path, root_orient=pose[:, :3], pose_body=pose[:, 3:66], trans=way @ files.C, mocap_frame_rate=rate)
    refused(path, "stand or lie along y, not z; give load_motion up='y'")
    check_same(load_motion(path, up="y"), rotations, way)
    assert load_motion(path, up="y", fps=30).fps == 30
    assert load_motion(path, up="y", hz=60).rotations.shape[0] == 3
    # people may lie down if up is given
    rotations[:, 0] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float) @ rotations[:, 0]
    path = files.write_amass(tmp_path / "lies_poses.npz", rotations, way)
    refused(path, "people stand or lie along")
    check_same(load_motion(path, up="z"), rotations, way)


def test_load_motion_splits_clips_at_nonfinite_frames(tmp_path):
    path = files.write_amass(tmp_path / "a.npz", ROTATIONS, WAY)
    content = dict(np.load(path))
    content["poses"][7, 3] = np.nan
    content["trans"][12] = np.inf
    np.savez(path, **content)
    motion = load_motion(path)
    assert motion.dropped == 2 and motion.names == ("a", "a#2", "a#3") and tuple(motion.length) == (7, 4, 7)
    check_same(motion, *(np.delete(x, [7, 12], 0) for x in (ROTATIONS, WAY)))
    content["poses"][:5] = np.nan
    np.savez(path, **content)
    refused(path, "7 of 20 frames have values that are not finite")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"drop": ("trans",)}, "holds betas, dmpls, gender, mocap_framerate, poses; an npz of motion needs"),
        ({"drop": ("poses",)}, "root_orient"),
        ({"drop": ("mocap_framerate",)}, "does not give its frame rate .* give load_motion fps="),
        *(({"fps": rate}, "above 0") for rate in (0, np.nan)),
        *(({"mocap_framerate": np.array(rate)}, "as one number") for rate in (["x"], [1.0, 1.0])),
        ({"poses": np.zeros((4, 60))}, r"\(4, 60\)"), ({"poses": np.zeros((4, 2, 156))}, r"\(4, 2, 156\)"),
        ({"poses": np.full((4, 156), "a")}, "must be numbers"), ({"poses": np.array([{}] * 4)}, "plain arrays"),
        ({"poses": np.full((4, 156), 90.0)}, "radians, not degrees"), ({"trans": np.full(3, "a")}, "must be numbers"),
        ({"trans": np.zeros((5, 3))}, r"\(4, 72\).*\(5, 3\)"), ({"trans": np.full((4, 3), 1e30)}, "expected meters"),
        ({"drop": ("poses",), "root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 60))}, r"\(4, 60\)"),
        ({"drop": ("poses",), "root_orient": np.zeros((4, 3)), "pose_body": np.zeros(())}, "pose_body"),
    ],
)  # fmt: skip
def test_load_motion_reports_bad_amass(tmp_path, changes, message):
    refused(files.write_amass(tmp_path / "wrong.npz", *files.a_clip(4), **changes), message)


@pytest.mark.parametrize("up", ["z", "y"])
def test_load_motion_lidarhuman26m_round_trip(tmp_path, up):
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


def test_damaged_lidarhuman26m_pose_file_ends_a_clip(tmp_path):
    rotations, way = files.a_clip(12)
    folder = files.write_pose_json(tmp_path / "labels/3d/pose/24", rotations, way, up="z", first=5)
    damaged = folder / "000009.json"
    damaged.write_text(damaged.read_text()[:50])
    with pytest.warns(UserWarning, match=r"left out 1 of 12 pose files: .*000009\.json: is not JSON"):
        motion = load_motion(tmp_path, up="z")
    assert tuple(motion.length) == (4, 7) and len(load_betas(tmp_path)) == 1
    with pytest.raises(InputError, match=r"000009\.json: is not JSON"):
        load_motion(damaged)


def test_load_motion_levels_lidarhuman26m(tmp_path):
    """The frame of a sensor that looks down is turned level, as by `prepare`; up="z" keeps it."""
    rotations, way = files.a_clip(120)
    rotations[:, 1:] = np.eye(3)
    # upright people who turn around
    rotations[:, 0] = rotation_about("z", np.linspace(0, 2 * np.pi, len(rotations)))
    tilted, tilted_way = rotations.copy(), way @ rotation_about("y", np.radians(15)).T
    tilted[:, 0] = rotation_about("y", np.radians(15)) @ rotations[:, 0]
    folder = files.write_pose_json(tmp_path / "labels/3d/pose/24", tilted, tilted_way)
    check_same(load_motion(folder, up="z"), tilted, tilted_way)
    level = load_motion(folder)
    up = level.rotations[:, 0] @ [0, 0, 1]
    assert np.degrees(np.arccos(up[:, 2])).max() < 2
    np.testing.assert_allclose(level.translation, way, atol=0.03 * np.abs(way).max())


@pytest.mark.parametrize(
    "content, message",
    [
        *(("{", "is not JSON"), ("[" * 100000, "is not JSON"), ("{}", "expected pose .* got {}")),
        ("3", r"expected pose \(72 numbers\) and trans \(3 numbers\), got 3"),
        *((json.dumps({"pose": pose, "trans": trans}), "expected pose") for pose, trans in (
            ([1, 2], [1, 2, 3]), ("x", [1, 2, 3]), ([0] * 72, [1, {}, 3]), ([10**400] * 72, [0] * 3))),
    ],
)  # fmt: skip
def test_load_motion_reports_bad_pose_json(tmp_path, content, message):
    folder = files.write_pose_json(tmp_path / "7", *files.a_clip(3))
    (folder / "000002.json").write_text(content)
    refused(folder / "000002.json", message, named="000002.json")
    # a folder is read without it
    with pytest.warns(UserWarning, match=rf"left out 1 of 3 pose files: \S*000002\.json: [^\n]*{message}[^\n]*$"):
        assert len(load_motion(folder, up="z").rotations) == 2
    for path in folder.iterdir():
        path.write_text(content)
    refused(folder, message, named=".json")
    (folder / "000002.json").write_text(json.dumps({"pose": [0] * 72, "trans": [None] * 3}))
    refused(folder / "000002.json", "expected pose|not finite")


def labels(rotations, way, **changes):
    person = {"pose": files.to_smpl(rotations), "trans": way, "beta": np.zeros(10), "gender": "male"}
    return {"framerate": 20, "first_person": {"lidar_traj": np.zeros((3, 9))}, "second_person": person} | changes


def write_labels(folder, content):
    path = folder / "seq007_garden_001_labels.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def test_load_motion_sloper4d_round_trip(tmp_path):
    rotations, way = files.a_clip()
    motion = load_motion(write_labels(tmp_path, labels(rotations, way)))
    check_same(motion, rotations, way)
    assert motion.fps == 20 and motion.names == ("seq007_garden_001_labels_second",)
    other, path = files.a_clip(4, seed=1)
    first = {"pose": files.to_smpl(other), "trans": path}
    refined = {"opt_pose": files.to_smpl(rotations) * 0.5, "opt_trans": way + [1, 0, 0]}
    second = labels(rotations, way)["second_person"] | refined
    motion = load_motion(write_labels(tmp_path, labels(rotations, way, first_person=first, second_person=second)))
    assert motion.names == ("seq007_garden_001_labels_first", "seq007_garden_001_labels_second")
    np.testing.assert_allclose(motion.translation[motion.frames(1)], way + [1, 0, 0], atol=1e-5)
    check_same(motion.of("seq007_garden_001_labels_first"), other, path)


def test_load_motion_cuts_sloper4d_at_missing_frames(tmp_path):
    rotations, way = files.a_clip(8)
    content = labels(rotations, way, frame_num=[0, 5, 10, 15, 500, 505, 510, 515])
    name = "seq007_garden_001_labels_second"
    assert load_motion(write_labels(tmp_path, content)).names == (name, f"{name}#2")
    # uneven steps are no gaps
    for other in ([0, 5], None, [0] * 8, ["a"] * 8, [0, 1, 3, 4, 6, 7, 9, 10], [0, 1, 6, 11, 16, 21, 26, 31]):
        assert load_motion(write_labels(tmp_path, content | {"frame_num": other})).names == (name,)


def test_load_motion_reads_people_of_sloper4d_folders_once(tmp_path):
    """Beside the labels, releases have masks without poses and the unrefined recording."""
    write_labels(tmp_path, labels(*files.a_clip(4)))
    (tmp_path / "seq007_garden_001_labels_mask.pkl").write_bytes(pickle.dumps({"masks": {}}))
    (tmp_path / "mocap_data").mkdir()
    (tmp_path / "mocap_data" / "seq007_garden_001_second.bvh").write_text("not read")
    assert load_motion(tmp_path).names == ("seq007_garden_001_labels_second",)


class Counter(dict):
    """A class that does not occur in label files."""


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c: 3, "a dict, got int"),
        (lambda c: {}, "expected second_person .* got nothing"),
        (lambda c: {k: v for k, v in c.items() if k != "framerate"}, "frame rate"),
        *((lambda c, r=r: c | {"framerate": r}, what) for r, what in (("fast", "frame rate"), (-20, "above 0"))),
        (lambda c: c | {"second_person": {"pose": np.zeros((3, 71)), "trans": np.zeros((3, 3))}}, r"\(3, 71\)"),
        (lambda c: c | {"second_person": {"pose": [[1, 2], [3]], "trans": np.zeros((3, 3))}}, "rows of equal length"),
        (lambda c: c | {"second_person": {"pose": np.zeros((0, 72)), "trans": np.zeros((0, 3))}}, "no frame"),
        (lambda c: c | {"extra": Counter()}, "Counter"),
    ],
)
def test_load_motion_reports_bad_sloper4d(tmp_path, change, message):
    refused(write_labels(tmp_path, change(labels(*files.a_clip(3)))), message)


# clips of positions, folders, and files without motion


@pytest.mark.parametrize("size", [0.8, 1.2])
def test_load_motion_strides_are_those_of_the_mean_adult(tmp_path, size):
    """Clips of a small or tall person who goes the same way in proportion: the body's feet do not slide."""
    rotations, way = files.a_clip(8)
    common = {"clip": ["a", "b"], "clip_start": [0, 5], "clip_length": [5, 3], "fps": 10.0}
    motions = []
    for scale in (1.0, size):
        joints = files.joints_of(rotations, way) * scale
        np.savez(tmp_path / "clips.npz", joints=joints, **common)
        motions.append(load_motion(tmp_path / "clips.npz"))
    same, other = motions
    np.testing.assert_allclose(other.rotations, same.rotations, atol=1e-3)
    for rows in (slice(0, 5), slice(5, 8)):
        path, other_path = (motion.translation[rows, :2] for motion in (same, other))
        np.testing.assert_allclose(other_path - other_path[0], path - path[0], atol=2e-3)
        # the place remains
        np.testing.assert_allclose(other_path.mean(0), path.mean(0) * size, atol=0.02)


def test_load_motion_retargets_clips_of_positions(tmp_path):
    rotations, way = files.a_clip(40)
    joints, path = files.joints_of(rotations, way), tmp_path / "clips.npz"
    content = dict(
        joints=joints, clip=np.array(["002_01", "005_01"]), clip_start=np.array([0, 15]),
        clip_length=np.array([15, 25]), fps=np.array(10.0),
    )  # fmt: skip
    np.savez(path, **content)
    motion = load_motion(path)
    assert motion.names == ("002_01", "005_01") and motion.fps == 10 and tuple(motion.length) == (15, 25)
    assert errors(motion, joints).mean() < 0.010 and errors(motion, joints).max() < 0.06
    for change, message in (({"joints": 1e3 * joints}, "998 times as tall"), ({"fps": np.array(1e5)}, "people move")):
        np.savez(path, **content | change)
        refused(path, message)

    joints[3, 4] = joints[3, 1]  # a thigh without length
    np.savez(path, **content)
    motion = load_motion(path)
    assert motion.dropped == 1 and tuple(motion.length) == (3, 11, 25)
    assert motion.names == ("002_01", "002_01#2", "005_01") and motion.of("002").names == ("002_01", "002_01#2")
    joints[15:25, 4] = joints[15:25, 1]
    np.savez(path, **content)
    refused(path, "10 of 25 frames")


def test_load_motion_reads_folder_of_all_formats(tmp_path):
    rotations, way = files.a_clip(13)
    files.write_amass(tmp_path / "b_poses.npz", rotations, way, fps=60)
    (tmp_path / "02").mkdir()
    written(tmp_path, files.bvh_text(rotations, way, fps=120), "02/02_01.bvh")
    written(tmp_path, ASF, "02/02.asf")
    written(tmp_path, files.amc_text(rotations, way, AXES), "02/02_02.amc")
    files.write_pose_json(tmp_path / "pose/7", rotations, way)
    write_labels(tmp_path, labels(rotations, way))
    written(tmp_path, "nothing to read here", "shape.npz")
    written(tmp_path, "hello", "README.txt")
    motion = load_motion(tmp_path)
    assert motion.names == ("02/02_01", "02/02_02", "b_poses", "pose/7", "seq007_garden_001_labels_second")
    assert motion.fps == 10 and tuple(motion.length) == (2, 2, 3, 13, 7)
    assert motion.of("02").names == ("02/02_01", "02/02_02")
    assert tuple(load_motion(tmp_path, hz=20).length) == (3, 3, 5, 25, 13)


def test_folders_are_read_through_links_but_not_in_circles(tmp_path):
    folder = tmp_path / "motion"
    for path in (folder, tmp_path / "elsewhere" / "02"):
        path.mkdir(parents=True)
        files.write_amass(path / "a_poses.npz", *files.a_clip(3), betas=[float(path == folder)] * 10)
    was = digest(folder)
    (folder / "02").symlink_to(tmp_path / "elsewhere" / "02")
    (folder / "02" / "above").symlink_to(folder)
    (folder / "02" / "outside").symlink_to(tmp_path)
    assert load_motion(folder).names == ("02/a_poses", "a_poses")
    assert digest(folder) != was and len(load_betas(folder)) == 2


def test_digest_depends_on_content_of_motion(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        (folder / "02").mkdir(parents=True)
        files.write_amass(folder / "02" / "a_poses.npz", *files.a_clip(3))
    (second / "notes.txt").write_text("no motion")
    was = digest(first)
    assert digest(second) == was and digest(first / "02" / "a_poses.npz") not in (was, digest(first / "02"))
    card = SynthesisJob(what="people", count=3, motion=str(first)).card()
    assert card == SynthesisJob(what="people", count=3, motion=str(second)).card()
    files.write_amass(first / "02" / "b_poses.npz", *files.a_clip(4))
    assert digest(first) != was and card != SynthesisJob(what="people", count=3, motion=str(first)).card()
    with pytest.raises(InputError, match="none.npz: no such file"):
        digest(tmp_path / "none.npz")


def test_load_motion_rejects_other_files_and_bad_options(tmp_path):
    for name, content, message in (
        ("a.npz", b"", "is empty"),
        ("b.npz", b"hello", "plain arrays"),
        ("c.fbx", b"hello", "expected a motion file, one of .npz, .bvh"),
        ("d", b"hello", "give it the suffix of its format"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, message)
    np.save(tmp_path / "one.npy", np.zeros(3))
    refused((tmp_path / "one.npy").rename(tmp_path / "one.npz"), "an npz of plain arrays")
    path = files.write_amass(tmp_path / "e.npz", *files.a_clip(4))
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(path, "copied completely")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "has no motion file; expected .npz, .bvh")
    for name in ("none.bvh", "none.json", "none"):
        refused(tmp_path / name, "no such file")
    for name, value in (("fps", 0), ("hz", -1), ("fps", float("nan")), ("up", "w")):
        with pytest.raises(InputError, match=f"{name} must be .* above 0|unknown up axis"):
            load_motion(path, **{name: value})
    with pytest.raises(InputError, match="expected the path"):
        load_motion(3)
