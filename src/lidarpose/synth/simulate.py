"""Simulated scans of a person's scene: its triangles, the ray cast, and the sensor's noise."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import pi
from typing import Any, cast

import numpy as np

from lidarpose.data.clips import MARGIN
from lidarpose.geometry import rotation_about
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.raycast import Hits, scan, scan_pattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import Box
from lidarpose.synth.acquisition import SINGLE_SCAN, Acquisition
from lidarpose.synth.bodies import FRAME_TIME, Bodies
from lidarpose.synth.environment.mesh import Mesh, box as box_mesh, union
from lidarpose.synth.noise import direction_mask, laser_mask
from lidarpose.synth.noise_kernels import lose_returns
from lidarpose.synth.place import Place
from lidarpose.synth.props import Prop
from lidarpose.synth.scene import SceneConfig

# manufacturers' range limits are for targets that reflect about 80 percent; clothes at 20 percent have half that range
REACH = 0.5
# margin that a label's box adds to the body's size, m
_BOX_ROOM = 0.1
# full divergence of beams, rad: 3 to 6 cm at 20 m
_DIVERGENCE = (0.0015, 0.003)
# maximum error of the released code's ranges, which are always too long, m
_DAPT_NOISE = 0.02


@dataclass(frozen=True, kw_only=True)
class ScanConditions:
    """Parameters of a sensor's noise, the same in all frames of a clip; each ring's error is redrawn in every frame.

    Args:
        sigma: standard deviation of a range, m.
        bias: standard deviation of an error that all points of a ring share, m.
        intensity_dropout: in [0, 1], maximum loss probability of returns at grazing incidence or far away.
        divergence: of a beam, rad; 0: a line.
        one_sided: additional range errors uniform in [0, one_sided), as in the released code, m.
        keep: share of patches that the laser-level mask keeps; 1: no mask.
        phase: index of a pattern's first frame.
    """

    sigma: float = 0.0
    bias: float = 0.0
    intensity_dropout: float = 0.0
    divergence: float = 0.0
    one_sided: float = 0.0
    keep: float = 1.0
    phase: int = 0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that is constant while a person moves.

    Args:
        config: the scene's configuration, at its difficulty.
        sensor: a spinning sensor or a ray pattern.
        place: of the person, and the sensor's mount.
        conditions: the sensor's noise.
        background: meshes in the level frame at the sensor: ground, things, another person.
        props: things that the person wears and uses.
        still: number of meshes of `background` that are static: all but the other person, which is the last mesh.
        acquisition: how the cloud is acquired.
        views: the scans that are added to the scene's own.
    """

    config: SceneConfig
    sensor: Sensor | RayPattern
    place: Place
    conditions: ScanConditions
    background: list[Mesh]
    props: list[Prop]
    still: int = 0
    acquisition: Acquisition = SINGLE_SCAN
    views: tuple["View", ...] = ()

    @property
    def body_place(self) -> Place:
        """The body's place, which is above the ground on props such as a bicycle."""
        return self.place.on_props(self.props)

    def meshes(self, bodies: Bodies, row: int, lag: float = 0.0) -> list[Mesh]:
        """All triangles, level frame: body `row`, whose pose is that of the frame's middle, then its props, then the
        background. lag: time by which the body has moved on, as a share of `FRAME_TIME`."""
        place = self.body_place
        pelvis = self.place.to_sensor(place.of_body(bodies.joints[row, :1]))[0]
        states = [bodies.between(row, lag + time) for time in looks(self.sensor, pelvis)]
        body_vertices = [place.of_body(vertices) for vertices, _ in states]
        meshes = [Mesh(body_vertices[0], bodies.faces, bodies.face_part, *body_vertices[1:])]
        for prop in self.props:
            prop_meshes = [prop.place(joints) for _, joints in states]
            vertices = [place.of_body(mesh.vertices) for mesh in prop_meshes]
            meshes.append(Mesh(vertices[0], prop_meshes[0].faces, prop.face_part, *vertices[1:]))
        return meshes + self.background

    def seen_from(self, at: np.ndarray, **changes: Any) -> "Scene":
        """The scene in a level frame with parallel axes whose origin is `at` (3,) m in this one; changes: other fields
        that differ for the sensor there."""
        place = changes.pop("place", self.place)
        feet = self.place.feet - at
        place = replace(place, feet=feet, yaw=self.place.yaw, distance=float(np.hypot(feet[0], feet[1])))
        return replace(self, place=place, background=[mesh.moved(-at) for mesh in self.background], views=(), **changes)

    def scans(self, bodies: Bodies, row: int, frame: int) -> Iterator[tuple["Scene", list[Mesh], int, np.ndarray]]:
        """The scans of which the cloud of body `row` consists, the scene's own first: the scene as seen from the scan's
        sensor, its meshes, the frame's number, and the sensor's position (3,) m in the level frame."""
        yield self, self.meshes(bodies, row), frame, np.zeros(3)
        for view in self.views:
            meshes = view.scene.meshes(bodies, row - view.earlier, view.lag)
            yield view.scene, meshes, frame - view.earlier, view.at


