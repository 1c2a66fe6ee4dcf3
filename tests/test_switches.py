"""Options for the paper's tables: fields of the scene, recorded positions, random weights, corpora as motion."""

import pickle
import shutil
from dataclasses import replace

import dataset_files
import motion_files as files
import numpy as np
import pytest
from training_runs import few_to_validate_on  # noqa: F401 - a fixture

from lidarpose.body.mocap import load_motion
from lidarpose.body.rig import heading
from lidarpose.cli import main
from lidarpose.data.dataset_card import read_card
from lidarpose.data.prepare import prepare
from lidarpose.errors import InputError
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.synth.shard_job import SynthesisJob, write_dataset
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.setup import make_setup

_SHORT = ["--workers", "0", "--pictures", "0", "--validate", "1000", "--batch", "4"]


# --- the scene's fields


def test_scene_fields_are_changed_by_name():
    scene = scene_config("wild")
    changed = scene.changed(("slope=0", "distance=4:12", "noise.clutter=0.5", "clutter=0.25", "most_clutter=30"))
    noise = replace(scene.noise, clutter=0.5, most_clutter=30)
    assert changed == replace(scene, slope=0.0, distance=(4.0, 12.0), clutter=0.25, noise=noise)
    assert type(changed.noise.most_clutter) is int
    masked = scene.changed(("keep=0.6",)).noise
    assert (masked.mask, masked.mask_keep) == (1.0, (0.6, 0.6))
    assert scene.changed(()) == scene
    assert scene.changed(("sensors=os1-64:hdl-64e",)) == replace(scene, sensors=("os1-64", "hdl-64e"))
    # converted by the declared type, not by that of the old value
    assert scene_config("paper").changed(("median_points=0.9",)).median_points == 0.9
    assert scene.changed(("dapt_compat=1",)).noise.dapt_compat is True
    # `sparse` would replace the named sensors
    named, both = (scene_config("wide").changed(("sensors=os1-64", *more)) for more in ((), ("sparse=0.5",)))
    assert (named.sensors, named.sparse, both.sparse) == (("os1-64",), 0.0, 0.5)


@pytest.mark.parametrize(
    "setting, told",
    [
        ("kep=1", "unknown setting of the scene 'kep'"),
        ("sensors=os1-65", "unknown sensor 'os1-65'"),
        ("sensors=", "unknown sensor ''"),
        ("noise=1", "unknown setting"),
        ("keep", "expected keep=a number or two"),
        ("keep=1.2", "keep must be between 0 and 1"),
        ("slope=1:2", "expected slope=a number, "),
        ("slope=-1", "at least 0"),
        ("slope=nan", "expected slope"),
        ("distance=9:4", "LOW:HIGH"),
        ("most_clutter=1.5", "most_clutter must be a whole number, got 1.5"),
        ("apart=0.5", "apart must be 0 or 1, got 0.5"),
        ("dapt_compat=0.5", "dapt_compat must be 0 or 1, got 0.5"),
    ],
)
def test_scene_rejects_unknown_fields_and_invalid_values(setting, told):
    with pytest.raises(InputError, match=told):
        scene_config("paper").changed((setting,))


def test_keep_option_excludes_the_same_change(tmp_path, capsys):
    assert (
        main(["synth", "--out", str(tmp_path / "people"), "-n", "4", "--keep", "0.5", "--set", "slope=0, keep=0.6"])
        == 2
    )
    assert "--keep 0.5 is the same as --set keep=0.5, got both: give one of them" in capsys.readouterr().err
    assert not (tmp_path / "people").exists()


def test_keep_option_sets_mask_of_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not main(["synth", "--out", "people", "-n", "4", "--scene", "paper", "--keep", "1", "--set", "slope=0"])
    assert read_card(tmp_path / "people").settings["set"] == ["keep=1", "slope=0"]
    assert not main(["pretrain", "run", "--people", "8", "--scene", "paper", "--keep", "0.5", *_SHORT])
    card = load_checkpoint("run/model.safetensors")[1].card
    assert card["recipe"]["set"] == ["keep=0.5"] and "--set keep=0.5" in card["command"]
    full, half = (
        make_setup(Pretrain(scene="paper", people=16, strays=0.0, noise=0.0, set=(f"keep={keep}",))).source
        for keep in ("1", "0.5")
    )
    counts = np.array([[len(source.example(k).points) for source in (full, half)] for k in range(8)]).mean(0)
    assert counts[1] < 0.75 * counts[0]
    assert main(["pretrain", "other", "--keep", "2", *_SHORT]) == 2 and not (tmp_path / "other").exists()


# --- recorded positions


def _bank(offset, frames=8):
    rotations, way = files.a_clip(frames)
    folder_motion = load_motion_of(rotations, way + offset)
    return PoseBank.of_motion(folder_motion), folder_motion


def load_motion_of(rotations, way, *, names=("a",)):
    from lidarpose.body.mocap.motion import Motion

    return Motion(
        rotations=rotations.astype(np.float32), translation=way.astype(np.float32), names=names,
        length=np.array([len(way)]), fps=10.0, source="test",
    )  # fmt: skip


