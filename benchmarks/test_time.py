"""What more work at test time brings on lidarpose-bench, and what it costs.

    python benchmarks/test_time.py tiny --out docs/scores/test_time.json

Passes: each but the first is about the pelvis that the one before found. Views: the last pass is repeated with the
person mirrored, turned by quarters, or shifted in the grid of voxels by up to a fine voxel, and joints are averaged, or
heatmaps are (as logarithms, brought to the mean vote). Rejection: the error of the most confident people and joints.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from ablations import figures

from lidarpose import evaluation
from lidarpose.data.files import write_atomic
from lidarpose.infer.backend import Estimates, Raw, estimates
from lidarpose.infer.predictor import _CENTER_STEP, Predictor, load
from lidarpose.model.plan import WINDOW, view_features
from lidarpose.sample import Pose, center_of
from lidarpose.skeleton import BODY26

# a logarithm that stands for a bin out of the heatmap, or of next to no weight
_LEAST = -12.0
_FLIP = np.array(BODY26.flip)
# quarter turns about z, each alone and mirrored; signed permutations, so that heatmaps turn exactly
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass(frozen=True)
class View:
    """How the person is shown: `turns` quarters, then a mirror across y; shift (3,) m of the grid."""

    turns: int = 0
    mirrored: bool = False
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def R_shown_person(self) -> np.ndarray:
        cosine, sine = _QUARTERS[self.turns]
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], float)
        return np.diag([1, -1, 1]) @ turn if self.mirrored else turn


@dataclass(frozen=True)
class Way:
    what: str
    passes: int = 2
    views: tuple[View, ...] = (View(),)
    heatmaps: bool = False


def _shifts(count: int) -> tuple[View, ...]:
    rng = np.random.default_rng(0)
    return tuple(View(shift=tuple(rng.uniform(-0.06, 0.06, 3))) for _ in range(count))


_ALL = tuple(View(turns, mirrored) for turns in range(4) for mirrored in (False, True))
USUAL = Way("as shipped: two passes, one view")
WAYS = (
    Way("one pass", passes=1),
    USUAL,
    Way("three passes", passes=3),
    Way("and mirrored, joints averaged", views=_ALL[:2]),
    Way("and mirrored, heatmaps averaged", views=_ALL[:2], heatmaps=True),
    Way("and turned by half, joints averaged", views=_ALL[::4]),
    Way("four turns, joints averaged", views=_ALL[::2]),
    Way("four turns, heatmaps averaged", views=_ALL[::2], heatmaps=True),
    Way("four turns, each mirrored too, joints averaged", views=_ALL),
    Way("four turns, each mirrored too, heatmaps averaged", views=_ALL, heatmaps=True),
    Way("three shifts of the grid besides, joints averaged", views=(View(), *_shifts(3))),
)


class Averaging(Predictor):
    """A predictor whose last pass is repeated and averaged."""

    def __init__(self, predictor: Predictor, way: Way):
        super().__init__(predictor.backend, name=predictor.model["name"], decode=predictor.model["decode"])
        self.way = way

    def _poses(self, clouds: list[np.ndarray], origin: np.ndarray | None) -> list[Pose | None]:
        centers = np.stack([center_of(points) for points in clouds])
        for _ in range(self.way.passes - 1):
            found = self.outputs(clouds, centers, origin)
            root = np.clip(found.joints[:, self._root].mean(1), -WINDOW / 2, WINDOW / 2)
            centers = centers + np.round(root / _CENTER_STEP) * _CENTER_STEP
        found = self._averaged([self._seen(view, clouds, centers, origin) for view in self.way.views])
        return [
            Pose(
                joints=found.joints[k] + center,
                skeleton=self.skeleton,
                **{name: getattr(found, name)[k] for name in ("confidence", "spread", "visible", "in_range")},
            )
            for k, center in enumerate(centers)
        ]

    def _seen(self, view: View, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None) -> Raw:
        """What the network says of people shown so, brought back."""
        R, middle = view.R_shown_person, centers + view.shift
        toward = np.stack([view_features(center, origin) for center in middle])
        toward[:, :3] = toward[:, :3] @ R.T
        shown = [(points - center) @ R.T for points, center in zip(clouds, middle, strict=True)]
        raw = self.backend.run(shown, toward)
        heatmaps = []
        for axis in range(3):
            source = int(np.abs(R[:, axis]).argmax())
            heatmaps.append(raw.heatmaps[source][..., :: int(R[source, axis])])
        values = {name: getattr(raw, name) for name in ("confidence", "log_spread", "visible")}
        values |= {"vote": raw.vote @ R + view.shift, "heatmaps": tuple(heatmaps)}
        if view.mirrored:
            values = {k: tuple(h[:, _FLIP] for h in v) if k == "heatmaps" else v[:, _FLIP] for k, v in values.items()}
        return replace(raw, **values)

    def _averaged(self, raws: list[Raw]) -> Estimates:
        if len(raws) == 1 or self.way.heatmaps:
            return estimates(_fused(raws), self._decoder)
        each = [estimates(raw, self._decoder) for raw in raws]
        names = ("joints", "confidence", "spread", "visible")
        means = {name: np.mean([getattr(one, name) for one in each], 0) for name in names}
        return replace(each[0], **means)


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


def rejection(judged) -> list[dict]:
    """Error of what is kept, the most confident first: whole people, and joints on their own."""
    error = judged.errors() * 1.0
    people, joints = [], []
    for score, value, rows in (
        (judged.confidence.mean(1), error.mean(1), people),
        (judged.confidence.ravel(), error.ravel(), joints),
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
    model = load(options.weights)
    ways = []
    for way in WAYS:
        started = time.process_time()
        # the usual one as it is, so that a fault of the twin above would show
        judge = model if way is USUAL else Averaging(model, way)
        done = evaluation.run(judge, ["bench"], limit=options.limit)
        seconds = time.process_time() - started
        if way is USUAL:
            kept = rejection(done.evaluations[0].judged)
        ways.append({"what": way.what, "usual": way is USUAL, "seconds": round(seconds, 2)})
        ways[-1]["figures"] = figures(done.scores.results[0])
        print(f"{way.what:<52} {ways[-1]['figures']['all']['value']:.1f} mm  {seconds:.1f} s", flush=True)
    found = json.loads(options.out.read_text()) if options.out.is_file() else {}
    found[Path(options.weights).stem] = {"ways": ways, "rejection": kept}
    write_atomic(options.out, json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
