"""What clutter, company, poor boxes and occluders cost at equal visibility.

    lidarpose evaluate tiny bench --out evaluation/tiny
    python benchmarks/visibility.py evaluation/tiny --out docs/scores/visibility.json

People of a condition are compared with clean people of whom as much is hidden: the error of each bin of hidden share,
weighted by how many of the condition are in it. Bins with under ten people of either are left out. The interval is a
bootstrap's over people.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from lidarpose.io.files import write_atomic

EDGES = np.array([-0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.01])
LEAST = 10
ROUNDS = 2000
CLEAN = "clean"


def compared(error: np.ndarray, hidden: np.ndarray, condition: np.ndarray, name: str) -> tuple[float, float, int]:
    """Mean errors, mm: of a condition's people, of clean ones of whom as much is hidden; how many of the condition."""
    bins = np.digitize(hidden, EDGES)
    theirs = clean = 0.0
    people = 0
    for k in np.unique(bins):
        own, other = error[(bins == k) & (condition == name)], error[(bins == k) & (condition == CLEAN)]
        if min(len(own), len(other)) >= LEAST:
            theirs, clean, people = theirs + own.sum(), clean + other.mean() * len(own), people + len(own)
    return theirs / people, clean / people, people


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what lidarpose evaluate wrote")
    parser.add_argument("--out", type=Path, required=True, help="a JSON file; other models in it are kept")
    options = parser.parse_args()
    columns = ["condition", "hidden", "moving", "error_mm"]
    rows = pq.read_table(options.folder / "poses.parquet", columns=columns).to_pydict()
    own = ~np.array(rows["moving"], bool)
    error = np.array([np.mean(one) for one, alone in zip(rows["error_mm"], own, strict=True) if alone])
    hidden, condition = np.array(rows["hidden"], float)[own], np.array(rows["condition"])[own]
    rng = np.random.default_rng(0)
    found = []
    for name in sorted(set(condition) - {CLEAN}):
        theirs, clean, people = compared(error, hidden, condition, name)
        ratios = []
        for _ in range(ROUNDS):
            drawn = rng.integers(len(error), size=len(error))
            a, b, _ = compared(error[drawn], hidden[drawn], condition[drawn], name)
            ratios.append(a / b)
        low, high = np.percentile(ratios, [2.5, 97.5])
        entry = {"condition": name, "people": people, "mm": theirs, "clean": clean, "ratio": theirs / clean}
        found.append({k: round(v, 3) if isinstance(v, float) else v for k, v in entry.items()})
        found[-1] |= {"low": round(low, 3), "high": round(high, 3)}
        ratio = f"x {theirs / clean:.2f} [{low:.2f}, {high:.2f}]"
        print(f"{name:<10} {theirs:6.1f} mm, clean {clean:6.1f}: {ratio}, {people} people")
    scores = json.loads((options.folder / "scores.json").read_text())
    stored = json.loads(options.out.read_text()) if options.out.is_file() else {}
    stored[scores["weights"]["name"]] = found
    write_atomic(options.out, json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    main()
