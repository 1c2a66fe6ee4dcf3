"""How whole scans are acquired: the sensor, its mount, the ray cast, lost and stray points, and the frame."""

from dataclasses import dataclass, replace
from functools import cache
from math import pi

import numpy as np

from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.lidar.presets import sensor as named_sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.raycast import Hits, scan, scan_pattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.environment.layouts import Layout
from lidarpose.synth.environment.mesh import Mesh
from lidarpose.synth.environment.site import Mount, pick
from lidarpose.synth.environment.things import KINDS
from lidarpose.synth.simulate import ScanConditions, add_sensor_noise

# sensors by name and their weights outdoors and indoors; "random": a sensor with random rings
_SENSORS = {
    "vlp-16": (1.0, 1.0), "vlp-32c": (1.0, 0.3), "hdl-32e": (0.8, 0.3), "hdl-64e": (0.8, 0.0), "os1-64": (1.0, 0.6),
    "os1-128": (0.5, 0.4), "os0-128": (0.6, 1.0), "pandar64": (1.0, 0.2), "av2": (1.2, 0.0), "waymo-top": (0.5, 0.0),
    "livox-mid360": (1.3, 1.5), "livox-avia": (1.0, 0.4), "livox-mid100": (0.4, 0.1), "depth-camera": (0.3, 1.5),
    "random": (2.5, 1.5),
}  # fmt: skip
# weights that differ in training
_TRAINING_SENSORS = {"depth-camera": (0.3, 1.8)}
# maximum number of beams in a scan: sensors with more get fewer columns
_MOST_BEAMS = 140_000
# minimum number of points in a piece of a place
_LEAST_PIECE = 300


def draw_sensor(indoors: bool, is_training: bool, rng: np.random.Generator) -> Sensor | RayPattern:
    """One of `_SENSORS`, or a sensor with random rings."""
    weights = _SENSORS | (_TRAINING_SENSORS if is_training else {})
    name = pick(rng, {name: shares[int(indoors)] for name, shares in weights.items()})
    device: Sensor | RayPattern
    if name == "random":
        rings = int(rng.choice([16, 24, 32, 40, 48, 64, 80, 128]))
        low, high = -rng.uniform(8, 45), rng.uniform(1, 45)
        share = np.linspace(0, 1, rings)
        if rng.random() < 0.4:
            # rings are denser in the middle
            share = 0.5 + 0.5 * np.sign(2 * share - 1) * np.abs(2 * share - 1) ** rng.uniform(1.2, 2.0)
        columns = int(rng.choice([600, 900, 1024, 1800, 2048]))
        device = Sensor(
            name=f"random-{rings}",
            elevations=np.radians(low + share * (high - low)),
            azimuth_step=2 * pi / columns,
            range_min=rng.choice([0.1, 0.5, 1.0]),
            range_max=rng.uniform(40, 150),
            range_sigma=rng.uniform(0.005, 0.03),
        )
    else:
        device = named_sensor(name)
    if isinstance(device, RayPattern):
        return _integrated(name, int(rng.integers(1, 5))) if device.duration else device
    if device.rows * device.columns > _MOST_BEAMS:
        columns = int(_MOST_BEAMS / device.rows)
        device = replace(device, azimuth_step=2 * pi / columns)
    return device


@cache
def _integrated(name: str, frames: int) -> RayPattern:
    """A rosette that integrates `frames` of its frames into one."""
    base_pattern = named_sensor(name)
    assert isinstance(base_pattern, RayPattern)

    def rays(number: int) -> tuple[np.ndarray, ...]:
        parts = [base_pattern.rays(number * frames + k) for k in range(frames)]
        azimuth, elevation, time, line = (np.concatenate(values) for values in zip(*parts, strict=True))
        frame_number = np.repeat(np.arange(frames), [len(part[0]) for part in parts])
        return azimuth, elevation, (time + frame_number) / frames, line

    return replace(base_pattern, rays=rays, frames=4, duration=base_pattern.duration * frames)  # type: ignore[arg-type]


def draw_mount(device: Sensor | RayPattern, layout: Layout, rng: np.random.Generator) -> Mount:
    """A mount on a robot, a tripod, a car, a mast or under a ceiling; high mounts are pitched down."""
    mount_draw, height_draw, direction_draw = rng.random(3)
    if layout.indoors:
        height = 0.3 + 1.5 * height_draw if mount_draw < 0.7 else layout.ceiling - 0.15 - 0.8 * height_draw
        height = min(height, layout.ceiling - 0.15, 5.0)
    elif layout.by_car and mount_draw < 0.7:
        height = 1.5 + 0.9 * height_draw
    else:
        height = 0.3 + 1.9 * height_draw if mount_draw < 0.85 else 2.2 + 3.8 * height_draw
    pitch, roll = np.radians(rng.normal(0, 1.2, 2))
    if height > 2.2 and not (layout.by_car and mount_draw < 0.7):
        pitch += np.radians(rng.uniform(2, 30))
    elif rng.random() < 0.15:
        pitch, roll = np.radians(rng.uniform(4, 30)) * np.array(
            [np.cos(2 * pi * direction_draw), np.sin(2 * pi * direction_draw)]
        )
    if device.name == "livox-mid360" and (height > 2.0 or rng.random() < 0.2):
        # it sees little below itself, so it is mounted upside down
        roll += pi
    is_narrow = isinstance(device, RayPattern) and device.is_narrow
    half_width = device.field_of_view / 2 if isinstance(device, RayPattern) else pi
    yaw = rng.uniform(-pi, pi)
    if is_narrow:
        yaw = -float(rng.choice(layout.ahead)) + rng.uniform(-0.5, 0.5)
    return Mount(
        height=float(height),
        R_sensor_level=rotation_about("x", roll) @ rotation_about("y", -pitch),
        turn=yaw,
        view=(-yaw, half_width if is_narrow or pitch < np.radians(12) else 1.2),
    )


