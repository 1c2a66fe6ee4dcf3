"""Calibrates a trained detector's scores on held-out scans and stores the calibration with the network.

Legend: D detections of a scan, F features.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.eval.detector.detection_scores import MATCH_RADIUS, match
from lidarpose.eval.detector.evaluate_detector import run_detector
from lidarpose.inference.detection import MOST_POSED
from lidarpose.inference.verification import FEATURES, VerifiedPeople, verification_features, verified
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.detector.detector import MAX_RANGE, Detections, Detector
from lidarpose.models.detector.network import DetectorNet
from lidarpose.models.detector.render import render
from lidarpose.models.export import export_detector
from lidarpose.progress import Progress
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train.detector.candidate_source import as_detected, scan_example
from lidarpose.train.run_dir import MODEL

DETECTOR = "detector.onnx"
# a seed that neither training runs nor benchmarks use
_SEED = 2**31 - 11
# number of training scans whose candidates determine the ranges of the quantized convolutions
_QUANTIZED_ON = 30
# false positives per scan at the default score
FALSE_PER_SCAN = 1.0
# score threshold of the detections that the calibration is fitted to
_LEAST_SCORE = 0.01
# logistic regression on standardized features: ridge penalty, Newton steps; maximum number of knots of the curve
_RIDGE, _NEWTON_STEPS, _KNOTS = 1e-3, 30, 16


def calibrate(folder: str | Path, scans: int, *, labeled: str | Path | None = None) -> Path:
    """Writes the detector of a run with scores calibrated on the given number of scans, and returns its path.

    labeled: a folder of labeled real scans, see `labeled_scans`; the default score is then high enough that at most
    `FALSE_PER_SCAN` false positives per scan pass on these, too. Raises InputError if a folder holds no detector or no
    scans.
    """
    check_int("--calibrate", scans, least=1)
    path = Path(folder) / MODEL
    if not path.is_file():
        raise InputError(f"{path} does not exist: give the folder of a run of lidarpose train-detector")
    network, header = load_checkpoint(path)
    if not isinstance(network, DetectorNet):
        raise InputError(f"{path}: expected a detector, got a network of the kind {header.network}")
    out = Path(folder) / DETECTOR
    candidates = [scan_example(_SEED, number).candidates for number in range(_QUANTIZED_ON)]
    examples = [render(scan_candidates) for scan_candidates in candidates if len(scan_candidates)]
    export_detector(network, out, card=header.card, examples=examples)
    detector = Detector(out)

    tables: list[ScanTable] = []
    with Progress(scans, unit="scans") as bar:
        for number in range(scans):
            scene = detection_scene(_SEED, number, family="heldout")
            scene = as_detected(scene, scene.origin)
            box_rows = np.unique(scene.person[scene.person >= 0])
            people = np.array([scene.boxes[row].center[:2] for row in box_rows]).reshape(-1, 2)
            detections = detector.detect(scene.points, scene.origin, max_range=MAX_RANGE, limit=MOST_POSED)
            features = verification_features(detections, scene.points, scene.origin)
            beside = partial(detector.detect_beside, scene.points, scene.origin, detections.ground)
            verify = partial(verified, detections, scene.points, scene.origin, detect_beside=beside)
            tables.append(ScanTable(detections=detections, features=features, people=people, verify=verify))
            bar.update(number + 1)
    card = header.card | fit(tables) | {"calibrated_on": scans}
    export_detector(network, out, card=card, examples=examples)
    if labeled is not None:
        (result,), _ = run_detector(weights=out, heldout=False, folders=[labeled], max_range=MAX_RANGE)
        card |= {"default_score": max(card["default_score"], result.thresholds[f"{FALSE_PER_SCAN:g}"])}
        export_detector(network, out, examples=examples, card=card | {"labeled_scans": result.scans})
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanTable:
    """D detections in a scan of P people: features (D, F), see `verification_features`; people (P, 2) m; verify: maps
    a header and a score threshold to the people among the detections, as `verified` finds them."""

    detections: Detections
    features: np.ndarray
    people: np.ndarray
    verify: Callable[[dict, float], VerifiedPeople]

    def is_near(self) -> np.ndarray:
        """(D,): whether a person is near each detection; several detections may be of one person."""
        distance = np.linalg.norm(self.detections.centers[:, None, :2] - self.people[None], axis=-1)
        return (distance < MATCH_RADIUS).any(1)

    def is_first(self, scores: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """(K,): whether each box, with scores (K,) and centers (K, 3) m, is the highest-scoring one of a person."""
        return match(centers[:, :2], scores, self.people, np.ones(len(self.people), bool)) >= 0


def fit(tables: Sequence[ScanTable]) -> dict:
    """The entries "calibration", "verification" and "default_score" of a header.

    The logistic regression counts every detection near a person as a positive: duplicates are removed later and are
    not false positives. The calibration of the score, and the default score, which lets `FALSE_PER_SCAN` false
    positives per scan pass, are fitted to the detections that remain after verification.
    """
    features = np.concatenate([table.features for table in tables])
    is_near = np.concatenate([table.is_near() for table in tables])
    is_verified = np.isfinite(features).all(1)
    bias, weights = logistic(features[is_verified], is_near[is_verified])
    verification: dict[str, Any] = {"bias": bias, **dict(zip(FEATURES, weights.tolist(), strict=True))}
    logits: list[np.ndarray] = []
    labels: list[np.ndarray] = []
    for table in tables:
        people = table.verify({"verification": verification}, _LEAST_SCORE)
        centers = np.array([box.center for box in people.boxes]).reshape(-1, 3)
        logits.append(people.logits)
        labels.append(table.is_first(people.logits, centers))
    logit, is_person = np.concatenate(logits), np.concatenate(labels)
    verification["calibration"] = monotone(logit, is_person)
    is_first = np.concatenate([table.is_first(table.features[:, 0], table.detections.centers) for table in tables])
    header = {"calibration": monotone(features[:, 0], is_first), "verification": verification}
    false = np.interp(logit[~is_person], *verification["calibration"])
    return header | {"default_score": passing_score(false, len(tables))}


def passing_score(false: np.ndarray, scans: int) -> float:
    """The score threshold that at most `FALSE_PER_SCAN` false positives per scan reach.

    false (D,): scores of all false positives in the given number of scans.
    """
    budget = round(FALSE_PER_SCAN * scans)
    if len(false) <= budget:
        return float(false.min(initial=0.5))
    # midway between the first false positive beyond the budget and the next higher score: equal scores pass together
    first = np.sort(false)[::-1][budget]
    return float(first + false[false > first].min(initial=1.0)) / 2


def logistic(features: np.ndarray, labels: np.ndarray) -> tuple[float, np.ndarray]:
    """The bias and weights (F,) of a logistic regression of labels (D,), by Newton's method, with a small ridge."""
    mean, scale = features.mean(0), features.std(0) + 1e-6
    x = np.column_stack([np.ones(len(features)), (features - mean) / scale])
    weights = np.zeros(x.shape[1])
    shrink = _RIDGE * len(x) * np.eye(len(weights))
    for _ in range(_NEWTON_STEPS):
        probability = 1 / (1 + np.exp(-x @ weights))
        gradient = x.T @ (probability - labels) + shrink @ weights
        hessian = (x * (probability * (1 - probability))[:, None]).T @ x + shrink
        weights -= np.linalg.solve(hessian, gradient)
    feature_weights = weights[1:] / scale
    return float(weights[0] - feature_weights @ mean), feature_weights


