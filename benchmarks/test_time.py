"""What more work at test time brings on lidarpose-bench, and what it costs.

    python benchmarks/test_time.py tiny --limit 1000 --out docs/scores/test_time.json

Passes: each but the first is about the pelvis of the one before. Transforms: the last pass is repeated with the
person mirrored, turned by quarters, or shifted in the grid of voxels, and joints are averaged (`inference/tta.py`), or
heatmaps are (as logarithms, brought to the mean vote). Rejection: the error of the most confident people and joints.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from ablation_tables import figures

from lidarpose import evaluation
from lidarpose.inference.backend import Raw, estimates
from lidarpose.inference.estimator import PASSES
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.tta import TRANSFORMS, TTATransform, apply
from lidarpose.io.files import write_atomic
from lidarpose.sample import Pose
from lidarpose.skeleton import BODY26

# a logarithm that stands for a bin out of the heatmap, or of next to no weight
_LEAST = -12.0
_FLIP = np.array(BODY26.flip)


@dataclass(frozen=True)
class Way:
    what: str
    passes: int = PASSES
    transforms: tuple[TTATransform, ...] = (TTATransform(),)
    heatmaps: bool = False


_SYMMETRIES = tuple(TTATransform(turns, mirrored) for turns in range(4) for mirrored in (False, True))
USUAL = Way("two passes, one prediction (`--tta 1`)")
WAYS = (
    Way("one pass", passes=1),
    USUAL,
    Way("three passes", passes=3),
    Way("and mirrored, joints averaged", transforms=_SYMMETRIES[:2]),
    Way("and mirrored, heatmaps averaged", transforms=_SYMMETRIES[:2], heatmaps=True),
    Way("four quarter rotations, joints averaged", transforms=_SYMMETRIES[::2]),
    Way("four rotations, each mirrored too, joints averaged", transforms=_SYMMETRIES),
    Way("`--tta 2`: rotated, mirrored and shifted", transforms=TRANSFORMS[:2]),
    Way("`--tta 4`", transforms=TRANSFORMS[:4]),
    Way("`--tta 8`", transforms=TRANSFORMS),
)


class Averaging(Predictor):
    """A predictor of other passes and transforms."""

    def __init__(self, predictor: Predictor, way: Way):
        super().__init__(predictor.backend, name=predictor.model["name"], decode=predictor.model["decode"])
        self._passes, self._tta, self.heatmaps = way.passes, way.transforms, way.heatmaps

    def outputs(self, clouds, centers, origin, clip=None, *, transforms=TRANSFORMS[:1]) -> Pose:
        if not self.heatmaps:
            return super().outputs(clouds, centers, origin, clip, transforms=transforms)
        raws = [self._raw(transform, clouds, centers, origin) for transform in transforms]
        return estimates(_fused(raws), self._decoder, self.skeleton)

    def _raw(
        self, transform: TTATransform, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None
    ) -> Raw:
        """What the network says of people shown so, brought back before it is decoded: heatmaps turn exactly."""
        R, heatmaps = transform.R_view_person, []
        raw = self.backend.run(*apply(transform, clouds, centers, origin))
        for axis in range(3):
            source = int(np.abs(R[:, axis]).argmax())
            heatmaps.append(raw.heatmaps[source][..., :: int(R[source, axis])])
        values = {name: getattr(raw, name) for name in ("confidence", "log_spread", "visible")}
        values |= {"vote": raw.vote @ R + transform.shift, "heatmaps": tuple(heatmaps)}
        if transform.mirrored:
            values = {k: tuple(h[:, _FLIP] for h in v) if k == "heatmaps" else v[:, _FLIP] for k, v in values.items()}
        return replace(raw, **values)


def _fused(raws: list[Raw]) -> Raw:
    """One answer: the mean vote, and about it the mean of the heatmaps' logarithms."""
    vote = np.mean([raw.vote for raw in raws], 0)
    heatmaps = []
    for axis in range(3):
        sums = 0.0
        for raw in raws:
            logits = raw.heatmaps[axis].astype(float)
            logits = logits - np.log(np.exp(logits - logits.max(-1, keepdims=True)).sum(-1, keepdims=True))
            logits = np.maximum(logits - logits.max(-1, keepdims=True), _LEAST)
            index = np.arange(logits.shape[-1]) + ((vote - raw.vote)[..., axis] / raw.step[axis])[..., None]
            below = np.floor(index).astype(int)
            share = index - below
            sums = sums + (1 - share) * _bins(logits, below) + share * _bins(logits, below + 1)
        heatmaps.append(sums / len(raws))
    told = {name: np.mean([getattr(raw, name) for raw in raws], 0) for name in ("confidence", "log_spread", "visible")}
    return replace(raws[0], vote=vote, heatmaps=tuple(heatmaps), **told)


def _bins(logits: np.ndarray, index: np.ndarray) -> np.ndarray:
    inside = (index >= 0) & (index < logits.shape[-1])
    return np.where(inside, np.take_along_axis(logits, np.clip(index, 0, logits.shape[-1] - 1), -1), _LEAST)


def rejection(predictions) -> list[dict]:
    """Error of what is kept, the most confident first: whole people, and joints on their own."""
    error = predictions.errors()
    people, joints = [], []
    for score, value, rows in (
        (predictions.confidence.mean(1), error.mean(1), people),
        (predictions.confidence.ravel(), error.ravel(), joints),
    ):
        order = np.argsort(-score)
        rows += [value[order[: max(round(share * len(order)), 1)]].mean() for share in (1.0, 0.9, 0.8, 0.7, 0.5)]
    kept = (100, 90, 80, 70, 50)
    found = zip(kept, people, joints, strict=True)
    return [{"kept": k, "people": round(float(p), 2), "joints": round(float(j), 2)} for k, p, j in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("--out", type=Path, required=True, help="a JSON file; other weights in it are kept")
    parser.add_argument("--limit", type=int, help="only so many people")
    options = parser.parse_args()
    model = load(options.weights, threads=1, tta=1)
    ways = []
    for way in WAYS:
        started = time.process_time()
        done = evaluation.run(Averaging(model, way), ["bench"], limit=options.limit)
        seconds = time.process_time() - started
        if way is USUAL:
            kept = rejection(done.evaluations[0].predictions)
        ways.append({"what": way.what, "usual": way is USUAL, "seconds": round(seconds, 2)})
        ways[-1]["figures"] = figures(done.scores.results[0])
        print(f"{way.what:<52} {ways[-1]['figures']['all']['value']:.1f} mm  {seconds:.1f} s", flush=True)
    found = json.loads(options.out.read_text()) if options.out.is_file() else {}
    found[Path(options.weights).stem] = {"ways": ways, "rejection": kept}
    write_atomic(options.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
