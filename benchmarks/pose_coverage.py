"""Distance of captured poses to the nearest poses of the prior, by action or person.

python benchmarks/pose_coverage.py MOTION.npz [MOTION.npz ...] [--poses 20000] [--unusual 0 0.3] [--people bd dg]

MOTION: `joints` (F, 24, 3) m of SMPL's joints, z up, and `clip` and `clip_length`: names PERSON_ACTION_NUMBER or
PERSON_NUMBER. All poses are given the same bone lengths, the center of the hips at the origin and the same heading of
the hips. The figure is the mean distance of 13 joints (head, hips, knees, ankles, shoulders, elbows, wrists) to the
nearest drawn pose, mm. There is a column for each share of unusual poses (`SceneConfig.unusual`): 0 as in `wild`, 0.3
as in `wide`.
"""

import argparse
from pathlib import Path

import numpy as np

from lidarpose.body.pose_prior.activities import unusual_mix
from lidarpose.body.pose_prior.sampling import sample_rotations
from lidarpose.body.rig import forward_kinematics, mean_adult_joints
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import SMPL24

# m: from the center of the hips to that of the shoulders, from there to the head, half widths of hips and shoulders
CHEST, HEAD, HALF_HIPS, HALF_SHOULDERS = 0.50, 0.25, 0.09, 0.18
THIGH, SHANK, UPPER_ARM, FOREARM = 0.42, 0.42, 0.28, 0.25


def on_one_body(joints: np.ndarray) -> np.ndarray:
    """joints (n, 24, 3) -> (n, 13, 3) float32 m."""
    joint_positions = {name: joints[:, i].astype(float) for i, name in enumerate(SMPL24.joints)}

    def direction(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return (end - start) / np.maximum(np.linalg.norm(end - start, axis=-1, keepdims=True), 1e-9)

    hips, shoulders = (
        (joint_positions[f"left_{name}"] + joint_positions[f"right_{name}"]) / 2 for name in ("hip", "shoulder")
    )
    chest = CHEST * direction(hips, shoulders)
    positions = [chest + HEAD * direction(shoulders, joint_positions["head"])]
    for side, other_side in (("left", "right"), ("right", "left")):
        for root, breadth, bones in (
            (0 * chest, HALF_HIPS, (("hip", "knee", THIGH), ("knee", "ankle", SHANK))),
            (chest, HALF_SHOULDERS, (("shoulder", "elbow", UPPER_ARM), ("elbow", "wrist", FOREARM))),
        ):
            first_joint = bones[0][0]
            positions.append(
                root
                + breadth
                * direction(joint_positions[f"{other_side}_{first_joint}"], joint_positions[f"{side}_{first_joint}"])
            )
            for start, end, length in bones:
                positions.append(
                    positions[-1]
                    + length * direction(joint_positions[f"{side}_{start}"], joint_positions[f"{side}_{end}"])
                )
    points = np.stack(positions, 1)
    left = points[:, 1]
    return (points @ rotation_about("z", np.arctan2(left[:, 0], left[:, 1])).swapaxes(-1, -2)).astype(np.float32)


def drawn_poses(count: int, unusual: float) -> np.ndarray:
    rotations = sample_rotations(np.random.default_rng(0), count, mix=unusual_mix(unusual)).rotations
    rest = mean_adult_joints()[None]
    return on_one_body(forward_kinematics(SMPL24.parents, rest, rotations, np.zeros((count, 3)))[1])


def nearest(poses: np.ndarray, frame: np.ndarray) -> float:
    offsets = poses - frame
    return 1e3 * float(np.sqrt(np.einsum("njk,njk->nj", offsets, offsets)).mean(1).min())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motion", nargs="+")
    parser.add_argument("--poses", type=int, default=20000)
    parser.add_argument("--unusual", type=float, nargs="+", default=[0.0, 0.3])
    parser.add_argument("--people", nargs="+", help="of the motion, by default all")
    parser.add_argument("--frames", type=int, default=60, help="most frames of a row, drawn at random")
    options = parser.parse_args()
    for path in options.motion:
        if not Path(path).is_file():
            parser.error(f"expected a file of captured motion, got {path}")
    banks = [drawn_poses(options.poses, share) for share in options.unusual]
    print(f"{'':40s}  frames" + "".join(f"{share:8.2f}" for share in options.unusual))
    for path in options.motion:
        with np.load(path, allow_pickle=False) as motion:
            names, frames = np.repeat(motion["clip"], motion["clip_length"]), on_one_body(motion["joints"])
        rows = np.array([str(name).rpartition("_")[0] for name in names])
        people, sums_by_person = np.array([row.partition("_")[0] for row in rows]), {}
        for row in np.unique(rows):
            person = row.partition("_")[0]
            if options.people and person not in options.people:
                continue
            row_frames = np.flatnonzero(rows == row)
            picked_frames = np.random.default_rng(0).permutation(row_frames)[: options.frames]
            mean = [np.mean([nearest(bank, frame) for frame in frames[picked_frames]]) for bank in banks]
            sums_by_person.setdefault(person, []).append(np.multiply(mean, len(row_frames)))
            print(f"{row:40s}{len(row_frames):8d}" + "".join(f"{value:8.1f}" for value in mean), flush=True)
        for person, sums in sums_by_person.items():
            if len(sums) == 1:
                continue
            count = int((people == person).sum())
            print(f"{person + ', all frames':40s}{count:8d}" + "".join(f"{v / count:8.1f}" for v in np.sum(sums, 0)))


if __name__ == "__main__":
    main()
