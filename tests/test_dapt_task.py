"""Training of the DAPT network: losses, batches, gradients, transfer between stages, batch norm statistics."""

import math
import pickle
import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from hypothesis import given, settings, strategies as st
from safetensors.torch import load_file
from training_runs import refused

from lidarpose.errors import InputError
from lidarpose.models.dapt.dapt_config import FAULTS, named_config
from lidarpose.models.dapt.dapt_net import DaptNet, DaptOutputs, to_tensors
from lidarpose.models.dapt.voxel_tables import LAYOUTS
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14
from lidarpose.train import loop, run_dir
from lidarpose.train.augment import Example
from lidarpose.train.data_loader import Chunks
from lidarpose.train.networks import finetuned_network, pretraining_network
from lidarpose.train.objectives.dapt_losses import DaptTargets, finetuning, log_gaussian, pretraining
from lidarpose.train.objectives.dapt_objective import DaptObjective, finetuning_config, pretraining_config, small
from lidarpose.train.objectives.dapt_transfer import transferred
from lidarpose.train.objectives.objective import one_process, total
from lidarpose.train.optim import optimizers, rate_factor, set_rates
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.setup import TrainSetup
from lidarpose.train.validation import update_batch_norms, validate

TINY = {
    "encoder_depths": (1, 1, 1),
    "encoder_channels": (16, 16, 32),
    "encoder_heads": (1, 1, 2),
    "decoder_depths": (1, 1),
    "decoder_channels": (16, 16),
    "decoder_heads": (1, 2),
    "anchor_channels": (16, 24, 16),
    "strides": (2, 2),
    "grid": 0.04,
    "patch": 512,
    "drop_path": 0.0,
    "anchor_dropout": 0.0,
}
PRETRAIN = DaptObjective(config=replace(pretraining_config(), **TINY), stage="pretrain")
# with a head that the stage does not use
FINETUNE = DaptObjective(config=replace(finetuning_config("waymo"), auxiliary=True, **TINY), stage="finetune")
# Table 3, rows 2 and 1: anchors on the finest level with coordinates, and the neck prn
FINEST = DaptObjective(config=replace(PRETRAIN.config, neck="finest", parts=0), stage="finetune")
PRN = DaptObjective(config=replace(FINEST.config, neck="prn"), stage="pretrain")
TASKS = {"pretrain": PRETRAIN, "finetune": FINETUNE, "finest": FINEST, "prn": PRN}
BOTH = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
pytestmark = pytest.mark.usefixtures("one_thread")


def person(n, seed=0, labelled=None, size=(0.2, 0.3, 0.6)):
    """n points; labelled: number of joints with a label, None for all."""
    rng = np.random.default_rng([seed, n])
    joints = rng.normal(0, size, (26, 3)).astype(np.float32)
    joints[rng.permutation(26)[26 if labelled is None else labelled :]] = np.nan
    return Example(
        points=rng.normal(0, size, (n, 3)).astype(np.float32),
        part=rng.integers(-1, 25, n),
        joints=joints,
        visible=np.full(26, np.nan, np.float32),
        view=np.zeros(5, np.float32),
        seed=seed + 100,
    )


def network(task, seed=0):
    torch.manual_seed(seed)
    return task.network()


def gradients(net, terms):
    net.zero_grad()
    total(terms).backward()
    return {name: value.grad.clone() for name, value in net.named_parameters()}


# --- the equations, against plain loops


def made(seed=0, people=3, voxels=7):
    """Random outputs of all heads, and targets with some unknown labels."""
    torch.manual_seed(seed)
    bins = (11, 13, 17)
    outputs = DaptOutputs(
        anchors=torch.zeros(people, 4, 1),
        points=torch.zeros(voxels, 1),
        logits_x=torch.randn(people, 4, bins[0]) * 3,
        logits_y=torch.randn(people, 4, bins[1]) * 3,
        logits_z=torch.randn(people, 4, bins[2]) * 3,
        inter=torch.randn(people, 4, 3),
        parts=torch.randn(voxels, 25) * 2,
        coordinates=torch.randn(people, 4, 3),
        low=(-1.0, -0.5, -2.0),
        step=(0.2, 0.1, 0.25),
    )
    # some are outside the range of the heatmaps
    joints = torch.randn(people, 4, 3)
    weight = torch.tensor([[1.0, 0, 1, 1], [0, 0, 0, 0], [0, 1, 0, 0]])
    return outputs, DaptTargets(joints=joints, weight=weight, part=torch.tensor([0, 24, -1, 3, 3, -1, 0]))


MENDED = finetuning_config("humanm3")


def numbers(value):
    return np.asarray(value, float)


def slow_regression(joints, targets):
    people = []
    for predicted, true, weight in zip(joints, numbers(targets.joints), numbers(targets.weight), strict=True):
        if sum(weight) > 0:
            distances = [math.dist(*pair) * w for *pair, w in zip(predicted, true, weight, strict=True)]
            people.append(sum(distances) / sum(weight))
    return sum(people) / len(people)


