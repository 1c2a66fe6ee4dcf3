"""Training the verifier, which separates people from false positives of the detector."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from training_runs import refused, train_until_killed

from lidarpose.cli import main
from lidarpose.geometry import rows_near
from lidarpose.inference import verification
from lidarpose.inference.backend import Raw
from lidarpose.models import bundled_path, weights_file
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.config import NetworkConfig
from lidarpose.models.detector.detector import detector_path
from lidarpose.models.posenet import PoseNet
from lidarpose.sample import MIN_POINTS
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train import loop, run_dir, setup
from lidarpose.train.data_loader import BATCHES
from lidarpose.train.detector import crop_source
from lidarpose.train.detector.candidate_source import NOBODY, scene_to_search
from lidarpose.train.detector.crop_source import CropExample, scan_crops
from lidarpose.train.objectives.verifier_objective import VerifierObjective, missed_by_verifier
from lidarpose.train.recipes import TrainVerifier

CONFIG = NetworkConfig(size="verifier", channels=(8, 16, 16), head_channels=8, blocks=(1, 1, 0), person=True)
RECIPE = TrainVerifier(scenes=BATCHES * 2, uses=2, batch=2, workers=0, seed=3, validate=1000)


def an_example(number, count=9):
    """Alternating upright and lying clouds of various sizes."""
    rng = np.random.default_rng(number)
    person = np.where(np.arange(count) % 2 == 0, np.arange(count), NOBODY)
    sizes = rng.integers(MIN_POINTS, 80, count)
    spread = {True: (0.15, 0.15, 0.5), False: (0.5, 0.15, 0.1)}
    clouds = [
        rng.normal(0, spread[number >= 0], (n, 3)).astype(np.float32)
        for number, n in zip(person.tolist(), sizes.tolist(), strict=True)
    ]
    view = np.tile(np.array([1, 0, 0, 2, 1], np.float32), (count, 1))
    labels = {"mounted": (person >= 0) & (person % 4 == 0), "num_others": np.zeros(count, int)}
    return CropExample(clouds=clouds, view=view, person=person, seed=number, **labels)


@pytest.fixture
def quick_crops(monkeypatch, tmp_path):
    """Replaces crops of scans by random crops. Returns the path of a small network's weights."""

    def crops(seed, number, *, family="train"):
        return an_example(number + 1000 * (family == "heldout"))

    for module in (crop_source, setup):
        monkeypatch.setattr(module, "scan_crops", crops)
    monkeypatch.setattr(crop_source, "VALIDATION", 3)
    path = tmp_path / "small.safetensors"
    torch.manual_seed(0)
    save_checkpoint(path, PoseNet(replace(CONFIG, size="small", person=False)), card={})
    return path


# ---- training data


def test_scan_crops_match_crops_of_detection(monkeypatch):
    """Same detections and points as those that `lidarpose.detect` passes to the verifier."""
    crops = scan_crops(5, 5)
    scene, origin = scene_to_search(5, 5, "train")
    detections = crop_source._detector().detect(scene.points, origin, max_range=40.0, limit=60)
    shown = []

    class Backend:
        batch = 64

        def run(self, clouds, view):
            shown.extend(clouds)
            return Raw(
                vote=np.zeros((len(clouds), 1, 3)),
                heatmaps=None,
                low=np.zeros(3),
                step=np.ones(3),
                person=np.zeros((len(clouds), 2)),
            )

    monkeypatch.setattr(verification, "bundled_backend", lambda name: Backend())
    rows = rows_near(detections.centers, scene.points, verification.AROUND)
    clouds = {i: scene.points[near] for i, near in enumerate(rows)}
    verification.Crops(detections, clouds, origin).verdicts()
    assert 0 < crops.size <= len(shown)
    for cloud in crops.clouds:
        if len(cloud) < 1024:
            assert any(len(a) == len(cloud) and np.allclose(a, cloud, atol=1e-4) for a in shown)
        else:
            # a subsample of one of the clouds
            large_clouds = [KDTree(a) for a in shown if len(a) >= 1024]
            assert min(tree.query(cloud)[0].max() for tree in large_clouds) < 1e-4