@pytest.mark.parametrize("offset", [(14.0, 5.0, 0.0), (0.0, 0.0, 0.0), (400.0, 0.0, 0.0)])
def test_captured_people_keep_recorded_positions(offset):
    """LiDAR recordings keep their positions; recordings of a room or far away are centered 12 m ahead."""
    bank, motion = _bank(np.array(offset))
    scene = scene_config("paper").changed(("recorded=1", "keep=1"))
    generator = Generator(scene=scene, bank=bank, captured=1.0, measure=False)
    places, facings = motion.translation[:-1, :2].copy(), heading(motion.rotations[:-1])
    if offset[0] != 14.0:
        places += np.array([12.0, 0.0]) - np.median(places, 0)
    for index in range(6):
        joints = generator.person(3, index).sample.pose.joints
        pelvis = joints[BODY26.index("pelvis"), :2]
        # the origin of the body is not its pelvis, and poses vary slightly
        nearest = np.linalg.norm(places - pelvis, axis=1).argmin()
        assert np.linalg.norm(places[nearest] - pelvis) < 0.35
        left = (joints[BODY26.index("left_hip")] - joints[BODY26.index("right_hip")])[:2]
        away = np.arctan2(-left[0], left[1]) - facings
        assert np.abs((away + np.pi) % (2 * np.pi) - np.pi).min() < 0.6


def test_recorded_people_outside_a_rosettes_view_are_scanned_by_other_sensors():
    # behind a sensor that looks ahead
    bank, _ = _bank(np.array([-9.0, 3.0, 0.0]))
    scene = scene_config("wide").changed(("accumulated=0", "integration=0", "recorded=1", "sparse=1"))
    generator = Generator(scene=scene, bank=bank, captured=1.0, measure=False)
    people = [generator.person(1, index).sample for index in range(30)]
    assert all(person.pose.joints[:, 0].max() < -6 and len(person.points) for person in people)


def test_recorded_positions_need_motion_and_single_frames(tmp_path):
    scene = scene_config("paper").changed(("recorded=1",))
    with pytest.raises(InputError, match="--motion"):
        Generator(scene=scene)
    with pytest.raises(InputError, match="--clips"):
        SynthesisJob(what="clips", count=1, motion="m.npz", set=("recorded=1",))
    bank, _ = _bank(np.zeros(3))
    with pytest.raises(InputError, match="ask for --captured above 0"):
        Generator(scene=scene, bank=bank)
    with pytest.raises(InputError, match="clips have no recorded positions: set recorded=0"):
        Generator(scene=scene, bank=bank, captured=1.0).clip(1, 0)
    for changes, words in ((("accumulated=0.1",), "set accumulated=0"), (("integration=1",), "set integration=0")):
        with pytest.raises(InputError, match=words):
            Generator(scene=scene.changed(changes), bank=bank, captured=1.0)


def test_combined_frames_of_captured_people_need_long_clips():
    scene = scene_config("wild").changed(("accumulated=0.5",))
    short, enough = (_bank(np.zeros(3), frames)[0] for frames in (5, 6))
    with pytest.raises(InputError, match="no clip lasts 0.5 s.*: give longer motion, or set accumulated=0$"):
        Generator(scene=scene, bank=short, captured=1.0)
    for bank, captured in ((short, 0.5), (enough, 1.0)):
        Generator(scene=scene, bank=bank, captured=captured)


# --- random weights


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic") / "people"
    write_dataset(SynthesisJob(what="people", count=6, scene="paper", seed=3), folder)
    return folder


@pytest.mark.long
@pytest.mark.parametrize("size, recipe", [("tiny", "default"), ("paper-tiny", "paper")])
def test_finetune_starts_from_random_weights(people, tmp_path, monkeypatch, size, recipe):
    monkeypatch.chdir(tmp_path)
    words = ["finetune", str(people), "--out", "run", "--init", "random", "--size", size, "--recipe", recipe]
    assert not main([*words, "--split", "all", "--epochs", "2", "--mix", "0", *_SHORT])
    header = load_checkpoint("run/model.safetensors")[1]
    assert header.card["init"] == "random" and header.card["init_card"] == {}
    if size == "paper-tiny":
        assert header.config.bins and not header.config.coordinates and len(header.config.joints) == 15
    assert not main(["evaluate", "run/model.safetensors", str(people), "--out", "scores"])
    assert not main(["finetune", "--out", "run", "--resume", "--epochs", "3"])


@pytest.mark.parametrize("changes", [{"init": "random"}, {"size": "tiny"}])
def test_random_init_and_size_require_each_other(changes):
    with pytest.raises(InputError, match="--init random --size NAME"):
        Finetune(data=("x",), **changes)


def test_finetune_rejects_unknown_size(people):
    with pytest.raises(InputError, match="unknown network size 'huge'"):
        make_setup(Finetune(data=(str(people),), split="all", init="random", size="huge"))


# --- corpora


