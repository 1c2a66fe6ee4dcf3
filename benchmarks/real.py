"""Poses of labelled people in real sweeps, where boxes are labelled and joints are not.

    python benchmarks/real.py FOLDER

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
    parser.add_argument("--weights", default="tiny")
    options = parser.parse_args()
    model = lidarpose.load(options.weights)
    tracks: dict[str, list[np.ndarray]] = {}
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
            print(
                f"{labels.stem} {str(person.id)[:8]}  {person.num_points:4d} points {distance:5.1f} m"
                f"  facing {np.degrees((turn + np.pi) % (2 * np.pi) - np.pi):5.0f} deg off the box"
                f"  {near:4.0%} near bones  lean {np.degrees(np.arccos(trunk[2] / np.linalg.norm(trunk))):3.0f} deg"
                f"  confidence {person.confidence.mean():.2f}"
            )
            tracks.setdefault(str(person.id), []).append(person.joints)
    pelvis = SMPL24.index("pelvis")
    for track, seen in tracks.items():
        for first, second in zip(seen[:-1], seen[1:], strict=True):
            moved = (second - second[pelvis]) - (first - first[pelvis])
            print(
                f"track {track[:8]}: two sweeps differ by {np.linalg.norm(moved, axis=-1).mean() * 1e3:.0f} mm a joint"
            )


if __name__ == "__main__":
    main()
