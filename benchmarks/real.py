"""Poses of people in real sweeps with labeled boxes but without labeled joints.

    python benchmarks/real.py FOLDER --least 5 --json docs/scores/real.json

FOLDER holds sweep_N.pcd, .bin or .ply, each with a sweep_N.json of boxes in the format of `lidarpose predict`. Prints
for each person: points, distance, the angle between the pose's facing and the box's heading (also with `--tta 4`), the
share of points within 15 cm of the skeleton's bones, lean of the trunk, confidence, `person`, and the mean joint
distance to the pose of the same person if nobody gives boxes. For tracks in two sweeps it also prints the mean joint
distance between the two poses after their pelvises are aligned.
"""

import argparse
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

import lidarpose
from lidarpose.geometry import distance_to_segments
from lidarpose.inference.predictor import TTA, Predictor
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.io.atomic import write_atomic
from lidarpose.models import DEFAULT
from lidarpose.sample import facing
from lidarpose.skeleton import SMPL24

# half thickness of a limb, including clothes and range noise, m
NEAR = 0.15


def distance_to_bones(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """points (n, 3), joints (24, 3) m -> (n,) m to the nearest bone."""
    start, end = np.array(SMPL24.bones).T
    return distance_to_segments(points, joints[start], joints[end])


def rows_of(model: Predictor, four: Predictor, folder: Path, least: int) -> Iterator[tuple[dict, PersonPose]]:
    """The figures and the pose of each labeled person with at least `least` points, sweep by sweep."""
    for labels in sorted(folder.glob("sweep_*.json")):
        sweep = next(path for path in sorted(folder.glob(f"{labels.stem}.*")) if path.suffix != ".json")
        boxes = {"people": json.loads(labels.read_text())["people"]}
        people = (lidarpose.predict(sweep, boxes=boxes, model=predictor) for predictor in (model, four))
        detected = lidarpose.predict(sweep, model=model)
        for person, other in zip(*people, strict=True):
            if person.num_points < least or person.pose is None:
                continue
            trunk = person.joints[SMPL24.index("neck")] - person.joints[SMPL24.index("pelvis")]
            row = {
                "sweep": labels.stem,
                "person": str(person.id)[:8],
                "points": int(person.num_points),
                "distance": float(np.linalg.norm(person.box.center)),
                "turn": turn(person),
                "turn_of_four": turn(other),
                "near": float((distance_to_bones(person.points, person.joints) < NEAR).mean()),
                "lean": float(np.degrees(np.arccos(trunk[2] / np.linalg.norm(trunk)))),
                "confidence": float(person.confidence.mean()),
                "is_person": float(person.pose.person),
                "to_detected": detected_distance(person, detected),
            }
            yield {key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}, person


def detected_distance(person: PersonPose, detected: Poses) -> float | None:
    """The mean joint distance, mm, between the pose in the labeled box and the pose of the same person among those
    detected; None if the person was not detected."""
    distances = [np.linalg.norm(other.box.center[:2] - person.box.center[:2]) for other in detected]
    if not distances or min(distances) > 0.5:
        return None
    joints = detected[int(np.argmin(distances))].joints
    return float(np.linalg.norm(joints - person.joints, axis=-1).mean() * 1e3)


def turn(person: PersonPose) -> float:
    """The angle from the box's heading to the pose's facing, degrees."""
    forward = facing(person.pose)
    angle = np.arctan2(forward[1], forward[0]) - person.box.yaw
    return float(np.degrees((angle + np.pi) % (2 * np.pi) - np.pi))


def moved(people: list[tuple[dict, PersonPose]]) -> Iterator[dict]:
    """The mean joint distance between a person's poses in consecutive sweeps, with aligned pelvises, mm."""
    tracks: dict[str, list[np.ndarray]] = {}
    points: dict[str, int] = {}
    pelvis = SMPL24.index("pelvis")
    for row, person in people:
        tracks.setdefault(row["person"], []).append(person.joints - person.joints[pelvis])
        points[row["person"]] = min(row["points"], points.get(row["person"], row["points"]))
    for name, poses in tracks.items():
        for first, second in pairwise(poses):
            yield {"person": name, "mm": round(float(np.linalg.norm(second - first, axis=-1).mean() * 1e3), 1)} | {
                "points": points[name]
            }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--least", type=int, default=50, help="fewest points a person")
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--tta", type=int, default=TTA, help="as of predict")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write people's figures")
    options = parser.parse_args()
    models = (lidarpose.load(options.weights, tta=count) for count in (options.tta, 4))
    people = list(rows_of(*models, options.folder, options.least))
    for row, _ in people:
        print(
            f"{row['sweep']} {row['person']}  {row['points']:4d} points {row['distance']:5.1f} m"
            f"  facing {row['turn']:5.0f} deg off the box, with --tta 4 {row['turn_of_four']:5.0f}"
            f"  {row['near']:4.0%} near bones  lean {row['lean']:3.0f} deg  confidence {row['confidence']:.2f}"
            f"  person {row['is_person']:.2f}"
            + (
                "  not detected"
                if row["to_detected"] is None
                else f"  {row['to_detected']:.0f} mm to the detected pose"
            )
        )
    tracks = list(moved(people))
    for entry in tracks:
        print(f"track {entry['person']}: two sweeps differ by {entry['mm']:.0f} mm a joint")
    if options.json:
        report = {"people": [row for row, _ in people], "tracks": tracks}
        write_atomic(options.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
