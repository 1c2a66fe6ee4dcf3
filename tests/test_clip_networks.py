"""LiDARCap and NE: inputs, clips, losses, training, predictions, evaluation."""

import json
from dataclasses import replace
from types import SimpleNamespace

import dataset_files as files
import numpy as np
import pytest
import torch
from accelerate import Accelerator
from training_runs import few_to_validate_on, refused  # noqa: F401 - a fixture

from lidarpose import evaluation
from lidarpose.body.rig import mean_adult_joints
from lidarpose.cli import main
from lidarpose.data.dataset_card import DatasetCard, write_card
from lidarpose.data.prepare import prepare
from lidarpose.data.rows import person_row
from lidarpose.data.shards import shard_path, shard_writer
from lidarpose.eval import robustness, run
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.eval.protocols import EvalSetup, eval_setup
from lidarpose.geometry import UP_AXES, axis_angle_to_matrix, rotation_about
from lidarpose.inference.inputs import Clips
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.torch_backend import ClipBackend
from lidarpose.models.baselines.baseline_config import CLOUDS, FRAME_POINTS, LidarcapConfig, NeConfig, pad_frames
from lidarpose.models.baselines.lidarcap import rest_offsets
from lidarpose.models.checkpoint import Header, build, save_checkpoint
from lidarpose.models.layers import DropPath
from lidarpose.sample import CLIP_FRAMES, clip_windows
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.generator import Generator
from lidarpose.train import data_loader, loop, setup
from lidarpose.train.augment import clip_example
from lidarpose.train.data_loader import ClipSource
from lidarpose.train.networks import PRETRAINED
from lidarpose.train.objectives.baseline_objective import ClipObjective
from lidarpose.train.objectives.objective import total
from lidarpose.train.optim import optimizers, set_rates
from lidarpose.train.recipes import Finetune, Pretrain, recipe
from lidarpose.train.setup import make_setup
from lidarpose.train.torch_dataset import InMemoryDataset
from lidarpose.train.validation import draw_examples, update_batch_norms, validate

CONFIGS = {"lidarcap": LidarcapConfig(width_divisor=4), "ne": NeConfig(width_divisor=4)}
# points per cloud, few to keep tests fast
FEW = 24


def thinned(sample, count=FEW):
    rows = np.random.default_rng(len(sample.points)).permutation(len(sample.points))[:count]
    clouds = {name: getattr(sample, name)[:count] for name in ("background", "neighbors")}
    return replace(sample, points=sample.points[rows], part=sample.part[rows], ring=sample.ring[rows], **clouds)


@pytest.fixture(scope="module")
def clips():
    generator = Generator(scene="paper", measure=False)
    return [[thinned(person.sample) for person in generator.clip(3, k)] for k in range(2)]


def write_clips(folder, clips, gap=0):
    """gap: number of frames missing after the 20th."""
    folder.mkdir()
    settings = {"what": "clips", "seed": 3, "scene": "paper"}
    write_card(folder, DatasetCard(settings=settings, count=len(clips), per_shard=10, tables=("people",)))
    with shard_writer(shard_path(folder, "people", 0), "people") as add:
        for index, clip in enumerate(clips):
            for frame, sample in enumerate(clip):
                add(person_row(sample, index=index, frame=frame + gap * (frame >= 20)))
    return folder