def slow_segmentation(logits, part):
    voxels = []
    for row, label in zip(numbers(logits), part.tolist(), strict=True):
        if label >= 0:
            voxels.append(-math.log(math.exp(row[label]) / sum(math.exp(value) for value in row)))
    return sum(voxels) / len(voxels)


def slow_heatmap(outputs, targets):
    true, weight = numbers(targets.joints), numbers(targets.weight)
    everything, people = 0.0, 0
    for b in range(len(true)):
        people += any(weight[b] > 0)
        for j in range(len(true[b])):
            for axis, low, step in zip("xyz", outputs.low, outputs.step, strict=True):
                row = numbers(getattr(outputs, f"logits_{axis}"))[b, j]
                at = min(max((true[b, j]["xyz".index(axis)] - low) / step, 0), len(row) - 1)
                truth = [math.exp(-((k - at) ** 2) / (2 * 2.0**2)) for k in range(len(row))]
                believed = [math.exp(value) for value in row]
                for h, q in zip(truth, believed, strict=True):
                    h, q = h / sum(truth), q / sum(believed)
                    everything += weight[b, j] * h * math.log(h / q)
    return everything / people


@pytest.mark.parametrize("seed", range(3))
def test_losses_equal_equations_9_and_10(seed):
    outputs, targets = made(seed)
    terms = pretraining(outputs, targets, MENDED)
    regression = slow_regression(numbers(outputs.coordinates), targets)
    assert terms["regression"].item() == pytest.approx(0.5 * regression, rel=1e-5)
    assert terms["segmentation"].item() == pytest.approx(slow_segmentation(outputs.parts, targets.part), rel=1e-5)
    assert total(terms).item() == pytest.approx(terms["regression"].item() + terms["segmentation"].item(), rel=1e-6)
    assert finetuning(outputs, targets, MENDED).keys() == {"heatmap", "mpjpe"}
    terms = finetuning(outputs, targets, MENDED)
    assert terms["heatmap"].item() == pytest.approx(slow_heatmap(outputs, targets), rel=1e-5)
    # without heatmaps, fine-tuning uses Eq. 7, too
    bare = replace(outputs, logits_x=None, voted=outputs.coordinates * 2)
    assert finetuning(bare, targets, MENDED)["regression"].item() == pytest.approx(regression, rel=1e-5)
    terms = pretraining(bare, targets, MENDED)
    assert terms["regression"].item() == pytest.approx(regression, rel=1e-5)
    assert terms["vote"].item() == pytest.approx(slow_regression(numbers(bare.voted), targets), rel=1e-5)
    assert terms["segmentation"].item() == pytest.approx(slow_segmentation(outputs.parts, targets.part), rel=1e-5)
    terms = finetuning(outputs, targets, MENDED)
    error = (numbers(outputs.joints()) - numbers(targets.joints))[targets.weight.bool().numpy()]
    assert terms["mpjpe"].item() == pytest.approx(np.linalg.norm(error, axis=-1).mean(), rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_losses_of_the_released_code(seed):
    outputs, targets = made(seed)
    joints, weight = numbers(targets.joints), numbers(targets.weight)

    def squared(predicted):
        distances = ((numbers(predicted) - joints) ** 2).sum(-1) * weight
        return np.mean([row.sum() / w.sum() for row, w in zip(distances, weight, strict=True) if w.any()])

    terms = pretraining(outputs, targets, replace(MENDED, squared_distance=True, ignore_background=True))
    assert terms["regression"].item() == pytest.approx(0.5 * squared(outputs.coordinates), rel=1e-5)
    on_body = torch.where(targets.part == 0, -1, targets.part)
    assert terms["segmentation"].item() == pytest.approx(slow_segmentation(outputs.parts, on_body), rel=1e-5)
    faults = dict(squared_distance=True, unnormalized_heatmaps=True, auxiliary_loss=True)
    terms = finetuning(outputs, targets, replace(MENDED, **faults))
    assert terms["auxiliary"].item() == pytest.approx(0.2 * squared(outputs.inter), rel=1e-5)
    expected = 0.0
    for axis, low, step in zip("xyz", outputs.low, outputs.step, strict=True):
        logits = numbers(getattr(outputs, f"logits_{axis}"))
        index, place = np.arange(logits.shape[-1]), (joints[..., "xyz".index(axis)] - low) / step
        truth = np.exp(-((index - place[..., None]) ** 2) / (2 * 2.0**2))
        predicted = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
        expected += ((truth * np.log(truth / predicted)).mean(-1) * weight).sum() / weight.sum()
    assert terms["heatmap"].item() == pytest.approx(expected, rel=1e-4)
    # coordinates instead of heatmaps, and the neck prn
    bare = replace(outputs, logits_x=None, voted=outputs.coordinates * 2)
    assert finetuning(bare, targets, replace(MENDED, squared_distance=True))["regression"].item() == pytest.approx(
        squared(outputs.coordinates), rel=1e-5
    )
    terms = pretraining(bare, targets, replace(MENDED, squared_distance=True, ignore_background=True))
    assert terms["vote"].item() == pytest.approx(squared(bare.voted), rel=1e-5)
    assert terms["segmentation"].item() == pytest.approx(slow_segmentation(outputs.parts, on_body), rel=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.floats(-1e4, 1e4), st.integers(1, 300))
def test_log_gaussian_targets_are_distributions(place, bins):
    target = log_gaussian(torch.tensor([place]), bins).exp()
    assert abs(target.sum().item() - 1) < 1e-5
    # the target of a joint outside the range is at its end
    assert abs(target.argmax().item() - min(max(place, 0), bins - 1)) <= 0.5 + 1e-3


def test_losses_use_background_and_ignore_unlabeled_joints():
    outputs, targets = made()
    parts, logits = (value.clone().requires_grad_() for value in (outputs.parts, outputs.logits_x))
    outputs = replace(outputs, parts=parts, logits_x=logits)
    pretraining(outputs, targets, MENDED)["segmentation"].backward()
    assert (parts.grad.abs().amax(1) > 0).tolist() == (targets.part >= 0).tolist()
    finetuning(outputs, targets, MENDED)["heatmap"].backward()
    assert ((logits.grad.abs().amax(-1) > 0) == targets.weight.bool()).all()


# --- batches


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("layout", LAYOUTS)
def test_collate_is_independent_of_batch_and_point_order(task, layout):
    task = replace(task, layout=layout)
    one, mates = person(300), [person(150, 1), person(0, 2), person(700, 3)]
    alone_, among = task.collate([one]), task.collate([*mates, one])
    rows = slice(len(among.tables.features) - len(alone_.tables.features), None)
    np.testing.assert_array_equal(alone_.tables.features, among.tables.features[rows])
    np.testing.assert_array_equal(alone_.joints[0], among.joints[3])
    order = np.random.default_rng(0).permutation(300)
    shuffled = task.collate([replace(one, points=one.points[order], part=one.part[order])])
    np.testing.assert_array_equal(alone_.tables.features, shuffled.tables.features)
    if task.stage == "pretrain":
        np.testing.assert_array_equal(alone_.part, among.part[rows])
        np.testing.assert_array_equal(alone_.part, shuffled.part)
    net = network(task).eval()
    np.testing.assert_allclose(task.joints(net, alone_)[0], task.joints(net, among)[3], atol=1e-5)


@pytest.mark.long
@BOTH
def test_terms_are_independent_of_order_of_people(task):
    people = [person(n, n) for n in (40, 0, 300, 9)]
    net = network(task).eval()
    forth, back = (task.collate(order) for order in (people, people[::-1]))
    np.testing.assert_allclose(task.joints(net, forth), task.joints(net, back)[::-1], atol=1e-5)
    terms, reversed_terms = (task.terms(net, arrays) for arrays in (forth, back))
    torch.testing.assert_close(terms, reversed_terms, rtol=1e-5, atol=1e-6)


def test_people_larger_than_patch_do_not_affect_others():
    task = replace(PRETRAIN, config=replace(PRETRAIN.config, patch=64))
    large, little = person(400, 1), person(30)
    alone_, among = task.collate([little]), task.collate([large, little])
    net = network(task).eval()
    np.testing.assert_allclose(task.joints(net, alone_)[0], task.joints(net, among)[1], atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1), st.integers(0, 200), st.floats(0.02, 0.5))
