"""What a trained detector's scores mean: fitted on scans of what training never shows, and written beside the network.

Legend: D detections of all scans, F features.
"""

from pathlib import Path

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.eval.detector.detection_scores import match
from lidarpose.eval.detector.evaluate_detector import run_detector
from lidarpose.inference.detection import MAX_RANGE, MOST_POSED
from lidarpose.inference.verification import final_score, score_terms, verification_features
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.detector.detector import Detector
from lidarpose.models.detector.network import DetectorNet
from lidarpose.models.export import export_detector
from lidarpose.progress import Progress
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train.detector.candidate_source import as_detected
from lidarpose.train.run_dir import MODEL

DETECTOR = "detector.onnx"
# a seed of which neither a run nor a bench has scans
_SEED = 2**31 - 11
# false people a scan at the default score
FALSE = 1.0
# of the logistic, on standardized features; of the piecewise linear curve, its knots at most
_RIDGE, _KNOTS = 1e-3, 16


def calibrate(folder: str | Path, scans: int, *, labeled: str | Path | None = None) -> Path:
    """Writes the detector of a run, its scores calibrated on so many scans, and returns its path.

    labeled: a folder of labeled real scans, see `labeled_scans`; there too the default score lets at most `FALSE` false
    people a scan pass. Raises InputError where a folder holds no detector or no scans.
    """
    check_int("--calibrate", scans, least=1)
    path = Path(folder) / MODEL
    if not path.is_file():
        raise InputError(f"{path} is not there: name the folder of a run of lidarpose train-detector")
    network, header = load_checkpoint(path)
    if not isinstance(network, DetectorNet):
        raise InputError(f"{path}: expected a detector, got a network of the kind {header.network}")
    out = Path(folder) / DETECTOR
    export_detector(network, out, card=header.card)
    detector = Detector(out)

    tables: list[tuple[np.ndarray, ...]] = []
    with Progress(scans, unit="scans") as bar:
        for number in range(scans):
            scene = detection_scene(_SEED, number, family="heldout")
            scene = as_detected(scene, scene.origin)
            box_rows = np.unique(scene.person[scene.person >= 0])
            people = np.array([scene.boxes[row].center for row in box_rows]).reshape(-1, 3)
            detections = detector.detect(scene.points, scene.origin, max_range=MAX_RANGE, limit=MOST_POSED)
            features, _ = verification_features(detections, scene.points, scene.origin)
            # the strongest first
            matches = match(detections.centers[:, :2], detections.logit, people[:, :2], np.ones(len(people), bool))
            tables.append((features, matches >= 0))
            bar.update(number + 1)
    features, is_person = (np.concatenate(column) for column in zip(*tables, strict=True))
    card = header.card | fit(features, is_person, scans) | {"calibrated_on": scans}
    export_detector(network, out, card=card)
    if labeled is not None:
        (result,), _ = run_detector(weights=out, heldout=False, folders=[labeled], max_range=MAX_RANGE)
        card |= {"default_score": max(card["default_score"], result.thresholds[f"{FALSE:g}"])}
        export_detector(network, out, card=card | {"labeled_scans": result.scans})
    return out


def fit(features: np.ndarray, is_person: np.ndarray, scans: int) -> dict:
    """The entries "calibration", "verification" and "default_score" of a header.

    features: (D, 6) of detections in so many scans, see `inference.verification.FEATURES`, NaN of those that could not
    be posed; is_person: (D,). The default score lets `FALSE` false people a scan pass.
    """
    is_posed = np.isfinite(features).all(1)
    posed_features, labels = features[is_posed], is_person[is_posed]
    terms = score_terms(posed_features)
    table = np.column_stack(list(terms.values()))
    bias, weights = logistic(table, labels)
    verification = {"bias": bias, **dict(zip(terms, weights.tolist(), strict=True))}
    verification["calibration"] = monotone(bias + table @ weights, labels)
    header = {"calibration": monotone(features[:, 0], is_person), "verification": verification}
    return header | {"default_score": passing_score(final_score(posed_features, header)[~labels], scans)}


def passing_score(false: np.ndarray, scans: int) -> float:
    """The score that lets `FALSE` false people a scan pass. false (D,): scores of all of them in so many scans."""
    false = np.sort(false)[::-1]
    last = min(round(FALSE * scans), len(false) - 1)
    # between the last false one that passes and the first that does not
    return float(false[last - 1 : last + 1].mean()) if last > 0 else 0.5


def logistic(features: np.ndarray, labels: np.ndarray, *, iterations: int = 30) -> tuple[float, np.ndarray]:
    """The bias and weights (F,) of a logistic regression of labels (D,), by Newton's method, slightly shrunk."""
    mean, scale = features.mean(0), features.std(0) + 1e-6
    x = np.column_stack([np.ones(len(features)), (features - mean) / scale])
    weights = np.zeros(x.shape[1])
    shrink = _RIDGE * len(x) * np.eye(len(weights))
    for _ in range(iterations):
        probability = 1 / (1 + np.exp(-x @ weights))
        gradient = x.T @ (probability - labels) + shrink @ weights
        hessian = (x * (probability * (1 - probability))[:, None]).T @ x + shrink
        weights -= np.linalg.solve(hessian, gradient)
    feature_weights = weights[1:] / scale
    return float(weights[0] - feature_weights @ mean), feature_weights


def monotone(logit: np.ndarray, labels: np.ndarray) -> list[list[float]]:
    """Knots [[logits], [probabilities]] of the share of true labels by logit, rising: groups of like logits, joined
    until each has a larger share than the one before (pool adjacent violators)."""
    order = np.argsort(logit, kind="stable")
    # half of the knots where people are, half where they are not
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
    # half a one of each kind more: nothing is certain
    shares = [(labels[pool].sum() + 0.5) / (len(pool) + 1) for pool in pools]
    middles = [float(logit[pool].mean()) for pool in pools]
    return [[round(value, 4) for value in middles], [round(float(value), 5) for value in np.maximum.accumulate(shares)]]