@pytest.fixture(scope="module")
def folder(clips, tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips") / "clips", clips)


@pytest.fixture(scope="module", params=CONFIGS)
def predictor(request):
    torch.manual_seed(0)
    config = CONFIGS[request.param]
    return Predictor(ClipBackend(build(config), Header(config=config, card={})), name=request.param)


# ---- inputs of a frame


def test_pad_frames_gives_points_once_and_mask():
    rng = np.random.default_rng(0)
    clouds = [rng.normal(0, 0.5, (n, 3)) for n in (5, 0, 700)]
    points, valid = pad_frames(clouds, LidarcapConfig(), [1, 2, 3])
    assert points.shape == (3, FRAME_POINTS, 3) and valid.sum(1).tolist() == [5, 1, FRAME_POINTS]
    np.testing.assert_allclose(points[0, :5], clouds[0], rtol=1e-6)
    assert (points[1, 0] == 0).all()
    assert len(np.unique(points[2], axis=0)) == FRAME_POINTS
    assert pad_frames(clouds, LidarcapConfig(most_points=128), [1, 2, 3])[1].sum(1).tolist() == [5, 1, 128]
    assert (pad_frames(clouds[2:], LidarcapConfig(), [3])[0] == points[2]).all(), (
        "a draw that follows from the seed alone"
    )
    far = np.array([[0.1, 0, 0], [9.0, 0, 0]])
    assert pad_frames([far], LidarcapConfig(), [0], window=2.0)[1].sum() == 1


def test_pad_frames_with_replacement_resamples_as_published():
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(200, 3)).astype(np.float32)
    published = LidarcapConfig(resample_with_replacement=True)
    points, valid = pad_frames([cloud], published, [0])
    # each point twice, and the first 56 two more times
    expected = np.concatenate([np.repeat(cloud, 2, axis=0), np.repeat(cloud[:56], 2, axis=0)])
    assert valid.all() and (points[0] == expected).all()
    assert (pad_frames([cloud[:1]], published, [0])[0] == cloud[0]).all()
    many = rng.normal(size=(700, 3)).astype(np.float32)
    drawn = pad_frames([many], published, [0])[0][0]
    assert drawn.shape == (FRAME_POINTS, 3) and len(np.unique(drawn, axis=0)) < 450
    assert {tuple(p) for p in drawn.tolist()} <= {tuple(p) for p in many.tolist()}


# ---- clips of datasets


def test_dataset_clips_counts_skipped_frames_by_reason(clips, tmp_path):
    without = [replace(sample, rotations=None) for sample in clips[1][:3]]
    longer = [*clips[0], *clips[1][:4]]
    dataset = InMemoryDataset.load([write_clips(tmp_path / "d", [longer, clips[1][:7], without])])
    rows, skipped = dataset.clips()
    assert dict(skipped) == {"frames without rotations": 3}
    # a short run is filled with its last frame, as the last clip of a long one is
    filled = np.concatenate([clip_windows(np.arange(20)), clip_windows(np.arange(20, 27))])
    assert (rows == filled).all() and rows.shape == (3, CLIP_FRAMES) and (rows[2, 6:] == 26).all()
    source = make_setup(recipe(Pretrain, "lidarcap", shards=(str(tmp_path / "d"),)))
    assert source.frames == CLIP_FRAMES and sum("left out" in warning for warning in source.warnings) == 1


def test_clip_example_is_centered_per_frame(clips):
    rng = np.random.default_rng(0)
    for trans_center, pelvis_centered in ((False, 0.0), (False, 1.0), (True, 1.0)):
        example = clip_example(clips[0], rng, trans_center=trans_center, pelvis_centered=pelvis_centered)
        for frame, sample, cloud in zip(example.frames, clips[0], example.clouds["background"], strict=True):
            center = sample.pose.joints[0] - frame.joints[0]
            np.testing.assert_allclose(frame.points + center, sample.points, atol=1e-5)
            np.testing.assert_allclose(cloud + center, sample.background, atol=1e-5)
            if trans_center:
                assert np.abs(frame.joints[0]).max() == 0, "of the package's body the pelvis is trans"
            elif not pelvis_centered:
                np.testing.assert_allclose(center, sample.center, atol=1e-5)
            else:
                assert 0 < np.abs(frame.joints[0]).max() < 0.3


