"""Losses, schedules, optimizers, settings, and the batches of a run."""

import json
import multiprocessing
import os
import pickle
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from motion_files import a_clip, write_amass

from lidarpose.errors import InputError
from lidarpose.models.config import BIN, SIZES
from lidarpose.models.layers import REACH, encode
from lidarpose.models.posenet import Outputs, PoseNet, Targets
from lidarpose.sample import center_of
from lidarpose.skeleton import BODY26
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES
from lidarpose.train import data_loader, optim
from lidarpose.train.augment import add_disturbances
from lidarpose.train.data_loader import BATCHES, Chunks, SyntheticSource, loader
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import (
    CONFIDENCE,
    HEATMAP,
    JOINTS,
    LEVEL,
    SIGMA,
    SPREAD,
    VOTE,
    PoseNetObjective,
    losses,
)
from lidarpose.train.optim import average, optimizers, rate_factor
from lidarpose.train.recipes import Finetune, Pretrain, recipe
from lidarpose.train.setup import Job, make_setup
from lidarpose.train.validation import validate

# three chunks of `BATCHES` batches
RECIPE = Pretrain(scene="paper", people=3 * BATCHES * 2, batch=2, workers=0, seed=5, easy=0.15, pictures=0)
TINY = SIZES["tiny"]
OBJECTIVE = PoseNetObjective(config=TINY)
WINDOW = REACH["window"]
BINS = round(2 * WINDOW / BIN)
EXACT = torch.randn(3, 26, 3, generator=torch.Generator().manual_seed(0)) * 0.4
# votes with errors below and above ten centimeters
SPREAD_OUT = torch.randn(40, 26, 3, generator=torch.Generator().manual_seed(0)) * 0.4
ASTRAY = SPREAD_OUT + torch.randn(40, 26, 3, generator=torch.Generator().manual_seed(1)) * 0.07


# --- losses


def outputs(vote, **more):
    people, joints = vote.shape[:2]
    values = {
        "vote": vote,
        "heatmap": encode(torch.zeros(people, joints, 3), SIGMA, BINS).log(),
        "part": torch.zeros(people, 4, 25),
        **{name: torch.zeros(people, joints) for name in ("confidence", "log_spread", "visible")},
        "level_joints": (vote, vote),
    }
    return Outputs(**(values | more))


def targets(joints, **more):
    known = torch.ones(joints.shape[:2], dtype=torch.bool)
    part = torch.tensor([[1, 2, 0, -1]] * len(joints))
    nobody_says = torch.full((len(joints), 2), torch.nan)
    own = {"joints": joints, "known": known, "visible": known.float(), "part": part, "person": nobody_says}
    return Targets(**(own | more))


def gradient(name, value, vote=ASTRAY, aims=None):
    """Gradient of the loss term `name`, or of the total, with respect to an output."""
    field, value = value if isinstance(value, tuple) else (name, value)
    value = value.clone().requires_grad_()
    terms = losses(outputs(**{"vote": vote, field: value}), aims or targets(SPREAD_OUT))
    (total(terms) if name == "total" else terms[name]).backward()
    return value.grad


def test_losses_are_distances():
    """The released code squares distances. Exact joints have no loss and a finite gradient."""
    exact = losses(outputs(EXACT), targets(EXACT))
    assert exact["vote"] == 0 and exact["level"] == 0
    # the heatmap has no bin at zero: decoding leaves an error of half a millimeter per axis
    assert exact["mpjpe"] < 2e-3
    assert total(exact).item() == pytest.approx(sum(v.item() for n, v in exact.items() if n != "mpjpe"), rel=1e-5)
    assert gradient("total", ("vote", EXACT), aims=targets(EXACT)).isfinite().all()
    shifted = losses(outputs(EXACT + torch.tensor([0.3, 0.0, -0.4])), targets(EXACT))
    for name, weight, within in (("vote", VOTE, 1e-4), ("level", 2 * LEVEL, 1e-4), ("joints", JOINTS, 5e-3)):
        assert shifted[name].item() == pytest.approx(weight * 0.5, rel=within)