@dataclass(frozen=True, kw_only=True)
class View:
    """A scan that is added to a scene's own.

    Args:
        scene: as seen from this scan's sensor, see `Scene.seen_from`.
        at: (3,) m, the position of this scan's sensor in the level frame of the scene's own scan.
        earlier: number of frames by which this scan is earlier.
        lag: see `Scene.meshes`.
    """

    scene: Scene
    at: np.ndarray
    earlier: int = 0
    lag: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SimulatedScan:
    """Points (n, 3) float32 m in the level frame, with noise; ring (n,); part (n,) uint8, 0: not the person; time (n,)
    float32 s, relative to the scene's own scan, if the cloud also has points of earlier frames."""

    points: np.ndarray
    ring: np.ndarray
    part: np.ndarray
    time: np.ndarray | None = None


def looks(device: Sensor | RayPattern, position: np.ndarray) -> tuple[float, ...]:
    """Times at which a sensor scans a person with the pelvis at `position` (3,) m in its frame, in units of
    `FRAME_TIME` relative to the middle of the scan: start and end of a rosette's frame; or when the first and the last
    ring of a laser stack pass. (0,): at one time."""
    if isinstance(device, RayPattern):
        half = device.duration / FRAME_TIME / 2
    else:
        # frames start behind the sensor: rings whose lag reaches into the next frame passed one turn earlier, in this
        # frame
        is_ahead = np.arctan2(position[1], position[0]) / (2 * pi) + 0.5 + device.lag > 1
        half = (device.lag - (is_ahead and device.lag > 0)) * device.turn_time / FRAME_TIME / 2
    return (-half, half) if half else (0.0,)


def label_box(vertices: np.ndarray, yaw: float, id: int) -> Box:
    """The label of a body: the box around its vertices (V, 3) m with heading `yaw` rad, enlarged by `_BOX_ROOM`."""
    aligned_vertices = vertices.astype(float) @ rotation_about("z", yaw)
    low, high = aligned_vertices.min(0), aligned_vertices.max(0)
    center = rotation_about("z", yaw) @ ((low + high) / 2)
    return Box(center=center, size=high - low + _BOX_ROOM, yaw=float((yaw + pi) % (2 * pi) - pi), id=id)


def draw_conditions(config: SceneConfig, sensor: Sensor | RayPattern, rng: np.random.Generator) -> ScanConditions:
    """Draws a sensor's conditions in a scene; only the probability of the mask scales with the difficulty."""
    noise = config.noise
    sigma, bias, dropout, wide_draw, divergence, mask_draw, keep, phase = rng.random(8).tolist()
    return ScanConditions(
        sigma=0.0 if noise.dapt_compat else sensor.range_sigma * _between(noise.sigma, sigma),
        bias=_between(noise.ring_bias, bias),
        intensity_dropout=noise.intensity_dropout * dropout,
        divergence=_between(_DIVERGENCE, divergence) if wide_draw < noise.beam_divergence else 0.0,
        one_sided=_DAPT_NOISE if noise.dapt_compat else 0.0,
        keep=_between(noise.mask_keep, keep) if mask_draw < noise.mask * config.hard else 1.0,
        phase=int(1e6 * phase),
    )