def test_clip_example_normalized_as_published(clips):
    """Points alone: each frame about its mean, in height about the clip's, divided by 1.2. Validation does not."""
    clip = [thinned(sample, 5 + k) for k, sample in enumerate(clips[0])]
    settings = {"trans_center": True, "pelvis_centered": 0.0}
    plain = clip_example(clip, np.random.default_rng(2), **settings)
    normalized = clip_example(clip, np.random.default_rng(2), **settings, normalize=True)
    height = np.concatenate([sample.points for sample in clip])[:, 2].mean()
    for before, after, cloud, sample in zip(
        plain.frames, normalized.frames, normalized.clouds["person"], clip, strict=True
    ):
        np.testing.assert_array_equal(after.joints, before.joints)
        np.testing.assert_allclose(after.points[:, :2].mean(0), 0, atol=1e-4)
        np.testing.assert_allclose(1.2 * after.points[:, 2], sample.points[:, 2] - height, atol=1e-4)
        np.testing.assert_allclose(cloud, after.points, atol=1e-5)
    dataset = SimpleNamespace(sample=lambda row: clip[row])
    source = ClipSource(clips=np.arange(16)[None], dataset=dataset, seed=3, trans_center=True, normalize=True)
    shown = source.example(0).points
    np.testing.assert_allclose(shown, normalized.points, atol=1e-5)
    np.testing.assert_allclose(source.validation_clips(1)[0].points, plain.points, atol=1e-5)


# ---- losses


def test_rest_offsets_are_those_of_mean_adult():
    rest = mean_adult_joints() @ UP_AXES["y"]
    offsets = rest - rest[[max(parent, 0) for parent in SMPL24.parents]]
    np.testing.assert_allclose(rest_offsets(), offsets, atol=1e-4)


@pytest.mark.parametrize("name", CONFIGS)
def test_clip_losses_vanish_at_true_rotations(name, clips):
    """Joints of the first stage are relative to the frame's center, so they include the position of the pelvis."""
    objective = ClipObjective(config=CONFIGS[name])
    arrays = objective.collate([clip_example(clip, np.random.default_rng(1)) for clip in clips])
    assert {f"{cloud}_valid" for cloud in objective.config.clouds} <= arrays.keys()
    assert ("background" in arrays) == (name == "ne")

    class Perfect:
        def __call__(self, clouds):
            from lidarpose.models.baselines.lidarcap import ClipOutputs, forward_kinematics

            rotations = torch.as_tensor(arrays["rotations"])
            joints = forward_kinematics(rotations, rest_offsets(), SMPL24.parents)
            pelvis = torch.as_tensor(arrays["joints"][:, :, :1])
            return ClipOutputs(joints=joints + pelvis, rotations=rotations)

    terms = objective.terms(Perfect(), arrays)
    assert float(total(terms)) < 1e-10
    # the joints are those of the mean adult in the pose of the person
    assert 0 < float(terms["mpjpe"]) < 0.12
    joints = objective.joints(Perfect(), arrays)
    assert joints.shape == (2 * CLIP_FRAMES, 26, 3) and np.isnan(joints[:, 24:]).all()
    true = np.concatenate([[sample.pose.joints[0] - sample.pose.joints[1] for sample in clip] for clip in clips])
    assert (np.sum((joints[:, 0] - joints[:, 1]) * true, -1) > 0).all()


# ---- runs


