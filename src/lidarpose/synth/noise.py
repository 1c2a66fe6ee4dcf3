"""Errors of points, laser grids and boxes, in numpy: each a pure function of its arguments and a random generator.

Legend: n points; parts are 0 for background, 1 + j for the bone of SMPL-24's joint j.
"""

from dataclasses import replace
from math import cos, sin

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.sample import Box
from lidarpose.synth.place import Place
from lidarpose.synth.scene import CropErrors

# --- the paper's laser-level mask: patches of the laser grid are removed, as if occluded by a foreground object

# Paper: section "Laser-level masking": the shorter side of the window is this many patches
_PATCHES = 8
# without a grid, the longer side has at most this many patches
_LONGEST = 64


def laser_mask(columns: int, rows: int, *, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(columns, rows) bool: which beams of the effective window survive.

    Paper: section "Laser-level masking". The window is cut into square patches of s_p beams,
    s_p = floor(min(columns, rows) / 8), at least 1 (the released code divides by zero on windows of under 8 beams);
    a share 1 - keep of all patches is masked.
    """
    patch = max(min(columns, rows) // _PATCHES, 1)
    patches_across, patches_down = -(-columns // patch), -(-rows // patch)
    mask = _kept_patches(patches_across * patches_down, keep, rng)
    return mask.reshape(patches_across, patches_down).repeat(patch, 0).repeat(patch, 1)[:columns, :rows]


def direction_mask(directions: np.ndarray, *, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: the laser-level mask for beams without a grid, such as a rosette's.

    The window is the range of the directions' azimuths and elevations; patches are squares of an eighth of its shorter
    side. A share 1 - keep of all patches is masked.

    Args:
        directions: (n, 3) beams of the window, of any length > 0, for instance the points they hit.
    """
    if len(directions) == 0:
        return np.zeros(0, bool)
    x, y, z = np.asarray(directions, np.float32).T
    c, s = x.mean(), y.mean()
    # azimuths relative to the window's mean direction, to avoid the seam at +-pi
    azimuth = np.arctan2(c * y - s * x, c * x + s * y)
    elevation = np.arctan2(z, np.sqrt(x * x + y * y))
    azimuth -= azimuth.min()
    elevation -= elevation.min()
    width, height = float(azimuth.max()), float(elevation.max())
    # a window that is a line has a shorter side of 0
    patch = max(min(width, height) / _PATCHES, max(width, height) / _LONGEST, 1e-6)
    columns, rows = int(width / patch) + 1, int(height / patch) + 1
    cell = (azimuth / np.float32(patch)).astype(np.int32) * rows + (elevation / np.float32(patch)).astype(np.int32)
    return _kept_patches(columns * rows, keep, rng)[np.minimum(cell, columns * rows - 1)]


def _kept_patches(patches: int, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(patches,) bool: True for a random share `keep` of the patches, rounded down."""
    mask = np.zeros(patches, bool)
    mask[rng.permutation(patches)[: int(patches * keep)]] = True
    return mask


# --- clutter points

# half extents of the region for clusters' centers, and clusters' radius, m, as in the released code
_CLUSTER_REACH = np.array([0.4, 0.4, 0.8])
_CLUSTER_RADIUS = 0.3
_CLUSTER_POINTS = 150


def noise_clusters(center: np.ndarray, *, most: int, rng: np.random.Generator) -> np.ndarray:
    """(k, 3) m: one or two `noise_cluster`s of 0 to `most` points each, as in the paper's stability study."""
    clusters = []
    for _ in range(rng.integers(1, 3)):
        count = int(rng.integers(0, most + 1))
        clusters.append(noise_cluster(center, count=count, rng=rng))
    return np.concatenate(clusters)


def noise_cluster(center: np.ndarray, *, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) m: points within 0.3 m of a random point that is up to 0.4 m (0.8 m in z) per axis from `center`."""
    cluster_center = center + rng.uniform(-1, 1, 3) * _CLUSTER_REACH
    direction = rng.normal(size=(count, 3))
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return cluster_center + direction * rng.uniform(0, _CLUSTER_RADIUS, (count, 1))


def dapt_clusters(center: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
    """(k, 3) m: clusters with the released code's distribution. Two clusters of 0 to 149 points each, around points
    within +-0.4 m (+-0.8 m in z) per axis of `center`; spherical coordinates are uniform: radius up to 0.3 m, polar
    angle, azimuth (so points are denser at the poles)."""
    cluster_centers = center + rng.uniform(-1, 1, (2, 3)) * _CLUSTER_REACH
    point_centers = np.repeat(cluster_centers, rng.integers(0, _CLUSTER_POINTS, 2), axis=0)
    radius, polar, azimuth = rng.random((3, len(point_centers))) * [[_CLUSTER_RADIUS], [np.pi], [2 * np.pi]]
    horizontal_radius = radius * np.sin(polar)
    return point_centers + np.stack(
        [horizontal_radius * np.cos(azimuth), horizontal_radius * np.sin(azimuth), radius * np.cos(polar)], 1
    )


# --- loss and jitter of points


def random_keep(count: int, *, share: float, rng: np.random.Generator) -> np.ndarray:
    """(count,) bool: drops each return independently with probability `share`."""
    return rng.random(count) >= share


def part_removal(part: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: drops the points of one body part, drawn at random from those present.

    Pass the parts of the points inside the crop only; otherwise a part outside the crop may be drawn.
    """
    parts = np.flatnonzero(np.bincount(part)[1:]) + 1 if len(part) else part
    return np.ones(len(part), bool) if len(parts) == 0 else part != parts[rng.integers(len(parts))]


def half_space_keep(points: np.ndarray, *, most: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: keeps one side of a random plane that cuts up to a share `most` off the cloud's extent.

    Simulates occlusion by the end of a wall, or a neighbor's box that has taken some of the points. The plane has a
    random orientation; the share is of the extent along its normal, and at least one point remains.
    """
    if len(points) == 0:
        return np.ones(0, bool)
    normal = rng.normal(size=3) * [1, 1, 0.5]
    projection = points @ (normal / np.linalg.norm(normal))
    low, high = projection.min(), projection.max()
    return projection >= low + (high - low) * most * rng.random()


def jitter(points: np.ndarray, *, sigma: float, clip: float, rng: np.random.Generator) -> np.ndarray:
    """points (n, 3) m, each moved by Gaussian noise of `sigma` m per axis, clipped to +-`clip` m."""
    return points + np.clip(rng.normal(0, sigma, points.shape), -clip, clip)


# --- the box around a person with a detector's errors

# margin that every box adds to the body's size, and the maximum of an additional random margin, m
_ROOM, _MORE = 0.05, 0.2
# range of the additional margin of a box that is far too large, m
_LOOSE = (0.1, 0.8)
# the bottom face: probability that it is above the soles or below the ground, and the range of the offset, m
_RAISED, _RAISED_BY = 0.2, (0.03, 0.15)
_SUNK, _SUNK_BY = 0.3, (0.03, 0.25)
# minimum size of a box, m
_LEAST_SIZE = 0.4
# margin on each side of a box without errors, m
_ALL = 2.5
# the center of a box with two people is at most this share of the way from the person meant to the other
_TOWARDS = 0.4


def draw_box(
    errors: CropErrors,
    difficulty: float,
    extent: tuple[list[float], list[float]],
    place: Place,
    rng: np.random.Generator,
    heading: float = 0.0,
) -> Box:
    """The box of a body, level frame, with the errors of a detector.

    Without errors, the box has a large margin and thus holds all points within the window of beams: the paper does not
    crop.

    Args:
        difficulty: in [0, 1], scales the probability that a box is cut.
        extent: the body's minimum and maximum x, y, z in m, in its own frame, axes aligned with its `heading` rad.
        place: of the body.
    """
    low, high = np.array(extent)
    yaw, cut_draw = place.yaw + heading, 1.0
    if not (errors.jitter or errors.loose or errors.cut):
        low, high = low - _ALL, high + _ALL
    else:
        *room_draws, loose_draw, loose_share, bottom_draw, depth_share, cut_draw = rng.random(8).tolist()
        *shift, yaw_error = (errors.jitter * rng.standard_normal(4)).tolist()
        extra_size = _LOOSE[0] + loose_share * (_LOOSE[1] - _LOOSE[0]) if loose_draw < errors.loose else 0.0
        if bottom_draw < _RAISED:
            low[2] += _RAISED_BY[0] + depth_share * (_RAISED_BY[1] - _RAISED_BY[0])
        elif bottom_draw < _RAISED + _SUNK:
            low[2] -= _SUNK_BY[0] + depth_share * (_SUNK_BY[1] - _SUNK_BY[0])
        margin = (_ROOM + _MORE * np.array(room_draws) + extra_size) / 2
        # a detector's z is more accurate than its x and y
        shift = np.array(shift) / [1, 1, 2]
        low, high, yaw = low - margin + shift, high + margin + shift, yaw + yaw_error
    # the center of the extent, rotated by the true heading
    c, s = cos(place.yaw + heading), sin(place.yaw + heading)
    x, y, z = ((low + high) / 2).tolist()
    center = place.feet + np.array([c * x - s * y, s * x + c * y, z])
    box = Box(center=center, size=np.maximum(high - low, _LEAST_SIZE), yaw=yaw)
    return cut_box(box, rng=rng) if cut_draw < errors.cut * difficulty else box


def box_of_two(box: Box, body: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> Box:
    """A box around a body, enlarged to hold another body, too; its center stays nearer to the first body.

    Args:
        box: of the body, with a detector's errors.
        body, other: (V, 3) m, vertices. "Nearer" refers to the centers of their extents in x and y.
    """
    middles = [(vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2 for vertices in (body, other)]
    offset = middles[1] - middles[0]
    # the center's position on the way to the other body's middle, as a share: from the box's own errors, then shifted
    squared_distance = float(offset @ offset)
    center_share = float((box.center[:2] - middles[0]) @ offset) / max(squared_distance, 1e-9)
    center = box.center.copy()
    center[:2] += (min(center_share + _TOWARDS * rng.random(), _TOWARDS) - center_share) * offset
    R_level_box = rotation_about("z", box.yaw)
    local = np.concatenate([body, other]) @ R_level_box - center @ R_level_box
    low, high = local.min(0), local.max(0)
    # in z the box need not be symmetric about its center
    half_size = np.maximum(np.maximum(-low, high), box.size / 2)
    shift = (min(low[2], -box.size[2] / 2) + max(high[2], box.size[2] / 2)) / 2
    half_size[2] = max(high[2], box.size[2] / 2) - shift
    return replace(box, center=center + [0, 0, shift], size=2 * half_size + _ROOM)


def cut_box(box: Box, *, most: float = 0.3, rng: np.random.Generator) -> Box:
    """The box with up to a share `most` cut off its height (at the feet twice as often as at the head) or off one side,
    as by detectors whose box ends at a car's hood or a table edge."""
    side_draw, amount = rng.random(2)
    lost_share = most * amount
    # axis and the side of it that is cut off
    axis, side = ((2, -1), (2, -1), (2, 1), (1, -1), (1, 1), (0, 1))[int(side_draw * 6)]
    shift = np.zeros(3)
    shift[axis] = -side * lost_share * box.size[axis] / 2
    size = box.size.copy()
    size[axis] *= 1 - lost_share
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    level_shift = np.array([c * shift[0] - s * shift[1], s * shift[0] + c * shift[1], shift[2]])
    return replace(box, center=box.center + level_shift, size=size)
