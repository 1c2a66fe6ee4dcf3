"""What a stability study does to a person's points, each a pure function of (points, how much, ...).

n points (n, 3) m in the sensor's frame, the sensor at the origin; `amount` as in `DISTURBANCES`, 0 changes nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.sample import Box, center_of
from lidarpose.synth.noise import jitter, noise_cluster, random_keep

# of the paper's: two clusters, as in its released code
_CLUSTERS = 2
# half a step of the noise whose clip is given: of normal steps 4.6 % are cut
_STEP = 0.5
# what the points' own box has around them where a dataset has no box, m
_ROOM = 0.05


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """title, with the unit of its amounts; amounts that a study tries; scale: amounts times this are printed; says:
    what is done, in words; does(points, box, amount, rng) -> points; rigid: the whole frame is moved, labels too."""

    title: str
    amounts: tuple[float, ...]
    scale: float
    says: str
    does: Callable[[np.ndarray, Box | None, float, np.random.Generator], np.ndarray]
    rigid: bool = False


def jittered_points(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Every coordinate moved by a normal step, cut at `amount` m, of half as much as standard deviation."""
    return jitter(points, sigma=_STEP * amount, clip=amount, rng=rng)


def with_clusters(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Two clusters of `amount` stray points each about the person."""
    center = center_of(points)
    # the places stay where they are while the clusters grow
    clusters = [noise_cluster(center, count=int(amount), rng=own) for own in rng.spawn(_CLUSTERS)]
    return np.concatenate([points, *clusters])


def thinned_out(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """All but a random share `amount` of the points; what is dropped at one share is dropped at each larger one."""
    return points[random_keep(len(points), share=amount, rng=rng)]


def behind_an_edge(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """All but what lies behind one straight edge of something opaque, which hides a share `amount` of the points: the
    end of a wall, a parapet, a car. The edge is straight as seen from the origin and has any direction."""
    turn = rng.uniform(0, 2 * np.pi)
    middle = points.mean(0)
    ahead = np.hypot(middle[0], middle[1])
    # seen from the sensor: to the left and up, as tangents of angles from the middle of the points
    forward = np.array([middle[0], middle[1], 0]) / max(ahead, 1e-6)
    depth = np.maximum(points @ forward, 1e-3)
    left = points @ np.array([-forward[1], forward[0], 0]) / depth
    along = np.cos(turn) * left + np.sin(turn) * points[:, 2] / depth
    hidden = int(round(amount * len(points)))
    kept = np.ones(len(points), bool)
    kept[np.argsort(along, kind="stable")[:hidden]] = False
    return points[kept]


def box_moved(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """What of the points lies in the person's box after that was moved by `amount` m in a level direction; without a
    box, in that of the points with 5 cm of room."""
    if box is None:
        low, high = points.min(0) - _ROOM, points.max(0) + _ROOM
        box = Box(center=(low + high) / 2, size=high - low)
    turn = rng.uniform(0, 2 * np.pi)
    moved = replace(box, center=box.center + amount * np.array([np.cos(turn), np.sin(turn), 0]))
    return points[moved.contains(points)]


def out_of_level(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Everything turned by `amount` rad about a random level axis through the sensor, as if that were mounted askew and
    took its own axis for up."""
    turn = rng.uniform(0, 2 * np.pi)
    R_tilted_level = axis_angle_to_matrix(amount * np.array([np.cos(turn), np.sin(turn), 0.0]))
    return points @ R_tilted_level.T


DISTURBANCES = {
    "jitter": Disturbance(
        title="point jitter, clip in cm",
        amounts=(0.02, 0.05, 0.1, 0.15, 0.2),
        scale=100,
        says="normal steps on every coordinate, cut at the clip, of half the clip as standard deviation",
        does=jittered_points,
    ),
    "clusters": Disturbance(
        title="points in each of two noise clusters",
        amounts=(10, 25, 50, 100, 200),
        scale=1,
        says="two clusters within 0.3 m of places up to 0.4 m, in height 0.8 m, from the middle of the points",
        does=with_clusters,
    ),
    "dropped": Disturbance(
        title="points dropped, %",
        amounts=(0.25, 0.5, 0.75, 0.9, 0.95),
        scale=100,
        says="a random share of the points is gone",
        does=thinned_out,
    ),
    "occluder": Disturbance(
        title="points behind an edge, %",
        amounts=(0.1, 0.25, 0.4, 0.55, 0.7),
        scale=100,
        says="all is gone that lies on one side of an edge, straight as the sensor sees it, of a random direction",
        does=behind_an_edge,
    ),
    "crop": Disturbance(
        title="box displaced, cm",
        amounts=(0.05, 0.1, 0.2, 0.3, 0.4),
        scale=100,
        says="the crop's box is moved in a random level direction; what it leaves is lost, nothing new comes in unless "
        "the dataset holds points around the box",
        does=box_moved,
    ),
    "tilt": Disturbance(
        title="frame out of level, deg",
        amounts=tuple(np.radians([5.0, 10.0, 15.0, 20.0, 30.0]).tolist()),
        scale=180 / np.pi,
        says="the sensor is mounted askew, in a random direction, and its own axis is taken for up",
        does=out_of_level,
        rigid=True,
    ),
}
