"""Losses, schedule, and runs that can be killed and taken up again."""

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
from lidarpose.models.config import BIN, preset
from lidarpose.models.layers import REACH, encode
from lidarpose.models.posenet import Outputs, PoseNet, Targets
from lidarpose.sample import center_of
from lidarpose.skeleton import BODY26, SMPL24
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES
from lidarpose.train.augment import disturbed
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
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.recipes import recipe as recipe_of
from lidarpose.train.setup import make_setup
from lidarpose.train.validation import Validation

# three chunks of `BATCHES` batches
RECIPE = Pretrain(scene="paper", people=3 * BATCHES * 2, batch=2, workers=0, seed=5, easy=0.15, pictures=0)
TASK = PoseNetObjective(config=preset("tiny"))
TINY = preset("tiny")
WINDOW = REACH["window"]
BINS = round(2 * WINDOW / BIN)


# --- losses


def outputs(vote, *, heatmap=None, confidence=0.0, log_spread=0.0):
    people, joints = vote.shape[:2]
    if heatmap is None:
        heatmap = encode(torch.zeros(people, joints, 3), SIGMA, BINS).log()
    return Outputs(
        vote=vote,
        heatmap=heatmap,
        part=torch.zeros(people, 4, 25),
        confidence=torch.full((people, joints), float(confidence)),
        log_spread=torch.full((people, joints), float(log_spread)),
        visible=torch.zeros(people, joints),
        level_joints=(vote, vote),
    )


def targets(joints):
    known = torch.ones(joints.shape[:2], dtype=torch.bool)
    return Targets(joints=joints, known=known, visible=known.float(), part=torch.tensor([[1, 2, 0, -1]] * len(joints)))


def truth(people=3):
    return torch.randn(people, 26, 3, generator=torch.Generator().manual_seed(0)) * 0.4


def test_exact_joints_cost_nothing():
    terms = losses(outputs(truth()), targets(truth()))
    assert terms["vote"] == 0 and terms["level"] == 0
    # the heatmap has no bin at zero: what is left of its decoding is half a millimetre an axis
    assert terms["mpjpe"] < 2e-3
    assert total(terms).item() == pytest.approx(sum(v.item() for n, v in terms.items() if n != "mpjpe"), rel=1e-5)


def test_the_vote_costs_its_distance():
    shift = torch.tensor([0.3, 0.0, -0.4])
    assert losses(outputs(truth() + shift), targets(truth()))["vote"].item() == pytest.approx(VOTE * 0.5, rel=1e-4)


def test_every_level_and_the_joints_cost_their_distance_too():
    """Not its square, as in the released code."""
    shift = torch.tensor([0.3, 0.0, -0.4])
    terms = losses(outputs(truth() + shift), targets(truth()))
    assert terms["level"].item() == pytest.approx(2 * LEVEL * 0.5, rel=1e-4)
    # a heatmap about the vote is decoded half a millimetre off an axis
    assert terms["joints"].item() == pytest.approx(JOINTS * 0.5, rel=5e-3)


def test_gradients_at_exact_joints_are_finite():
    vote = truth().requires_grad_()
    total(losses(outputs(vote), targets(truth()))).backward()
    assert torch.isfinite(vote.grad).all()


def test_the_heatmap_is_learned_about_the_vote_and_only_within_reach():
    joints = truth()
    far = joints.clone()
    far[0] += WINDOW + 0.1
    heatmap = encode(torch.zeros(3, 26, 3), SIGMA, BINS).log().requires_grad_()
    losses(outputs(far, heatmap=heatmap), targets(joints))["heatmap"].backward()
    # the right heatmap is the optimum, and one out of reach is not pulled at all
    assert heatmap.grad.abs().max() < 1e-6
    wrong = torch.zeros(3, 26, 3, BINS, requires_grad=True)
    losses(outputs(far, heatmap=wrong), targets(joints))["heatmap"].backward()
    assert wrong.grad[0].abs().max() == 0 and wrong.grad[1:].abs().min() > 0
    entropy = -(encode(torch.tensor(0.0), SIGMA, BINS) * encode(torch.tensor(0.0), SIGMA, BINS).log()).sum()
    best = losses(outputs(joints), targets(joints))["heatmap"]
    assert best.item() == pytest.approx(HEATMAP * entropy.item(), rel=1e-4)