@pytest.mark.long
@pytest.mark.parametrize("name", CONFIGS)
def test_clip_network_trains_evaluates_and_predicts(name, folder, clips, tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "VALIDATION", CLIP_FRAMES)
    few = {"batch": 32, "workers": 0, "pictures": 1}
    wanted = recipe(Pretrain, name, size=f"{name}-tiny", shards=(str(folder),), scene="paper", people=40, **few)
    assert (wanted.optimizer, wanted.rate, wanted.decay, wanted.ema) == ("adam", 1e-4, 1e-4, 0)
    assert recipe(Pretrain, "ne").batch == 8 * CLIP_FRAMES
    path = loop.train(wanted, tmp_path / "run", device="cpu", draw=draw_examples)
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    # a clip counts as 16 people: two steps of two clips
    assert log[-1]["people"] == 64 and {"rotation", "joints", "first", "mpjpe"} <= log[-1].keys()
    assert log[-1]["validation_mm"] > 0 and list((tmp_path / "run/pictures").glob("*.png"))
    result = evaluation.evaluate(path, folder)
    assert result.counts["people"] == 2 * CLIP_FRAMES
    assert any(line.figure.startswith("accel") and line.people for line in result.lines)
    tuned = recipe(Finetune, name, data=(str(folder),), init=str(path), split="all", epochs=1.0, **few)
    assert make_setup(tuned).people == 2 * CLIP_FRAMES
    went_on, before = make_setup(tuned).network().state_dict(), load(path).backend.network.state_dict()
    assert all(torch.equal(value, before[key]) for key, value in went_on.items())
    # by commands, from random weights
    monkeypatch.chdir(tmp_path)
    words = ["--model", name, "--size", f"{name}-tiny", "--split", "all", "--epochs", "1", "--batch", "32"]
    assert not main(["finetune", str(folder), *words, "--workers", "0", "--pictures", "0", "--out", "tuned"])
    assert not main(["evaluate", "tuned/model.safetensors", str(folder), "--out", "scores"])
    assert json.loads((tmp_path / "scores/scores.json").read_text())["results"][0]["counts"]["people"] == 32
    np.save("cloud.npy", clips[0][0].points)
    assert not main(["predict", "cloud.npy", "--weights", "tuned/model.safetensors"])
    (person,) = json.loads((tmp_path / "cloud.poses.json").read_text())["people"]
    assert np.isfinite(person["joints"]).all() and len(person["joints"]) == len(SMPL24)


def test_clip_example_turn_rotates_clip_as_a_whole(clips):
    """Points, joints, surroundings and root rotations turn by one angle; other rotations stay the same."""
    clip = clips[0]
    plain = clip_example(clip, np.random.default_rng(4), pelvis_centered=0.0)
    turned = clip_example(clip, np.random.default_rng(4), pelvis_centered=0.0, turn=True)
    bones = [np.stack([frame.joints[1] - frame.joints[0] for frame in one.frames]) for one in (plain, turned)]
    angles = [np.arctan2(bone[:, 1], bone[:, 0]) for bone in bones]
    angle = (angles[1] - angles[0])[0]
    R = rotation_about("z", angle)
    assert abs(np.sin(angle)) > 0.01
    for before, after in zip(plain.frames, turned.frames, strict=True):
        np.testing.assert_allclose(after.points, before.points @ R.T, atol=1e-5)
        np.testing.assert_allclose(after.joints, before.joints @ R.T, atol=1e-5)
    for name, clouds in plain.clouds.items():
        for before, after in zip(clouds, turned.clouds[name], strict=True):
            np.testing.assert_allclose(after, before @ R.T, atol=1e-5)
    roots = [axis_angle_to_matrix(one.rotations[:, 0]) for one in (plain, turned)]
    np.testing.assert_allclose(roots[1], R @ roots[0], atol=1e-5)
    np.testing.assert_array_equal(turned.rotations[:, 1:], plain.rotations[:, 1:])
    again = clip_example(clip, np.random.default_rng(5), pelvis_centered=0.0, turn=True)
    assert np.abs(again.frames[0].joints - turned.frames[0].joints).max() > 0.01


def test_clip_source_shifts_windows_by_epoch(monkeypatch):
    """As published for NE, but windows stay within their run of frames."""
    monkeypatch.setattr(data_loader, "clip_example", lambda samples, *_, **__: samples)
    settings = {"dataset": SimpleNamespace(sample=lambda row: row), "seed": 3, "trans_center": False}
    run = np.arange(40)
    shifted = ClipSource(clips=clip_windows(run, following=CLIP_FRAMES - 1), **settings)
    starts = set()
    for epoch in range(150):
        first, second, third = sorted(shifted.example(3 * epoch + k) for k in range(3))
        starts.add(first[0])
        assert first == list(range(first[0], first[0] + 16)) and second == list(range(second[0], second[0] + 16))
        assert second[0] == min(16 + first[0], 24) and third == [*range(32, 40), *[39] * 8]
    assert starts == set(range(16))
    still = ClipSource(clips=clip_windows(run), **settings)
    assert sorted(still.example(k) for k in range(3)) == sorted(still.example(k) for k in range(3, 6))
    # validation windows are not shifted
    assert [clip[0] for clip in shifted.validation_clips(3)] == [0, 16, 32]


