"""One call of `lidarpose evaluate detector`: the detector, the sets of scans, the folder of results."""

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose._version import __version__
from lidarpose.errors import InputError, check_int, check_name
from lidarpose.eval.detector.detection_pictures import draw_false, draw_missed
from lidarpose.eval.detector.detection_scores import Detect, DetectorResult, score_detector
from lidarpose.eval.detector.labeled_scans import ScanSet, heldout_scans, labeled_scans
from lidarpose.inference.detection import Search, find_people
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.scan import Scan
from lidarpose.io.atomic import write_all_atomic
from lidarpose.models.detector.candidates import suppress_near
from lidarpose.models.detector.detector import SAME, Detector
from lidarpose.models.detector.ground import estimate_ground, without_ground
from lidarpose.models.detector.proposals import propose
from lidarpose.sample import Box

SCHEMA = "lidarpose.detector-scores/1"
FILE = "detector.json"
METHODS = ("detector", "scorer", "pose", "candidates")
# size of the box around a candidate, m
_CANDIDATE = np.array([0.9, 0.9, 2.0])
# mean spread at which the score of a pose has fallen to 1 / e, m
_SPREAD = 0.1


def detector_of(method: str, detector: Detector | None, *, max_range: float) -> Detect:
    """The search function of a method.

    "detector" is `lidarpose.detect`, "scorer" the same without poses. Two untrained baselines rank the candidates of
    the detector: "pose" by the spread of the pose that `tiny` predicts, "candidates" by their order. All but "detector"
    assume a level frame.

    Args:
        detector: for the first two methods; None for the bundled one.
    """
    # also checks the range for the other methods
    search = Search(max_range=max_range, min_score=0.0, detector=detector)
    if method == "detector":
        return partial(_detect, search)
    if method == "scorer":
        return partial(_scorer, detector or Detector(), max_range=max_range)
    return partial(_baseline, load("tiny", tta=1) if method == "pose" else None)


def _detect(search: Search, points: np.ndarray, origin: np.ndarray | None) -> tuple[Sequence[Box], np.ndarray]:
    boxes = find_people(Scan(points=points, origin=origin), search).boxes or []
    return boxes, np.array([box.score for box in boxes], float)


def _scorer(detector: Detector, points: np.ndarray, origin: np.ndarray | None, *, max_range: float):
    detections = detector.detect(points, origin, max_range=max_range, limit=None)
    boxes = zip(detections.centers, detections.sizes, strict=True)
    return [Box(center=center, size=size) for center, size in boxes], detections.score


def _baseline(predictor: Predictor | None, points: np.ndarray, origin: np.ndarray | None):
    ground = estimate_ground(points, origin) or without_ground(points, origin)
    centers = propose(points, ground)
    boxes = [Box(center=center + [0, 0, _CANDIDATE[2] / 2], size=_CANDIDATE) for center in centers]
    scores = 1 - np.arange(len(boxes)) / max(len(boxes), 1)
    if predictor is not None and boxes:
        poses = predictor.predict(points, boxes=boxes, sensor_origin="unknown" if origin is None else origin)
        scores = np.array([np.exp(-person.spread.mean() / _SPREAD) if person.has_pose else 0.0 for person in poses])
    indices = suppress_near(centers, scores, SAME)
    return [boxes[k] for k in indices], scores[indices]


def run_detector(
    method: str = "detector",
    *,
    weights: str | os.PathLike | None = None,
    heldout: bool = True,
    folders: Sequence[str | os.PathLike] = (),
    max_range: float = 40.0,
    network: str | None = None,
    limit: int | None = None,
    sensor_unknown: bool = False,
    seed: int = 0,
    detect: Detect | None = None,
    progress: Callable[[str, int, int], None] = lambda dataset, done, total: None,
) -> tuple[list[DetectorResult], list[ScanSet]]:
    """Scores a detector on the frozen scenes and on folders of labeled scans.

    Args:
        method: see `detector_of`.
        detect: a search function to evaluate instead.
        weights: a detector's ONNX file, None for the bundled one.
        heldout: score on the frozen scenes.
        folders: see `labeled_scans`.
        max_range: m, people farther away are ignored.
        network: weights whose poses in detected boxes are compared with those in labeled boxes; None leaves this out.
        limit: number of scans of each set, evenly spread; None for all.
        sensor_unknown: do not pass the sensor's position, so that people are searched for at any distance.
    """
    check_name("method", method, METHODS)
    if limit is not None:
        check_int("limit", limit, least=1)
    if weights is not None and (detect is not None or method not in ("detector", "scorer")):
        raise InputError(f"a detector's file is for the methods detector and scorer, got {method}: omit it")
    sets = [heldout_scans(limit)] if heldout else []
    sets += [labeled_scans(folder, limit) for folder in folders]
    set_names = [scans.name for scans in sets]
    if duplicate := next((name for name in set_names if set_names.count(name) > 1), None):
        raise InputError(f"two sets of scans are called {duplicate}: evaluate them one by one, or rename a folder")
    default_score = None
    if detect is None:
        detector = Detector(weights) if method in ("detector", "scorer") else None
        default_score = detector.header.get("default_score") if detector and method == "detector" else None
        detect = detector_of(method, detector, max_range=max_range)
    predictor = None if network is None else load(network, tta=1)
    score = partial(
        score_detector,
        detect,
        max_range=max_range,
        default_score=default_score,
        predictor=predictor,
        sensor_unknown=sensor_unknown,
        seed=seed,
    )
    return [score(scans, progress=partial(progress, scans.name)) for scans in sets], sets


def write_detector(
    results: Sequence[DetectorResult],
    sets: Sequence[ScanSet],
    folder: Path,
    about: dict[str, Any],
    pictures: Path | None = None,
) -> list[Path]:
    """Writes detector.json and, into the folder `pictures` if given, pictures of false positives and missed people;
    returns all paths."""
    names = ("dataset", "scans", "changed", "thresholds", "reliability", "things", "rows")
    entries = [{name: getattr(result, name) for name in names} for result in results]
    text = json.dumps({"schema": SCHEMA, "version": __version__} | about | {"results": entries})
    # one line per row
    files: dict[Path, bytes | None] = {folder / FILE: text.replace('{"figure"', '\n{"figure"').encode() + b"\n"}
    if pictures is not None:
        for result, scans in zip(results, sets, strict=True):
            files[pictures / f"{scans.name}-false.png"] = draw_false(result, scans)
            files[pictures / f"{scans.name}-missed.png"] = draw_missed(result, scans)
    contents = {path: content for path, content in files.items() if content}
    write_all_atomic(contents)
    return list(contents)
