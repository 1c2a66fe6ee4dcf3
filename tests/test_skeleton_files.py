"""BVH and ASF/AMC: other skeletons' joints, by name, on our body."""

import re

import motion_files as files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lidarpose.body.mocap import asf_amc, bvh, joint_positions, joint_tree, load_motion
from lidarpose.errors import InputError
from lidarpose.geometry import UP_AXES

J = files.J
MAIN = [J[n] for n in J if not n.endswith(("foot", "hand"))]
NAMES = {
    "smpl": files.SMPL_NAMES,
    "cmu": files.CMU_NAMES,
    "mixamo": files.MIXAMO_NAMES,
    "rokoko": files.ROKOKO_NAMES,
    "blender": files.BLENDER_NAMES,
    "unreal": files.UNREAL_NAMES,
}
ROTATIONS, WAY = files.a_clip(20)
JOINTS = files.joints_of(ROTATIONS, WAY)
BVH = files.bvh_text(ROTATIONS, WAY, names=files.CMU_NAMES)
ASF, AXES = files.asf_text()
AMC = files.amc_text(ROTATIONS, WAY, AXES)


def errors(motion, joints=JOINTS):
    """Distances (F, 24) m of the joints from where they went in."""
    return np.linalg.norm(files.joints_of(motion.rotations, motion.translation) - joints, axis=-1)


def written(tmp_path, text, name="a.bvh"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


# what was written comes back: positions to less than 0.1 mm, on our body within what retargeting by positions costs


@pytest.mark.parametrize("skeleton", NAMES)
def test_a_bvh_of_any_names_comes_back(tmp_path, skeleton):
    motion = load_motion(written(tmp_path, files.bvh_text(ROTATIONS, WAY, names=NAMES[skeleton])))
    assert motion.names == ("a",) and motion.fps == pytest.approx(30) and motion.dropped == 0
    error = errors(motion)
    assert error[:, MAIN].mean() < 0.010 and error.max() < 0.05


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YXZ", "ZYX", "YZX", "XZY"])
def test_a_bvh_has_its_joints_where_they_were(tmp_path, order):
    """The tree's own positions, in centimeters and y up, without retargeting."""
    tree, values, rate = bvh.read_bvh(written(tmp_path, files.bvh_text(ROTATIONS, WAY, order=order)))
    assert rate == pytest.approx(30)
    index = [tree.names.index(name) for name in J]
    np.testing.assert_allclose(tree.positions(values)[:, index] / 100 @ UP_AXES["y"].T, JOINTS, atol=1e-4)


@pytest.mark.parametrize("unit, up", [(1.0, "y"), (0.01, "z"), (0.0254, "y"), (0.001, "x"), (0.0254 / 0.45, "y")])
def test_units_and_up_are_found(tmp_path, unit, up):
    path = written(tmp_path, files.bvh_text(ROTATIONS, WAY, names=files.CMU_NAMES, unit=unit, up=up))
    for motion in (load_motion(path), load_motion(path, up=up)):
        assert errors(motion)[:, MAIN].mean() < 0.010


def test_children_and_tall_people_keep_their_unit():
    rest = JOINTS[:1]
    for size in (0.62, 0.8, 1.0, 1.2):
        for name, meters in joint_positions.UNITS.items():
            assert joint_positions.meters_per_unit("x", rest * size / meters) == meters, (size, name)


def test_skeletons_with_less(tmp_path):
    """Without hands, feet, collars' own place and spine joints; what is made up is plausible."""
    names = files.CMU_NAMES
    motion = load_motion(
        written(
            tmp_path,
            files.bvh_text(ROTATIONS, WAY, names=names, drop=("left_hand", "right_hand", "left_foot", "right_foot")),
        )
    )
    error = errors(motion)
    sure = [j for j in MAIN if "ankle" not in list(J)[j]]
    assert error[:, sure].mean() < 0.012 and error[:, [J["left_foot"], J["right_foot"]]].mean() < 0.12
    matched = {n: i for n, i in J.items() if n.endswith(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))}
    matched["head"] = J["head"]
    less = joint_tree.JointTree(names=list(J), parents=[-1, *[0] * 23], offsets=np.zeros((24, 3)), channels=[])
    motion = joint_tree.tree_motion("x", less, JOINTS, fps=10, up="z", kind="test", matched=matched)
    error = errors(motion)
    assert error[:, [J[f"{s}_{n}"] for s in ("left", "right") for n in ("hip", "knee", "elbow")]].mean() < 0.09