@pytest.mark.long
def test_crop_labels_follow_distance_and_points():
    examples = [scan_crops(0, number) for number in range(4, 8)]
    person = np.concatenate([example.person for example in examples])
    assert (person >= 0).sum() >= 5 and (person == NOBODY).sum() >= 10
    for example, number in zip(examples, range(4, 8), strict=True):
        scene = detection_scene(0, number)
        counts = np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes))
        assert (counts[example.person[example.person >= 0]] >= MIN_POINTS).all()
        assert all(MIN_POINTS <= len(cloud) <= 1024 for cloud in example.clouds)
        assert example.view.shape == (example.size, 5)
        assert not example.mounted[example.person == NOBODY].any()
        np.testing.assert_array_equal(example.mounted, np.append(scene.mounted, False)[example.person])
    label = crop_source._label
    assert label(np.array([0.3, 2.0]), np.array([4, 7]), np.array([-1, 4])) == 4
    assert label(np.array([0.5, 2.0]), np.array([4, 7]), np.array([-1, -1])) == crop_source.IGNORE
    assert label(np.array([0.9, 2.0]), np.array([4, 7]), np.array([-1, 4])) == crop_source.IGNORE
    assert label(np.array([0.9, 2.0]), np.array([4, 7]), np.array([-1, -1])) == NOBODY
    assert label(np.zeros(0), np.zeros(0, int), np.array([-1])) == NOBODY


def test_augmentation_varies_and_is_same_for_all_processes(quick_crops):
    source = replace(setup.make_setup(replace(RECIPE, init=str(quick_crops), uses=3)).source, lag=4)
    first, again = source.example(37), replace(source).example(37)
    for a, b in zip(first.clouds, again.clouds, strict=True):
        np.testing.assert_array_equal(a, b)
    scan = source.load_scene(1, 2)
    before = [cloud.copy() for cloud in scan.clouds]
    shown = [source.draw_example(scan, np.random.default_rng(k)) for k in range(2)]
    assert not np.array_equal(shown[0].clouds[0], shown[1].clouds[0])
    for cloud, old in zip(scan.clouds, before, strict=True):
        np.testing.assert_array_equal(cloud, old)
    # clouds and view directions are mirrored together
    scan = replace(scan, view=scan.view + np.float32([0, 0.5, 0, 0, 0]))
    scan = replace(scan, clouds=[cloud + np.float32([0, 5, 0]) for cloud in scan.clouds])
    shown = source.draw_example(scan, np.random.default_rng(0))
    sides = np.array([np.sign(cloud[:, 1].mean()) for cloud in shown.clouds])
    assert set(sides) == {-1, 1} and (np.sign(shown.view[:, 1]) == sides).all()
    assert all(MIN_POINTS <= len(a) <= len(b) for a, b in zip(shown.clouds, scan.clouds, strict=True))


# ---- learning


def test_collate_groups_crops_by_size():
    objective = VerifierObjective(config=CONFIG)
    examples = [an_example(number, 30) for number in range(3)]
    groups = objective.collate(examples)
    assert [len(group["person"]) for group in groups] == [32, 32, 26]
    assert np.sum([group["person"].sum(0) for group in groups], axis=0).tolist() == [45, 24]
    torch.manual_seed(0)
    network = objective.network().eval()
    together = objective.scores(network, examples[0])
    example = replace(examples[0], person=np.zeros(1, int), mounted=np.zeros(1, bool))
    alone = [
        objective.scores(network, replace(example, clouds=[cloud], view=view[None]))[0]
        for cloud, view in zip(examples[0].clouds, examples[0].view, strict=True)
    ]
    np.testing.assert_allclose(together, alone, atol=1e-4)
    assert objective.scores(network, an_example(0, 0)).shape == (0, 2)


def test_batch_without_detections_has_gradients_of_zero():
    objective = VerifierObjective(config=CONFIG)
    network = objective.network()
    terms = objective.terms(network, objective.collate([an_example(0, 0), an_example(1, 0)]))
    assert {name: term.item() for name, term in terms.items()} == {"person": 0, "mounted": 0, "ap": 0}
    (terms["person"] + terms["mounted"]).backward()
    gradients = [p.grad for p in network.person.parameters()]
    assert gradients and not any(gradient.any() for gradient in gradients)