def _between(ends: tuple[float, float], share: float) -> float:
    return ends[0] + share * (ends[1] - ends[0])


def simulate(
    scene: Scene, bodies: Bodies, row: int, rng: np.random.Generator, *, frame: int = 0, box: Box | None = None
) -> SimulatedScan:
    """The cloud of body `row`: the scan of the scene's sensor and all scans added to it; `box` as in
    `simulate_scan`."""
    return _added_up(scene.scans(bodies, row, frame), rng, box)


def simulate_still(scene: Scene, thing: Mesh, rng: np.random.Generator, *, box: Box | None = None) -> SimulatedScan:
    """The cloud of a thing that does not move, see `simulate`."""
    view_scans = ((view.scene, thing.moved(-view.at), -view.earlier, view.at) for view in scene.views)
    scans = [(scene, thing, 0, np.zeros(3)), *view_scans]
    return _added_up(
        ((view_scene, [mesh, *view_scene.background], frame, position) for view_scene, mesh, frame, position in scans),
        rng,
        box,
    )


def _added_up(
    view_scans: Iterable[tuple[Scene, list[Mesh], int, np.ndarray]], rng: np.random.Generator, box: Box | None = None
) -> SimulatedScan:
    """Simulates scans as in `Scene.scans` and concatenates them in the frame of the first one."""
    scans: list[SimulatedScan] = []
    frames: list[int] = []
    for view_scene, meshes, frame, position in view_scans:
        frames.append(frame)
        view_box = None if box is None else replace(box, center=box.center - position)
        scan = simulate_scan(view_scene, meshes, rng, frame=frame, box=view_box)
        scans.append(replace(scan, points=scan.points + position.astype(np.float32)) if scans else scan)
    if len(scans) == 1:
        return scans[0]
    arrays = {name: np.concatenate([getattr(scan, name) for scan in scans]) for name in ("points", "ring", "part")}
    if min(frames) < frames[0]:
        seconds = np.array([FRAME_TIME * (frame - frames[0]) for frame in frames], np.float32)
        arrays["time"] = np.repeat(seconds, [len(scan.points) for scan in scans])
    return SimulatedScan(**arrays)


def simulate_scan(
    scene: Scene, meshes: list[Mesh], rng: np.random.Generator, *, frame: int = 0, box: Box | None = None
) -> SimulatedScan:
    """The scan of the scene's sensor.

    Args:
        meshes: all triangles in the level frame; the window of beams is around the first mesh, the body, or around
            body and ground, see `SceneConfig.ground_window`.
        frame: number of frames after a pattern's first one.
        box: the window of beams covers it, too; level frame.
    """
    sensor = scene.sensor
    hits, mesh = _cast(scene, meshes, frame, box=box)
    points, returned = add_sensor_noise(hits, mesh, sensor, scene.conditions, rng)
    # the body has parts, so the union has, too
    ring, part = hits.ring[returned], cast("np.ndarray", mesh.part)[hits.face[returned]]
    if scene.config.noise.dapt_compat and isinstance(sensor, Sensor):
        seam_rows = np.flatnonzero((hits.column[returned] + hits.column0) % sensor.columns == 0)
        points, ring, part = (np.concatenate([a, a[seam_rows]]) for a in (points, ring, part))
    return SimulatedScan(points=scene.place.to_level(points), ring=ring, part=part)


def count_alone(scene: Scene, body: Mesh, frame: int) -> int:
    """Number of beams that would hit a body if nothing else were in the scene."""
    return len(_cast(scene, [body], frame)[0].face)


def scan_background(scene: Scene, body: Mesh, frame: int) -> np.ndarray:
    """Points (n, 3) float32 m in the level frame of the static surroundings of a body, including those that the body
    occludes; without noise, as in a map."""
    empty_body = replace(body, faces=body.faces[:0], part=None)
    hits, _ = _cast(scene, [empty_body, *scene.background[: scene.still]], frame, margin=MARGIN)
    return scene.place.to_level(hits.points)


