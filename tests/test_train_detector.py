"""Training the detector: leveled scans, the exported file, labels, runs, and validation."""

import json
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from training_runs import refused, train_until_killed

from lidarpose.cli import main
from lidarpose.errors import LidarPoseError
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.models import bundled_path, export as export_module
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.detector.candidates import Candidates
from lidarpose.models.detector.detector import detector_path, open_detector
from lidarpose.models.detector.detector_config import OUTPUT, OUTPUTS, DetectorConfig
from lidarpose.models.detector.ground import estimate_up
from lidarpose.models.detector.network import DetectorNet
from lidarpose.models.detector.render import CandidateAugmentation, render
from lidarpose.models.export import export, export_detector
from lidarpose.models.onnx import open_network
from lidarpose.sample import Box
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train import loop, run_dir, setup
from lidarpose.train.data_loader import BATCHES
from lidarpose.train.detector import candidate_source
from lidarpose.train.detector.candidate_source import (
    IGNORE,
    NOBODY,
    DetectorExample,
    Labels,
    SceneSource,
    labels_of,
    transform_labels,
)
from lidarpose.train.objectives.detector_objective import (
    DetectorObjective,
    average_precision,
    missed_people,
    training_rows,
)
from lidarpose.train.objectives.objective import total
from lidarpose.train.recipes import TrainDetector

CONFIG = DetectorConfig()
SMALL = DetectorConfig(channels=(8, 8, 16), coarse_channels=(4, 8), hidden=16)
RECIPE = TrainDetector(scenes=BATCHES * 2, uses=2, batch=2, workers=0, seed=3, validate=1000)


def some_candidates(rng, is_person, *, centers=None, yaw=0.0):
    """Candidates with 60 points each: as high as a person where is_person, else a low box."""
    count = len(is_person)
    points = [rng.normal(0, (0.15, 0.2, 0.0), (60, 3)) for _ in is_person]
    for own, tall in zip(points, is_person, strict=True):
        own[:, 2] = rng.uniform(0, 1.75 if tall else 0.7, 60)
    return Candidates(
        centers=np.zeros((count, 3)) if centers is None else np.array(centers),
        yaw=np.full(count, yaw),
        distance=np.full(count, 8.0),
        sensor_height=np.full(count, 1.8),
        count=np.full(count, 60),
        sizes=np.full(count, 60),
        xyz=np.rint(np.concatenate(points).T / 5e-4).astype(np.int16),
        range_views=np.full((count, 4, 34, 30), 100, np.uint8),
        contexts=np.zeros((count, 4, 20, 20), np.uint8),
    )


def an_example(number, *, count=10):
    """A scan with alternating people and boxes."""
    rng = np.random.default_rng(number)
    is_person = np.arange(count) % 2 == 0
    labels = Labels(
        person=np.where(is_person, np.arange(count), NOBODY),
        center=np.zeros((count, 2), np.float32),
        foot=np.zeros(count, np.float32),
        height=np.full(count, 1.75, np.float32),
        mounted=np.zeros(count, bool),
    )
    centers = 2.0 * np.arange(count)[:, None] * [1, 0, 0]
    return DetectorExample(candidates=some_candidates(rng, is_person, centers=centers), labels=labels)


@pytest.fixture
def quick_scans(monkeypatch):
    """Replaces scans by random candidates and the network by a small one."""

    def scan(seed, number, *, family="train"):
        return an_example(number + 1000 * (family == "heldout"))

    for module in (candidate_source, setup):
        monkeypatch.setattr(module, "scan_example", scan)
    monkeypatch.setattr(candidate_source, "VALIDATION", 3)
    monkeypatch.setattr(setup, "DetectorConfig", lambda: SMALL)


# ---- candidates


