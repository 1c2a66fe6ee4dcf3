"""tools/make_motion.py: converts archives of captured motion to a file for training."""

import motion_files as files
import numpy as np
import pytest
from scripts import load_script

from lidarpose.body.mocap import load_motion

make_motion = load_script("tools/make_motion.py")


def write_archive(folder):
    """Two subjects of the CMU database at 120 Hz, one of HDM05: 25 frames with the same pose."""
    rotations, way = files.a_clip(1)
    rotations, way = np.repeat(rotations, 25, axis=0), np.repeat(way, 25, axis=0)
    asf, axes = files.asf_text()
    amc = files.amc_text(rotations, way, axes)
    for name, skeleton in (("02/02_01", "02/02"), ("02/02_10", "02/02"), ("05/05_02", "05/05")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{skeleton}.asf").write_text(asf)
        (folder / f"{name}.amc").write_text(amc)
    (folder / "hdm05").mkdir()
    (folder / "hdm05/HDM_bd.asf").write_text(asf)
    (folder / "hdm05/HDM_bd_squat1Reps_001_120.amc").write_text(amc)
    (folder / "hdm05/readme.txt").write_text("not motion")
    return files.joints_of(rotations[:1], way[:1])


def test_make_motion_output_is_read_by_load_motion(tmp_path, capsys):
    joints = write_archive(tmp_path / "archive")
    out = tmp_path / "motion.npz"
    assert make_motion.main([str(tmp_path / "archive"), "--out", str(out)]) == 0
    assert "4 clips, 12 frames at 10 a second" in capsys.readouterr().out
    motion = load_motion(out)
    assert motion.names == ("002_01", "002_10", "005_02", "bd_squat1Reps_001") and motion.fps == 10
    assert motion.length.tolist() == [3, 3, 3, 3]
    with np.load(out) as stored:
        # 25 mm: error of retargeting to the mean adult
        np.testing.assert_allclose(stored["joints"], np.repeat(joints, 12, axis=0), atol=0.025)
    played = files.joints_of(motion.rotations, motion.translation)
    np.testing.assert_allclose(played, np.repeat(joints, 12, axis=0), atol=0.04)


def test_read_clips_selects_subjects_without_opening_others(tmp_path):
    write_archive(tmp_path)
    (tmp_path / "05/05_03.amc").write_text("broken")
    assert list(make_motion.read_clips([tmp_path], ["2", "bd"])) == ["002_01", "002_10", "bd_squat1Reps_001"]
    # an existing file can be extended
    make_motion.save_clips(tmp_path / "more/clips.npz", make_motion.read_clips([tmp_path / "02"], []))
    both = make_motion.read_clips([tmp_path / "more", tmp_path / "hdm05"], ["002", "bd"])
    assert list(both) == ["002_01", "002_10", "bd_squat1Reps_001"]


def test_make_motion_excludes_and_shortens_clips_by_name(tmp_path, capsys):
    write_archive(tmp_path / "archive")
    words = [str(tmp_path / "archive"), "--out", str(tmp_path / "motion.npz"), "--without", "005*", "002_10"]
    assert make_motion.main([*words, "--first", "0.7", "bd_*"]) == 0
    motion = load_motion(tmp_path / "motion.npz")
    assert motion.names == ("002_01", "bd_squat1Reps_001") and motion.length.tolist() == [3, 2]
    for first in (["2", "bd_*"], ["bd_*"], ["0.5"], ["nan", "x"]):
        assert make_motion.main([*words, "--first", *first]) == 2
        assert "--first: expected a share" in capsys.readouterr().err


def test_make_motion_excludes_pieces_of_cut_clips(tmp_path, capsys):
    write_archive(tmp_path)
    path = tmp_path / "02/02_01.amc"
    lines = path.read_text().splitlines()
    start = lines.index("13")
    lines[start + 1] = "root nan " + " ".join(lines[start + 1].split()[2:])
    path.write_text("\n".join(lines))
    assert list(make_motion.read_clips([tmp_path / "02"], [])) == ["002_01", "002_01#2", "002_10"]
    # with and without leading zeros
    for pattern in ("002_01", "02_01"):
        assert list(make_motion.read_clips([tmp_path / "02"], [], without=[pattern])) == ["002_10"]
    words = [str(tmp_path), "--out", str(tmp_path / "motion.npz")]
    for option in (["--without", "02_1", "typo*"], ["--first", "0.5", "02_1", "typo*"]):
        assert make_motion.main([*words, *option]) == 2
        assert f"{option[0]}: no clip is called 02_1, typo*" in capsys.readouterr().err


def test_read_clips_resamples_with_given_fps(tmp_path):
    write_archive(tmp_path)
    assert len(make_motion.read_clips([tmp_path], ["2"], fps=60)["002_01"]) == 5
    # only of files that do not state their rate
    make_motion.save_clips(tmp_path / "clips/clips.npz", {"002_01": files.joints_of(*files.a_clip(30))})
    assert len(make_motion.read_clips([tmp_path / "clips"], [], fps=60)["002_01"]) == 30


def test_read_clips_follows_links(tmp_path):
    write_archive(tmp_path / "archive")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked/02").symlink_to(tmp_path / "archive/02")
    assert list(make_motion.read_clips([tmp_path / "linked"], [])) == ["002_01", "002_10"]


@pytest.mark.parametrize(
    "folders, subjects, message",
    [
        (["nowhere"], [], "expected a folder"),
        (["."], ["2", "77"], "no clip of subject 77"),
        (["hdm05/empty"], [], "no .amc, .bvh, .npz file"),
        (["02", "02"], [], "two clips 002_01"),
    ],
)
def test_make_motion_errors_are_one_line_and_write_nothing(tmp_path, capsys, folders, subjects, message):
    write_archive(tmp_path)
    (tmp_path / "hdm05/empty").mkdir()
    out = tmp_path / "motion.npz"
    arguments = [*(str(tmp_path / folder) for folder in folders), "--out", str(out)]
    assert make_motion.main([*arguments, *(["--subjects", *subjects] if subjects else [])]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert not out.exists()
