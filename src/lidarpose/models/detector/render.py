"""Renders the detector network's inputs for a candidate: its points, the sensor's view past it, and its surroundings.

The view frame of a candidate: x level and away from the sensor, y left, z up from the ground at the candidate's
center. If the sensor is unknown, x and y are those of the level frame. Inputs, with K candidates as the first axis:

    fine (K, 28, 24, 24): slices of 10 cm from -0.5 to 2.3 m, cells of 10 cm: .5 + .125 log2(1 + points), 0 if empty
    range_view (K, 4, 28, 24): directions, as a view of 2.4 x 2.8 m at the candidate's distance, rows from bottom to
        top, columns from right to left: nearest and farthest return beyond the candidate (m / 4, clipped to +-1),
        number of returns, and number of returns in a cell of twice the size, both as .125 log2(1 + returns)
    context (K, 4, 20, 20): 10 x 10 m from above, x first: highest point above the ground (m / 4, clipped to 1), share
        of the heights 0.3-2.1 m that hold points, .125 log2(1 + points), the same for points near the ground
    scalars (K, 4): log of the distance, height of the sensor above the ground at the candidate (m / 4), log of the
        number of points, 1 if the sensor is known; without a sensor, range_view and the first two are 0
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lidarpose.models.detector.candidates import CONTEXT_CELL, CONTEXT_SIDE, MARGIN, UNIT, Candidates
from lidarpose.models.detector.range_image import BOTTOM, CELL, RANGE_CHANNELS, SIDE, SLICES


@dataclass(frozen=True, kw_only=True, eq=False)
class CandidateAugmentation:
    """Training augmentation of candidates. Points in the view frame are, in order, mirrored, turned, scaled, shifted.

    Each field is an array with one entry per candidate (K), or one value for all. turn: rad about z; mirror: y to -y;
    scale; shift (K, 2) m; keep: share of points; noise: standard deviation along x, away from the sensor, m;
    drop_origin: treat the sensor as unknown; seed: of the random numbers drawn for each point.
    """

    turn: Any = 0.0
    mirror: Any = False
    scale: Any = 1.0
    shift: Any = (0.0, 0.0)
    keep: Any = 1.0
    noise: Any = 0.0
    drop_origin: Any = False
    seed: Any = 0

    def over(self, count: int) -> "CandidateAugmentation":
        """The same, with one entry for each of `count` candidates."""
        shapes = {"shift": (count, 2)}
        values = {f.name: np.broadcast_to(getattr(self, f.name), shapes.get(f.name, (count,))) for f in fields(self)}
        return CandidateAugmentation(**values)

    @property
    def matrix(self) -> np.ndarray:
        """(K, 2, 2): mirroring, turn and scale of x and y."""
        c, s = self.scale * np.cos(self.turn), self.scale * np.sin(self.turn)
        sign = np.where(self.mirror, -1, 1)
        return np.stack([np.stack([c, -s * sign], -1), np.stack([s, c * sign], -1)], -2)

    def apply(self, places: np.ndarray) -> np.ndarray:
        """Positions (K, 2) m, one per candidate, mirrored, turned, scaled and shifted."""
        augmentation = self.over(len(places))
        return (augmentation.matrix @ places[..., None])[..., 0] + augmentation.shift


def render(
    candidates: Candidates, augmentation: CandidateAugmentation | None = None, *, fine: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The network's inputs, float32: see the module. fine: memory (K, 28, 24, 24) float32 to reuse for that input."""
    has_sensor, count = candidates.distance > 0, candidates.count
    points = candidates.xyz * np.float32(UNIT)
    owner = np.repeat(np.arange(len(candidates)), candidates.sizes)
    contexts, change = candidates.contexts, None
    if augmentation is not None:
        change = augmentation.over(len(candidates))
        has_sensor, count = has_sensor & ~change.drop_origin, count * change.keep
        points, owner = _moved_points(points, owner, candidates.sizes, change)
        contexts = _moved_contexts(contexts, change)
    scalars = np.zeros((len(candidates), 4), np.float32)
    scalars[:, 0] = np.log(np.where(has_sensor, candidates.distance, 1.0))
    scalars[:, 1] = has_sensor * candidates.sensor_height / 4
    scalars[:, 2] = np.log1p(count)
    scalars[:, 3] = has_sensor
    return {
        # if a candidate has more points than are stored, each stored point stands for several
        "fine": _fine(points, owner, candidates.count / np.maximum(candidates.sizes, 1), fine),
        "range_view": _range_views(candidates.range_views, has_sensor, change),
        "context": contexts * np.float32(1 / 255),
        "scalars": scalars,
    }