def spoiled(seed=1):
    """Votes whose errors are on both sides of ten centimetres, and those errors."""
    shift = torch.randn(40, 26, 3, generator=torch.Generator().manual_seed(seed)) * 0.07
    joints = truth(40)
    made = outputs(joints + shift)
    return joints, made, (made.joints() - joints).norm(dim=-1)


def test_confidence_is_best_at_the_probability_of_a_hit():
    joints, made, error = spoiled()
    rate = (error < 0.1).float().mean()
    assert 0.1 < rate < 0.9
    logit = torch.logit(rate)
    at = {d: losses(replace(made, confidence=made.confidence * 0 + logit + d), targets(joints)) for d in (-0.2, 0, 0.2)}
    assert at[0]["confidence"] < min(at[-0.2]["confidence"], at[0.2]["confidence"])
    confidence = (made.confidence * 0 + logit).requires_grad_()
    losses(replace(made, confidence=confidence), targets(joints))["confidence"].backward()
    assert abs(confidence.grad.sum()) < 1e-5 * CONFIDENCE


def test_spread_is_best_at_the_expected_distance():
    joints, made, error = spoiled()
    log_spread = (made.log_spread * 0 + error.mean().log()).requires_grad_()
    losses(replace(made, log_spread=log_spread), targets(joints))["spread"].backward()
    assert abs(log_spread.grad.sum()) < 1e-5 * SPREAD
    for other in (0.8, 1.25):
        there = losses(replace(made, log_spread=log_spread + np.log(other)), targets(joints))["spread"]
        assert there > losses(replace(made, log_spread=log_spread), targets(joints))["spread"]


def test_confidence_and_spread_never_pull_at_the_joints():
    joints, made, _ = spoiled()
    vote = made.vote.clone().requires_grad_()
    terms = losses(replace(made, vote=vote), targets(joints))
    assert not (terms["confidence"] + terms["spread"] + terms["heatmap"]).requires_grad
    assert terms["vote"].requires_grad and terms["joints"].requires_grad


def test_padding_has_no_part():
    made = outputs(truth())
    part = torch.zeros(3, 4, 25)
    part[:, 3, 7] = 50.0
    a, b = (losses(replace(made, part=p), targets(truth()))["part"] for p in (torch.zeros(3, 4, 25), part))
    assert a == b


def test_joints_whose_truth_is_unknown_teach_nothing():
    joints, made, _ = spoiled()
    aims = targets(joints)
    known = aims.known.clone()
    known[:, 5] = False
    known[3] = False
    lost = joints.clone()
    lost[~known] = float("nan")
    told = losses(made, replace(aims, known=known))
    blind = losses(made, replace(aims, joints=lost, known=known))
    for name, value in told.items():
        assert value == blind[name] and torch.isfinite(value), name
    assert told["vote"] != losses(made, aims)["vote"]
    nobody = losses(made, replace(aims, known=known & False))
    assert nobody["vote"] == nobody["joints"] == nobody["heatmap"] == 0
    vote = made.vote.clone().requires_grad_()
    total(losses(replace(made, vote=vote), replace(aims, joints=lost, known=known))).backward()
    assert torch.isfinite(vote.grad).all() and not vote.grad[~known].any() and vote.grad[known].any()


def test_visibility_is_learned():
    aims = targets(truth())
    aims = replace(aims, visible=aims.visible * (torch.arange(26) % 2 == 0))
    visible = torch.zeros(3, 26, requires_grad=True)
    losses(replace(outputs(truth()), visible=visible), aims)["visible"].backward()
    assert (visible.grad[:, ::2] < 0).all() and (visible.grad[:, 1::2] > 0).all()


# --- schedule and optimizers


