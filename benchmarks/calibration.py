"""Calibration of the joints' confidence, spread and visibility on held-out synthetic people.

    python benchmarks/calibration.py --motion cmu_motion.npz \\
        --out docs/images/reliability.png --json docs/scores/calibration.json

The people are those of benchmarks/heldout.py with another seed. `confidence` predicts the probability that a joint is
within 10 cm, `visible` the probability that a point of the body is within 18 cm of it, `spread` its mean error. The
expected calibration error is over ten equal bins; the plot shows them with the share of joints in each.
"""

import argparse
import json
from pathlib import Path

import heldout
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidarpose.inference.predictor import load
from lidarpose.io.atomic import write_atomic
from lidarpose.metrics import auroc, calibration_error
from lidarpose.models import DEFAULT
from lidarpose.sample import CONFIDENCE_RADIUS
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.train.augment import visible_joints

BINS = 10
# ranges of `spread`, m
SPREADS = (
    ("all", 0.0, np.inf),
    ("under 5 cm", 0.0, 0.05),
    ("5 to 10 cm", 0.05, 0.1),
    ("10 to 20 cm", 0.1, 0.2),
    ("over 20 cm", 0.2, np.inf),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", required=True)
    parser.add_argument("--subjects", default="006,007")
    parser.add_argument("--people", type=int, default=1000)
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--out", help="PNG of the reliability plot")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures")
    options = parser.parse_args()
    bank = PoseBank.from_clips(options.motion, tuple(options.subjects.split(",")))
    persons = heldout.people(bank, options.people, 50, heldout.SEED + 9)
    model = load(options.weights, tta=1)
    predictions = model.predict([p.sample.points for p in persons], sensor_origin=(0, 0, 0), skeleton="body26")
    true = np.stack([p.sample.pose.to(BODY26).joints for p in persons])
    error = np.linalg.norm(np.stack([p.joints for p in predictions]) - true, axis=-1)
    body_points = [p.sample.points[p.sample.part > 0].astype(float) for p in persons]
    visible = np.stack([visible_joints(joints, points) for joints, points in zip(true, body_points, strict=True)])
    confidence = np.stack([p.confidence for p in predictions])
    spread = np.stack([p.spread for p in predictions])
    predicted_visible = np.stack([p.pose.visible for p in predictions])
    is_hit = error < CONFIDENCE_RADIUS
    curves = {
        "confidence: the joint is within 10 cm": (confidence.ravel(), is_hit.ravel()),
        "visible: a point of the body lies within 18 cm of the joint": (predicted_visible.ravel(), visible.ravel()),
    }
    report = {"weights": options.weights, "people": len(true), "stated": [], "spread": []}
    for name, (probability, truth) in curves.items():
        entry = {"what": name, "ece": calibration_error(probability, truth), "auroc": auroc(probability, truth)}
        report["stated"].append(entry)
        print(f"{name}: ECE {entry['ece']:.3f}, AUROC {entry['auroc']:.3f}")
    report["rank"] = float(_rank(spread, error))
    print(f"spread and error: rank correlation {report['rank']:.2f}")
    for name, low, high in SPREADS:
        is_in_bin = (spread >= low) & (spread < high)
        entry = {"of": name, "share": 100 * is_in_bin.mean()}
        entry |= {"stated": spread[is_in_bin].mean() * 1e3, "true": error[is_in_bin].mean() * 1e3}
        report["spread"].append({key: value if key == "of" else float(value) for key, value in entry.items()})
        print(
            f"  {name}: {entry['share']:.1f} % of joints, {entry['stated']:.1f} mm stated, {entry['true']:.1f} mm true"
        )
    if options.json:
        write_atomic(options.json, json.dumps(report, indent=1) + "\n")
    if options.out:
        _plot(curves, options.out)


def _rank(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rank correlation."""
    a, b = (np.argsort(np.argsort(x.ravel())) for x in (a, b))
    return float(np.corrcoef(a, b)[0, 1])


def _plot(curves: dict, path: str) -> None:
    figure = Figure(figsize=(7.6, 3.6), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (name, (probability, truth)) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        index = np.minimum((probability * BINS).astype(int), BINS - 1)
        count = np.bincount(index, minlength=BINS)
        is_filled = count > 0
        mean = np.bincount(index, probability, BINS)[is_filled] / count[is_filled]
        share = np.bincount(index, truth, BINS)[is_filled] / count[is_filled]
        axes.bar((np.arange(BINS) + 0.5) / BINS, count / count.sum(), 0.09, color="#d8dee6", label="share of joints")
        axes.plot([0, 1], [0, 1], color="#888888", linewidth=0.8)
        axes.plot(mean, share, "o-", color="#1f5f99", markersize=4, label="true share")
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="predicted", title=name.replace(": ", "\n"))
        axes.title.set_fontsize(10)
        axes.legend(fontsize=8, loc="upper left", frameon=False)
    canvas.print_png(path)


if __name__ == "__main__":
    main()
