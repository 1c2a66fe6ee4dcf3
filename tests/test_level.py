"""Leveling of a tilted sensor by the people in its scans."""

import json

import dataset_files as files
import numpy as np
import pytest
from motion_files import a_clip, joints_of

from lidarpose.body.mocap.leveling import LEAST_FRAMES, leveling, up_of_people
from lidarpose.data.prepare import prepare, reader
from lidarpose.errors import InputError
from lidarpose.geometry import axis_angle_to_matrix, rotation_about

AXIS = np.array([0.6, 0.8, 0.0])


def tilt(degrees):
    """R_sensor_level of a LiDAR tilted by `degrees`."""
    return axis_angle_to_matrix(np.radians(degrees) * AXIS)


def people(degrees, frames=2 * LEAST_FRAMES):
    return joints_of(*a_clip(frames, 4)) @ tilt(degrees).T


@pytest.mark.parametrize("degrees", [0, 5, 15, 40])
def test_leveling_finds_up_from_turning_people(degrees):
    up, doubt = up_of_people(people(degrees))
    assert np.degrees(np.arccos(up @ tilt(degrees)[:, 2])) < 2 and np.degrees(doubt) == pytest.approx(3)
    found = leveling(people(degrees))
    assert (found is None) == (degrees == 0)
    if degrees:
        np.testing.assert_allclose(found @ up, [0, 0, 1], atol=1e-9)
        # the smallest such rotation, without rotation about z
        assert np.degrees(np.arccos((np.trace(found) - 1) / 2)) == pytest.approx(degrees, abs=2)


def test_leveling_compensates_forward_lean():
    joints, lean = people(0), np.radians(12)
    left = joints[:, 1] - joints[:, 2]
    headings = np.linspace(-1.2, 1.2, len(joints))
    for k, yaw in enumerate(np.arctan2(left[:, 1], left[:, 0])):
        # the left side along y, then forward over the hips, then to the heading
        ahead = joints[k] @ rotation_about("z", np.pi / 2 - yaw).T @ rotation_about("y", lean).T
        joints[k] = ahead @ rotation_about("z", headings[k]).T
    up, _ = up_of_people(joints)
    assert np.degrees(np.arccos(up[2])) < 4


def test_leveling_is_none_for_few_frames():
    assert up_of_people(people(15, frames=LEAST_FRAMES - 1)) is None and leveling(people(15, frames=3)) is None


def test_leveling_is_none_for_leaning_people_who_never_turn():
    joints = people(0)
    left = joints[:, 1] - joints[:, 2]
    for k, yaw in enumerate(np.arctan2(left[:, 1], left[:, 0])):
        joints[k] = joints[k] @ rotation_about("z", -yaw).T @ rotation_about("x", np.radians(-6)).T
    up, doubt = up_of_people(joints)
    assert np.degrees(doubt) == pytest.approx(10) and np.degrees(np.arccos(up[2])) < 10
    assert leveling(joints) is None


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Dataset whose sequence 5 was recorded by a LiDAR tilted by 15 degrees, SMPL file, and true joints."""
    root = tmp_path_factory.mktemp("raw")
    smpl = files.write_smpl(root / "SMPL_NEUTRAL.npz")
    truth = files.write_lidarhuman26m(root, smpl, sequences=("5",), frames=LEAST_FRAMES, R_sensor_level=tilt(15))
    return root, smpl, truth


def test_lidarhuman26m_reader_levels_tilted_sensor(raw):
    root, smpl, truth = raw
    kept, leveled = (list(reader("lidarhuman26m", smpl, level=level).read(root, "5")) for level in (False, True))
    assert {item.source for item in kept} == {"lidarhuman26m"}
    assert {item.source for item in leveled} == {"lidarhuman26m, turned level by 15 deg"}
    for a, b in zip(kept, leveled, strict=True):
        np.testing.assert_allclose(a.joints, truth["5", a.frame, "0"] @ tilt(15).T, atol=1e-4)
        # one rotation about the LiDAR for points, joints and trans; heights are right to 2 degrees
        np.testing.assert_allclose(b.joints[:, 2], truth["5", a.frame, "0"][:, 2], atol=15 * 0.035)
        for before, after in ((a.points, b.points), (a.joints, b.joints), (a.centers["trans"], b.centers["trans"])):
            np.testing.assert_allclose(np.linalg.norm(after, axis=-1), np.linalg.norm(before, axis=-1), atol=1e-4)
        # distances between joints and trans do not change
        before, after = (np.linalg.norm(x.joints - x.centers["trans"], axis=-1) for x in (a, b))
        np.testing.assert_allclose(after, before, atol=1e-4)
        # the points stay near the joints
        apart = np.linalg.norm(b.points[:, None] - b.joints, axis=-1).min(1)
        assert np.median(apart) < 0.3


def test_prepare_lidarhuman26m_without_leveling(raw, tmp_path):
    root, smpl, _ = raw
    found = prepare("lidarhuman26m", root, tmp_path / "own", smpl=smpl, level=False)
    assert list(found["sources"]) == ["lidarhuman26m"]
    with pytest.raises(InputError, match="level is false, requested is true"):
        prepare("lidarhuman26m", root, tmp_path / "own", smpl=smpl)
    assert json.loads((tmp_path / "own" / "dataset.json").read_text())["frame"].startswith("the LiDAR's own")
    with pytest.raises(InputError, match="omit --no-level"):
        reader("sloper4d", smpl, level=False)