def test_tilted_scans_are_leveled_before_training(monkeypatch):
    scene = detection_scene(3, 12)
    assert estimate_up(scene.points, scene.origin) is None
    R = axis_angle_to_matrix(np.array([0.25, -0.3, 0.0]))
    joints = (scene.joints @ R.T).astype(np.float32)
    # as tight as before, but upright in the tilted frame
    grown = np.ptp(joints[..., 2], 1) - np.ptp(scene.joints[..., 2], 1)
    boxes = tuple(
        replace(box, center=R @ box.center, size=box.size + [0, 0, more])
        for box, more in zip(scene.boxes, grown, strict=True)
    )
    points = (scene.points @ R.T).astype(np.float32)
    tilted = replace(scene, points=points, origin=R @ scene.origin, boxes=boxes, joints=joints, up=R @ scene.up)
    level = candidate_source.leveled(tilted, estimate_up(tilted.points, tilted.origin))
    assert tilted.up[2] < 0.95 and level.up[2] > 0.995
    seen = [number for number in range(len(boxes)) if (scene.person == number).sum() > 20]
    assert len(seen) > 2
    for number in seen:
        box, own = level.boxes[number], level.points[level.person == number]
        assert own[:, 2].min() > box.center[2] - box.size[2] / 2 - 0.1
        assert own[:, 2].max() < box.center[2] + box.size[2] / 2 + 0.1
        assert np.hypot(*(np.median(own, 0) - box.center)[:2]) < 0.5
        assert abs(box.size[2] - scene.boxes[number].size[2]) < 0.1
    monkeypatch.setattr(candidate_source, "detection_scene", lambda *args, **keywords: tilted)
    found = {number for number in candidate_source.scan_example(3, 12).labels.person if number >= 0}
    assert len(found & set(seen)) > 0.6 * len(seen)


# ---- the network and its file


def random_inputs(candidates, config=CONFIG, seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in config.shapes(candidates).items()}


def test_network_output_does_not_depend_on_other_candidates():
    torch.manual_seed(0)
    network = DetectorNet(CONFIG).eval()
    assert 2e5 < sum(value.numel() for value in network.parameters()) < 4.5e5
    inputs = [torch.as_tensor(array) for array in random_inputs(6).values()]
    with torch.inference_mode():
        together = network(*inputs)
        alone = torch.cat([network(*(values[k : k + 1] for values in inputs)) for k in range(6)])
    assert together.shape == (6, len(OUTPUTS)) and together.std(0).min() > 0
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)


@pytest.mark.long
def test_exported_detector_matches_network(tmp_path):
    torch.manual_seed(0)
    network, path = DetectorNet(CONFIG), tmp_path / "detector.onnx"
    card = {"calibration": [[-1.0, 1.0], [0.1, 0.9]], "default_score": 0.5}
    export_detector(network, path, card=card)
    assert path.stat().st_size < 1.5e6
    session, header = open_detector(path)
    assert header["default_score"] == 0.5 and header["calibration"] == card["calibration"] and header["version"]
    for candidates in (0, 1, 5):
        arrays = random_inputs(candidates, seed=candidates)
        with torch.inference_mode():
            expected = network(*map(torch.as_tensor, arrays.values())).numpy()
        # weights are stored as float16
        np.testing.assert_allclose(session.run([OUTPUT], arrays)[0], expected, atol=0.02)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with refused("is damaged"):
        open_detector(path)


@pytest.mark.long
def test_exported_detector_has_convolutions_in_8_bits(tmp_path, monkeypatch):
    torch.manual_seed(0)
    network, path = DetectorNet(CONFIG), tmp_path / "detector.onnx"
    torch.nn.init.normal_(network.last.weight)
    examples = [random_inputs(count, seed=count) for count in (20, 30)]
    export_detector(network, path, card={"default_score": 0.5}, examples=examples)
    again = tmp_path / "again.onnx"
    export_detector(network, again, card={"default_score": 0.5}, examples=examples)
    assert again.read_bytes() == path.read_bytes()
    kinds = Counter(node.op_type for node in onnx.load(path).graph.node)
    assert kinds["Conv"] and kinds["DequantizeLinear"] >= 3 * kinds["Conv"]
    session, header = open_detector(path)
    assert header["default_score"] == 0.5
    for candidates in (1, 40):
        arrays = random_inputs(candidates, seed=candidates)
        with torch.inference_mode():
            expected = network(*map(torch.as_tensor, arrays.values())).numpy()
        actual = session.run([OUTPUT], arrays)[0]
        error = np.abs(actual - expected).mean()
        assert 1e-4 < error < 0.05 * np.abs(expected).mean()
    assert session.run([OUTPUT], random_inputs(0))[0].shape == (0, len(OUTPUTS))
    monkeypatch.setattr(export_module, "_QUANTIZED", 0.0)
    with pytest.raises(LidarPoseError, match="nothing was written"):
        export_detector(network, tmp_path / "worse.onnx", card={}, examples=examples)
    assert not (tmp_path / "worse.onnx").exists()


