"""People found by a tilted sensor and on sloping ground.

    python benchmarks/tilted.py [--scans 120] --json docs/scores/tilted.json

The frozen scenes of `lidarpose evaluate detector heldout` are changed by a linear map about the sensor, which keeps
every ray a ray, so what is occluded stays occluded: a rotation for a tilted sensor, and a shear along z for a slope, on
which people stay upright. The direction is another one in each scene. Detections are mapped back before matching.
The detector is not told of either.
"""

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from lidarpose.eval.detector.detection_scores import DetectorResult, score_detector
from lidarpose.eval.detector.labeled_scans import heldout_scans
from lidarpose.geometry import rotation_about
from lidarpose.inference.detection import Search, find_people
from lidarpose.inference.scan import Scan
from lidarpose.io.atomic import write_atomic
from lidarpose.models.detector.detector import Detector
from lidarpose.sample import Box

TILTS, SLOPES = (0.0, 5.0, 10.0, 20.0, 30.0), (0.05, 0.1, 0.2, 0.3)


def tilt(degrees: float, azimuth: float) -> np.ndarray:
    """(3, 3): rotation by an angle about a horizontal axis at an azimuth, rad."""
    turn = rotation_about("z", azimuth)
    return turn @ rotation_about("x", np.radians(degrees)) @ turn.T


def slope(rise: float, azimuth: float) -> np.ndarray:
    """(3, 3): shear that lifts points by `rise` times their distance along an azimuth, rad."""
    shear = np.eye(3)
    shear[2, :2] = rise * np.cos(azimuth), rise * np.sin(azimuth)
    return shear


def detect(
    detector: Detector, change: Callable[[float], np.ndarray], points: np.ndarray, origin: np.ndarray
) -> tuple[list[Box], np.ndarray]:
    """The people found in a changed scan, at their places in the unchanged one."""
    azimuth = np.random.default_rng(len(points)).uniform(-np.pi, np.pi)
    matrix = change(azimuth)
    scan = Scan(points=(points - origin) @ matrix.T, origin=np.zeros(3))
    boxes = find_people(scan, Search(min_score=0.0, detector=detector)).boxes or []
    back = np.linalg.inv(matrix)
    boxes = [Box(center=back @ box.center + origin, size=box.size, yaw=box.yaw, score=box.score) for box in boxes]
    return boxes, np.array([box.score for box in boxes], float)


def figures(result: DetectorResult) -> dict[str, float]:
    """Recall at one false person a scan and at the default score, and the false people a scan there."""

    def value(figure: str, at: str, group: str = "all", of: str = "all", name: str = "value") -> float:
        row = (figure, at, group, of)
        return next(r for r in result.rows if (r["figure"], r["at"], r["group"], r["of"]) == row)[name]

    points = ("points", "50 and more")
    return {
        "people": value("recall", "1", name="count"),
        "all": value("recall", "1"),
        "many_points": value("recall", "1", *points),
        "default": value("recall", "default", *points),
        "false": value("false_people", "default"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=120)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    changes = {f"tilted by {degrees:g} degrees": partial(tilt, degrees) for degrees in TILTS}
    changes |= {f"slope of {100 * rise:g} %": partial(slope, rise) for rise in SLOPES}
    detector = Detector()
    table = []
    for name, change in changes.items():
        result = score_detector(
            partial(detect, detector, change),
            heldout_scans(options.scans),
            default_score=detector.header["default_score"],
        )
        table.append({"scene": name} | figures(result))
        print(table[-1], flush=True)
    if options.json:
        command = f"python benchmarks/tilted.py --scans {options.scans}"
        write_atomic(options.json, json.dumps({"command": command, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