def test_plateau_schedule_uses_losses_of_whole_epochs(folder, tmp_path):
    """A resumed run takes the losses from its log."""
    wanted = recipe(Finetune, "lidarcap", data=(str(folder),), split="all", size="lidarcap-tiny", batch=32, workers=0)
    assert wanted.schedule == "reduce-on-plateau"
    people = loop.BATCHES * wanted.batch
    made = replace(make_setup(wanted), epoch=2 * people)
    run = loop._Run(wanted, made, tmp_path, Accelerator(cpu=True), "", None)
    losses = [3.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    for k, loss in enumerate(losses):
        run.chunk, run._losses = k + 1, [*run._losses, (people * (k + 1), loss)]
    # epochs of two chunks, the last one incomplete: losses 2, 2, 2
    assert run.seen == 7 * people and run._plateau_factor() == pytest.approx(0.9)
    entries = [{"people": seen, "seconds": 1.0, "rotation": loss / 2, "first": loss / 2} for seen, loss in run._losses]
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(entry | {"mpjpe": 9.0}) + "\n" for entry in entries))
    run._save()
    again = loop._Run(wanted, made, tmp_path, run.accelerator, "", None)
    again.resume()
    assert again._losses == run._losses and again._plateau_factor() == run._plateau_factor()


def test_setup_rejects_settings_that_clip_networks_lack(folder, tmp_path):
    with refused("lidarcap learns from clips: .* by --shards"):
        make_setup(recipe(Pretrain, "lidarcap"))
    with refused("batch counts frames, and a clip has 16: give a multiple, got 24"):
        loop.train(recipe(Pretrain, "lidarcap", shards=(str(folder),), batch=24), tmp_path / "run", device="cpu")
    with refused("head is an option of the paper's network, lidarcap has none"):
        make_setup(recipe(Finetune, "lidarcap", data=(str(folder),), split="all", head="coordinates"))
    with refused("keep_anchors is an option of the paper's network"):
        make_setup(recipe(Finetune, "lidarcap", data=(str(folder),), split="all", keep_anchors=False))
    with refused("heatmap_rate is for the paper's network with heatmaps, lidarcap has none: omit it"):
        make_setup(recipe(Finetune, "lidarcap", data=(str(folder),), split="all", heatmap_rate=10.0))
    # before the data are read
    with refused("leave --mix at 0, and --augment at none or turn"):
        make_setup(recipe(Finetune, "ne", data=(str(tmp_path),), split="all", mix=0.25))
    with refused("shift_windows is for clip networks, tiny reads single frames"):
        make_setup(recipe(Finetune, data=(str(tmp_path),), init="tiny", split="all", mix=0.0, shift_windows=True))
    with refused("normalize_in_training is an option of lidarcap"):
        make_setup(recipe(Pretrain, "ne", shards=(str(folder),), options=("normalize_in_training",)))
    wanted = recipe(Pretrain, "lidarcap", shards=(str(folder),), options=("normalize_in_training",))
    assert make_setup(wanted).source.normalize
    with refused("the joints of lidarcap are SMPL's 24"):
        replace(LidarcapConfig(), joints=BODY26.joints)
    with refused("option of lidarcap"):
        make_setup(recipe(Pretrain, "lidarcap", shards=(str(folder),), options=("grid=32",)))


def test_setup_rejects_shards_without_clips(tmp_path):
    people = [[Generator(scene="paper", measure=False).person(0, k).sample] for k in range(3)]
    with refused("needs frames of people with rotations, got 3 without"):
        make_setup(recipe(Pretrain, "lidarcap", shards=(str(write_clips(tmp_path / "p", people)),)))


