"""Training of PRN and LPFormer: batches, losses, configurations, checkpoints, commands, overfitting."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from training_runs import few_to_validate_on  # noqa: F401

from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.inference.predictor import load
from lidarpose.models.baselines.baseline_config import MOST_POINTS, LpformerConfig, PrnConfig, pad_clouds
from lidarpose.models.baselines.point_transformer_v2 import GroupedVectorAttention
from lidarpose.models.baselines.prn import BareAttention
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.voxelize import view_features
from lidarpose.sample import SEEN, LabeledSample, Pose
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14
from lidarpose.train.augment import AUGMENTATIONS, Example, augmented
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.networks import PRETRAINED, _with_options, networks
from lidarpose.train.objectives.baseline_objective import LABEL_RADIUS, BaselineObjective, point_labels, with_joints
from lidarpose.train.objectives.dapt_objective import DaptObjective, deep, pretraining_config
from lidarpose.train.objectives.objective import total
from lidarpose.train.recipes import Finetune, Pretrain, recipe
from lidarpose.train.validation import update_batch_norms, validate

PRN, LPFORMER = PrnConfig(), LpformerConfig(grid=32)
# the PRN neck of the paper's Table 1 on a narrow Point Transformer V3
NECK = replace(PRETRAINED["paper-tiny"][0], neck="prn", parts=0, drop_path=0.0)
BOTH = pytest.mark.parametrize("config", [PRN, LPFORMER], ids=["prn", "lpformer"])


def person(n, seed=0):
    rng = np.random.default_rng([seed, n])
    joints = rng.normal(0, (0.2, 0.3, 0.5), (26, 3)).astype(np.float32)
    points = joints[rng.integers(26, size=n)] + rng.normal(0, 0.05, (n, 3))
    visible, view = np.full(26, np.nan, np.float32), np.zeros(5, np.float32)
    return Example(points=points, part=np.zeros(n, int), joints=joints, visible=visible, view=view, seed=seed)


# ---- inputs


def test_pad_clouds_centers_on_extent_and_keeps_sensor_position():
    rng = np.random.default_rng(0)
    clouds = [rng.uniform((-0.2, -0.3, -1), (0.4, 0.1, 0.9), (n, 3)) for n in (50, 7, 0)]
    # outside the window
    clouds[1] = np.concatenate([clouds[1], [[9.0, 0, 0]]])
    origin = np.array([4.0, -3.0, 1.0])
    view = np.stack([view_features(np.zeros(3), origin), *np.zeros((2, 5))])
    arrays = pad_clouds(clouds, view, PrnConfig(), [1, 2, 3])
    assert arrays["valid"].sum(1).tolist() == [50, 7, 1]
    for row, cloud in enumerate((clouds[0], clouds[1][:7])):
        points = arrays["points"][row][arrays["valid"][row]]
        np.testing.assert_allclose(points + arrays["middle"][row], cloud, atol=1e-6)
        np.testing.assert_allclose(points.min(0), -points.max(0), atol=1e-6)
    np.testing.assert_allclose(arrays["center"][0], arrays["middle"][0] - origin, atol=1e-5)
    assert not arrays["center"][1:].any()


def test_pad_clouds_samples_without_or_with_replacement():
    rng = np.random.default_rng(0)
    clouds, view = [rng.normal(0, 0.3, (n, 3)) for n in (300, 1500)], np.zeros((2, 5))
    once = pad_clouds(clouds, view, PrnConfig(), [5, 6])
    published = PrnConfig(resample_with_replacement=True)
    again = pad_clouds(clouds, view, published, [5, 6])
    distinct = [[len(np.unique(points[valid], axis=0)) for points, valid in zip(a["points"], a["valid"], strict=True)]
                for a in (once, again)]  # fmt: skip
    assert once["valid"].sum(1).tolist() == [300, MOST_POINTS] and distinct[0] == [300, MOST_POINTS]
    # all points of a small cloud are drawn, of a large one a share of about 1 - exp(-1024 / 1500)
    assert again["valid"].sum(1).tolist() == [MOST_POINTS] * 2 and distinct[1][0] == 300 and 650 < distinct[1][1] < 830
    assert not np.array_equal(again["points"], pad_clouds(clouds, view, published, [7, 8])["points"])
    fewer = pad_clouds(clouds, view, PrnConfig(most_points=128), [5, 6])
    assert fewer["valid"].sum(1).tolist() == [128, 128]


# ---- losses


def test_point_labels_give_nearest_known_joint_within_radius():
    points = torch.tensor([[[0.0, 0, 0], [0.3, 0, 0], [1.0, 0, 0], [0.0, 0, 0]]])
    joints = torch.tensor([[[0.01, 0, 0], [0.2, 0, 0], [0.45, 0, 0]]])
    valid, known = torch.tensor([[True, True, True, False]]), torch.tensor([[False, True, True]])
    label, offset = point_labels(points, valid, joints, known)
    # the last point may belong to the joint without a label
    assert label.tolist() == [[1, 1, -1, -1]]
    assert point_labels(points, valid, joints, torch.ones_like(known))[0].tolist() == [[0, 1, 3, -1]]
    assert torch.allclose(offset[0, :2], torch.tensor([[0.2, 0, 0], [-0.1, 0, 0]]))


@pytest.mark.long
@BOTH
def test_baseline_objective_masks_unlabeled_joints(config):
    objective = BaselineObjective(config=config)
    torch.manual_seed(0)
    network = objective.network().eval()
    examples = [person(40, 1), person(25, 2)]
    hidden = BODY26.index(config.joints[3])
    examples[0].joints[hidden] = np.nan
    arrays = objective.collate(examples)
    terms = objective.terms(network, arrays)
    assert set(terms) >= {"joints", "part", "mpjpe"} and total(terms).isfinite()
    true = np.stack([example.joints for example in examples])[:, config.columns]
    error = np.linalg.norm(objective.joints(network, arrays)[:, config.columns] - true, axis=-1)
    assert float(terms["mpjpe"]) == pytest.approx(np.nanmean(error), rel=1e-4) == float(terms["joints"].detach())
    total(terms).backward()
    gradients = [value.grad for value in network.parameters() if value.requires_grad]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    # joints that the network lacks are NaN; predictions move with the cloud
    joints = objective.joints(network, arrays)
    assert np.isnan(joints).all((0, 2)).sum() == 26 - len(config.joints)
    step = np.float32([0.3, -0.2, 0.1])
    moved = [replace(e, points=e.points + step, joints=e.joints + step) for e in examples]
    np.testing.assert_allclose(objective.joints(network, objective.collate(moved)), joints + step, atol=1e-4)


@pytest.mark.long
def test_second_softmax_bounds_part_loss_from_below():
    torch.manual_seed(0)
    terms = {}
    for second in (False, True):
        objective = BaselineObjective(config=replace(LPFORMER, second_softmax=second))
        torch.manual_seed(0)
        terms[second] = objective.terms(objective.network().eval(), objective.collate([person(30)]))
    assert terms[True]["joints"] == terms[False]["joints"] and terms[True]["part"] != terms[False]["part"]
    # the cross entropy of a softmax over probabilities of 16 classes is at least log(1 + 15 / e)
    assert terms[True]["part"] > np.log(1 + 15 / np.e) - 1e-3


def test_divide_by_all_joints_scales_joint_loss():
    example = replace(person(30), joints=np.where(np.arange(26)[:, None] % 2, np.nan, person(30).joints))
    terms = {}
    for divide in (False, True):
        objective = BaselineObjective(config=replace(LPFORMER, divide_by_all_joints=divide))
        torch.manual_seed(0)
        arrays = objective.collate([example])
        terms[divide] = objective.terms(objective.network().eval(), arrays)["joints"]
    labels = np.isfinite(arrays["joints"]).all(-1)
    assert 0 < labels.mean() < 1
    torch.testing.assert_close(terms[True], terms[False] * labels.mean(), rtol=1e-5, atol=0, check_dtype=False)


def test_labels_before_scaling_scales_label_radius():
    one = person(300)
    visible = np.ones(26, np.float32)
    sample = LabeledSample(
        points=one.points.astype(np.float32),
        part=np.full(300, -1, np.int16),
        pose=Pose(joints=one.joints, visible=visible, skeleton=BODY26),
        joint_labels=np.full(26, SEEN, np.uint8),
        center=np.zeros(3),
    )
    shown = augmented(sample, AUGMENTATIONS["lidarhmr"], np.random.default_rng(2))
    assert abs(shown.scale - 1) > 0.05
    labels = {}
    for before in (False, True):
        objective = BaselineObjective(config=replace(PRN, labels_before_scaling=before))
        arrays = {name: torch.as_tensor(array) for name, array in objective.collate([shown]).items()}
        known = arrays["joints"].isfinite().all(-1)
        labels[before] = point_labels(arrays["points"], arrays["valid"], arrays["joints"], known, arrays["radius"])
    # the option does not change offsets
    torch.testing.assert_close(labels[True][1], labels[False][1])
    distance = labels[True][1].norm(dim=-1)
    for before, radius in ((False, LABEL_RADIUS), (True, LABEL_RADIUS * shown.scale)):
        assert ((labels[before][0] < len(PRN.joints)) == (distance < radius)).all()
    assert (labels[True][0] != labels[False][0]).any()


# ---- fast paths


def test_grouped_attention_missing_in_softmax_as_published():
    torch.manual_seed(0)
    attention = GroupedVectorAttention(12, 3).train()
    x, xyz = torch.randn(5, 12), torch.randn(5, 3)
    neighbors = torch.tensor([[0, 1, 2], [1, -1, -1], [2, 4, -1], [3, 0, -1], [4, 2, 0]])
    attention.missing_in_softmax = True
    out = attention(x, xyz, neighbors)
    # as in the published code: missing neighbors are zeros, with a mask after the softmax
    exists = (neighbors >= 0)[..., None]
    gathered = {name: getattr(attention, name)(x)[neighbors] * exists for name in ("key", "value")}
    offset = (xyz[neighbors] - xyz[:, None]) * exists
    bias = attention.position[1](attention.position[0](offset.flatten(0, 1))).unflatten(0, (5, 3))
    relation = gathered["key"] - attention.query(x)[:, None] + bias
    scores = attention.weight((relation * attention.group_weight).unflatten(-1, (3, 4)).sum(-1).flatten(0, 1))
    weight = scores.unflatten(0, (5, 3)).softmax(1) * exists
    values = (gathered["value"] + bias).unflatten(-1, (3, 4)) * weight[..., None]
    torch.testing.assert_close(out, values.sum(1).flatten(1))
    attention.missing_in_softmax = False
    assert (attention(x, xyz, neighbors)[1] - out[1]).abs().max() > 1e-3


def test_grouped_attention_equals_definition():
    torch.manual_seed(0)
    attention = GroupedVectorAttention(12, 3).eval()
    x, xyz = torch.randn(9, 12), torch.randn(9, 3)
    neighbors = torch.tensor([[m, (m + 1) % 9, (m + 4) % 9 if m % 2 else -1] for m in range(9)])
    rows = []
    for m in range(9):
        own = [n for n in neighbors[m].tolist() if n >= 0]
        bias = attention.position[1](attention.position[0](xyz[own] - xyz[m]))
        relation = attention.key(x[own]) - attention.query(x[[m]]) + bias
        scores = attention.weight((relation * attention.group_weight).unflatten(1, (3, 4)).sum(-1)).softmax(0)
        value = (attention.value(x[own]) + bias).unflatten(1, (3, 4))
        rows.append((value * scores[..., None]).sum(0).flatten())
    assert torch.allclose(attention(x, xyz, neighbors), torch.stack(rows), atol=1e-6)


def test_bare_attention_queries_gives_first_rows():
    torch.manual_seed(0)
    attention = BareAttention(12, heads=3).eval()
    x, valid = torch.randn(2, 10, 12), torch.arange(10) < torch.tensor([[10], [6]])
    assert torch.allclose(attention(x, valid, queries=4), attention(x, valid)[:, :4], atol=1e-6)


# ---- configurations, checkpoints, commands


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: LpformerConfig(grid=48), "grid must be 64, 32, 16 cells, got 48"),
        (lambda: PrnConfig(joints=("nose", "nose")), "each once"),
        (lambda: PrnConfig(joints=("tail",)), "unknown joint"),
        (lambda: PrnConfig(width_divisor=3), "width_divisor must be one of 1, 2, 4, 8, got 3"),
        (lambda: PrnConfig(most_points=0), "most_points must be"),
        (lambda: LpformerConfig(attention_dropout=1), "attention_dropout must be a probability below 1, got 1"),
        (lambda: LpformerConfig(second_softmax=1), "second_softmax must be true or false, got 1"),
        (lambda: _with_options(PRN, ("grid=32",)), "unknown option of prn 'grid'"),
        (
            lambda: Pretrain(model="prn", size="tiny"),
            "the model prn has the size prn or prn-small or prn-tiny, got tiny",
        ),
        (lambda: Pretrain(model="best"), "unknown model 'best'"),
        (lambda: Pretrain(betas=(0.9, 1.0)), "betas must be two numbers"),
    ],
)
def test_configs_and_recipes_reject_invalid_values(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_with_options_sets_fields_by_name():
    options = ("grid=32", "second_softmax", "sensor_position=true", "resample_with_replacement=false")
    options += ("attention_dropout=0.05", "width_divisor=4")
    expected = LpformerConfig(
        grid=32, second_softmax=True, sensor_position=True, attention_dropout=0.05, width_divisor=4
    )
    assert _with_options(LpformerConfig(), options) == expected


def test_baseline_recipes_match_published_values():
    prn, lpformer = (recipe(Pretrain, name) for name in ("prn", "lpformer"))
    assert (prn.rate, prn.optimizer, prn.decay, prn.batch, prn.schedule) == (5e-4, "adam", 0, 64, "constant")
    assert (lpformer.rate, lpformer.betas, lpformer.batch, lpformer.decay) == (5e-4, (0.85, 0.95), 16, 0.01)
    fine = recipe(Finetune, "prn", data=("a",))
    assert (fine.init, fine.size, fine.epochs, fine.augment, fine.mix) == ("random", "prn", 50, "lidarhmr", 0)
    assert recipe(Finetune, "prn", data=("a",), init="first.safetensors").size == ""
    assert Pretrain(model="dapt").size == "paper" and Pretrain(model="ours") == replace(Pretrain(), model="ours")


@pytest.mark.long
def test_models_command_lists_all_networks(capsys):
    assert not main(["models", "--json"])
    rows = json.loads(capsys.readouterr().out)
    assert rows == networks()
    counts = {row["size"]: (row["joints"], row["frames"], row["parameters"]) for row in rows}
    assert counts["prn"] == (15, 1, 1_738_482) and counts["lpformer"] == (15, 1, 4_814_485)
    assert counts["lidarcap"] == (24, 16, 34_925_854) and counts["ne"] == (24, 16, 129_720_766)
    # narrow sizes for CPUs
    assert counts["prn-small"][2] == 120_606 and counts["lpformer-small"][2] == 309_493
    assert counts["prn-tiny"][2] == 36_348 and counts["lpformer-tiny"][2] == 80_581
    assert counts["lidarcap-small"][2] == 576_798 and counts["ne-small"][2] == 2_072_910
    assert {"ours", "dapt"} < {row["name"] for row in rows} and {"tiny", "paper", "paper-small"} <= counts.keys()
    # of paper-deep the neck reads as many levels as that of the published size
    assert len(pretraining_config().decoder_depths) == len(deep(pretraining_config()).decoder_depths) == 4
    assert not main(["models"])
    assert "129,720,766" in capsys.readouterr().out


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("skeleton", [WAYMO14, SMPL24])
def test_with_joints_copies_weights_by_joint_name(config, skeleton, tmp_path):
    trained = BaselineObjective(config=config).network()
    other = replace(config, joints=skeleton.joints)
    network = with_joints(trained, other)
    old, new = trained.state_dict(), network.state_dict()
    for name, value in new.items():
        before = old[name]
        if not name.startswith(trained.per_joint):
            assert torch.equal(value, before)
            continue
        for joint in set(config.joints) & set(skeleton.joints):
            assert torch.equal(value[other.joints.index(joint)], before[config.joints.index(joint)])
        if len(value) > len(skeleton):
            assert torch.equal(value[-1], before[-1])
    save_checkpoint(tmp_path / "a.safetensors", network, card={})
    again, header = load_checkpoint(tmp_path / "a.safetensors")
    assert header.config == other and header.skeleton is skeleton
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), new.values(), strict=True))


@pytest.mark.long
def test_prn_pretrain_evaluate_predict_and_finetune(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--workers", "0", "--pictures", "0", "--validate", "1000"]
    narrow = ["--size", "prn-tiny", "--people", "16", "--batch", "8", "--scene", "paper"]
    assert not main(["pretrain", "run", "--model", "prn", *narrow, *words])
    network, header = load_checkpoint("run/model.safetensors")
    assert header.network == "prn" and header.card["recipe"]["optimizer"] == "adam"
    (line,) = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert {"joints", "vote", "part", "offset", "mpjpe"} <= line.keys() and line["validation_mm"] > 0
    assert not main(["evaluate", "run/model.safetensors", "bench", "--limit", "4"])
    assert "MPJPE" in capsys.readouterr().out
    # predict gives the objective's joints in the frame of the cloud
    example = person(60)
    cloud = np.float32(example.points) + [20, 0, 1]
    pose = load("run/model.safetensors", tta=1).predict(cloud)
    assert pose.skeleton.joints == HUMAN15.joints
    objective = BaselineObjective(config=header.config)
    expected = objective.joints(network, objective.collate([example]))[0, header.config.columns]
    np.testing.assert_allclose(pose.joints, expected + [20, 0, 1], atol=2e-3)
    # --init is accepted only for the same network and width, and not by pretrain
    assert main(["pretrain", "more", "--model", "prn", "--init", "run/model.safetensors"]) == 2
    assert "prn starts from random weights" in capsys.readouterr().err
    folder = tmp_path / "people"
    assert not main(["synth", "--out", str(folder), "--count", "8", "--scene", "paper"])
    common = [str(folder), "--split", "all", "--epochs", "1", "--batch", "4", *words]
    wider = ["--model", "prn", "--init", "run/model.safetensors", "--options", "width_divisor=1", "--out", "no"]
    assert main(["finetune", *common, *wider]) == 2
    assert "--init has weights for width_divisor=8" in capsys.readouterr().err
    assert not main(["finetune", *common, "--model", "prn", "--init", "run/model.safetensors", "--out", "second"])
    assert load_checkpoint("second/model.safetensors")[1].config.joints == BODY26.joints
    options = ["--options", "resample_with_replacement,width_divisor=4"]
    assert not main(["finetune", *common, "--model", "prn", *options, "--out", "third"])
    third = load_checkpoint("third/model.safetensors")[1]
    assert third.config.resample_with_replacement and third.card["init"] == "random"
    assert main(["finetune", *common, "--model", "lpformer", "--init", "run/model.safetensors", "--out", "no"]) == 2
    assert "contains the network prn, not lpformer" in capsys.readouterr().err


# ---- learning


def _learned(objective, people, points, steps, rate):
    """Train on a fixed batch, with a rate that falls in the second half; return its error in evaluation mode in mm."""
    source = SyntheticSource(scene="paper", seed=5, pelvis_centered=0.0)
    examples = [e for e in map(source.example, range(3 * people)) if len(e.points) >= 30][:people]
    assert len(examples) == people
    rows = [np.random.default_rng(e.seed).permutation(len(e.points))[:points] for e in examples]
    examples = [replace(e, points=e.points[r], part=e.part[r]) for e, r in zip(examples, rows, strict=True)]
    torch.manual_seed(0)
    network = objective.network().train()
    arrays = objective.collate(examples)
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=0)
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = rate * min(1, 2 * (1 - step / steps))
        optimizer.zero_grad()
        total(objective.terms(network, arrays)).backward()
        optimizer.step()
    # as the training loop does before it validates and saves
    update_batch_norms(network, objective, [arrays])
    return validate(objective, network, examples, people)[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "objective, people, points, steps, rate, most",
    [
        (BaselineObjective(config=PRN), 8, 60, 120, 2e-3, 80),
        (DaptObjective(config=NECK, stage="pretrain"), 4, 100, 240, 2e-3, 40),
        (BaselineObjective(config=PRETRAINED["lpformer-small"][0]), 4, 100, 200, 1e-3, 30),
    ],
    ids=["prn", "neck-prn", "lpformer-small"],
)
def test_networks_overfit_a_few_people(objective, people, points, steps, rate, most):
    """The neck and LPFormer have widths for CPUs and no dropout in attention."""
    assert _learned(objective, people, points, steps, rate) < most