def test_collate_takes_most_frequent_part_of_voxel(seed, n, size):
    one = replace(person(n, 3, size=size), seed=seed)
    arrays = PRETRAIN.collate([one])
    cells = {}
    for point, part in zip(one.points, one.part.tolist(), strict=True):
        cells.setdefault(tuple(np.floor(point / 0.04).tolist()), []).append((part, point.tolist()))
    assert len(arrays.part) == max(len(cells), 1)
    for row, part in zip(arrays.tables.features, arrays.part.tolist(), strict=True):
        here = cells.get(tuple(np.floor(row / 0.04).tolist()), [])
        assert not here or row.tolist() in [point for _, point in here]
        known = [p for p, _ in here if p >= 0]
        assert part == (-1 if not known else min(set(known), key=lambda p: (-known.count(p), p)))


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.sampled_from([0.3, 5.0, 2000.0]))
def test_example_size_counts_occupied_cells(seed, n, reach):
    example = replace(person(5), points=np.random.default_rng(seed).uniform(-reach, reach, (n, 3)).astype(np.float32))
    assert example.size == len({tuple(cell) for cell in np.floor(example.points * 10).tolist()})


def test_prn_collate_labels_voxels_by_nearest_joint():
    people = [person(60, 1, labelled=5, size=0.1), person(0, 2), person(40, 3, labelled=0), person(60, 4)]
    arrays = PRN.collate(people)
    rows = np.repeat(np.arange(4), arrays.tables.levels[0].lengths)
    want = []
    for b, at in zip(rows, arrays.tables.features, strict=True):
        distances = [math.dist(at, joint) if np.isfinite(joint).all() else math.inf for joint in arrays.joints[b]]
        nearest = min(distances)
        # far from all joints is background, if no joint lacks a label
        far = -1 if math.inf in distances else 0
        want.append(1 + distances.index(nearest) if nearest < 0.1 else far)
    # people without points or labels are not supervised
    want = np.where((rows == 0) | (rows == 3), want, -1)
    assert arrays.part.tolist() == want.tolist() and {0, -1} < set(arrays.part.tolist())


