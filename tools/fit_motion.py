"""Fits the part of the pose prior that comes from captured motion: a mixture of Gaussians over the angles of a pose.

    python tools/fit_motion.py CLIPS.npz --subjects 002 005 --out src/lidarpose/body/assets/motion_prior.npz

`lidarpose.body.mocap.motion` describes the layout of CLIPS.npz. Only the mixture's parameters are stored, no poses.
"""

import argparse
from pathlib import Path

import numpy as np

from lidarpose.body.mocap import load_motion
from lidarpose.body.pose_prior.activities import (
    ANGLE_INDEX,
    EULER_FROM_ANGLES,
    collar_lift,
    shoulder_angles,
    shoulder_matrix,
)  # fmt: skip
from lidarpose.body.pose_prior.latents import LOWER, SHOULDERS, hanging_arm
from lidarpose.body.rig import without_yaw
from lidarpose.geometry import rotation_about, rotation_vector
from lidarpose.skeleton import SMPL24

_LIFT_STEPS = 6  # fixed-point steps that remove the collar's share from the upper arm
_ITERATIONS = 60
_RIDGE = 3.0**2  # degrees squared added to each variance: poses are not more exact, and none is stored exactly
_SHRINK = 0.1  # share of the pooled covariance in each component's


def angles_from_rotations(rotations: np.ndarray) -> np.ndarray:
    """The inverse of `activities.rotations_from_angles`: the angles (n, 27), degrees, closest to local rotations
    (n, 24, 3, 3).

    Rotations that the angles cannot express are dropped: rotations of wrists and hands, unequal shares of the spine's
    joints, and rotations of the collars except for their effect on the upper arms.
    """
    rotations = np.asarray(rotations, float)
    # joints that share an angle have the same small rotation, so their Euler angles are added
    angles = _to_euler(rotations).reshape(len(rotations), 72) @ np.sign(EULER_FROM_ANGLES).T
    for side, sign in (("left", 1.0), ("right", -1.0)):
        collar, shoulder = (rotations[:, SMPL24.index(f"{side}_{name}")] for name in ("collar", "shoulder"))
        arm = shoulder_angles(collar @ shoulder, sign)
        for _ in range(_LIFT_STEPS):
            unlift = rotation_about("x", -sign * np.radians(collar_lift(arm[:, :2])))
            arm = shoulder_angles(unlift @ collar @ shoulder, sign)
        angles[:, [ANGLE_INDEX[f"{side}_{name}"] for name in ("raise", "out", "in")]] = arm
    return angles


def to_features(rotations: np.ndarray) -> np.ndarray:
    """Local rotations (n, 24, 3, 3) -> the mixture's features (n, 27): the inverse of `latents.from_features`."""
    features = angles_from_rotations(rotations)
    for part, sign in SHOULDERS:
        features[:, part] = np.degrees(rotation_vector(shoulder_matrix(features[:, part], sign) @ hanging_arm(sign).T))
    return features


def _to_euler(matrix: np.ndarray) -> np.ndarray:
    """R_y R_x R_z (..., 3, 3) -> (..., 3) degrees about y, x, z; x in +-90."""
    y = np.arctan2(matrix[..., 0, 2], matrix[..., 2, 2])
    x = -np.arcsin(np.clip(matrix[..., 1, 2], -1, 1))
    z = np.arctan2(matrix[..., 1, 0], matrix[..., 1, 1])
    return np.degrees(np.stack([y, x, z], -1))


def save_mixture(path: str | Path, weights: np.ndarray, means: np.ndarray, covariances: np.ndarray) -> None:
    """Writes weights (K,), means (K, 27) and covariances (K, 27, 27), the last as their Cholesky factors."""
    roots = np.linalg.cholesky(covariances)[:, *LOWER]
    np.savez_compressed(
        path, weights=weights.astype(np.float32), means=means.astype(np.float16), roots=roots.astype(np.float16)
    )


def fit_mixture(features: np.ndarray, components: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """features (n, D) -> weights (K,), means (K, D), covariances (K, D, D), by expectation maximization."""
    n, width = features.shape
    means = features[_spread_seeds(features, components, rng)]
    pooled = np.cov(features.T) + _RIDGE * np.eye(width)
    covariances = np.repeat(pooled[None] / components ** (2 / width), components, 0)
    weights = np.full(components, 1 / components)
    for _ in range(_ITERATIONS):
        score = np.stack(
            [np.log(w) + _log_gauss(features, m, c) for w, m, c in zip(weights, means, covariances, strict=True)], 1
        )
        share = np.exp(score - score.max(1, keepdims=True))
        share /= share.sum(1, keepdims=True)
        count = share.sum(0) + 1e-6
        weights, means = count / count.sum(), (share.T @ features) / count[:, None]
        within = np.zeros((width, width))
        for k in range(components):
            offset = features - means[k]
            covariances[k] = (share[:, k, None] * offset).T @ offset
            within += covariances[k] / n
            covariances[k] /= count[k]
        covariances = (1 - _SHRINK) * covariances + _SHRINK * within + _RIDGE * np.eye(width)
    return weights, means, covariances


def _spread_seeds(features: np.ndarray, count: int, rng: np.random.Generator) -> list[int]:
    """Indices of distant rows: each drawn with probability proportional to its squared distance from those before."""
    seeds = [int(rng.integers(len(features)))]
    distance = np.full(len(features), np.inf)
    while len(seeds) < count:
        distance = np.minimum(distance, ((features - features[seeds[-1]]) ** 2).sum(1))
        seeds.append(int(rng.choice(len(features), p=distance / distance.sum())))
    return seeds


def _log_gauss(features: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, (features - mean).T)
    return -0.5 * (white**2).sum(0) - np.log(np.diag(root)).sum()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips")
    parser.add_argument("--subjects", nargs="+", required=True, help="prefixes of clip names, such as 002")
    parser.add_argument("--components", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", required=True)
    args = parser.parse_args()
    features = to_features(without_yaw(load_motion(args.clips).of(args.subjects).rotations))
    save_mixture(args.out, *fit_mixture(features, args.components, np.random.default_rng(args.seed)))
    print(f"{args.out}: {args.components} components from {len(features)} poses")


if __name__ == "__main__":
    main()