@pytest.mark.long
def test_lidarhuman26m_from_raw_files_to_scores(tmp_path):
    """With the published protocol: centered on trans, as in training."""
    smpl = files.write_smpl(tmp_path / "SMPL_NEUTRAL.npz")
    files.write_lidarhuman26m(tmp_path / "raw", smpl, sequences=("5", "7"), frames=18)
    prepare("lidarhuman26m", tmp_path / "raw", tmp_path / "set", smpl=smpl)
    wanted = recipe(
        Finetune, "lidarcap", data=(str(tmp_path / "set"),), size="lidarcap", options=("trans_center",), batch=16
    )
    made = make_setup(wanted)
    # sequence 5: two windows, the last one padded
    assert made.people == 200 * 2 * CLIP_FRAMES and made.objective.config.trans_center
    example = made.source.example(0)
    assert np.ptp([frame.joints[0] for frame in example.frames], axis=0).max() < 1e-4
    torch.manual_seed(0)
    save_checkpoint(tmp_path / "w.safetensors", made.network(), card={})
    result = evaluation.evaluate(tmp_path / "w.safetensors", tmp_path / "set", protocol="dapt")
    assert result.counts["people"] == 18


# ---- learning


@pytest.mark.slow
@pytest.mark.parametrize("size", ["lidarcap-small", "ne-small"])
def test_clip_networks_overfit_two_clips(size, monkeypatch):
    """Narrow networks for CPUs, with the rates of the paper's tables and without dropout. The error at the true
    rotations is 20.6 mm, because the networks use the bones of the mean adult."""
    monkeypatch.setattr(torch.nn.functional, "dropout", lambda x, *_: x)
    monkeypatch.setattr(DropPath, "forward", lambda _, branch: branch)
    generator = Generator(scene="paper", measure=False)
    made = [[thinned(person.sample) for person in generator.clip(3, k)] for k in (1, 12)]
    examples = [clip_example(clip, np.random.default_rng(1), trans_center=False, pelvis_centered=0.0) for clip in made]
    objective = ClipObjective(config=PRETRAINED[size][0])
    rates = recipe(Pretrain, size.removesuffix("-small"), rate=2e-3, schedule="cosine", warmup=0.04)
    torch.manual_seed(0)
    network = objective.network().train()
    for module in network.modules():
        if isinstance(module, torch.nn.MultiheadAttention):
            module.dropout = 0.0
    arrays, steps = objective.collate(examples), 1300 if size == "lidarcap-small" else 1700
    made_by = optimizers(network, rates)
    for step in range(steps):
        set_rates(made_by, rates, step / steps)
        for optimizer in made_by:
            optimizer.zero_grad()
        total(objective.terms(network, arrays)).backward()
        for optimizer in made_by:
            optimizer.step()
    update_batch_norms(network, objective, [arrays])
    assert validate(objective, network.eval(), examples, 2)[0] < 50


@pytest.mark.parametrize("stock", [False, True])
def test_ne_initialization_keeps_frames_distinct(stock, clips):
    """With the published initialization, frames are nearly equal before the first step."""
    config = replace(PRETRAINED["ne-small"][0], stock_initialization=stock)
    torch.manual_seed(0)
    network = build(config)
    objective, spread = ClipObjective(config=config), {}

    for name in ("norm", "clip"):
        module = getattr(network, name)
        module.register_forward_hook(
            lambda _, __, out, name=name: spread.update(
                {name: float(out.detach().std(1).mean() / out.detach().square().mean().sqrt())}
            )
        )
    arrays = objective.collate([clip_example(clip, np.random.default_rng(1)) for clip in clips])
    # frames without neighbors, for which the encoder gets zeros
    arrays["neighbors"] = np.zeros_like(arrays["neighbors"])
    total(objective.terms(network.train(), arrays)).backward()
    gradient = torch.nn.utils.get_total_norm([value.grad for value in network.parameters() if value.grad is not None])
    assert (spread["clip"] > 0.8 * spread["norm"]) == (not stock)
    assert (gradient < 100) == (not stock)
    assert bool(network.rotations.output.bias[0] == 1) == (not stock)


# ---- predictions


def _joints(poses):
    return np.stack([person.joints for person in poses])