def test_collate_keeps_random_point_of_voxel():
    cloud = np.float32([[0.001, 0.001, 0.001], [0.02, 0.02, 0.02], [0.039, 0.039, 0.039], [-0.01, 0, 0]])
    cell = replace(person(4), points=cloud, part=np.array([7, 3, 3, -1]))
    batches = [PRETRAIN.collate([person(0), replace(cell, seed=seed)]) for seed in range(40)]
    assert {arrays.tables.features[2, 0] for arrays in batches} == set(cloud[:3, 0])
    assert all(arrays.part.tolist() == [-1, -1, 3] for arrays in batches)


@BOTH
def test_objective_and_batches_survive_pickling(task):
    arrays = task.collate([person(60), person(0, 1, labelled=3)])
    assert pickle.loads(pickle.dumps(task)) == task
    net = network(task).eval()
    terms, again = (task.terms(net, batch) for batch in (arrays, pickle.loads(pickle.dumps(arrays))))
    torch.testing.assert_close(terms, again, rtol=0, atol=0)


def test_objective_joints_are_those_of_head_and_stage():
    out = FINETUNE.joints(network(FINETUNE).eval(), FINETUNE.collate([person(50), person(5, 1)]))
    has = np.isin(BODY26.joints, WAYMO14.joints)
    assert out.shape == (2, 26, 3) and np.isfinite(out[:, has]).all() and np.isnan(out[:, ~has]).all()
    joints = np.arange(78, dtype=np.float32).reshape(26, 3)
    arrays = FINETUNE.collate([replace(person(9), joints=joints)])
    np.testing.assert_array_equal(arrays.joints[0], joints[[BODY26.index(name) for name in FINETUNE.config.joints]])
    task = DaptObjective(config=replace(named_config("paper"), **TINY), stage="pretrain")
    net, arrays = network(task).eval(), task.collate([person(70)])
    with torch.no_grad():
        outputs = net(to_tensors(arrays.tables))
    np.testing.assert_array_equal(task.joints(net, arrays), outputs.coordinates.numpy())
    np.testing.assert_array_equal(replace(task, stage="finetune").joints(net, arrays), outputs.joints().numpy())


# --- gradients


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("rare", [False, True])
def test_gradients_of_two_shares_average_to_whole_batch(task, rare):
    # people, labels and voxels are split unevenly; in training mode, a batch norm would see only its own half
    people = [person(40), person(200, 1, labelled=2), person(3, 2, labelled=0), person(0, 3), person(90, 4)]
    if rare:
        # only one joint and one point have labels, so that a share of the counts is less than one
        nothing = np.full((26, 3), np.nan, np.float32)
        hip = np.where(np.arange(26)[:, None] == BODY26.index("left_hip"), np.float32(0.2), nothing)
        people = [replace(one, joints=nothing, part=np.full(len(one.points), -1)) for one in people]
        people[4] = replace(people[4], joints=hip, part=np.where(np.arange(90) == 50, 4, -1))
    net = network(task).eval()
    whole = task.terms(net, task.collate(people))
    want = gradients(net, whole)
    halves = [task.collate(people[:1]), task.collate(people[1:])]
    counts = [[], []]
    for half, shared in zip(halves, counts, strict=True):
        task.terms(net, half, share=lambda count, shared=shared: shared.append(count) or count)
    assert len(counts[0]) == len(counts[1]) > 0
    means = [(a + b) / 2 for a, b in zip(*counts, strict=True)]
    gradients_of, terms = [], []
    for half in halves:
        answers = iter(means)
        terms.append(task.terms(net, half, share=lambda _, answers=answers: next(answers)))
        gradients_of.append(gradients(net, terms[-1]))
    for name, value in whole.items():
        torch.testing.assert_close((terms[0][name] + terms[1][name]) / 2, value, rtol=1e-4, atol=1e-6, msg=name)
    largest = max(value.abs().max() for value in want.values())
    # without sharing of counts, they differ
    naive = [gradients(net, task.terms(net, half, share=one_process)) for half in halves]
    off = 0.0
    for name, value in want.items():
        mean, unshared = ((a[name] + b[name]) / 2 for a, b in (gradients_of, naive))
        torch.testing.assert_close(mean, value, rtol=1e-3, atol=1e-6 * float(largest), msg=name)
        off = max(off, float((unshared - value).abs().max()))
    assert off > 1e-2 * largest


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("n", [1, 2, 1500])
def test_gradients_are_finite_for_all_parameters(task, layout, n):
    if task is PRN and n == 1:
        pytest.skip("its norms are torch's own, which need two rows")
    task = replace(task, layout=layout)
    net = network(task).train()
    terms = task.terms(net, task.collate([person(n)]))
    assert all(torch.isfinite(value) for value in terms.values())
    # each parameter has a gradient
    assert all(torch.isfinite(value).all() for value in gradients(net, terms).values())