def _moved_points(
    points: np.ndarray, owner: np.ndarray, sizes: np.ndarray, change: CandidateAugmentation
) -> tuple[np.ndarray, np.ndarray]:
    """Augmented points (3, n) float32 m, and the candidates that own them; some points are dropped. owner (n,):
    candidate of each given point; sizes (K,): number of points of each candidate."""
    draws = [np.zeros((2, 0), np.float32)]
    for size, seed, deviation in zip(sizes.tolist(), change.seed.tolist(), change.noise.tolist(), strict=True):
        rng = np.random.default_rng(seed)
        draws.append(np.stack([rng.random(size, np.float32), rng.standard_normal(size, np.float32) * deviation]))
    chance, noise = np.concatenate(draws, axis=1)
    is_kept = chance < change.keep.astype(np.float32)[owner]
    points, owner, noise = points[:, is_kept], owner[is_kept], noise[is_kept]
    points[0] += noise
    matrix, shift = change.matrix.astype(np.float32)[owner], change.shift.astype(np.float32)[owner]
    x, y = (matrix[:, i, 0] * points[0] + matrix[:, i, 1] * points[1] + shift[:, i] for i in (0, 1))
    return np.stack([x, y, points[2] * change.scale.astype(np.float32)[owner]]), owner


def _fine(points: np.ndarray, owner: np.ndarray, weight: np.ndarray, fine: np.ndarray | None) -> np.ndarray:
    """(K, 28, 24, 24) of points (3, n) m of candidates `owner` (n,), each of which stands for `weight` (K,) points."""
    shape = (len(weight), SLICES, SIDE, SIDE)
    origin_cell = np.array([[SIDE // 2], [SIDE // 2], [-BOTTOM / CELL]], np.float32)
    j, k, i = np.floor(points * np.float32(1 / CELL) + origin_cell).astype(np.int64)
    # as unsigned integers, negative indices are large
    is_inside = np.logical_and.reduce([axis.view(np.uint64) < n for axis, n in zip((i, j, k), shape[1:], strict=True)])
    cell_index = (((owner * SLICES + i) * SIDE + j) * SIDE + k)[is_inside]
    fine = np.empty(shape, np.float32) if fine is None else fine
    fine[:] = 0
    cells = fine.reshape(-1)
    np.add.at(cells, cell_index, np.float32(1))
    cells[cell_index] = 0.5 + 0.125 * np.log2(1 + cells[cell_index] * weight[owner[is_inside]])
    return fine


def _range_views(pixels: np.ndarray, has_sensor: np.ndarray, change: CandidateAugmentation | None) -> np.ndarray:
    views = np.zeros((len(has_sensor), RANGE_CHANNELS, SLICES, SIDE), np.float32)
    pixels = pixels[has_sensor]
    if change is None:
        margin = (pixels.shape[3] - SIDE) // 2
        pixels = pixels[:, :, margin : margin + SLICES, margin : margin + SIDE]
    else:
        scale, sign = change.scale[has_sensor, None], np.where(change.mirror, -1.0, 1.0)[has_sensor, None]
        height = ((np.arange(SLICES) + 0.5) * CELL + BOTTOM) / scale
        lateral = (np.arange(SIDE) + 0.5) * CELL - SIDE * CELL / 2
        lateral = sign * (lateral - change.shift[has_sensor, 1:]) / scale
        i = np.floor((height - BOTTOM) / CELL).astype(np.int64) + MARGIN
        j = np.floor((lateral + SIDE * CELL / 2) / CELL).astype(np.int64) + MARGIN
        i, j = np.clip(i, 0, pixels.shape[2] - 1), np.clip(j, 0, pixels.shape[3] - 1)
        pixels = np.moveaxis(pixels[np.arange(len(pixels))[:, None, None], :, i[:, :, None], j[:, None, :]], -1, 1)
        _lose_returns(pixels, change.keep[has_sensor], change.seed[has_sensor].tolist())
    ranges = (pixels[:, :2] - np.float32(128)) / np.float32(127)
    ranges[pixels[:, :2] == 0] = 0
    views[has_sensor, :2], views[has_sensor, 2:] = ranges, pixels[:, 2:] / np.float32(255)
    return views


def _lose_returns(views: np.ndarray, share: np.ndarray, seeds: list[int]) -> None:
    """Drops all but a share (K,) of the returns of range views (K, 4, H, W), in place; a cell may become empty."""
    share = share[:, None, None]
    count = np.exp2(views[:, 2] / (0.125 * 255)) - 1
    chance = np.empty(count.shape, np.float32)
    for k, seed in enumerate(seeds):
        chance[k] = np.random.default_rng([seed, 1]).random(count.shape[1:], np.float32)
    views[:, :3] *= (chance >= (1 - share) ** count)[:, None]
    byte_offset = np.log2(share) * (0.125 * 255)
    views[:, 2:] = np.where(views[:, 2:] > 0, np.maximum(views[:, 2:] + byte_offset[:, None], 1), 0)


def _moved_contexts(contexts: np.ndarray, change: CandidateAugmentation) -> np.ndarray:
    side = (np.arange(CONTEXT_SIDE) - (CONTEXT_SIDE - 1) / 2) * CONTEXT_CELL
    target = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    source = (target - change.shift[:, None]) @ np.swapaxes(np.linalg.inv(change.matrix), 1, 2)
    i, j = np.moveaxis(np.floor(source / CONTEXT_CELL).astype(np.int64) + CONTEXT_SIDE // 2, -1, 0)
    i, j = np.clip(i, 0, CONTEXT_SIDE - 1), np.clip(j, 0, CONTEXT_SIDE - 1)
    return np.moveaxis(contexts[np.arange(len(contexts))[:, None], :, i, j], -1, 1).reshape(contexts.shape)
