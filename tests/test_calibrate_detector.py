"""Calibration of a detector's scores on scans of another family than that of training."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import lidarpose.train.detector.calibrate as module
from lidarpose.eval.detector.detection_scores import match
from lidarpose.geometry import rotation_about
from lidarpose.inference.verification import final_logit, final_score, surest_rows
from lidarpose.models.checkpoint import save_checkpoint
from lidarpose.models.detector.detector_config import DetectorConfig
from lidarpose.models.detector.network import DetectorNet
from lidarpose.sample import Box
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train.detector.calibrate import ScanTable, fit, logistic, monotone, passing_score


def test_logistic_recovers_weights():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(20_000, 2)) * [1, 10] + [0, 5]
    truth = 0.5 + features @ [2.0, -0.1]
    labels = rng.random(len(features)) < 1 / (1 + np.exp(-truth))
    bias, weights = logistic(features, labels)
    np.testing.assert_allclose([bias, *weights], [0.5, 2.0, -0.1], rtol=0.1)


def test_monotone_recovers_probabilities():
    rng = np.random.default_rng(0)
    logit = rng.normal(0, 3, 20_000)
    probability = 1 / (1 + np.exp(-logit - 1))
    logits, shares = monotone(logit, rng.random(len(logit)) < probability)
    assert (np.diff(logits) > 0).all() and (np.diff(shares) >= 0).all() and 0 < shares[0] and shares[-1] < 1
    np.testing.assert_allclose(np.interp(logit, logits, shares), probability, atol=0.08)


def test_match_assigns_each_person_once():
    people = np.array([[1.0, 0.0, 0.9], [5.0, 0.0, 0.9]])
    centers = np.array([[1.2, 0.1, 0.9], [1.1, 0.0, 0.9], [5.6, 0.0, 0.9], [5.2, 0.0, 2.0], [9.0, 0.0, 0.9]])

    def matched(centers, people):
        strongest_first = -np.arange(len(centers), dtype=float)
        return match(centers[:, :2], strongest_first, people[:, :2], np.ones(len(people), bool)) >= 0

    assert matched(centers, people).tolist() == [True, False, False, True, False]
    assert matched(centers[:0], people).tolist() == []
    assert not matched(centers, people[:0]).any()


def test_passing_score_gives_requested_false_positives():
    assert passing_score(np.array([0.2, 0.9, 0.6, 0.1]), 2) == pytest.approx(0.4)
    # not more than one false positive per scan: all may pass
    assert passing_score(np.array([0.7, 0.3]), 5) == 0.3
    assert passing_score(np.array([0.9, 0.8]), 2) == 0.5
    assert passing_score(np.zeros(0), 5) == 0.5
    # equal scores pass together
    assert passing_score(np.array([0.9, 0.9, 0.9, 0.1]), 2) == pytest.approx(0.95)
    assert passing_score(np.array([0.95, 0.8, 0.8, 0.1]), 2) == pytest.approx(0.875)


def made_tables(rng, scans):
    """Scans with 2 people, each detected twice, and 8 other detections."""
    tables = []
    for _ in range(scans):
        people = rng.uniform(-30, 30, (2, 2))
        places = np.concatenate([people, people + 0.1, rng.uniform(100, 200, (8, 2))])
        is_person = np.arange(12) < 4
        features = np.column_stack([rng.normal(is_person * 2.0, 2), rng.normal(is_person * 4.0, 2), np.ones(12)])
        features[-1, 1] = np.nan

        def verify(header, least, features=features, places=places):
            scores, logits = final_score(features, header), final_logit(features, header)
            pelvises = np.column_stack([places, np.where(scores < least, np.nan, 0)])
            rows = surest_rows(scores, pelvises, logits)
            boxes = [Box(center=pelvises[row], size=np.ones(3), score=scores[row], id=row) for row in rows]
            return SimpleNamespace(boxes=boxes, logits=logits[rows])

        detections = SimpleNamespace(centers=np.column_stack([places, np.zeros(12)]))
        tables.append(ScanTable(detections=detections, features=features, people=people, verify=verify))
    return tables


def test_fit_default_score_gives_one_false_positive_per_scan():
    tables = made_tables(np.random.default_rng(0), 100)
    header = fit(tables)
    boxes = [box for table in tables for box in table.verify(header, header["default_score"]).boxes]
    # one detection per person: the duplicate is neither a true nor a false positive
    assert 70 <= sum(box.id >= 4 for box in boxes) <= 100 and 150 <= sum(box.id < 4 for box in boxes) <= 200
    assert set(header) == {"calibration", "verification", "default_score"}
    assert set(header["verification"]) == {"bias", "logit", "verifier", "log_points", "calibration"}
    assert json.loads(json.dumps(header)) == header


def test_fit_scores_equal_precision_after_suppression():
    header = fit(made_tables(np.random.default_rng(0), 400))
    boxes = [box for table in made_tables(np.random.default_rng(1), 400) for box in table.verify(header, 0.01).boxes]
    scores, labels = np.array([box.score for box in boxes]), np.array([box.id < 4 for box in boxes])
    for low, high in ((0.0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 1.0)):
        rows = (scores >= low) & (scores <= high)
        assert rows.sum() > 30 and abs(scores[rows].mean() - labels[rows].mean()) < 0.08


@pytest.mark.long
def test_calibrate_levels_tilted_scans(tmp_path, monkeypatch):
    scene = detection_scene(3, 12)
    R = rotation_about("y", np.radians(20.0))
    tilted = replace(scene, points=(scene.points @ R.T).astype(np.float32), origin=R @ scene.origin, up=R @ scene.up)
    monkeypatch.setattr(module, "detection_scene", lambda *args, **named: tilted)
    seen = []
    real = module.Detector.detect

    def detect(self, points, origin, **options):
        seen.append(points)
        return real(self, points, origin, **options)

    monkeypatch.setattr(module.Detector, "detect", detect)
    monkeypatch.setattr(module, "fit", lambda tables: {"default_score": 0.5})
    network = DetectorNet(DetectorConfig(channels=(8, 8, 16), coarse_channels=(4, 8), hidden=16))
    save_checkpoint(tmp_path / module.MODEL, network, card={})
    module.calibrate(tmp_path, 1)
    # within the accuracy of the leveling
    off = np.linalg.norm(seen[0] - scene.points, axis=1)
    assert np.median(off / np.maximum(np.linalg.norm(scene.points, axis=1), 1)) < 0.05