@BOTH
def test_losses_of_people_without_labels_or_points(task):
    net = network(task).train()
    nothing = [replace(person(n, n, labelled=0), part=np.full(n, -1)) for n in (30, 0, 1)]
    terms = task.terms(net, task.collate(nothing))
    assert total(terms).item() == 0 and terms["mpjpe"].item() == 0
    assert all((value == 0).all() for value in gradients(net, terms).values())
    terms = task.terms(net, task.collate([person(0), person(0, 1, labelled=4)]))
    assert total(terms).item() > 0
    assert all(torch.isfinite(value).all() for value in gradients(net, terms).values())


@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
def test_only_unused_heads_of_stage_have_zero_gradients(stage):
    task = DaptObjective(config=replace(named_config("paper"), **TINY), stage=stage)
    net = network(task)
    of = gradients(net, task.terms(net, task.collate([person(60), person(9, 1)])))
    still = {name.split(".")[1] for name, value in of.items() if (value == 0).all()}
    assert still == ({"query", "inter_feat"} if stage == "pretrain" else {"coordinate", "feat", "inter_feat"})


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("layout", LAYOUTS)
def test_terms_under_bfloat16_autocast_are_close(task, layout):
    task = replace(task, layout=layout)
    net = network(task).train()
    people = [person(n, n) for n in (200, 0, 1, 600)]
    want = task.terms(net, task.collate(people))
    net = network(task).train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        terms = task.terms(net, task.collate(people))
        joints = task.joints(net, task.collate(people))
    for name, value in terms.items():
        assert value.dtype == torch.float32 and abs(value - want[name]) < 0.1 * want[name] + 0.05, name
    assert np.isfinite(joints[:, np.isin(BODY26.joints, task.config.joints)]).all()
    assert all(torch.isfinite(value).all() for value in gradients(net, terms).values())


# --- learning


@pytest.mark.long
@BOTH
def test_dapt_overfits_four_people(task):
    people = [person(30, k, size=0.25) for k in range(4)]
    if task is PRN:
        # its votes come from points near the joints
        near = [each.joints[np.arange(30) % 26] + np.float32(0.02) for each in people]
        people = [replace(each, points=points) for each, points in zip(people, near, strict=True)]
    arrays = task.collate(people)
    net = network(task).train()
    for module in net.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    losses = []
    for _ in range(150 if task is PRN else 60):
        terms = task.terms(net, arrays)
        optimizer.zero_grad()
        total(terms).backward()
        optimizer.step()
        losses.append({name: value.item() for name, value in terms.items()})
    for name, value in losses[-1].items():
        assert value < losses[0][name] / 2, name


# --- transfer between stages


def trained(config, seed=3):
    torch.manual_seed(seed)
    net = DaptNet(config).eval()
    for value in net.state_dict().values():
        if value.is_floating_point():
            value.copy_(torch.rand_like(value))
    return net


def test_transferred_copies_only_backbone():
    source = trained(PRETRAIN.config)
    before = {name: value.clone() for name, value in source.state_dict().items()}
    config = replace(FINETUNE.config, joints=HUMAN15.joints)
    torch.manual_seed(8)
    fresh = DaptNet(config).state_dict()
    torch.manual_seed(8)
    net = transferred(source, config)
    body = {n for n in fresh if n.startswith("backbone.") and "keypoint_embedding" not in n}
    assert net.config == config and net.training and 50 < len(body) < len(fresh)
    for name, value in net.state_dict().items():
        assert torch.equal(value, before[name] if name in body else fresh[name]), name
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 1
    assert all(torch.equal(before[name], value) for name, value in source.state_dict().items())