def test_heatmap_loss_is_relative_to_vote_and_within_window():
    far = EXACT.clone()
    far[0] += WINDOW + 0.1
    # the true heatmap is the optimum; joints outside the window have no gradient
    right = encode(torch.zeros(3, 26, 3), SIGMA, BINS).log()
    assert gradient("heatmap", right, far, targets(EXACT)).abs().max() < 1e-6
    wrong = gradient("heatmap", torch.zeros(3, 26, 3, BINS), far, targets(EXACT))
    assert wrong[0].abs().max() == 0 and wrong[1:].abs().min() > 0
    entropy = -(encode(torch.tensor(0.0), SIGMA, BINS) * encode(torch.tensor(0.0), SIGMA, BINS).log()).sum()
    best = losses(outputs(EXACT), targets(EXACT))["heatmap"]
    assert best.item() == pytest.approx(HEATMAP * entropy.item(), rel=1e-4)


def test_confidence_and_spread_losses_have_correct_optimum():
    """Probability of an error below 10 cm, and expected distance. Both losses have no gradient for the joints."""
    error = (outputs(ASTRAY).joints() - SPREAD_OUT).norm(dim=-1)
    rate = (error < 0.1).float().mean()
    assert 0.1 < rate < 0.9
    for name, field, best, weight in (
        ("confidence", "confidence", torch.logit(rate), CONFIDENCE),
        ("spread", "log_spread", error.mean().log(), SPREAD),
    ):
        value = torch.full((40, 26), best.item())
        assert abs(gradient(name, (field, value)).sum()) < 1e-5 * weight
        below, at, above = (
            losses(outputs(ASTRAY, **{field: value + d}), targets(SPREAD_OUT))[name] for d in (-0.2, 0, 0.2)
        )
        assert at < min(below, above)
    terms = losses(outputs(ASTRAY.clone().requires_grad_()), targets(SPREAD_OUT))
    assert not (terms["confidence"] + terms["spread"] + terms["heatmap"]).requires_grad
    assert terms["vote"].requires_grad and terms["joints"].requires_grad


def test_padding_has_no_part_loss():
    part = torch.zeros(3, 4, 25)
    part[:, 3, 7] = 50.0
    a, b = (losses(outputs(EXACT, part=p), targets(EXACT))["part"] for p in (torch.zeros(3, 4, 25), part))
    assert a == b


def test_unlabeled_joints_have_no_loss_and_no_gradient():
    known = targets(SPREAD_OUT).known.clone()
    known[:, 5] = False
    known[3] = False
    lost = torch.where(known[..., None], SPREAD_OUT, float("nan"))
    made = outputs(ASTRAY)
    terms, blind = (losses(made, targets(joints, known=known)) for joints in (SPREAD_OUT, lost))
    for name, value in terms.items():
        assert value == blind[name] and torch.isfinite(value), name
    assert terms["vote"] != losses(made, targets(SPREAD_OUT))["vote"]
    nobody = losses(made, targets(SPREAD_OUT, known=known & False))
    assert nobody["vote"] == nobody["joints"] == nobody["heatmap"] == 0
    pull = gradient("total", ("vote", ASTRAY), aims=targets(lost, known=known))
    assert torch.isfinite(pull).all() and not pull[~known].any() and pull[known].any()


def test_visibility_loss_follows_labels():
    aims = targets(EXACT, visible=(torch.arange(26) % 2 == 0).float().expand(3, 26))
    pull = gradient("visible", torch.zeros(3, 26), EXACT, aims)
    assert (pull[:, ::2] < 0).all() and (pull[:, 1::2] > 0).all()


def test_bone_and_symmetry_losses():
    exact = losses(outputs(EXACT), targets(EXACT), bone=2.0, symmetry=3.0)
    # decoding the heatmap leaves an error of half a millimeter per axis
    assert exact["bone"] < 2 * 3e-3 and exact["symmetry"] > 0.1
    stretched = losses(outputs(EXACT * 1.1), targets(EXACT), bone=2.0)
    lengths = torch.stack([(EXACT[:, a] - EXACT[:, b]).norm(dim=-1) for a, b in BODY26.bones])
    assert stretched["bone"].item() == pytest.approx(2.0 * 0.1 * lengths.mean().item(), abs=4e-3)
    # a mirror-symmetric body has no symmetry loss
    even = EXACT.clone()
    left = [j for j, name in enumerate(BODY26.joints) if "left" in name]
    even[:, [BODY26.flip[j] for j in left]] = even[:, left] * torch.tensor([-1.0, 1, 1])
    even[:, [j for j, name in enumerate(BODY26.joints) if "_" not in name or name == "head_center"], 0] = 0.0
    assert losses(outputs(even), targets(EXACT), symmetry=3.0)["symmetry"] < 3 * 3e-3