def test_pretrain_warns_about_corpus_without_parts(people, tmp_path):
    dataset_files.write_lipd(tmp_path / "raw", dataset_files.write_smpl(tmp_path / "SMPL_NEUTRAL.npz"))
    prepare("lipd", tmp_path / "raw", tmp_path / "corpus", progress=False)
    warnings = make_setup(Pretrain(shards=(str(tmp_path / "corpus"),))).warnings
    assert any("L_seg" in warning for warning in warnings)
    shutil.copytree(tmp_path / "corpus", tmp_path / "second")
    setup = make_setup(Pretrain(shards=(str(tmp_path / "corpus"), str(tmp_path / "second"))))
    (warning,) = setup.warnings
    assert setup.card["warnings"] == [warning]
    assert warning.startswith("no point of corpus, second has a body part")
    assert not make_setup(Pretrain(shards=(str(people),))).warnings


def _written(folder, entries):
    (folder / "train.pkl").write_bytes(pickle.dumps(entries))
    return folder / "train.pkl"


@pytest.mark.parametrize("which, up", [("freemotion", "y"), ("noisemotion", "z")])
def test_corpus_poses_are_loaded_as_motion(tmp_path, which, up):
    rotations, way = files.a_clip(10)
    poses = files.to_smpl(rotations, up)
    entries = []
    for k, pose in enumerate(poses):
        gt = pose if which == "freemotion" else np.stack([pose * 0, pose, pose * 0])
        place = files.UP_AXES[up].T @ way[k]
        entries.append({"motion_id": "a" if k < 6 else "b", "gt": gt, "T_1": place, "shape": np.zeros(10), "pc": None})
    motion = load_motion(_written(tmp_path, [*entries[:3], {"motion_id": "a"}, *entries[3:]]))
    # clips are cut at entries that are skipped
    assert motion.names == ("a", "a#2", "b") and motion.length.tolist() == [3, 3, 4] and motion.fps == 10
    np.testing.assert_allclose(motion.rotations, rotations, atol=1e-4)
    np.testing.assert_allclose(motion.translation, way, atol=1e-4)


def test_lipd_joints_without_poses_are_loaded_as_motion(tmp_path):
    rotations, way = files.a_clip(6)
    joints = files.joints_of(rotations)
    entries = [{"seq_path": "s", "gt_joint": j, "trans": w} for j, w in zip(joints, way, strict=True)]
    motion = load_motion(_written(tmp_path, entries))
    assert motion.names == ("s",) and len(motion.rotations) == 6
    again = files.joints_of(motion.rotations)
    assert np.linalg.norm(again - joints, axis=-1)[:, files.MAIN].max() < 0.03
    cut = load_motion(_written(tmp_path, [*entries[:3], {"seq_path": "s", "gt_joint": 5}, *entries[3:]]))
    assert cut.names == ("s", "s#2") and cut.length.tolist() == [3, 3]


def test_load_motion_skips_joints_among_poses(tmp_path):
    rotations, way = files.a_clip(5)
    poses, joints = files.to_smpl(rotations, "z"), files.joints_of(rotations)
    entries = [{"motion_id": "a", "gt": pose, "T_1": place} for pose, place in zip(poses, way, strict=True)]
    entries[2] = {"motion_id": "a", "gt_joint": joints[2], "T_1": way[2]}
    motion = load_motion(_written(tmp_path, entries))
    assert len(motion.rotations) == 4
    np.testing.assert_allclose(motion.rotations, np.delete(rotations, 2, 0), atol=1e-4)


def test_corpus_pose_without_numbers_does_not_change_the_up_axis(tmp_path):
    rotations, way = files.a_clip(40)
    poses = files.to_smpl(rotations, "z")
    entries = [{"motion_id": "a", "gt": pose, "T_1": place} for pose, place in zip(poses, way, strict=True)]
    entries[5]["gt"] = poses[5] * np.nan
    motion = load_motion(_written(tmp_path, entries))
    assert motion.dropped == 1
    np.testing.assert_allclose(motion.rotations, np.delete(rotations, 5, 0), atol=1e-4)


def test_corpus_entry_without_position_cuts_its_clip(tmp_path):
    rotations, way = files.a_clip(10)
    poses = files.to_smpl(rotations, "z")
    entries = [{"motion_id": "a", "gt": pose, "T_1": place} for pose, place in zip(poses, way, strict=True)]
    entries[4] = {"motion_id": "a", "gt": poses[4], "T_3": way[4]}
    motion = load_motion(_written(tmp_path, entries))
    assert motion.names == ("a", "a#2") and motion.length.tolist() == [4, 5]
    np.testing.assert_allclose(motion.translation, np.delete(way, 4, 0), atol=1e-4)
    # a clip without any position stays where it is
    unplaced = [{"motion_id": "b", "gt": pose} for pose in poses]
    motion = load_motion(_written(tmp_path, [*entries, *unplaced]))
    assert motion.names == ("a", "a#2", "b") and not motion.translation[9:].any()


def test_load_motion_rejects_list_without_poses(tmp_path):
    with pytest.raises(InputError, match="gt_joint"):
        load_motion(_written(tmp_path, [{"pc": 3}, 4]))