def test_the_rate_rises_stays_and_falls_to_nothing():
    done = np.linspace(0, 1, 2001)
    factor = np.array([rate_factor(d, RECIPE) for d in done])
    assert (factor >= 0).all() and (factor <= 1).all() and factor[0] > 0 and factor[-1] == 0
    rise, fall = done < RECIPE.warmup, done > 1 - RECIPE.cool
    assert (np.diff(factor[rise]) >= 0).all() and (np.diff(factor[fall]) < 0).all()
    np.testing.assert_array_equal(factor[~rise & ~fall], 1)
    assert np.abs(np.diff(factor)).max() < 0.03
    assert rate_factor(1.5, RECIPE) == 0


def test_every_weight_is_learned_once():
    network = PoseNet(TINY)
    made = optimizers(network, RECIPE)
    grouped = [id(p) for o in made for group in o.param_groups for p in group["params"]]
    assert sorted(grouped) == sorted(id(p) for p in network.parameters())
    hidden = {id(p) for group in made[1].param_groups for p in group["params"]}
    names = {name for name, value in network.named_parameters() if id(value) in hidden}
    assert "bottleneck.blocks.0.attention.query.weight" in names
    assert not any(name.startswith(("anchors", "part", "stem.voxel", "joint.heatmap")) for name in names)
    assert all(dict(network.named_parameters())[name].ndim == 2 for name in names)
    assert len(optimizers(network, replace(RECIPE, muon_rate=0.0))) == 1


def test_the_mean_of_the_weights_follows_them():
    network = torch.nn.Linear(1, 1)
    mean = {name: torch.zeros_like(value) for name, value in network.named_parameters()}
    average(mean, network, 0, 0.999)
    torch.testing.assert_close(mean["weight"], network.weight.detach() * 0.9)
    for step in range(1, 60):
        average(mean, network, step, 0.999)
    torch.testing.assert_close(mean["weight"], network.weight.detach(), rtol=1e-3, atol=1e-6)


def test_the_released_schedule():
    cosine = recipe_of(Pretrain, "paper")
    assert rate_factor(0, cosine) == pytest.approx(0.1) and rate_factor(1, cosine) == pytest.approx(1e-3)
    assert rate_factor(cosine.warmup, cosine) == 1
    # half of the way down, half of the rate
    middle = cosine.warmup + (1 - cosine.warmup) / 2
    assert rate_factor(middle, cosine) == pytest.approx((1 + 1e-3) / 2)
    factor = np.array([rate_factor(d, cosine) for d in np.linspace(cosine.warmup, 1, 500)])
    assert (np.diff(factor) < 0).all()


def test_lengths_of_bones_and_their_symmetry():
    joints = truth()
    exact = losses(outputs(joints), targets(joints), bone=2.0, symmetry=3.0)
    # what the heatmap has no bin for is half a millimetre an axis
    assert exact["bone"] < 2 * 3e-3
    stretched = losses(outputs(joints * 1.1), targets(joints), bone=2.0)
    lengths = torch.stack([(joints[:, a] - joints[:, b]).norm(dim=-1) for a, b in BODY26.bones])
    assert stretched["bone"].item() == pytest.approx(2.0 * 0.1 * lengths.mean().item(), abs=4e-3)
    # a body and its mirror image have even sides together
    even = joints.clone()
    even[:, [BODY26.flip[j] for j in range(26) if "left" in BODY26.joints[j]]] = even[
        :, [j for j in range(26) if "left" in BODY26.joints[j]]
    ] * torch.tensor([-1.0, 1, 1])
    middle = [j for j, name in enumerate(BODY26.joints) if "_" not in name or name == "head_center"]
    even[:, middle, 0] = 0.0
    assert losses(outputs(even), targets(joints), symmetry=3.0)["symmetry"] < 3 * 3e-3
    assert losses(outputs(joints), targets(joints), symmetry=3.0)["symmetry"] > 0.1


# --- batches


def assert_same_chunks(a, b):
    for left, right in zip(a, b, strict=True):
        for x, y in zip(left, right, strict=True):
            assert x.keys() == y.keys()
            for name in x:
                np.testing.assert_array_equal(np.asarray(x[name]), np.asarray(y[name]), err_msg=name)