@pytest.mark.parametrize("length", [0.45, 1.0])
def test_an_amc_comes_back(tmp_path, length):
    skeleton, axes = files.asf_text(length=length)
    written(tmp_path, skeleton, "02.asf")
    path = written(tmp_path, files.amc_text(ROTATIONS, WAY, axes, length=length), "02_05.amc")
    tree, values, unit_m = asf_amc.read_amc(path)
    positions = tree.positions(values) * unit_m @ UP_AXES["y"].T
    for i, bone in enumerate(tree.names):
        if bone in files.ASF_ENDS:
            np.testing.assert_allclose(positions[:, i], JOINTS[:, J[files.ASF_ENDS[bone]]], atol=1e-4)
    motion = load_motion(path)
    assert motion.names == ("02_05",) and motion.fps == 120
    # both collars are one point in this format
    error = errors(motion)
    assert error[:, MAIN].mean() < 0.05 and error[:, [J["left_ankle"], J["right_ankle"]]].mean() < 0.02


def test_where_the_skeleton_of_an_amc_is_found(tmp_path):
    path = written(tmp_path, AMC, "02_05.amc")
    with pytest.raises(InputError, match="put 02.asf or 02_05.asf beside it"):
        load_motion(path)
    written(tmp_path, ASF, "any.ASF")
    expected = load_motion(path).rotations
    written(tmp_path, "nonsense", "02.asf")
    with pytest.raises(InputError, match="02.asf: an ASF file has :root"):
        load_motion(path)
    written(tmp_path, ASF, "02_05.asf")
    np.testing.assert_array_equal(load_motion(path).rotations, expected)
    for name in ("02.asf", "02_05.asf"):
        (tmp_path / name).unlink()
    written(tmp_path, ASF, "other.asf")
    with pytest.raises(InputError, match="there are any.asf, other.asf"):
        load_motion(path)


# what is wrong


def changed(text, old, new, count=1):
    assert old in text
    return text.replace(old, new, count)


