"""How often warnings detect inputs that are not in meters with z up, and how often they are false alarms.

    python benchmarks/plausibility.py --people 400

Prints the share of people of lidarpose-bench with each warning: unchanged, in other units, and upside down.
"""

import argparse

import numpy as np

import lidarpose
from lidarpose.eval.dataset import load_bench

CHANGES = {
    "as it is": 1.0,
    "feet": 1 / 0.3048,
    "decimeters": 10.0,
    "doubled": 2.0,
    "upside down": np.array([1.0, -1.0, -1.0]),
}
WARNINGS = {"size": "taller than a person", "units": "are the units", "upside down": "upside down"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--people", type=int, default=2000)
    parser.add_argument("--weights", default="small")
    parser.add_argument("--tta", type=int, default=1)
    options = parser.parse_args()
    model = lidarpose.load(options.weights, tta=options.tta)
    bench = load_bench()
    rows = bench.people[np.linspace(0, len(bench.people) - 1, options.people).astype(int)]
    print(f"{'input':<14}" + "".join(f"{name:>14}" for name in (*WARNINGS, "any")))
    for name, change in CHANGES.items():
        people = model.predict([bench.points[row] * change for row in rows])
        hits = np.array([[any(text in w for w in p.warnings) for text in WARNINGS.values()] for p in people])
        shares = [*hits.mean(0), hits.any(1).mean()]
        print(f"{name:<14}" + "".join(f"{100 * share:>12.1f} %" for share in shares), flush=True)


if __name__ == "__main__":
    main()