def chunks(recipe, start=0, steps=3 * BATCHES):
    people = Chunks(
        source=make_setup(recipe).source, task=TASK, batch=recipe.batch, seed=recipe.seed, start=start, steps=steps
    )
    return list(loader(people, workers=recipe.workers))


def test_chunks_are_the_same_from_any_start():
    whole = chunks(RECIPE)
    assert len(whole) == 3 and all(len(batches) == BATCHES for batches in whole)
    assert_same_chunks(whole[1:], chunks(RECIPE, start=1))
    assert_same_chunks(whole[2:], chunks(RECIPE, start=2))
    joints = np.concatenate([b["joints"] for batches in whole for b in batches])
    assert len(np.unique(joints[:, 5], axis=0)) == len(joints) == RECIPE.people


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_go_on_when_their_whole_group_is_told_to_stop(number):
    """The run needs them for the batches that it finishes before it saves."""
    people = Chunks(
        source=make_setup(RECIPE).source, task=TASK, batch=RECIPE.batch, seed=RECIPE.seed, start=0, steps=3 * BATCHES
    )
    made = []
    for batches in loader(people, workers=1):
        for worker in multiprocessing.active_children():
            os.kill(worker.pid, number)
        made.append(batches)
    assert_same_chunks(made, chunks(RECIPE))


def test_the_last_chunk_may_be_short():
    whole, short = chunks(RECIPE), chunks(RECIPE, steps=BATCHES + 3)
    assert [len(batches) for batches in short] == [BATCHES, 3]
    assert_same_chunks(whole[:1], short[:1])


@pytest.mark.parametrize("ranks", [2, 4])
def test_processes_share_every_batch_out(ranks):
    """Together they show the people of one process, batch by batch, and nobody twice."""
    common = {
        "source": make_setup(RECIPE).source,
        "task": TASK,
        "batch": 8,
        "seed": 5,
        "start": 0,
        "steps": BATCHES + 1,
    }
    (alone,) = (list(loader(Chunks(**common), workers=0)),)
    shared = [list(loader(Chunks(**common, rank=rank, ranks=ranks), workers=0)) for rank in range(ranks)]
    for c, batches in enumerate(alone):
        for k, batch in enumerate(batches):
            joints = np.concatenate([one[c][k]["joints"] for one in shared])
            assert len(joints) == 8
            order = [np.argsort(j[:, 0, 0], kind="stable") for j in (joints, batch["joints"])]
            np.testing.assert_array_equal(joints[order[0]], batch["joints"][order[1]])


@pytest.fixture
def asked(monkeypatch):
    """(index, hard) of everybody who is made."""
    made = []
    original = Generator.person

    def person(self, seed, index, *, hard):
        made.append((index, hard))
        return original(self, seed, index, hard=hard)

    monkeypatch.setattr(Generator, "person", person)
    return made


def test_difficulty_rises_over_the_first_share_of_the_run(asked):
    chunks(replace(RECIPE, scene="wild", easy=0.5, batch=4, people=96))
    # lane by lane
    index, hard = np.array(sorted(asked)).T
    np.testing.assert_array_equal(index, np.arange(96))
    ceiling = np.minimum(index / 48, 1)
    assert hard[0] == 0 and (hard <= ceiling).all()
    # below the ceiling every difficulty goes on being seen, the harder ones more often: its mean is two thirds
    assert (hard[1:] / ceiling[1:]).mean() == pytest.approx(2 / 3, abs=0.08) and hard[48:].min() < 0.35


@pytest.mark.parametrize("scene", ["paper", "reference"])
def test_the_paper_s_people_are_all_as_hard_as_the_paper_s(asked, scene):
    """Everybody masked: `hard` would take the mask away."""
    chunks(replace(recipe_of(Pretrain, "paper"), size="tiny", scene=scene, batch=4, people=32, workers=0))
    assert {hard for _, hard in asked} == {1.0}
    asked.clear()
    chunks(replace(RECIPE, scene=scene, easy=0.5, batch=4, people=96))
    assert [hard for _, hard in sorted(asked)] == [min(k / 48, 1.0) for k in range(96)]