def _cast(
    scene: Scene, meshes: list[Mesh], frame: int, *, margin: float = 0.0, box: Box | None = None
) -> tuple[Hits, Mesh]:
    """The hits, and the union of all meshes, in the sensor's frame. margin rad: added to the scene's margin of the
    window of beams; box: the window covers it, too."""
    place, sensor = scene.place, scene.sensor
    # the first mesh of the background is the ground; meshes that define the window are sorted to the front
    ground = scene.background[:1] if scene.config.ground_window else []
    window_mesh_ids = {id(mesh) for mesh in (meshes[0], *ground)}
    if box is not None:
        # the window extends `around` beyond its meshes, so the box is shrunk, its corners by `around`; nothing is
        # visible below the feet
        size = np.maximum(box.size - np.sqrt(2) * scene.config.around, 0.0)
        top, bottom = box.center[2] + size[2] / 2, max(box.center[2] - size[2] / 2, place.feet[2])
        size[2] = max(top - bottom, 0.0)
        window_mesh = box_mesh(size).moved([*box.center[:2], bottom], box.yaw)
        meshes = [replace(window_mesh, faces=window_mesh.faces[:0]), *meshes]
        window_mesh_ids.add(id(meshes[0]))
    meshes = sorted(meshes, key=lambda mesh: id(mesh) not in window_mesh_ids)
    body_vertices = sum(len(mesh.vertices) for mesh in meshes if id(mesh) in window_mesh_ids)
    mesh = union(meshes)
    mesh = replace(mesh, vertices=place.to_sensor(mesh.vertices))
    moved = None if mesh.later is None else place.to_sensor(mesh.later)
    margin += scene.config.margin + np.arctan2(scene.config.around, place.distance)
    if isinstance(sensor, Sensor):
        body = mesh.vertices[:body_vertices]
        hits = scan(
            mesh.vertices,
            mesh.faces,
            sensor,
            divergence=scene.conditions.divergence,
            window_vertices=body if moved is None else np.concatenate([body, moved[:body_vertices]]),
            margin=margin,
            moved=moved,
        )
        return hits, mesh
    hits = scan_pattern(
        mesh.vertices,
        mesh.faces,
        sensor,
        (scene.conditions.phase + frame) % sensor.frames,
        moved=moved,
        body_vertices=body_vertices,
        margin=margin,
    )
    return hits, mesh


def _laser_level_mask(hits: Hits, sensor: Sensor | RayPattern, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: which hits the laser-level mask keeps."""
    if keep >= 1:
        return np.ones(len(hits.points), np.bool_)
    if isinstance(sensor, RayPattern):
        return direction_mask(hits.points, keep=keep, rng=rng)
    return laser_mask(hits.columns, hits.rows, keep=keep, rng=rng)[hits.column, hits.ring - hits.row0]


def add_sensor_noise(
    hits: Hits,
    mesh: Mesh,
    sensor: Sensor | RayPattern,
    conditions: ScanConditions,
    rng: np.random.Generator,
    *,
    ring_normals: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The hits that the sensor does not lose, with range errors.

    Args:
        hits: of a ray cast of `mesh`, in the sensor's frame.
        ring_normals: standard normals, one per ring, if several scans share them; None: drawn here.

    Returns:
        Points (k, 3) float32 m and their indices (k,) among the hits.
    """
    count = len(hits.points)
    keep = _laser_level_mask(hits, sensor, conditions.keep, rng)
    normals = rng.standard_normal(count, np.float32)
    if ring_normals is None:
        ring_normals = rng.standard_normal(int(hits.ring.max(initial=-1)) + 1, np.float32)
    chance = rng.random(count, np.float32)
    point_ring_normals = ring_normals.astype(float)[hits.ring]
    error = (conditions.sigma * normals.astype(float) + conditions.bias * point_ring_normals).astype(np.float32)
    if conditions.one_sided:
        error += conditions.one_sided * rng.random(count, np.float32)
    return lose_returns(
        *(hits.points, hits.face, mesh.vertices, mesh.faces, keep, error, chance),
        *(sensor.dropout, conditions.intensity_dropout, REACH * sensor.range_max),
    )