def test_predict_single_cloud_equals_clip_of_equal_frames(predictor, clips):
    clouds = [sample.points for sample in clips[0][:3]]
    alone = predictor.predict(clouds)
    equal = predictor.predict([clouds[1]] * CLIP_FRAMES, clips=Clips.of_run(CLIP_FRAMES))
    np.testing.assert_allclose(equal[CLIP_FRAMES // 2].joints, alone[1].joints, atol=1e-4)
    assert alone[1].skeleton == SMPL24


def test_predict_clip_depends_on_other_frames_and_their_order(predictor, clips):
    clouds = [sample.points for sample in clips[0]]
    around = {name: [getattr(sample, name) for sample in clips[0]] for name in CLOUDS[1:]}
    joints = _joints(predictor.predict(clouds, clips=Clips.of_run(CLIP_FRAMES, **around)))
    backwards = Clips.of_run(CLIP_FRAMES, **{name: given[::-1] for name, given in around.items()})
    turned = _joints(predictor.predict(clouds[::-1], clips=backwards))
    alone = _joints(predictor.predict(clouds))
    assert np.abs(joints - alone).max() > 1e-3
    assert np.abs(joints - turned[::-1]).max() > 1e-3
    # only NE uses background and neighbors
    bare = _joints(predictor.predict(clouds, clips=Clips.of_run(CLIP_FRAMES)))
    assert (np.abs(bare - joints).max() > 1e-5) == (predictor.model["name"] == "ne")


def test_predict_clip_gives_no_pose_for_empty_frames(predictor, clips):
    clouds = [sample.points for sample in clips[0]]
    clouds[4], clouds[15] = clouds[4][:2], clouds[15][:0]
    poses = predictor.predict(clouds, clips=Clips.of_run(CLIP_FRAMES))
    assert [k for k, person in enumerate(poses) if person.pose is None] == [4, 15]
    filled = list(clouds)
    filled[4], filled[15] = clouds[5], clouds[14]
    same = predictor.predict(filled, clips=Clips.of_run(CLIP_FRAMES))
    np.testing.assert_allclose(poses[0].joints, same[0].joints, atol=1e-4)


@pytest.mark.parametrize(
    "clips, told",
    [
        (Clips.of_run(20), "each of the 4 clouds in one window"),
        (Clips.of_run(3), "each of the 4 clouds in one window"),
        (Clips(windows=np.arange(4)[None]), "windows of 16 rows"),
        (Clips(windows=None), "windows of 16 rows"),
        (Clips(windows=[[0] * 16, [1] * 15]), "windows of 16 rows"),
        (Clips(windows=[[0.0, 1.0, 2.0, 3.0] * 4]), "windows of 16 rows"),
        (Clips(windows=np.repeat([[0, 1, 2, 3], [0, 1, 2, 3]], 4, axis=1)), "in one window"),
        (Clips.of_run(4, background=[np.zeros((5, 3))] * 3), "clouds of background as clouds, 4, got 3"),
        (Clips.of_run(4, neighbors=[np.zeros((5, 2))] * 4), r"neighbors\[0\] must be \(n, 3\)"),
    ],
)
def test_predict_rejects_clips_that_do_not_match_clouds(predictor, clips, told):
    with refused(told):
        predictor.predict([np.random.default_rng(k).normal(0, 0.3, (20, 3)) for k in range(4)], clips=clips)


@pytest.mark.parametrize("given", [{"boxes": []}, {"find": True}])
def test_predict_rejects_clips_with_boxes_or_find(predictor, given):
    with refused("omit clips with boxes or find"):
        predictor.predict(np.zeros((20, 3)), clips=Clips.of_run(1), **given)


def test_single_frame_network_rejects_clips():
    with refused("reads single frames"):
        load("tiny").predict([np.zeros((10, 3))] * CLIP_FRAMES, clips=Clips.of_run(CLIP_FRAMES))


def test_evaluation_predicts_true_windows(predictor, folder, clips):
    result = evaluation.run(predictor, [folder]).evaluations[0]
    by_clip = []
    for clip in clips:
        around = {name: [getattr(sample, name) for sample in clip] for name in CLOUDS[1:]}
        clouds = [sample.points for sample in clip]
        poses = predictor.predict(clouds, sensor_origin=(0, 0, 0), clips=Clips.of_run(CLIP_FRAMES, **around))
        by_clip.append(_joints(poses))
    names = list(result.predictions.skeleton.joints)
    expected = np.concatenate(by_clip)[:, [SMPL24.index(name) for name in names]]
    np.testing.assert_allclose(result.predictions.pred, expected, atol=1e-3)


@pytest.mark.long
def test_evaluation_notes_unknown_surroundings(clips, tmp_path):
    torch.manual_seed(0)
    alone = [replace(sample, background=None, neighbors=None) for sample in clips[0][:5]]
    folder = write_clips(tmp_path / "clips", [alone + clips[0][5:]])
    notes = {}
    for name, config in CONFIGS.items():
        model = Predictor(ClipBackend(build(config), Header(config=config, card={})), name=name)
        notes[name] = evaluation.run(model, [folder]).evaluations[0].result.notes
    note = "surroundings of 5 of 16 people are not known: the network got none"
    assert note in notes["ne"] and note not in notes["lidarcap"]


@pytest.mark.long
def test_evaluation_with_limit_predicts_frames_alone(predictor, folder, clips, monkeypatch):
    """Frames that are not consecutive form no window, even if evenly spaced. The same holds for the stability study."""
    result = evaluation.run(predictor, [folder], limit=8).evaluations[0].predictions
    samples = [sample for clip in clips for sample in clip]
    assert len(result.row) == 8
    for row, pred in zip(result.row, result.pred, strict=True):
        around = {name: [getattr(samples[row], name)] for name in CLOUDS[1:]}
        clip = Clips(windows=np.zeros((1, CLIP_FRAMES), int), **around)
        (alone,) = predictor.predict([samples[row].points], sensor_origin=(0, 0, 0), clips=clip)
        expected = alone.joints[[SMPL24.index(name) for name in result.skeleton.joints]]
        np.testing.assert_allclose(pred, expected, atol=1e-3)
    monkeypatch.setattr(robustness, "PEOPLE", 8)
    monkeypatch.setattr(robustness, "PERTURBATIONS", {})
    monkeypatch.setattr(robustness, "_sensor_curve", lambda *_: None)
    asked, clips_of = [], EvalSetup._clips
    monkeypatch.setattr(EvalSetup, "_clips", lambda *given: asked.append(clips_of(*given)) or asked[-1])
    setup = eval_setup(predictor, open_eval_dataset(folder))
    robustness.study(setup, result)
    (given,) = asked
    assert len(given["clips"].windows) == 8 and (np.ptp(given["clips"].windows, axis=1) == 0).all()


@pytest.mark.parametrize("gap", [0, 5])
def test_evaluation_in_chunks_predicts_same_windows(gap, clips, tmp_path, monkeypatch):
    """One run of 40 frames, or two of 20 with a gap, then another person, in chunks of at least 10 frames."""
    samples = [*clips[0], *clips[1], *clips[0][:8]]
    folder = write_clips(tmp_path / "long", [samples, clips[1]], gap=gap)
    torch.manual_seed(0)
    config = PRETRAINED["lidarcap-small"][0]
    predictor = Predictor(ClipBackend(build(config), Header(config=config, card={})), name="small")
    whole = evaluation.run(predictor, [folder]).evaluations[0].predictions
    predict, sizes = EvalSetup.predict, []
    monkeypatch.setattr(EvalSetup, "predict", lambda self, people: sizes.append(len(people)) or predict(self, people))
    monkeypatch.setattr(run, "_CHUNK", 10)
    parts = evaluation.run(predictor, [folder]).evaluations[0].predictions
    assert sizes == ([16, 20, 20] if gap else [16, 16, 24])
    np.testing.assert_allclose(parts.pred, whole.pred, atol=1e-4)