def test_easier_people_are_seen_better():
    generator = Generator(scene=SCENES["wild"])
    easy, full = (np.mean([generator.person(1, k, hard=h).facts.visible for k in range(64)]) for h in (0.0, 1.0))
    assert easy > full + 0.03


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_nothing(workers):
    assert_same_chunks(chunks(RECIPE), chunks(replace(RECIPE, workers=workers)))


def test_numbers_of_numpy_paths_and_one_name_alone_are_settings_too():
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
        # without a file they would choose nobody
        ({"subjects": ("a",)}, "subjects are of captured clips: name their file by motion too"),
        *(({"keep_anchors": value}, "keep_anchors must be True or False, got .*") for value in ("false", 0, None)),
    ],
)
def test_a_recipe_refuses_what_is_no_such_setting(change, message):
    with pytest.raises(InputError, match=f"^{message}$"):
        recipe_of(Finetune, data="a", **change) if "keep_anchors" in change else Pretrain(**change)


def test_disturbed_people_have_their_joints_and_more_or_other_points():
    sample = Generator(scene=SCENES["wild"], measure=False).person(2, 0).sample
    kept = sample.points.copy()
    assert disturbed(sample, strays=0.0, noise=0.0, rng=np.random.default_rng(0)) is sample
    more = [disturbed(sample, strays=1.0, noise=0.0, rng=np.random.default_rng(k)) for k in range(40)]
    for one in more:
        count = len(sample.points)
        np.testing.assert_array_equal(one.points[:count], sample.points)
        assert (one.part[count:] == 0).all() and len(one.part) == len(one.points) and one.pose is sample.pose
        np.testing.assert_array_equal(one.center, center_of(one.points))
    assert max(len(one.points) for one in more) > len(sample.points) + 50
    steps = []
    for seed in range(40):
        one = disturbed(sample, strays=0.0, noise=1.0, rng=np.random.default_rng(seed))
        steps.append((one.points - sample.points).std())
        assert one.points.dtype == np.float32 and np.array_equal(one.part, sample.part)
    assert 0.003 < min(steps) < 0.01 and 0.04 < max(steps) < 0.09
    share = [disturbed(sample, strays=0.3, noise=0.0, rng=np.random.default_rng(k)) is not sample for k in range(300)]
    assert 0.2 < np.mean(share) < 0.4
    np.testing.assert_array_equal(sample.points, kept)


def test_sources_go_to_processes_that_do_not_fork(tmp_path):
    motion = write_amass(tmp_path / "walk_poses.npz", *a_clip(40))
    source = SyntheticSource(scene="wild", seed=3, motion=str(motion), captured=0.5)
    want = source.example(1)
    chunks = Chunks(source=source, task=TASK, batch=2, seed=3, start=0, steps=8)
    # what is remembered stays behind
    sent = pickle.dumps(chunks)
    assert len(sent) < 20_000
    np.testing.assert_array_equal(pickle.loads(sent).source.example(1).points, want.points)
    generator = Generator(scene="paper")
    there = pickle.loads(pickle.dumps(generator))
    np.testing.assert_array_equal(there.person(1, 2).sample.points, generator.person(1, 2).sample.points)


def test_weights_decay():
    groups = [g for o in optimizers(PoseNet(preset("tiny")), RECIPE) for g in o.param_groups]
    (alone,) = optimizers(PoseNet(preset("tiny")), replace(RECIPE, muon_rate=0.0))
    assert {g["weight_decay"] for g in [*groups, *alone.param_groups]} == {RECIPE.decay} != {0.0}


def test_a_validation_is_the_mean_error_in_mm(tmp_path):
    joints = np.random.default_rng(0).normal(size=(3, 26, 3))
    joints[0, 4] = np.nan
    people = [SimpleNamespace(joints=one) for one in joints]

    def found(network, some, *, device):
        return np.nan_to_num(np.stack(some)) + [0.03, 0.0, 0.04]

    task = SimpleNamespace(collate=lambda some: [one.joints for one in some], joints=found)
    job = SimpleNamespace(validation=lambda: people, task=task, joints=SMPL24)
    assert Validation(job, RECIPE, tmp_path).run(None, 0, "cpu") == pytest.approx(50)