# --- schedule and optimizers


def test_rate_factor_warms_up_and_cools_down_to_zero():
    done = np.linspace(0, 1, 2001)
    factor = np.array([rate_factor(d, RECIPE) for d in done])
    assert (factor >= 0).all() and (factor <= 1).all() and factor[0] > 0 and factor[-1] == rate_factor(1.5, RECIPE) == 0
    rise, fall = done < RECIPE.warmup, done > 1 - RECIPE.cool
    assert (np.diff(factor[rise]) >= 0).all() and (np.diff(factor[fall]) < 0).all()
    np.testing.assert_array_equal(factor[~rise & ~fall], 1)
    assert np.abs(np.diff(factor)).max() < 0.03


def test_plateau_factor_is_reduced_after_two_bad_epochs():
    assert optim.plateau_factor([], 1e-4) == optim.plateau_factor([1.0, 0.98, 0.975], 1e-4) == 1
    # reduced after two bad epochs, then the count restarts; a gain of more than 1 % restarts it, too
    assert optim.plateau_factor([1.0, 0.995, 0.995], 1e-4) == pytest.approx(0.9)
    assert optim.plateau_factor([1.0, 1, 1, 1], 1e-4) == pytest.approx(0.9)
    assert optim.plateau_factor([1.0, 1, 0.9, 0.9, 0.9], 1e-4) == pytest.approx(0.9)
    # torch makes no reductions of less than 1e-8
    assert 9e-8 < optim.plateau_factor([1.0] * 400, 1e-4) * 1e-4 < 1e-7 and optim.plateau_factor([1.0] * 99, 2e-8) == 1
    with pytest.raises(InputError, match="only fine-tuning has epochs"):
        recipe(Pretrain, schedule="reduce-on-plateau")


def test_paper_recipe_has_released_cosine_schedule():
    cosine = recipe(Pretrain, "paper")
    # half of the rate in the middle of the decay
    middle = cosine.warmup + (1 - cosine.warmup) / 2
    for done, factor in ((0, 0.1), (cosine.warmup, 1), (middle, (1 + 1e-3) / 2), (1, 1e-3)):
        assert rate_factor(done, cosine) == pytest.approx(factor)
    assert (np.diff([rate_factor(d, cosine) for d in np.linspace(cosine.warmup, 1, 500)]) < 0).all()


def test_optimizers_cover_all_parameters_with_decay():
    network = PoseNet(TINY)
    made, (alone,) = optimizers(network, RECIPE), optimizers(network, replace(RECIPE, muon_rate=0.0))
    groups = [group for optimizer in made for group in optimizer.param_groups]
    assert sorted(id(p) for group in groups for p in group["params"]) == sorted(id(p) for p in network.parameters())
    assert {group["weight_decay"] for group in [*groups, *alone.param_groups]} == {RECIPE.decay} != {0.0}
    hidden = {id(p) for p in made[1].param_groups[0]["params"]}
    names = {name for name, value in network.named_parameters() if id(value) in hidden}
    assert "bottleneck.blocks.0.attention.query.weight" in names
    assert not any(name.startswith(("anchors", "part", "stem.voxel", "joint.heatmap")) for name in names)
    assert all(value.ndim == 2 for name, value in network.named_parameters() if name in names)


def test_average_follows_weights():
    network = torch.nn.Linear(1, 1)
    mean = {name: torch.zeros_like(value) for name, value in network.named_parameters()}
    average(mean, network, 0, 0.999)
    torch.testing.assert_close(mean["weight"], network.weight.detach() * 0.9)
    for step in range(1, 60):
        average(mean, network, step, 0.999)
    torch.testing.assert_close(mean["weight"], network.weight.detach(), rtol=1e-3, atol=1e-6)


# --- batches


def assert_same_chunks(a, b):
    for left, right in zip(a, b, strict=True):
        for x, y in zip(left, right, strict=True):
            assert x.keys() == y.keys()
            for name in x:
                np.testing.assert_array_equal(np.asarray(x[name]), np.asarray(y[name]), err_msg=name)


