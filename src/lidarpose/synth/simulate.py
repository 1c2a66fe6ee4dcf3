"""What a sensor returns of a scene: the cast, and what goes wrong with it."""

from dataclasses import dataclass

import numpy as np

from lidarpose.lidar.beam_divergence import scan_wide
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.ray_pattern_scan import scan_pattern
from lidarpose.lidar.raycast import Hits
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.mask import direction_mask, laser_mask
from lidarpose.synth.noise_kernels import spoil
from lidarpose.synth.placement import Place
from lidarpose.synth.scene import SceneConfig


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A mesh of a scene. vertices (V, 3) m; moved (V, 3) where they are when the sensor's frame ends, None: where they
    were; part (F,) uint8 of its faces, 0 = not the person, None: all 0."""

    vertices: np.ndarray
    faces: np.ndarray
    moved: np.ndarray | None = None
    part: np.ndarray | None = None

    @classmethod
    def still(cls, mesh: Mesh) -> "Layer":
        return cls(vertices=mesh.vertices, faces=mesh.faces)


@dataclass(frozen=True, kw_only=True)
class Returns:
    """Points (n, 3) float32 m in the level frame, with their faults; ring (n,); part (n,) uint8."""

    points: np.ndarray
    ring: np.ndarray
    part: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What a sensor's day is like, the same for all frames of a clip.

    sigma m of a range; bias m of a ring; weak in [0, 1]: how much is lost that grazes or is far; divergence rad of a
    beam, 0 = a line; keep: share of patches that the mask keeps, 1 = no mask; phase: a pattern's first frame.
    """

    sigma: float
    bias: float
    weak: float
    divergence: float
    keep: float
    phase: int


def draw_conditions(config: SceneConfig, device: Sensor | RayPattern, rng: np.random.Generator) -> Conditions:
    """Conditions of a scene; of them the mask alone is as frequent as the scene is difficult."""
    faults = config.faults
    noise, bias, weak, wide, divergence, mask, keep, phase = rng.random(8).tolist()
    sigma = 0.0 if faults.released else device.range_sigma * _between(faults.sigma, noise)
    return Conditions(
        sigma=sigma,
        bias=_between(faults.ring_bias, bias),
        weak=faults.weak * weak,
        divergence=_between(_DIVERGENCE, divergence) if wide < faults.wide else 0.0,
        keep=faults.keep + (faults.keep_most - faults.keep) * keep if mask < faults.mask * config.hard else 1.0,
        phase=int(1e6 * phase),
    )


# full divergence of beams, rad: 3 to 6 cm at 20 m
_DIVERGENCE = (0.0015, 0.003)


def _between(ends: tuple[float, float], share: float) -> float:
    return ends[0] + share * (ends[1] - ends[0])


def look(
    layers: list[Layer],
    device: Sensor | RayPattern,
    place: Place,
    conditions: Conditions,
    config: SceneConfig,
    rng: np.random.Generator,
    *,
    frame: int = 0,
) -> Returns:
    """The returns of `layers` (level frame), the first of which is the body that the window of beams is about.

    frame: how many frames after a pattern's first one.
    """
    hits, vertices, faces, part = _cast(layers, device, place, conditions, config, frame)
    points, kept = spoil(
        hits.points,
        hits.face,
        vertices,
        faces,
        hits.ring,
        keep=_unmasked(hits, device, conditions, rng),
        sigma=conditions.sigma,
        bias=conditions.bias,
        dropout=device.dropout,
        weak=conditions.weak,
        range_max=device.range_max,
        one_sided=_RELEASED_NOISE if config.faults.released else 0.0,
        rng=rng,
    )
    ring, part = hits.ring[kept], part[hits.face[kept]]
    if config.faults.released and isinstance(device, Sensor):
        twice = np.flatnonzero((hits.column[kept] + hits.column0) % device.columns == 0)
        points, ring, part = (np.concatenate([a, a[twice]]) for a in (points, ring, part))
    return Returns(points=place.to_level(points), ring=ring, part=part)


# ranges of the released code are too long by up to this, m
_RELEASED_NOISE = 0.02


def _unmasked(
    hits: Hits, device: Sensor | RayPattern, conditions: Conditions, rng: np.random.Generator
) -> np.ndarray | None:
    """(n,) bool: which hits the laser-level mask leaves, None for all."""
    if conditions.keep >= 1:
        return None
    if isinstance(device, RayPattern):
        return direction_mask(hits.points, keep=conditions.keep, rng=rng)
    mask = laser_mask(hits.columns, hits.rows, keep=conditions.keep, rng=rng)
    return mask[hits.column, hits.ring - hits.row0]


def count_alone(
    body: Layer, device: Sensor | RayPattern, place: Place, conditions: Conditions, config: SceneConfig, frame: int
) -> int:
    """How many beams would meet a body with nothing else around."""
    return len(_cast([body], device, place, conditions, config, frame)[0].face)


def _cast(
    layers: list[Layer],
    device: Sensor | RayPattern,
    place: Place,
    conditions: Conditions,
    config: SceneConfig,
    frame: int,
) -> tuple[Hits, np.ndarray, np.ndarray, np.ndarray]:
    """The hits, and vertices (sensor frame), faces and the faces' parts of all layers as one mesh."""
    vertices, moved, faces, part = _joined(layers, isinstance(device, RayPattern) and device.duration > 0)
    vertices = place.to_sensor(vertices)
    body = vertices[: len(layers[0].vertices)]
    margin = config.margin + np.arctan2(config.around, place.distance)
    if isinstance(device, Sensor):
        hits = scan_wide(vertices, faces, device, divergence=conditions.divergence, window_vertices=body, margin=margin)
        return hits, vertices, faces, part
    hits = scan_pattern(
        vertices,
        faces,
        device,
        (conditions.phase + frame) % device.frames,
        moved=place.to_sensor(moved) if device.duration else None,
        body_vertices=len(body),
        margin=margin,
    )
    return hits, vertices, faces, part


def _joined(layers: list[Layer], moving: bool) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]:
    """vertices, moved (None unless `moving`), faces and the faces' parts of all layers as one mesh."""
    start, faces = 0, []
    for layer in layers:
        faces.append(layer.faces + np.int32(start))
        start += len(layer.vertices)
    part = [np.zeros(len(layer.faces), np.uint8) if layer.part is None else layer.part for layer in layers]
    vertices = np.concatenate([layer.vertices for layer in layers])
    moved = None
    if moving:
        moved = np.concatenate([layer.vertices if layer.moved is None else layer.moved for layer in layers])
    return vertices, moved, np.concatenate(faces), np.concatenate(part)