@pytest.mark.long
def test_detector_and_pose_network_are_not_interchangeable(tmp_path):
    with refused("expected a detector, got a network of the kind pose"):
        open_detector(bundled_path("tiny", ".onnx"))
    path = tmp_path / "detector.safetensors"
    save_checkpoint(path, DetectorNet(SMALL), card={})
    assert main(["predict", str(path), "--weights", str(path), "--backend", "torch"]) == 2
    export(path, tmp_path / "detector.onnx")
    assert open_detector(tmp_path / "detector.onnx")[1]["version"]


# ---- labels


def test_labels_of_assigns_candidates_to_people():
    boxes = tuple(
        Box(center=np.array([x, 0.0, 0.9]), size=np.array([0.6, 0.6, 1.9]), yaw=0.0, id=str(k))
        for k, x in enumerate((5.0, 10.0, 20.0))
    )
    person = np.repeat(np.array([0, 1, 2, -1], np.int16), [40, 40, 3, 10])
    scene = SimpleNamespace(boxes=boxes, person=person, mounted=np.array([False, True, False]))
    # on a person; between; on no person; on a person with 3 points; the nearest one of a person, though far away
    places = [(5.2, 0.2), (5.0, -0.45), (5.0, 0.6), (20.0, 0.1), (10.4, 0.0)]
    rng = np.random.default_rng(0)
    candidates = some_candidates(rng, [True] * 5, centers=[(x, y, -0.1) for x, y in places], yaw=np.pi / 2)
    labels = labels_of(candidates, scene)
    assert labels.person.tolist() == [0, IGNORE, NOBODY, IGNORE, 1]
    # the view frame's x is the level frame's y
    np.testing.assert_allclose(labels.center[0], [-0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose([labels.foot[0], labels.height[0]], [0.1, 1.8], atol=1e-6)
    assert labels.mounted.tolist() == [False, False, False, False, True]


def test_transform_labels_matches_augmentation():
    labels = replace(an_example(0, count=1).labels, center=np.array([[0.3, 0.1]], np.float32))
    change = CandidateAugmentation(turn=np.pi / 2, mirror=True, scale=1.05, shift=(0.02, -0.04))
    after = transform_labels(labels, change)
    np.testing.assert_allclose(after.center[0], [0.1 * 1.05 + 0.02, 0.3 * 1.05 - 0.04], atol=1e-6)
    np.testing.assert_allclose(after.center[0], change.apply(labels.center)[0], atol=1e-6)
    assert after.height[0] == pytest.approx(1.75 * 1.05)


# ---- learning


def test_scene_source_shows_each_scan_equally_often(quick_scans, monkeypatch):
    shown = []
    real = SceneSource._scan
    monkeypatch.setattr(SceneSource, "_scan", lambda self, n, newest: shown.append(n) or real(self, n, newest))
    source = replace(setup.make_setup(replace(RECIPE, uses=3)).source, lag=4)
    examples = [source.example(index) for index in range(60)]
    assert all(shown.count(number) == 3 for number in range(8, 12)) and len(source._kept) <= 3 * 4 + 1
    # another process starts in the middle
    again = replace(source).example(37)
    objective = DetectorObjective(config=SMALL)
    for name, array in objective.collate([examples[37]]).items():
        np.testing.assert_array_equal(array, objective.collate([again])[name])
    fine = [objective.collate([examples[index]])["fine"] for index in (36, 36 + 3 * 4 + 1)]
    assert shown[36] == shown[49] and not np.array_equal(*fine)


def test_training_rows_include_hardest_negatives():
    logit = torch.arange(200.0)
    person = torch.full((200,), NOBODY)
    person[:4], person[199] = torch.arange(4), IGNORE
    rows = training_rows(logit, person, torch.zeros(200, dtype=torch.long)).tolist()
    assert set(range(4)) < set(rows) and 199 not in rows
    assert set(range(189, 199)) < set(rows) and len(rows) < 60


def test_average_precision_is_mean_precision_of_positives():
    logit, truth = torch.tensor([4.0, 3.0, 2.0, 1.0]), torch.tensor([True, False, True, False])
    assert average_precision(logit, truth) == pytest.approx((1 + 2 / 3) / 2)
    assert average_precision(logit, torch.zeros(4, dtype=torch.bool)) == 0


@pytest.mark.long
def test_detector_overfits_a_few_candidates():
    torch.manual_seed(0)
    objective = DetectorObjective(config=SMALL)
    arrays = objective.collate([an_example(0, count=16), an_example(1, count=16)])
    rng = np.random.default_rng(0)
    arrays["center"] = rng.uniform(-0.3, 0.3, arrays["center"].shape).astype(np.float32)
    network = objective.network()
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    for _ in range(150):
        optimizer.zero_grad()
        terms = objective.terms(network, arrays)
        total(terms).backward()
        optimizer.step()
    assert terms["ap"] == 1 and terms["person"] < 0.15 and terms["offset"] < 0.25
    scores = objective.scores(network, arrays)
    assert ((scores[:, 0] > 0) == (arrays["person"] >= 0)).all()


def log_of(folder):
    lines = [json.loads(line) for line in (folder / run_dir.LOG).read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


@pytest.mark.long
def test_killed_run_resumes_to_same_losses(quick_scans, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    loop.train(RECIPE, whole)
    train_until_killed(RECIPE, killed, "_step", BATCHES + 2)
    loop.train(RECIPE, killed, resume=True)
    assert len(log_of(whole)) == 2
    for before, after in zip(log_of(whole), log_of(killed), strict=True):
        assert before == pytest.approx(after, abs=1e-4)
    network, header = load_checkpoint(killed / run_dir.MODEL)
    assert isinstance(network, DetectorNet) and header.card["scans_seen"] == 32
    assert 0 <= header.card["validation_missed"] <= 100
    assert json.loads((killed / run_dir.CONFIG).read_text())["kind"] == "train-detector"


def test_train_detector_command_trains_and_checks_options(quick_scans, tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["--scenes", "8", "--uses", "2", "--batch", "2", "--workers", "0", "--seed", "3"]
    assert main(["train-detector", str(folder), *words]) == 0
    assert capsys.readouterr().out.strip().endswith("model.safetensors")
    assert main(["train-detector", str(folder), "--resume", "--uses", "3"]) == 2
    assert "a run keeps its recipe" in capsys.readouterr().err
    assert main(["train-detector", str(tmp_path / "none"), "--calibrate", "5"]) == 2
    assert "give the folder of a run" in capsys.readouterr().err
    for words, other in (("--calibrate 3 --scenes 5", "--scenes"), ("--calibrate 3 --resume", "--resume")):
        assert main(["train-detector", str(folder), *words.split()]) == 2
        assert f"expected no other option than --scans, got {other}" in capsys.readouterr().err
    assert main(["train-detector", str(folder), "--scans", str(tmp_path)]) == 2
    assert "add --calibrate N" in capsys.readouterr().err
    assert main(["pretrain", str(folder), "--resume"]) == 2
    assert "resume it with that command" in capsys.readouterr().err


def test_missed_people_at_one_false_positive_per_scan(quick_scans):
    examples = candidate_source.validation_scans(0)
    logits = iter([np.array(values) for values in ([9.0, 8, 7, 6, 5, 4, 3, 2, 1, 0],) * 3])
    objective = SimpleNamespace(
        collate=lambda examples: None, scores=lambda *args, **kwargs: np.pad(next(logits)[:, None], ((0, 0), (0, 5)))
    )
    # people have 9, 7, 5, 3, 1 and others 8, 6, ... in each of 3 scans; false positive 4 has 6, so 9 and 7 pass
    missed, joints = missed_people(objective, torch.nn.Linear(1, 1), examples, 1)
    assert missed == pytest.approx(60) and joints is None
    # at one position only the strongest candidate counts
    together = [replace(one, candidates=replace(one.candidates, centers=np.zeros((10, 3)))) for one in examples]
    logits = iter([np.arange(10.0)] * 3)
    assert missed_people(objective, torch.nn.Linear(1, 1), together, 1)[0] == 100


def test_init_detector_loads_bundled_weights(tmp_path):
    """Its output matches the exported file up to the precision of convolutions in 8 bits."""
    begun = setup.make_setup(replace(RECIPE, init="detector")).network().eval()
    session, _ = open_network(detector_path())
    arrays = render(candidate_source.scan_example(3, 12).candidates)
    with torch.inference_mode():
        own = begun(*map(torch.as_tensor, arrays.values())).numpy()
    exported = session.run(None, arrays)[0]
    assert len(own) > 20 and own[:, 0].std() > 2
    assert np.abs(own - exported)[:, 0].mean() < 0.3 and np.abs(own - exported)[:, 1:5].mean() < 0.03
    for init, message in ((tmp_path / "none.safetensors", "none.safetensors"), (bundled_path("tiny"), "a detector")):
        with refused(message):
            setup.make_setup(replace(RECIPE, init=str(init)))