def chunks(recipe, workers=0, **more):
    settings = {"batch": recipe.batch, "seed": recipe.seed, "start": 0, "steps": 3 * BATCHES} | more
    return loader(Chunks(source=make_setup(recipe).source, objective=OBJECTIVE, **settings), workers=workers)


@pytest.fixture(scope="module")
def whole():
    return list(chunks(RECIPE))


@pytest.mark.long
def test_chunks_do_not_depend_on_start_and_workers(whole, monkeypatch):
    assert len(whole) == 3 and all(len(batches) == BATCHES for batches in whole)
    joints = np.concatenate([b["joints"] for batches in whole for b in batches])
    assert len(np.unique(joints[:, 5], axis=0)) == len(joints) == RECIPE.people
    for start in (1, 2):
        assert_same_chunks(whole[start:], chunks(RECIPE, start=start))
    for workers, shared in ((1, 0), (2, 0), (1, 2**60)):
        # without enough shared memory, chunks are sent through a pipe
        monkeypatch.setattr(data_loader, "_SHARED_OF_WORKER", shared)
        assert data_loader._has_shared_memory(workers) == (not shared and data_loader._SHARED_MEMORY.is_dir())
        assert_same_chunks(whole, chunks(RECIPE, workers))
    # the last chunk may be short
    short = list(chunks(RECIPE, steps=BATCHES + 3))
    assert [len(batches) for batches in short] == [BATCHES, 3]
    assert_same_chunks(whole[:1], short[:1])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_ignore_stop_signals(whole, number):
    """The run needs them for the batches that it finishes before saving."""
    made, signaled = [], 0
    for batches in chunks(RECIPE, 1):
        for worker in multiprocessing.active_children():
            os.kill(worker.pid, number)
            signaled += 1
        made.append(batches)
    assert signaled
    assert_same_chunks(made, whole)


def test_processes_share_each_batch():
    """Their batches together contain the people of a single process's batch, each once."""
    settings = {"batch": 8, "steps": BATCHES + 1}
    alone = list(chunks(RECIPE, **settings))
    for ranks in (2, 4):
        shared = [list(chunks(RECIPE, **settings, rank=rank, ranks=ranks)) for rank in range(ranks)]
        for c, batches in enumerate(alone):
            for k, batch in enumerate(batches):
                joints = np.concatenate([own[c][k]["joints"] for own in shared])
                assert len(joints) == 8
                order = [np.argsort(j[:, 0, 0], kind="stable") for j in (joints, batch["joints"])]
                np.testing.assert_array_equal(joints[order[0]], batch["joints"][order[1]])


@pytest.fixture
def asked(monkeypatch):
    """(index, hard) of each generated person."""
    made, original = [], Generator.person

    def person(self, seed, index, *, hard):
        made.append((index, hard))
        return original(self, seed, index, hard=hard)

    monkeypatch.setattr(Generator, "person", person)
    return made


def test_difficulty_rises_over_easy_share_of_run(asked):
    list(chunks(replace(RECIPE, scene="wild", easy=0.5, batch=4, people=96)))
    # people are generated lane by lane
    index, hard = np.array(sorted(asked)).T
    np.testing.assert_array_equal(index, np.arange(96))
    ceiling = np.minimum(index / 48, 1)
    assert hard[0] == 0 and (hard <= ceiling).all()
    # all difficulties below the ceiling occur, harder ones more often: the mean is two thirds of it
    assert (hard[1:] / ceiling[1:]).mean() == pytest.approx(2 / 3, abs=0.08) and hard[48:].min() < 0.35


@pytest.mark.parametrize("scene", ["paper", "reference"])
def test_paper_scenes_have_full_difficulty(asked, scene):
    """All people are masked; a lower difficulty would remove the mask."""
    list(chunks(replace(recipe(Pretrain, "paper"), size="tiny", scene=scene, batch=4, people=32)))
    assert {hard for _, hard in asked} == {1.0}
    asked.clear()
    list(chunks(replace(RECIPE, scene=scene, easy=0.5, batch=4, people=96)))
    assert [hard for _, hard in sorted(asked)] == [min(k / 48, 1.0) for k in range(96)]