def scan_scene(
    device: Sensor | RayPattern, mesh: Mesh, R_sensor_level: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) m in the level frame at the sensor, and the face (n,) that each was returned from."""
    R = R_sensor_level.astype(np.float32)
    vertices = mesh.vertices @ R.T
    hits: Hits
    if isinstance(device, RayPattern):
        later_vertices = None if mesh.later is None else mesh.later @ R.T
        hits = scan_pattern(vertices, mesh.faces, device, int(rng.integers(device.frames)), moved=later_vertices)
    else:
        hits = scan(vertices, mesh.faces, device)
    conditions = ScanConditions(
        sigma=device.range_sigma * rng.uniform(0.3, 1.3),
        bias=rng.uniform(0.002, 0.015),
        intensity_dropout=0.9 * rng.random() ** 2,
    )
    points, returned = add_sensor_noise(hits, Mesh(vertices, mesh.faces), device, conditions, rng)
    face = hits.face[returned]
    if isinstance(device, Sensor) and rng.random() < 0.15:
        # the lowest rings are missing
        ring_mask = hits.ring[returned] >= rng.uniform(0.05, 0.5) * device.rows
        points, face = points[ring_mask], face[ring_mask]
    return points @ R, face


def scatter_leaves(points: np.ndarray, leaves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) m with those on leaves (mask (n,)) moved a little behind the few large leaves of the mesh."""
    rows = np.flatnonzero(leaves)
    depth = rng.uniform(0.02, 0.2) * rng.standard_exponential(len(rows))
    moved_points = points.copy()
    moved_points[rows] *= (1 + depth / np.maximum(np.linalg.norm(points[rows], axis=1), 0.3))[:, None].astype(
        np.float32
    )
    return moved_points


def add_strays(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Moves some points nearer to the sensor, as mixed pixels, dust and rain do. Returns points and indices (k,) of
    stray points."""
    share = rng.choice([0.0, 0.0005, 0.004], p=[0.4, 0.4, 0.2])
    stray_rows = np.flatnonzero(rng.random(len(points)) < share)
    moved_points = points.copy()
    moved_points[stray_rows] *= rng.uniform(0.1, 1.0, (len(stray_rows), 1)).astype(np.float32)
    return moved_points, stray_rows


def cut_scan(points: np.ndarray, thing: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, bool]:
    """(n,) bool: which points a user's file holds, and whether it holds only a piece of the place. A file may hold all
    points, or lack those near the sensor or the ground, or hold a piece only."""
    keep_mask, draws = np.ones(len(points), bool), rng.random(3)
    if draws[0] < 0.1:
        keep_mask &= np.hypot(points[:, 0], points[:, 1]) > rng.uniform(1, 3)
    if draws[1] < 0.03:
        keep_mask &= (thing != KINDS.index("ground")) | (rng.random(len(points)) < 0.02)
    if draws[2] < 0.1:
        size, angle = rng.uniform(6, 20, 2), rng.uniform(-pi, pi)
        center = rng.uniform(3, 14) * np.array([np.cos(angle), np.sin(angle)])
        is_inside = (np.abs(points[:, :2] - center) < size / 2).all(1)
        if is_inside.sum() > _LEAST_PIECE:
            return keep_mask & is_inside, True
    return keep_mask, False


@dataclass(frozen=True)
class SceneFrame:
    """The frame of a scene: rotation R (3, 3) from the level frame, and the sensor's position in it, (3,) m."""

    R: np.ndarray
    origin: np.ndarray

    @classmethod
    def draw(cls, mount: Mount, rng: np.random.Generator, *, most: float) -> "SceneFrame":
        """Level within a degree or two; in a tenth of the cases tilted by 3 to `most` degrees. The origin is the
        sensor, a point near the ground below it (as of a vehicle), or a point up to 200 m away."""
        angle, degrees = rng.uniform(-pi, pi), abs(rng.normal(0, 1.2))
        if rng.random() < 0.1:
            degrees = rng.uniform(3, most)
        R = axis_angle_to_matrix(np.radians(degrees) * np.array([np.cos(angle), np.sin(angle), 0]))
        origin = np.zeros(3)
        if rng.random() < 0.3:
            origin = np.array([*rng.normal(0, 1.0, 2), mount.height + rng.normal(0, 0.05)])
        elif rng.random() < 0.05:
            origin = rng.uniform(-200, 200, 3) * [1, 1, 0.1]
        return cls(R, origin)

    def of(self, points: np.ndarray) -> np.ndarray:
        return points @ self.R.T + self.origin

    def yaw(self, yaw: float) -> float:
        x, y, _ = self.R @ [np.cos(yaw), np.sin(yaw), 0]
        return float(np.arctan2(y, x))
