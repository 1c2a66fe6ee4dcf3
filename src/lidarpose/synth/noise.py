"""What happens to points after the cast, each a small pure function of (points, ..., rng).

What is drawn for every point can also be handed in (`error`, `chance`), so that a fast twin can be held against these.
Legend: n points; parts are 0 for what is not body, 1 + j for the bone of SMPL-24's joint j. All frames are the
sensor's: it stands at the origin.
"""

from dataclasses import replace

import numpy as np

from lidarpose.sample import Box


def along_beams(points: np.ndarray, error: np.ndarray) -> np.ndarray:
    """points (n, 3) m moved away from the sensor by error (n,) m."""
    distance = np.linalg.norm(points, axis=1)
    return points * (1 + error / np.maximum(distance, _NEAREST))[:, None]


# what is nearer to the sensor is not moved by more than its share, m
_NEAREST = 1e-3


# makers' range limits hold for targets that reflect about 80 percent; clothes at 20 percent are seen half as far
REACH = 0.5


def weak_loss(points: np.ndarray, normals: np.ndarray, *, range_max: float) -> np.ndarray:
    """(n,) probability that a return is too weak to be seen.

    The power that comes back from a matt surface larger than the beam goes with cos(incidence) / range^2 (the LiDAR
    range equation for extended Lambertian targets). At half of the sensor's range_max m, half of what faces it comes
    back; clothes differ in reflectivity, which makes the step soft: 1 / (1 + power^2), power 1 there.
    """
    reach = REACH * range_max
    squared = (points**2).sum(1)
    power = _cosine(points, normals) * reach**2 / np.maximum(squared, _NEAREST**2)
    return 1 / (1 + power**2)


def random_keep(count: int, *, share: float, rng: np.random.Generator) -> np.ndarray:
    """(count,) bool: all but a random `share` of the returns, each on its own."""
    return rng.random(count) >= share


def _cosine(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    beam = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
    return np.abs((beam * normals).sum(1))


def spoil_reference(
    points: np.ndarray,
    normals: np.ndarray,
    keep: np.ndarray,
    error: np.ndarray,
    chance: np.ndarray,
    *,
    dropout: float,
    weak: float,
    range_max: float,
) -> tuple[np.ndarray, np.ndarray]:
    """All that happens to returns on the way, in one go; `spoil.spoil` is the compiled twin.

    points (n, 3) m, normals (n, 3) unit, keep (n,) bool: what is left of them; error (n,) m of the ranges; chance (n,)
    uniform draws. A return survives where its chance is above the probability that it is lost at random (`dropout`)
    or for weakness (`weak` times `weak_loss`). Returns the kept points (k, 3) with their errors and their indices (k,).
    """
    lost = 1 - (1 - dropout) * (1 - weak * weak_loss(points, normals, range_max=range_max))
    kept = np.flatnonzero(keep & (chance >= lost))
    return along_beams(points[kept], error[kept]), kept


def noise_clusters(center: np.ndarray, *, most: int, rng: np.random.Generator) -> np.ndarray:
    """(k, 3) m: up to two blobs of stray points about `center`, as the paper's stability study adds them.

    Each has 0 to `most` points within 0.3 m of a place up to 0.4 m (0.8 m in height) from the center.
    """
    blobs = []
    for _ in range(rng.integers(1, 3)):
        count = int(rng.integers(0, most + 1))
        blobs.append(stray_cluster(center, count=count, rng=rng))
    return np.concatenate(blobs)


def stray_cluster(center: np.ndarray, *, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) m: one blob of stray points, within 0.3 m of a place up to 0.4 m (0.8 m in height) from `center`."""
    place = center + rng.uniform(-1, 1, 3) * _CLUSTER_REACH
    direction = rng.normal(size=(count, 3))
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return place + direction * rng.uniform(0, _CLUSTER_RADIUS, (count, 1))


# half the extents of where clusters may lie and their radius, m: the released code's
_CLUSTER_REACH = np.array([0.4, 0.4, 0.8])
_CLUSTER_RADIUS = 0.3
_CLUSTER_POINTS = 150


def reference_clusters(center: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
    """(k, 3) m: the released code's law. Two areas, each of 0 to 149 points about a place within +-0.4 m (+-0.8 m in
    height) of `center`; spherical coordinates uniform: radius to 0.3 m, polar angle, azimuth (denser at the poles)."""
    places = center + rng.uniform(-1, 1, (2, 3)) * _CLUSTER_REACH
    place = np.repeat(places, rng.integers(0, _CLUSTER_POINTS, 2), axis=0)
    radius, polar, azimuth = rng.random((3, len(place))) * [[_CLUSTER_RADIUS], [np.pi], [2 * np.pi]]
    flat = radius * np.sin(polar)
    return place + np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), radius * np.cos(polar)], 1)


def part_removal(part: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: keeps all but the points of one body part that is present, drawn at random.

    Give the parts of the points inside the crop: a part outside cannot go missing.
    """
    present = np.flatnonzero(np.bincount(part)[1:]) + 1 if len(part) else part
    return np.ones(len(part), bool) if len(present) == 0 else part != present[rng.integers(len(present))]


def half_space_keep(points: np.ndarray, *, most: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: what lies on one side of a random plane that cuts up to a share `most` off the cloud's extent.

    As behind the end of a wall, or where a neighbour's box has taken its share. The plane is upright, lies flat or
    leans; the share is of the extent along its normal, and never all points go.
    """
    if len(points) == 0:
        return np.ones(0, bool)
    normal = rng.normal(size=3) * [1, 1, 0.5]
    along = points @ (normal / np.linalg.norm(normal))
    low, high = along.min(), along.max()
    return along >= low + (high - low) * most * rng.random()


def cut_box(box: Box, *, most: float = 0.3, rng: np.random.Generator) -> Box:
    """A box that loses up to a share `most` of its height (the feet twice as often as the head) or of one side, as
    detectors that stop at a bonnet or a table edge do."""
    end, amount = rng.random(2)
    lost = most * amount
    # axis and the side of it that goes
    axis, side = ((2, -1), (2, -1), (2, 1), (1, -1), (1, 1), (0, 1))[int(end * 6)]
    shift = np.zeros(3)
    shift[axis] = -side * lost * box.size[axis] / 2
    size = box.size.copy()
    size[axis] *= 1 - lost
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    turned = np.array([c * shift[0] - s * shift[1], s * shift[0] + c * shift[1], shift[2]])
    return replace(box, center=box.center + turned, size=size)


def jitter(points: np.ndarray, *, sigma: float, clip: float, rng: np.random.Generator) -> np.ndarray:
    """points (n, 3) m, each moved by a normal step of `sigma` m an axis, cut at +-`clip` m."""
    return points + np.clip(rng.normal(0, sigma, points.shape), -clip, clip)