@pytest.mark.parametrize("hard", [0.0, 0.4])
def test_difficulty_of_scene_is_the_maximum(asked, hard):
    list(chunks(replace(RECIPE, scene="wild", set=(f"hard={hard}",), easy=0.0, batch=4, people=32)))
    difficulties = np.array([difficulty for _, difficulty in asked])
    assert difficulties.max() <= hard and difficulties.mean() == pytest.approx(2 / 3 * hard, abs=0.1)


def test_easier_people_are_more_visible():
    generator = Generator(scene=SCENES["wild"])
    easy, full = (np.mean([generator.person(1, k, hard=h).facts.visible for k in range(64)]) for h in (0.0, 1.0))
    assert easy > full + 0.03


def test_sources_can_be_pickled(tmp_path):
    motion = write_amass(tmp_path / "walk_poses.npz", *a_clip(40))
    source = SyntheticSource(scene="wild", seed=3, motion=str(motion), captured=0.5)
    want = source.example(1)
    # cached data is not pickled
    sent = pickle.dumps(Chunks(source=source, objective=OBJECTIVE, batch=2, seed=3, start=0, steps=8))
    assert len(sent) < 20_000
    np.testing.assert_array_equal(pickle.loads(sent).source.example(1).points, want.points)
    generator = Generator(scene="paper")
    there = pickle.loads(pickle.dumps(generator))
    np.testing.assert_array_equal(there.person(1, 2).sample.points, generator.person(1, 2).sample.points)


def test_add_disturbances_changes_points_only():
    sample = Generator(scene=SCENES["wild"], measure=False).person(2, 0).sample
    before, count = sample.points.copy(), len(sample.points)

    def changed(strays, noise, seeds=40):
        return [
            add_disturbances(sample, strays=strays, noise=noise, rng=np.random.default_rng(k)) for k in range(seeds)
        ]

    assert all(same is sample for same in changed(0.0, 0.0, 1))
    cluttered = changed(1.0, 0.0)
    for other in cluttered:
        np.testing.assert_array_equal(other.points[:count], sample.points)
        assert (other.part[count:] == 0).all() and len(other.part) == len(other.points) and other.pose is sample.pose
        np.testing.assert_array_equal(other.center, center_of(other.points))
    assert max(len(other.points) for other in cluttered) > count + 50
    # the center is kept in a crop of two people
    crowded = replace(sample, source="synth/wide/os1-64/inverted+crowded", center=sample.center + np.float32(0.3))
    moved = add_disturbances(crowded, strays=1.0, noise=1.0, rng=np.random.default_rng(0))
    assert len(moved.points) != count and np.array_equal(moved.center, crowded.center)
    blurred = changed(0.0, 1.0)
    assert all(other.points.dtype == np.float32 and np.array_equal(other.part, sample.part) for other in blurred)
    steps = [(other.points - sample.points).std() for other in blurred]
    assert 0.003 < min(steps) < 0.01 and 0.04 < max(steps) < 0.09
    assert 0.2 < np.mean([other is not sample for other in changed(0.3, 0.0, 300)]) < 0.4
    np.testing.assert_array_equal(sample.points, before)


# --- settings


def test_recipes_accept_numpy_numbers_paths_and_single_names():
    plain = Pretrain(people=64, rate=0.5, motion="walks", subjects=("002",), shards=("a",))
    other = Pretrain(people=np.int64(64), rate=np.float32(0.5), motion=Path("walks"), subjects="002", shards=Path("a"))
    assert other == plain and json.loads(json.dumps(other.to_dict())) == json.loads(json.dumps(plain.to_dict()))
    assert Pretrain(motion="m", subjects=["a"]) == Pretrain(motion="m", subjects=("a",))
    assert Finetune(data="humanm3").data == ("humanm3",)
    assert Finetune(data="a", keep_anchors=np.bool_(False)).keep_anchors is False


