"""Benefit and cost of test-time augmentation on lidarpose-bench.

    python benchmarks/test_time.py tiny --limit 1000 --out docs/scores/test_time.json

The first pass locates the pelvis, at which the other passes are centered: with the person mirrored, rotated by quarter
turns, or shifted in the voxel grid. Joints are averaged (`inference/tta.py`). Rejection: the error of the most
confident people and joints. Cost is the processor time of prediction, on one thread, in batches.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ablation_tables import figures

from lidarpose import evaluation
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.tta import IDENTITY, MIRRORED, TRANSFORMS, TTATransform
from lidarpose.io.atomic import write_atomic


@dataclass(frozen=True)
class Way:
    """A setting of passes. first: transform in the pass that locates the pelvis; averaged: whether its prediction is
    averaged, too; transforms: those of the passes after it."""

    what: str
    transforms: tuple[TTATransform, ...] = (IDENTITY,)
    first: TTATransform = MIRRORED
    averaged: bool = True


USUAL = Way("`--tta 1`, the first pass mirrored and averaged")
WAYS = (
    Way("one pass about the pelvis, the first not averaged", first=IDENTITY, averaged=False),
    Way("the first averaged, not mirrored", first=IDENTITY),
    USUAL,
    Way("four quarter rotations", tuple(TTATransform(turns) for turns in range(4))),
    Way("`--tta 2`", TRANSFORMS[:2]),
    Way("`--tta 4`", TRANSFORMS[:4]),
    Way("`--tta 4`, the first not averaged", TRANSFORMS[:4], averaged=False),
    Way("`--tta 8`", TRANSFORMS),
)


class Shown(Predictor):
    """A predictor with other passes."""

    def __init__(self, predictor: Predictor, way: Way):
        super().__init__(predictor.backend, name=predictor.model["name"], decode=predictor.model["decode"])
        self._first, self._tta, self._averaged = way.first, way.transforms, way.averaged
        self.seconds, self.people = 0.0, 0

    def predict_in(self, *arguments, **options):
        """As in `Predictor`, but adds up the processor time."""
        start = time.process_time()
        people = super().predict_in(*arguments, **options)
        self.seconds += time.process_time() - start
        self.people += len(people)
        return people


def rejection(predictions) -> list[dict]:
    """Errors of the most confident shares, of whole people and of single joints."""
    error = predictions.errors()
    people, joints = [], []
    for score, value, rows in (
        (predictions.confidence.mean(1), error.mean(1), people),
        (predictions.confidence.ravel(), error.ravel(), joints),
    ):
        order = np.argsort(-score)
        rows += [value[order[: max(round(share * len(order)), 1)]].mean() for share in (1.0, 0.9, 0.8, 0.7, 0.5)]
    kept_percent = (100, 90, 80, 70, 50)
    levels = zip(kept_percent, people, joints, strict=True)
    return [{"kept": k, "people": float(p), "joints": float(j)} for k, p, j in levels]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("--out", type=Path, required=True, help="a JSON file; other weights in it are kept")
    parser.add_argument("--limit", type=int, help="only so many people")
    options = parser.parse_args()
    model = load(options.weights, threads=1, tta=1)
    results = []
    for setting in WAYS:
        shown = Shown(model, setting)
        run_result = evaluation.run(shown, ["bench"], limit=options.limit)
        if setting is USUAL:
            rejection_rows = rejection(run_result.evaluations[0].predictions)
        ms = shown.seconds / shown.people * 1e3
        results.append({"what": setting.what, "usual": setting is USUAL, "ms": ms})
        results[-1]["figures"] = figures(run_result.scores.results[0])
        print(f"{setting.what:<52} {results[-1]['figures']['all']['value']:.1f} mm  {ms:.1f} ms", flush=True)
    stored_results = json.loads(options.out.read_text()) if options.out.is_file() else {}
    stored_results[Path(options.weights).stem] = {"ways": results, "rejection": rejection_rows}
    write_atomic(options.out, json.dumps(stored_results, indent=1) + "\n")


if __name__ == "__main__":
    main()