ROW = BVH.splitlines()[-1]


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "is empty"),
        ("hello", "starts with HIERARCHY, got 'hello'"),
        ("HIERARCHY", "no MOTION part"),
        (BVH[: BVH.index("MOTION")], "no MOTION part"),
        (BVH[:-400], "expected 20 frames of 75 numbers, got .* copied completely"),
        (BVH[: BVH.index("Frame Time")], "must begin with Frames: and Frame Time:"),
        (BVH[: BVH.index("Frames")], "must begin with Frames"),
        (changed(BVH, "Frames: 20", "Frames: x"), "whole number"),
        (re.sub(r"CHANNELS.*", "CHANNELS 0", changed(BVH, "Frames: 20", "Frames: -1")), "no joint has CHANNELS"),
        (changed(BVH, "Frames: 20", "Frames: -1")[: BVH.index(ROW)], "whole number of 0 or more, got ' -1'"),
        (changed(BVH, "Frames: 20", "Frames: 0")[: BVH.index(ROW)], "frames of 75|no frame"),
        (re.sub("Frame Time: .*", "Frame Time: 0", BVH), "no frame time above 0"),
        (re.sub("Frame Time: .*", "Frame Time: x", BVH), "no frame time above 0"),
        (re.sub("Frame Time: .*", "Frame Time: 1e-300", BVH), "no frame time above 0"),
        (BVH.replace(ROW, ROW.replace(ROW.split()[7], "abc")), "MOTION must be numbers"),
        (re.sub(r"OFFSET.*", "OFFSET 0 0 0", BVH), "have no length"),
        (changed(BVH, "OFFSET", "OFFSET nan"), "3 finite numbers"),
        (changed(BVH, "OFFSET", "OFFSETS"), "stands where it cannot; expected one ROOT"),
        (changed(BVH, "CHANNELS 3 Zrotation", "CHANNELS 3 Wrotation"), "the channel 'Wrotation'"),
        (changed(BVH, "CHANNELS 3", "CHANNELS 4"), "a count and as many names"),
        (changed(BVH, "{", ""), "stands where it cannot"),
        (changed(BVH, "}", ""), "not complete"),
        (changed(BVH, "\nMOTION", "\n}\nMOTION"), "stands where it cannot"),
        (changed(BVH, "JOINT", "ROOT"), "stands where it cannot"),
        (changed(BVH, "HIERARCHY", "HIERARCHY\n{"), "stands where it cannot"),
        (BVH.replace("LeftUpLeg", "Banana").replace("RightForeArm", "Apple"), "joint for left_hip, right_elbow among"),
        (BVH.replace("Head", "Skulptur"), "no joint for head among Hips, .*; needed are"),
        (files.bvh_text(ROTATIONS, WAY, unit=0.5), "times as tall as an adult; known units are m, cm"),
        (files.bvh_text(ROTATIONS, WAY * [100, 100, 1]), "m/s: are positions and bones in one unit"),
        (files.bvh_text(ROTATIONS, WAY * 1e9), "100 km|m/s"),
    ],
)  # fmt: skip
def test_a_wrong_bvh_is_named(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        load_motion(written(tmp_path, text))
    assert "a.bvh: " in str(caught.value) and "\n" not in str(caught.value)


def test_mixed_units_upside_down_and_no_rate(tmp_path):
    lines = BVH.splitlines()
    at = next(i for i, line in enumerate(lines) if "LeftLeg" in line)
    lines[at + 2] = re.sub(r"(-?[\d.]+)", lambda m: str(float(m[0]) * 100), lines[at + 2])
    with pytest.raises(InputError, match="left leg is .* long, the right .* one unit throughout"):
        load_motion(written(tmp_path, "\n".join(lines)))
    over = ROTATIONS.copy()
    over[:, 0] = np.diag([1.0, -1, -1]) @ over[:, 0]
    path = written(tmp_path, files.bvh_text(over, WAY, names=files.CMU_NAMES))
    with pytest.raises(InputError, match="people stand along -y; give load_motion up='-y'"):
        load_motion(path)
    assert errors(load_motion(path, up="y"), files.joints_of(over, WAY))[:, MAIN].mean() < 0.01
    path = written(tmp_path, re.sub("Frame Time: .*", "Frame Time: 0", BVH))
    assert load_motion(path, fps=25).fps == 25


def test_bad_frames_of_a_bvh_are_left_out(tmp_path):
    lines = BVH.splitlines()
    lines[-6] = "nan " + lines[-6].partition(" ")[2]
    lines[-3] = lines[-3].rpartition(" ")[0] + " 1e999"
    motion = load_motion(written(tmp_path, "\n".join(lines)))
    assert motion.dropped == 2 and tuple(motion.length) == (14, 2, 2)
    lines[-20:-6] = ["nan " * 75] * 14
    with pytest.raises(InputError, match="16 of 20 frames"):
        load_motion(written(tmp_path, "\n".join(lines)))


@pytest.mark.parametrize(
    "asf, amc, message",
    [
        (ASF, "", "is empty"),
        (ASF, "hello world\n", "numbered frames of bones, got 'hello world'"),
        (ASF, ":FULLY-SPECIFIED\n", "no frame"),
        (ASF, "1\n2\n3\n", "moves no bone"),
        (ASF, AMC[:-300], "copied completely"),
        (ASF, AMC.replace("lfemur", "banana"), "moves banana, which s.asf does not have"),
        (ASF, re.sub("lfemur .*", "lfemur 1 2", AMC), "lfemur has 2 numbers a frame, its skeleton 3"),
        (ASF, re.sub("lfemur .*", "lfemur 1 2 x", AMC), "numbers of lfemur must be"),
        ("", AMC, "is empty"),
        (changed(ASF, ":bonedata", ":bones"), AMC, ":bonedata is missing"),
        (changed(ASF, "length 0.45", "length 0"), AMC, "length of :units must be above 0"),
        (changed(ASF, "length 0.45", "length x"), AMC, "length of :units"),
        (changed(ASF, "angle deg", "angle grad"), AMC, "deg or rad, got 'grad'"),
        (changed(ASF, "order TX", "order TW"), AMC, "order of :root"),
        (changed(ASF, "name lfemur", "name"), AMC, "has no name"),
        (changed(ASF, "name lfemur", "name rfemur"), AMC, "rfemur twice"),
        (changed(ASF, "     direction", "     direktion"), AMC, "lowerback has no direction"),
        (changed(ASF, "  XYZ\n", "  XYY\n"), AMC, "order such as XYZ"),
        (changed(ASF, "dof rx", "dof l"), AMC, "the freedom 'l'"),
        (changed(ASF, "  end\n:hierarchy", ":hierarchy"), AMC, "stops inside a bone"),
        (re.sub("root lower", "root nobody lower", ASF), AMC, "names 'nobody'"),
        (re.sub("root lowerback", "root", ASF), AMC, "lowerback.* hangs from nothing"),
        (ASF + "  root ltibia\n", AMC, "ltibia twice"),
        (ASF.replace("ltibia", "lshin"), AMC.replace("ltibia", "lshin"), "s.asf: has no bone ltibia among"),
        (re.sub(r"     length \S+", "     length 0", ASF), AMC, "have no length"),
        (re.sub(r"     length (\S+)", "     length 1e300", ASF), AMC, "expected joints at finite positions"),
    ],
)  # fmt: skip
def test_a_wrong_amc_or_asf_is_named(tmp_path, asf, amc, message):
    written(tmp_path, asf, "s.asf")
    with pytest.raises(InputError, match=message) as caught:
        load_motion(written(tmp_path, amc, "s_1.amc"))
    assert re.search(r"s(_1\.amc|\.asf): ", str(caught.value)) and "\n" not in str(caught.value)


# whatever stands in a file, an InputError is all that comes

SHORT = files.bvh_text(ROTATIONS[:2], WAY[:2], names=files.CMU_NAMES)
SHORT_AMC = files.amc_text(ROTATIONS[:2], WAY[:2], AXES)
ODD = st.sampled_from(
    ["", "{", "}", "nan", "1e308", "-1e308", "inf", "0", "9" * 30, "\x00", "JOINT x", "End Site", "MOTION", "OFFSET",
     "XYZ", ":root", "begin", "end", "root", "lfemur", "name", "dof rx", "ROOT", "Frames: 3", "\n", "é", "Hips"]
)  # fmt: skip


def spoiled(text, places, odd, cut):
    words = re.split(r"(\s+)", text)
    for place, word in zip(places, odd, strict=False):
        words[int(place * (len(words) - 1))] = word
    return "".join(words)[: int(cut * len(text)) + 1]


FUZZ = dict(
    places=st.lists(st.floats(0, 1), max_size=4),
    odd=st.lists(ODD, max_size=4),
    cut=st.one_of(st.just(1.1), st.floats(0, 1)),
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(**FUZZ)
def test_a_spoiled_bvh_never_crashes(tmp_path, places, odd, cut):
    path = tmp_path / "a.bvh"
    path.write_text(spoiled(SHORT, places, odd, cut), encoding="utf-8")
    try:
        motion = load_motion(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(motion.rotations).all()


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.booleans(), **FUZZ)
def test_a_spoiled_amc_never_crashes(tmp_path, which, places, odd, cut):
    (tmp_path / "s.asf").write_text(ASF if which else spoiled(ASF, places, odd, cut), encoding="utf-8")
    path = tmp_path / "s_1.amc"
    path.write_text(spoiled(SHORT_AMC, places, odd, cut) if which else SHORT_AMC, encoding="utf-8")
    try:
        motion = load_motion(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(motion.rotations).all()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200), suffix=st.sampled_from([".bvh", ".amc", ".json", ".npz"]))
def test_any_bytes_are_an_input_error(tmp_path, data, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    (tmp_path / "a.asf").write_bytes(data)
    with pytest.raises(InputError):
        load_motion(path)