@pytest.mark.parametrize(
    "change, message",
    [
        ({"people": 0}, "people must be at least 1, got 0"),
        ({"batch": 0}, "batch must be at least 1, got 0"),
        *(({name: -1}, f"{name} must be at least [01], got -1") for name in ("people", "rate", "captured", "workers")),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"people": 5.5}, "people must be a whole number, got 5.5"),
        ({"rate": None}, "rate must be a number, got None"),
        ({"scene": 3}, "scene must be text, got 3"),
        ({"shards": [3]}, r"shards must be a list of texts, got \[3\]"),
        # subjects need a motion file
        ({"subjects": ("a",)}, "subjects select captured clips: give their file by motion too"),
        ({"captured": 1.0}, "captured is the share of captured poses: give their file by motion too"),
        ({"head": "arms"}, "unknown head 'arms': .*"),
        ({"drop_path": "much"}, "drop_path must be a number, got 'much'"),
        *(({"keep_anchors": value}, "keep_anchors must be true or false, got .*") for value in ("false", 0, None)),
    ],
)
def test_recipe_rejects_invalid_settings(change, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        recipe(Finetune, data="a", **change) if "keep_anchors" in change else Pretrain(**change)


@pytest.mark.parametrize(
    "kind, change, message",
    [
        (Pretrain, {"neck": "prn"}, "neck, head and drop_path are options of the paper's network: add --size paper"),
        (Pretrain, {"size": "paper-small", "neck": "giraffe"}, "unknown neck 'giraffe'"),
        (Pretrain, {"size": "paper-small", "neck": "prn", "head": "heatmaps"}, "has coordinates and no heatmaps"),
        (Pretrain, {"size": "paper-small", "drop_path": 1.5}, "drop_path must be a probability below 1"),
        (
            Pretrain,
            {"size": "paper-small", "heatmap_rate": 10},
            "heatmap_rate is for the paper's network with heatmaps",
        ),
        (Pretrain, {"heatmap_rate": 10}, "heatmap_rate is for .*, tiny has none: omit it"),
        (Pretrain, {"size": "paper-small", "muon_rate": 0.01}, "muon_rate is for the package's own networks, .*: omit"),
        (Pretrain, {"optimizer": "adam"}, "tiny is trained by Muon and AdamW: omit --optimizer, or add --muon-rate 0"),
        (Finetune, {"data": "a", "neck": "prn"}, "a checkpoint has its own neck: omit --neck"),
        (Finetune, {"data": "a", "set": "keep=0.5", "mix": 0}, "change the people that are mixed in: give --mix X"),
        (Finetune, {"data": "a", "set": "recorded=1"}, "recorded needs captured motion"),
    ],
)
def test_setup_checks_options_of_paper_network(kind, change, message):
    with pytest.raises(InputError, match=message):
        make_setup(kind(**change))


def test_named_recipes_match_the_paper():
    assert recipe(Pretrain) == Pretrain()
    paper = recipe(Pretrain, "paper", people=5)
    # Paper: AdamW, cosine, batch 64, 3e-4 and 5e-4, 50 epochs
    assert (paper.size, paper.scene, paper.batch, paper.rate, paper.people) == ("paper", "paper", 64, 3e-4, 5)
    assert paper.schedule == "cosine" and not (paper.muon_rate or paper.ema or paper.clip)
    fine = recipe(Finetune, "paper", data=("a",), init="first.safetensors")
    assert (fine.rate, fine.epochs, fine.mix, fine.augment, fine.keep_anchors) == (5e-4, 50, 0, "paper", False)
    one = make_setup(recipe(Pretrain, "paper-one-stage", people=64)).objective
    assert one.stage == "finetune" and one.config.bins and one.config.drop_path == 0.05 and one.config.neck == "mde"
    # the paper's networks are trained on all training sequences
    assert fine.hold_out == 0


def test_setup_accepts_old_names():
    new = make_setup(RECIPE)
    old = Job(task=new.task, **{name: value for name, value in vars(new).items() if name != "objective"})
    assert old == new and new.task is new.objective


def test_validate_returns_mean_error_in_mm():
    joints = np.random.default_rng(0).normal(size=(3, 26, 3))
    joints[0, 4] = np.nan

    def predicted(network, batch, *, device):
        return np.nan_to_num(np.stack(batch)) + [0.03, 0.0, 0.04]

    objective = SimpleNamespace(collate=lambda examples: [each.joints for each in examples], joints=predicted)
    examples = [SimpleNamespace(joints=each, frames=(SimpleNamespace(joints=each),)) for each in joints]
    assert validate(objective, torch.nn.Linear(1, 1), examples, 2)[0] == pytest.approx(50)
