"""Scores of weights on lidarpose-bench, by condition, sensor, distance, points and joint, beside two floors.

    python benchmarks/bench.py --weights tiny --json scores.json

Crops are centered from their points alone; MPJPE in millimetres on human15's joints, nothing aligned.
"""

import argparse
import json
import time

import numpy as np

from lidarpose.evaluate.bench import GROUPS, NAME, errors, floors, load_bench, rows_by, swapped
from lidarpose.evaluate.metrics import auroc, calibration_error
from lidarpose.infer.predictor import load
from lidarpose.skeleton import BODY26, HUMAN15

HIT = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="tiny")
    parser.add_argument("--json", help="also write the figures to this file")
    options = parser.parse_args()
    bench, model = load_bench(), load(options.weights)
    people = bench.people
    results = {}
    for name, origin in (("sensor known", (0.0, 0.0, 0.0)), ("sensor unknown", None)):
        started = time.perf_counter()
        poses = model.predict([bench.points[k] for k in people], sensor_origin=origin, skeleton="body26")
        seconds = time.perf_counter() - started
        joints = bench.joints.copy()
        joints[people] = np.stack([pose.joints for pose in poses])
        results[name] = _scores(bench, joints)
        pick = BODY26.map_to(HUMAN15)
        confidence, hit = np.stack([pose.confidence for pose in poses])[:, pick], errors(bench, joints)[people] < HIT
        results[name] |= {
            "calibration_error": round(calibration_error(confidence.ravel(), hit.ravel()), 3),
            "auroc": round(auroc(confidence.ravel(), hit.ravel()), 3),
            "ms_a_person": round(seconds * 1e3 / len(people), 2),
        }
    results |= {name: _scores(bench, joints) for name, joints in floors(bench).items()}
    for name, result in results.items():
        print(f"--- {name}: MPJPE {result['mpjpe']} mm")
        for title, groups in result["groups"].items():
            print(f"{title:<13}", "  ".join(f"{key} {value}" for key, value in groups.items()))
        print(f"{'joints':<13}", "  ".join(f"{key} {value}" for key, value in result["joints"].items()))
        print({key: value for key, value in result.items() if key not in ("groups", "joints", "mpjpe")})
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"bench": NAME, "weights": options.weights, "results": results}, file, indent=1)


def _scores(bench, joints: np.ndarray) -> dict:
    error = errors(bench, joints) * 1e3
    groups = {
        title: {name: round(float(error[rows].mean()), 1) for name, rows in named.items() if len(rows)}
        for title, named in rows_by(bench).items()
    }
    plenty = bench.people[bench.columns["num_points"][bench.people] >= 100]
    return {
        "mpjpe": round(float(error[bench.people].mean()), 1),
        "groups": groups,
        "joints": {
            name: round(float(error[bench.people][:, [HUMAN15.index(joint) for joint in members]].mean()), 1)
            for name, members in GROUPS.items()
        },
        "turned_round_100_points": round(float(swapped(bench, joints)[plenty].mean()), 4),
    }


if __name__ == "__main__":
    main()