@pytest.mark.long
def test_verifier_training_updates_whole_network(quick_crops):
    torch.manual_seed(0)
    begun = setup.make_setup(replace(RECIPE, init=str(quick_crops)))
    network, objective = begun.network(), begun.objective
    assert network.config.size == "verifier" and network.config.person
    arrays = objective.collate([an_example(0, 16), an_example(1, 16)])
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    for _ in range(100):
        optimizer.zero_grad()
        terms = objective.terms(network, arrays)
        (terms["person"] + terms["mounted"]).backward()
        # distributed training waits for the gradients of all parameters that require one
        assert all((p.grad is not None) == p.requires_grad for p in network.parameters())
        optimizer.step()
    assert terms["person"] < 0.05 and terms["mounted"] < 0.1 and terms["ap"] == 1
    assert (network.stem.out.weight.grad != 0).any()
    # the person head of a pose network has no gradient for the backbone
    other = PoseNet(CONFIG)
    objective.terms(other, arrays)["person"].backward()
    assert other.stem.out.weight.grad is None and other.person.norm.weight.grad is not None


def test_missed_by_verifier_at_one_false_positive_per_scan(monkeypatch):
    objective = VerifierObjective(config=CONFIG)
    examples = [replace(an_example(0, 6), person=np.array([0, 0, NOBODY, 1, NOBODY, 2]))] * 3
    # the better of two detections of a person counts; the fourth false positive has 2
    logits = {0: [1.0, 5, 4, 1.5, 2, 3]}
    monkeypatch.setattr(VerifierObjective, "scores", lambda *args, **keywords: np.array(logits[0])[:, None])
    assert missed_by_verifier(objective, torch.nn.Linear(1, 1), examples, 1) == (pytest.approx(100 / 3), None)
    logits[0] = [1.0, 5, 0, 2.5, 2, 3]
    assert missed_by_verifier(objective, torch.nn.Linear(1, 1), examples, 1)[0] == 0


@pytest.mark.long
def test_killed_run_resumes_to_same_losses(quick_crops, tmp_path):
    recipe = replace(RECIPE, init=str(quick_crops))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    loop.train(recipe, whole)
    train_until_killed(recipe, killed, "_step", BATCHES + 2)
    loop.train(recipe, killed, resume=True)
    logs = []
    for folder in (whole, killed):
        lines = [json.loads(line) for line in (folder / run_dir.LOG).read_text().splitlines()]
        logs.append([{name: value for name, value in line.items() if name != "seconds"} for line in lines])
    assert len(logs[0]) == 2
    for before, after in zip(*logs, strict=True):
        assert before == pytest.approx(after, abs=1e-4)
    network, header = load_checkpoint(killed / run_dir.MODEL)
    assert network.config == CONFIG and header.card["scans_seen"] == 32
    assert 0 <= header.card["validation_missed"] <= 100


def test_train_verifier_command_rejects_other_networks(quick_crops, tmp_path, capsys):
    words = ["--scenes", "8", "--uses", "2", "--batch", "2", "--workers", "0", "--init", str(quick_crops)]
    assert main(["train-verifier", str(tmp_path / "run"), *words]) == 0
    assert capsys.readouterr().out.strip().endswith("model.safetensors")
    assert main(["train-verifier", str(tmp_path / "other"), "--init", str(detector_path(".safetensors"))]) == 2
    assert "expected one of the package's own networks" in capsys.readouterr().err
    with refused("none.safetensors"):
        setup.make_setup(replace(RECIPE, init="none.safetensors"))


def test_bundled_verifier_has_expected_config_and_card():
    network, header = load_checkpoint(weights_file("verifier.safetensors"))
    tiny, _ = load_checkpoint(bundled_path("tiny"))
    assert network.config == replace(tiny.config, size="verifier", person=True)
    assert header.card["scans_seen"] > 0 and "train-verifier" in header.card["command"]