def test_transferred_copies_anchors_by_joint_name():
    source = trained(replace(PRETRAIN.config, joints=BODY26.joints[:25]))
    torch.manual_seed(8)
    net = transferred(source, FINETUNE.config, keep_anchors=True)
    torch.manual_seed(8)
    fresh = DaptNet(FINETUNE.config).backbone.keypoint_embedding
    for j, name in enumerate(FINETUNE.config.joints):
        # head_center is new
        want = fresh[j] if name == "head_center" else source.backbone.keypoint_embedding[BODY26.index(name)]
        assert torch.equal(net.backbone.keypoint_embedding[j], want), name
    assert BODY26.joints[25] == "head_center" and "head_center" in FINETUNE.config.joints


def test_transferred_copies_matching_heads():
    whole = replace(named_config("paper"), **TINY)
    source = trained(whole)
    # another range of z, fewer joints in another order
    config = replace(whole, joints=WAYMO14.joints, ranges=(*whole.ranges[:2], (-1.5, 1.5)))
    torch.manual_seed(8)
    net = transferred(source, config, keep_anchors=True)
    torch.manual_seed(8)
    fresh = DaptNet(config)
    old, new, begun = source.state_dict(), net.state_dict(), fresh.state_dict()
    anew = {name for name in new if torch.equal(new[name], begun[name]) and not torch.equal(new[name], old[name])}
    assert anew == {
        "heads.query.fcs.2.fc2.weight",
        "heads.query.fcs.2.fc2.bias",
        "heads.query.coord_range",
        "heads.query.joint_wise_weight",
    }
    rows = old["heads.inter_feat.fc.fc2.weight"].reshape(26, 3, -1)
    for j, name in enumerate(WAYMO14.joints):
        assert torch.equal(new["heads.inter_feat.fc.fc2.weight"].reshape(14, 3, -1)[j], rows[BODY26.index(name)])
    again = transferred(source, whole, keep_anchors=True).state_dict()
    buffers = ("heads.query.coord_range", "heads.query.joint_wise_weight")
    assert all(torch.equal(value, again[name]) for name, value in old.items() if name not in buffers)
    # the coordinate head has another name if it is the only head of anchors
    bare = transferred(source, replace(PRETRAIN.config, joints=SMPL24.joints), keep_anchors=True).state_dict()
    assert torch.equal(bare["heads.query.fc.fc2.weight"], old["heads.coordinate.fc.fc2.weight"])
    assert torch.equal(bare["heads.feat.fc.3.weight"], old["heads.feat.fc.3.weight"])


def test_transferred_copies_neck():
    for neck in ("finest", "prn"):
        source = trained(replace(PRN.config, neck=neck))
        config = replace(source.config, name="waymo", joints=WAYMO14.joints)
        old, new = (net.state_dict() for net in (source, transferred(source, config, keep_anchors=True)))
        table = "backbone.keypoint_embedding" if neck == "finest" else "heads.prn.joint"
        by_joint = {table} | {f"heads.prn.vote.parts.7.{k}" for k in ("weight", "bias") if neck == "prn"}
        assert all(torch.equal(value, new[name]) for name, value in old.items() if name not in by_joint)
        shift = {name: 0 if name == table else 1 for name in by_joint}
        for j, joint in enumerate(WAYMO14.joints):
            if joint in HUMAN15.joints:
                for name in by_joint:
                    assert torch.equal(new[name][j + shift[name]], old[name][HUMAN15.joints.index(joint) + shift[name]])
        with refused("neck does not fit|tensor backbone.* does not fit"):
            transferred(trained(PRETRAIN.config), config)


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"encoder_channels": (16, 32, 32)},
            r"tensor backbone.dec.dec1.up.proj_skip.0.weight does not fit: pretrain was pre-trained with \(16, 16\), "
            r"waymo has \(16, 32\)",
        ),
        (
            {"decoder_depths": (1, 2)},
            r"tensor backbone.dec.dec1.block1.attn.proj.bias does not fit: .* pre-trained with none, waymo has \(16,\)",
        ),
        ({"anchor_channels": (16, 24, 24)}, "tensor backbone.dec.dec_ke1.fc_in.0.bias does not fit"),
        ({"grid": 0.02}, "grid does not fit: pretrain was pre-trained with 0.04, waymo has 0.02: fine-tune with"),
        ({"strides": (2, 4)}, "strides does not fit"),
        ({"stale_convolution": True}, "stale_convolution does not fit"),
        ({"grid_from_minimum": True}, "grid_from_minimum does not fit"),
        ({"encoder_heads": (2, 1, 2)}, "encoder_heads does not fit"),
        ({"anchor_heads": 2}, "anchor_heads does not fit"),
    ],
)
@pytest.mark.parametrize("keep", [False, True])
def test_transferred_rejects_mismatched_backbone(change, message, keep):
    with refused(message):
        transferred(trained(PRETRAIN.config), replace(FINETUNE.config, **change), keep_anchors=keep)


# --- settings


