"""Increase of errors by clutter, second people, poor boxes and occluders, at equal visibility.

    lidarpose evaluate tiny bench --out evaluation/tiny
    python benchmarks/visibility.py evaluation/tiny --out docs/scores/visibility.json

People of a condition are compared with equally occluded clean people: the errors in bins of the occluded share are
weighted by the number of the condition's people in each bin. Bins with fewer than ten people of either group are left
out. Intervals are from a bootstrap over people.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from lidarpose.io.atomic import write_atomic

EDGES = np.array([-0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.01])
LEAST = 10
ROUNDS = 2000
CLEAN = "clean"


def compared(error: np.ndarray, hidden: np.ndarray, condition: np.ndarray, name: str) -> tuple[float, float, int]:
    """Mean errors, mm, of a condition's people and of equally occluded clean people; number of the former. NaN
    if no bin has enough of both."""
    bins = np.digitize(hidden, EDGES)
    condition_sum = clean_sum = 0.0
    people = 0
    for k in np.unique(bins):
        condition_errors, clean_errors = (
            error[(bins == k) & (condition == name)],
            error[(bins == k) & (condition == CLEAN)],
        )
        if min(len(condition_errors), len(clean_errors)) >= LEAST:
            condition_sum, clean_sum, people = (
                condition_sum + condition_errors.sum(),
                clean_sum + clean_errors.mean() * len(condition_errors),
                people + len(condition_errors),
            )
    return (condition_sum / people, clean_sum / people, people) if people else (np.nan, np.nan, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what lidarpose evaluate wrote")
    parser.add_argument("--out", type=Path, required=True, help="a JSON file; other models in it are kept")
    options = parser.parse_args()
    columns = ["condition", "hidden", "moving", "error_mm"]
    rows = pq.read_table(options.folder / "poses.parquet", columns=columns).to_pydict()
    is_counted = ~np.array(rows["moving"], bool)
    error = np.array(
        [
            np.mean(joint_errors)
            for joint_errors, is_scored in zip(rows["error_mm"], is_counted, strict=True)
            if is_scored
        ]
    )
    hidden, condition = np.array(rows["hidden"], float)[is_counted], np.array(rows["condition"])[is_counted]
    rng = np.random.default_rng(0)
    entries = []
    for name in sorted(set(condition) - {CLEAN}):
        condition_error, clean_error, people = compared(error, hidden, condition, name)
        if not people:
            print(f"{name:<10} left out: no bin has {LEAST} of its people and {LEAST} clean ones")
            continue
        ratios = []
        for _ in range(ROUNDS):
            sample_rows = rng.integers(len(error), size=len(error))
            a, b, _ = compared(error[sample_rows], hidden[sample_rows], condition[sample_rows], name)
            ratios.append(a / b)
        low, high = np.nanpercentile(ratios, [2.5, 97.5])
        entry = {
            "condition": name,
            "people": people,
            "mm": condition_error,
            "clean": clean_error,
            "ratio": condition_error / clean_error,
        }
        entries.append({k: round(v, 3) if isinstance(v, float) else v for k, v in entry.items()})
        entries[-1] |= {"low": round(low, 3), "high": round(high, 3)}
        ratio = f"x {condition_error / clean_error:.2f} [{low:.2f}, {high:.2f}]"
        print(f"{name:<10} {condition_error:6.1f} mm, clean {clean_error:6.1f}: {ratio}, {people} people")
    scores = json.loads((options.folder / "scores.json").read_text())
    results = json.loads(options.out.read_text()) if options.out.is_file() else {}
    results[scores["weights"]["name"]] = entries
    write_atomic(options.out, json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