def monotone(logit: np.ndarray, labels: np.ndarray) -> list[list[float]]:
    """Knots [[logits], [probabilities]] of the share of true labels as a rising function of the logit: groups of
    similar logits are merged until each has a larger share than the one before (pool adjacent violators)."""
    order = np.argsort(logit, kind="stable")
    # half of the knots at quantiles of the positives, half at quantiles of the negatives
    quantiles = np.linspace(0, 1, _KNOTS // 2 + 1)[1:-1]
    pivots = np.unique(np.concatenate([np.quantile(logit[labels == label], quantiles) for label in np.unique(labels)]))
    groups = np.split(order, np.searchsorted(logit[order], pivots))
    pools: list[np.ndarray] = []
    for group in groups:
        if not len(group):
            continue
        pools.append(group)
        while len(pools) > 1 and labels[pools[-2]].mean() >= labels[pools[-1]].mean():
            last_pool = pools.pop()
            pools[-1] = np.concatenate([pools[-1], last_pool])
    # half a positive and half a negative are added, so that no probability is 0 or 1
    shares = [(labels[pool].sum() + 0.5) / (len(pool) + 1) for pool in pools]
    middles = [float(logit[pool].mean()) for pool in pools]
    return [[round(value, 4) for value in middles], [round(float(value), 5) for value in np.maximum.accumulate(shares)]]