def test_dapt_training_configs_are_consistent():
    assert pretraining_config().joints == HUMAN15.joints
    assert not any(getattr(pretraining_config(), fault) for fault in FAULTS)
    for dataset in ("waymo", "humanm3", "lidarhuman26m", "sloper4d"):
        config = finetuning_config(dataset)
        assert not any(getattr(config, fault) for fault in FAULTS) and not config.auxiliary
        assert config.bins == named_config(dataset).bins
        DaptObjective(config=small(config), stage="finetune")
    DaptObjective(config=small(pretraining_config()), stage="pretrain")
    weights = [sum(v.numel() for v in DaptNet(c).parameters()) for c in (small(pretraining_config()), PRETRAIN.config)]
    assert 50e6 / 45 < weights[0] < 50e6 / 35 and weights[1] < weights[0]


def test_released_faults_are_options_of_training():
    options = tuple(f"{fault}=true" for fault in FAULTS)
    for head in ("coordinates", "heatmaps"):
        config, _ = pretraining_network(Pretrain(size="paper-tiny", head=head, options=options))
        assert all(getattr(config, fault) for fault in FAULTS) and bool(config.bins) == (head == "heatmaps")
        mended, _ = pretraining_network(Pretrain(size="paper-tiny", head=head))
        assert config.auxiliary == (head == "heatmaps")
        assert replace(config, **dict.fromkeys(FAULTS, False), auxiliary=False) == mended
    assert not DaptNet(config).backbone.keypoint_embedding.any() and DaptNet(mended).backbone.keypoint_embedding.all()
    recipe = Finetune(data=("a",), init="random", size="paper-tiny", options=options[:1])
    tuned, build = finetuned_network(recipe, None, HUMAN15, "humanm3")
    assert tuned.stale_convolution and not tuned.grid_from_minimum and build().config == tuned
    # the head of the auxiliary loss comes with fine-tuning, from random weights or pre-trained ones
    recipe = Finetune(data=("a",), size="paper-tiny", options=("auxiliary_loss",), init="random")
    tuned, build = finetuned_network(recipe, None, HUMAN15, "humanm3")
    assert tuned.auxiliary and build().config == tuned and DaptObjective(config=tuned, stage="finetune")
    pretrained, _ = pretraining_network(Pretrain(size="paper-tiny", options=("auxiliary_loss",)))
    assert not pretrained.auxiliary
    recipe = Finetune(data=("a",), keep_anchors=False, init="a")
    assert finetuned_network(recipe, trained(pretrained), HUMAN15, "humanm3")[0].auxiliary
    recipe = Finetune(data=("a",), init="random", size="paper-tiny", options=options[:1])
    with pytest.raises(InputError, match="trained without these options"):
        finetuned_network(recipe, trained(mended), HUMAN15, "humanm3")
    assert pretraining_network(Pretrain(size="paper-small", options=("anchor_dropout=0",)))[0].anchor_dropout == 0
    with pytest.raises(InputError, match="unknown option of .* 'grid': "):
        pretraining_network(Pretrain(size="paper-tiny", options=("grid=0.02",)))
    with pytest.raises(InputError, match="small has none: omit --options"):
        pretraining_network(Pretrain(size="small", options=options))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"stage": "train"}, "unknown stage of training 'train': .*pretrain"),
        ({"layout": "flat"}, "unknown layout 'flat'"),
        ({"stage": "pretrain"}, "pre-training needs coordinates and 25 parts, waymo has coordinates=False and parts=0"),
    ],
)
def test_dapt_objective_rejects_invalid_settings(change, message):
    with pytest.raises(InputError, match=message):
        replace(FINETUNE, **change)


def test_collate_rejects_invalid_people():
    for part in (np.array([0, 25, 3]), np.array([1, 2])):
        with pytest.raises(InputError, match="each of 3 points needs a part below 25"):
            PRETRAIN.collate([replace(person(3), part=part)])
    broken = person(5).points.copy()
    broken[2, 1] = np.nan
    with pytest.raises(InputError, match="points must be finite"):
        FINETUNE.collate([replace(person(5), points=broken)])


# --- statistics of batch norms


@dataclass(frozen=True)
class Fixed:
    """A source that repeats the same few people."""

    people: int

    def example(self, index):
        return person(40 + 20 * (index % self.people), index % self.people)


NORMS = ("running_mean", "running_var")
SHORT = Pretrain(
    size="paper-small", scene="paper", people=80, batch=4, workers=0, seed=5, rate=2e-3, muon_rate=0.0, ema=0.9,
    pictures=0, validate=1000,
)  # fmt: skip


def setup_of(task):
    source = Fixed(6)
    return TrainSetup(
        objective=task,
        source=source,
        people=SHORT.people,
        network=task.network,
        validation=lambda: [source.example(k) for k in range(6)],
        joints=HUMAN15,
        card={},
    )


