"""Poses of labelled people in real sweeps, where boxes are labelled and joints are not.

    python benchmarks/real.py FOLDER --json docs/scores/real.json

FOLDER holds sweep_N.pcd, .bin or .ply, and beside each a sweep_N.json of boxes as `lidarpose predict` takes them.
Prints for each person: points, distance, the angle between where the pose faces and where the box heads, the share of
points within 15 cm of the skeleton's bones, lean of the trunk, confidence; and, for a track that two sweeps share, how
far the pose moved against itself once both are put on one pelvis.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import lidarpose
from lidarpose.data.files import write_atomic
from lidarpose.infer.files import TTA
from lidarpose.model.bundled import DEFAULT
from lidarpose.skeleton import SMPL24
from lidarpose.view.person import facing

# a limb's half thickness with clothes and the noise of a range, m
NEAR = 0.15


def distance_to_bones(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """points (n, 3), joints (24, 3) m -> (n,) m to the nearest bone."""
    start, end = joints[[a for a, _ in SMPL24.bones]], joints[[b for _, b in SMPL24.bones]]
    along = end - start
    share = ((points[:, None] - start) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--least", type=int, default=50, help="fewest points a person")
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--tta", type=int, default=TTA, help="looks at each person")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write people's figures")
    options = parser.parse_args()
    model = lidarpose.load(options.weights, tta=options.tta)
    tracks: dict[str, list[np.ndarray]] = {}
    rows = []
    for labels in sorted(options.folder.glob("sweep_*.json")):
        sweep = next(path for path in sorted(options.folder.glob(f"{labels.stem}.*")) if path.suffix != ".json")
        entries = json.loads(labels.read_text())["people"]
        poses = lidarpose.predict(sweep, boxes={"people": entries}, model=model)
        for person in poses:
            if person.num_points < options.least or person.pose is None:
                continue
            forward = facing(person.pose)
            turn = np.arctan2(forward[1], forward[0]) - person.box.yaw
            trunk = person.joints[SMPL24.index("neck")] - person.joints[SMPL24.index("pelvis")]
            near = (distance_to_bones(person.points, person.joints) < NEAR).mean()
            distance = np.linalg.norm(person.box.center)
            row = {"sweep": labels.stem, "person": str(person.id)[:8], "points": int(person.num_points)}
            row |= {
                "distance": float(distance),
                "turn": float(np.degrees((turn + np.pi) % (2 * np.pi) - np.pi)),
                "near": float(near),
                "lean": float(np.degrees(np.arccos(trunk[2] / np.linalg.norm(trunk)))),
                "confidence": float(person.confidence.mean()),
            }
            rows.append({key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()})
            print(
                f"{row['sweep']} {row['person']}  {row['points']:4d} points {row['distance']:5.1f} m"
                f"  facing {row['turn']:5.0f} deg off the box  {row['near']:4.0%} near bones"
                f"  lean {row['lean']:3.0f} deg  confidence {row['confidence']:.2f}"
            )
            tracks.setdefault(str(person.id), []).append(person.joints)
    if options.json:
        write_atomic(options.json, json.dumps(rows, indent=1) + "\n")
    pelvis = SMPL24.index("pelvis")
    for track, seen in tracks.items():
        for first, second in zip(seen[:-1], seen[1:], strict=True):
            moved = (second - second[pelvis]) - (first - first[pelvis])
            print(
                f"track {track[:8]}: two sweeps differ by {np.linalg.norm(moved, axis=-1).mean() * 1e3:.0f} mm a joint"
            )


if __name__ == "__main__":
    main()