def test_update_batch_norms_equals_torch_update_bn():
    batches = [PRETRAIN.collate([person(n, n) for n in sizes]) for sizes in ((50, 9), (300, 40), (80, 5, 7))]
    net, twin = network(PRETRAIN), network(PRETRAIN)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    update_batch_norms(net, PRETRAIN, batches)
    torch.optim.swa_utils.update_bn([to_tensors(arrays.tables) for arrays in batches], twin)
    assert not net.training and net.backbone.embedding.stem.norm.momentum == 0.01
    for name, value in net.state_dict().items():
        torch.testing.assert_close(value, twin.state_dict()[name], rtol=1e-5, atol=1e-6)
        assert torch.equal(value, before[name]) != name.endswith((*NORMS, "num_batches_tracked")), name


@pytest.mark.long
def test_update_batch_norms_improves_on_running_statistics():
    """After a few steps at a high rate, running statistics with momentum 0.01 are those of early weights."""
    source = Fixed(8)
    examples = [source.example(k) for k in range(8)]
    arrays = FINETUNE.collate(examples)
    net = network(FINETUNE).train()
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    for _ in range(60):
        optimizer.zero_grad()
        total(FINETUNE.terms(net, arrays)).backward()
        optimizer.step()
    stale, _ = validate(FINETUNE, net.eval(), examples, 8)
    update_batch_norms(net, FINETUNE, [arrays])
    anew, _ = validate(FINETUNE, net, examples, 8)
    assert anew < 0.6 * stale


@pytest.mark.long
@pytest.mark.parametrize(("task", "times"), [(PRETRAIN, 1.0), (FINETUNE, 10.0)], ids=("pretrain", "finetune"))
def test_resumed_dapt_run_ends_with_equal_weights_and_statistics(tmp_path, monkeypatch, task, times):
    """Three chunks, the last one of four steps. Statistics are those of the last whole chunk."""
    monkeypatch.setattr(loop, "SAVE_EVERY", -1.0)
    setup, recipe = (
        setup_of(replace(task, config=replace(task.config, drop_path=0.1))),
        replace(SHORT, heatmap_rate=times),
    )
    loop.train(recipe, tmp_path / "whole", setup=setup)
    halted = tmp_path / "halted"
    calls = []

    def once(self, *args, original=loop._Run._save):
        original(self)
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop._Run, "_save", once)
        with pytest.raises(KeyboardInterrupt):
            loop.train(recipe, halted, setup=setup)
    loop.train(recipe, halted, setup=setup, resume=True)
    for name in (run_dir.MODEL, run_dir.STATE, run_dir.BEST):
        one, other = (load_file(folder / name) for folder in (tmp_path / "whole", halted))
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one), name
    # the model has statistics of its own, the state for resuming has those of training
    model, state = load_file(halted / run_dir.MODEL), load_file(halted / run_dir.STATE)
    net = setup.objective.network()
    net.load_state_dict(model)
    chunks = Chunks(source=setup.source, objective=setup.objective, batch=4, seed=5, start=3, steps=20)
    update_batch_norms(net, setup.objective, chunks.batches_of(1))
    for name, value in net.state_dict().items():
        assert torch.equal(value, model[name]), name
        assert torch.equal(value, state[f"network.{name}"]) is False or not name.endswith(NORMS), name


@pytest.mark.parametrize("task", [FINETUNE, FINEST], ids=["heatmaps", "coordinates"])
def test_heatmap_rate_applies_to_last_heatmap_layers(task):
    net = network(task)
    recipe = replace(SHORT, heatmap_rate=10.0)
    (alike,), (made,) = optimizers(net, SHORT), optimizers(net, recipe)
    assert [len(group["params"]) for group in alike.param_groups] == [len(list(net.parameters()))]
    names = {id(value): name for name, value in net.named_parameters()}
    set_rates([made], recipe, rate_factor(0.5, recipe))
    due = {
        name: 10.0 if re.fullmatch(r"heads\.query\.fcs\.[012]\.fc2\.(weight|bias)", name) else 1.0
        for name in names.values()
    }
    got = {names[id(p)]: group["lr"] for group in made.param_groups for p in group["params"]}
    assert got == pytest.approx({name: times * recipe.rate * rate_factor(0.5, recipe) for name, times in due.items()})
    assert sum(times > 1 for times in due.values()) == (6 if task is FINETUNE else 0)


@pytest.mark.long
def test_batch_norm_statistics_use_people_of_all_processes(tmp_path):
    setup = setup_of(PRETRAIN)
    loop.train(SHORT, tmp_path / "run", setup=setup)
    runs = []
    for processes in (1, 2):
        accelerator = Accelerator(cpu=True)
        run = loop._Run(SHORT, setup, tmp_path / "run", accelerator, "", None)
        run.resume()
        run.accelerator = SimpleNamespace(num_processes=processes, device="cpu")
        runs.append(run._averaged().state_dict())
    one, two = runs
    model = load_file(tmp_path / "run" / run_dir.MODEL)
    assert all(torch.equal(one[name], two[name]) and torch.equal(one[name], model[name]) for name in one)
