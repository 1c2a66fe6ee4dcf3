"""Whole scans to find people in: places of all kinds, crowds, and what is taken for people, seen by any sensor.

A scene is laid out as `environment.layouts` draws it, with groups of people and the things of `environment.things` in
its free areas, a fifth of them beside people; then the ground is sloped and waved, all is seen by a sensor that may be
tilted, and points get lost or go astray. What is drawn depends on (seed, index, family) alone. Family "train" never
draws the things and rooms that are left out for judging; "heldout" draws them most often; "bench" draws all alike.

Letters: P people, n points of a scene.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import cache
from math import pi

import numpy as np

from lidarpose.errors import check_int, check_name
from lidarpose.geometry import axis_angle_to_matrix, rotation_about
from lidarpose.lidar.presets import sensor as named_sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.raycast import Hits, scan, scan_pattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import FRAME_TIME, Bodies, draw_bodies
from lidarpose.synth.environment.layouts import LAYOUTS, Layout
from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.site import (
    HALF_WIDTH,
    Mount,
    Relief,
    Site,
    add_own_vehicle,
    add_screens,
    draw_habits,
    pick,
    scatter,
)  # fmt: skip
from lidarpose.synth.environment.things import KINDS, LEAVES
from lidarpose.synth.environment.traffic import add_surroundings
from lidarpose.synth.place import Place
from lidarpose.synth.props import Prop, draw_props
from lidarpose.synth.props.attachments import MOUNTS, PELVIS, rigid_prop, upright
from lidarpose.synth.scene import RandomStream
from lidarpose.synth.simulate import ScanConditions, add_sensor_noise, label_box

FAMILIES = ("train", "heldout", "bench")
# how often each place is drawn; the left-out ones only where they may be
_PLACES = {"street": 4.0, "square": 2.0, "path": 2.0, "room": 2.0, "car park": 0.8, "corridor": 1.2, "hall": 1.2}
_TRAINING_PLACES = {"street": 4.0, "square": 2.0, "path": 2.0, "room": 2.4, "small room": 1.8, "car park": 0.8}
# sensors by name and how often they are drawn outdoors and indoors; "random": rings at random
_SENSORS = {
    "vlp-16": (1.0, 1.0), "vlp-32c": (1.0, 0.3), "hdl-32e": (0.8, 0.3), "hdl-64e": (0.8, 0.0), "os1-64": (1.0, 0.6),
    "os1-128": (0.5, 0.4), "os0-128": (0.6, 1.0), "pandar64": (1.0, 0.2), "av2": (1.2, 0.0), "waymo-top": (0.5, 0.0),
    "livox-mid360": (1.3, 1.5), "livox-avia": (1.0, 0.4), "livox-mid100": (0.4, 0.1), "depth-camera": (0.3, 1.5),
    "random": (2.5, 1.5),
}  # fmt: skip
# the same in training, where it differs
_TRAINING_SENSORS = {"depth-camera": (0.3, 1.8)}
# beams of a scan at most: what has more sends fewer columns
_MOST_BEAMS = 140_000
# people by activity, outdoors and indoors
_MIX_OUTDOORS = {"idle": 0.31, "walk": 0.34, "captured": 0.07, "run": 0.03, "step": 0.02, "bend": 0.035}
_MIX_OUTDOORS |= {"crouch": 0.035, "kneel": 0.01, "sit": 0.1, "cycle": 0.09, "push": 0.05, "sport": 0.02}
_MIX_INDOORS = _MIX_OUTDOORS | {"idle": 0.36, "walk": 0.2, "sit": 0.25, "cycle": 0.004, "run": 0.0}
# in training more of those who do not stand; who sits outdoors and indoors
_TRAINING_MIX, _TRAINING_SITS = {"bend": 0.07, "crouch": 0.1, "kneel": 0.08}, (0.16, 0.3)
# who sits, outdoors: what on, and how often
_SEATS = (("moped", 0.3), ("wheelchair", 0.25), ("chair", 0.45))
_MOUNTED = ("bicycle", "moped", "wheelchair")
_PROP_KINDS = {name: name for name in ("chair", "table", "bicycle", "moped")} | {"pram": "cart", "trolley": "cart"}
# in training: how many of those who sit do so at a table, who needs half as much more, what stands among people besides
_AT_TABLES = 0.3
_LOW = ("bend", "crouch", "kneel", "sit")
_AMONG_PEOPLE = {"pole": 2.0, "sign": 1.0, "bollard": 0.5, "moped": 0.5, "bicycle": 0.5, "wall end": 0.5, "bush": 0.5}
# people stand at least so far apart, and who rides or pushes something needs more, m
_APART, _MORE = 0.42, 0.4
# points of a piece of a place at least
_LEAST_PIECE = 300


@dataclass(frozen=True, kw_only=True)
class DetectionScene:
    """A scan and who is in it, in one frame, z about up, meters.

    Args:
        points: (n, 3) float32.
        origin: (3,), the sensor.
        boxes: of all P people, seen or not: tight around the body, 0.1 added; ids 0 to P - 1.
        person: (n,) int16, index into `boxes`, -1: none.
        joints: (P, 26, 3) float32, body26.
        mounted: (P,) bool: rides or sits in a wheelchair.
        sensor: name.
        kind: of the place; "fragment": a piece of one.
        negatives: kinds of `things.KINDS` that the scene holds.
        thing: (n,) int16, index into `things.KINDS`, -1: a person or no thing at all.
        up: (3,), what is truly up; its z is 1 where the frame is level.
        height: of the sensor above the ground beneath it.
        activities: (P,) names of `body.pose_prior.activities.KINDS`.
    """

    points: np.ndarray
    origin: np.ndarray
    boxes: tuple[Box, ...]
    person: np.ndarray
    joints: np.ndarray
    mounted: np.ndarray
    sensor: str
    kind: str
    negatives: list[str]
    thing: np.ndarray
    up: np.ndarray
    height: float
    activities: tuple[str, ...]

    @property
    def things(self) -> tuple[str, ...]:
        """Names of all kinds, which `thing` counts."""
        return KINDS

    def points_digest(self) -> str:
        """sha256 of the points in whole millimeters, as hexadecimal digits."""
        return hashlib.sha256(np.round(self.points.astype(float) * 1000).astype("<i8").tobytes()).hexdigest()


def detection_scene(seed: int, index: int, *, family: str = "train") -> DetectionScene:
    """Scene `index` of `seed`. family: "train", "heldout" or "bench". Raises InputError."""
    seed, index = check_int("seed", seed, least=0), check_int("index", index, least=0)
    check_name("family of scenes", family, FAMILIES)
    rng = np.random.default_rng([seed, RandomStream.DETECTION, FAMILIES.index(family), index])
    is_training = family == "train"
    place = pick(rng, _TRAINING_PLACES if is_training else _PLACES)
    layout = LAYOUTS[place](rng)
    device = _draw_sensor(layout.indoors, _SENSORS | (_TRAINING_SENSORS if is_training else {}), rng)
    mount = _draw_mount(device, layout, rng)
    duration = device.duration if isinstance(device, RayPattern) else 0.0
    site = Site(layout, device, mount)
    weights = draw_habits(layout.indoors, family, rng)
    count = int((rng.integers(3, 16) if layout.indoors else rng.integers(15, 61)) * layout.things)
    add_own_vehicle(site, rng)
    if is_training and not layout.indoors:
        add_surroundings(site, place, rng)
    scatter(site, weights, count - count // 4, np.zeros((0, 2)), rng)
    people = _draw_people(site, duration > 0, is_training, rng)
    feet = np.array([person.place.feet[:2] for person in people]).reshape(-1, 2)
    scatter(site, weights, count // 4, feet, rng)
    if is_training and len(feet):
        scatter(site, _AMONG_PEOPLE, int(rng.integers(0, 5)), feet, rng)
    add_screens(site, feet, rng)
    _lift(site, people, Relief.draw(layout.indoors, rng), mount.height + layout.sensor[2])
    meshes = [(number, *item) for number, person in enumerate(people) for item in person.meshes(duration)]
    meshes += [(-1, *item) for item in site.items]
    # a person's body and clothes are no thing, things are nobody
    owners = [number if name is None else -1 for number, name, _ in meshes]
    kinds = [-1 if name is None else KINDS.index(name) for _, name, _ in meshes]
    counts = [len(mesh.faces) for _, _, mesh in meshes]
    turn = rotation_about("z", mount.turn).T
    scene = union([mesh for _, _, mesh in meshes])
    points, face = _scan(device, _turned(scene, turn.astype(np.float32)), mount.R_sensor_level, rng)
    person_of, thing_of = (np.repeat(np.array(values, np.int16), counts)[face] for values in (owners, kinds))
    if scene.part is not None:
        points = _into_leaves(points, scene.part[face] == LEAVES, rng)
    points, stray = _go_astray(points, rng)
    person_of[stray], thing_of[stray] = -1, -1
    kept, is_piece = _cut(points, thing_of, rng)
    frame = _Frame.draw(mount, rng, most=30.0 if is_training else 15.0)
    labels = [[frame.of(places @ turn) for places in person.label(duration)] for person in people]
    return DetectionScene(
        points=frame.of(points[kept]).astype(np.float32),
        origin=frame.origin,
        boxes=tuple(
            label_box(vertices, frame.yaw(person.place.yaw + mount.turn), number)
            for number, (person, (vertices, _)) in enumerate(zip(people, labels, strict=True))
        ),
        person=person_of[kept],
        joints=np.array([joints for _, joints in labels], np.float32).reshape(-1, len(BODY26), 3),
        mounted=np.array([person.mounted for person in people], bool),
        sensor=device.name,
        kind="fragment" if is_piece else place,
        negatives=sorted({KINDS[kind] for kind in kinds if kind >= 0}),
        thing=thing_of[kept],
        up=frame.R[:, 2].copy(),
        height=mount.height,
        activities=tuple(person.bodies.kinds[person.row] for person in people),
    )


def _lift(site: Site, people: list["_Person"], relief: Relief, height: float) -> None:
    """Sets all on the ground's slope and waves, the sensor to z = 0, so high above its flat ground."""
    down = np.array([0, 0, -height])
    for person in people:
        person.place = replace(person.place, feet=person.place.feet + [0, 0, relief.at(person.place.feet)] + down)
    for row, (name, mesh) in enumerate(site.items):
        vertices = mesh.vertices.copy()
        vertices[:, 2] += relief.at(vertices.T)
        site.items[row] = name, Mesh((vertices + down).astype(np.float32), mesh.faces, mesh.part)


def _turned(mesh: Mesh, turn: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices @ turn, mesh.faces, mesh.part, None if mesh.later is None else mesh.later @ turn)


# --- the sensor


def _draw_sensor(
    indoors: bool, weights: dict[str, tuple[float, float]], rng: np.random.Generator
) -> Sensor | RayPattern:
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
    """A rosette that collects `frames` of its frames into one."""
    single = named_sensor(name)
    assert isinstance(single, RayPattern)

    def rays(number: int) -> tuple[np.ndarray, ...]:
        parts = [single.rays(number * frames + k) for k in range(frames)]
        azimuth, elevation, time, line = (np.concatenate(values) for values in zip(*parts, strict=True))
        late = np.repeat(np.arange(frames), [len(part[0]) for part in parts])
        return azimuth, elevation, (time + late) / frames, line

    return replace(single, rays=rays, frames=4, duration=single.duration * frames)  # type: ignore[arg-type]


def _draw_mount(device: Sensor | RayPattern, layout: Layout, rng: np.random.Generator) -> Mount:
    """On a robot, a tripod, a car, a mast or under a ceiling; what is high looks down."""
    where, up, turn = rng.random(3)
    if layout.indoors:
        height = 0.3 + 1.5 * up if where < 0.7 else layout.ceiling - 0.15 - 0.8 * up
        height = min(height, layout.ceiling - 0.15, 5.0)
    elif layout.by_car and where < 0.7:
        height = 1.5 + 0.9 * up
    else:
        height = 0.3 + 1.9 * up if where < 0.85 else 2.2 + 3.8 * up
    pitch, roll = np.radians(rng.normal(0, 1.2, 2))
    if height > 2.2 and not (layout.by_car and where < 0.7):
        pitch += np.radians(rng.uniform(2, 30))
    elif rng.random() < 0.15:
        pitch, roll = np.radians(rng.uniform(4, 30)) * np.array([np.cos(2 * pi * turn), np.sin(2 * pi * turn)])
    if device.name == "livox-mid360" and (height > 2.0 or rng.random() < 0.2):
        # it sees little below itself: hung upside down
        roll += pi
    narrow = isinstance(device, RayPattern) and device.azimuths[1] - device.azimuths[0] < 2 * pi - 1e-3
    half = (device.azimuths[1] - device.azimuths[0]) / 2 if isinstance(device, RayPattern) else pi
    yaw = rng.uniform(-pi, pi)
    if narrow:
        yaw = -float(rng.choice(layout.ahead)) + rng.uniform(-0.5, 0.5)
    return Mount(
        height=float(height),
        R_sensor_level=rotation_about("x", roll) @ rotation_about("y", -pitch),
        turn=yaw,
        view=(-yaw, half if narrow or pitch < np.radians(12) else 1.2),
    )


@dataclass(kw_only=True)
class _Person:
    """Row `row` of `bodies` at a place, with props; mounted: on what rolls."""

    bodies: Bodies
    row: int
    place: Place
    props: list[Prop]

    @property
    def mounted(self) -> bool:
        return any(prop.name in _MOUNTED for prop in self.props)

    def _lifted(self) -> Place:
        lift = max((prop.lift for prop in self.props), default=0.0)
        return replace(self.place, feet=self.place.feet + [0, 0, lift])

    def _poses(self, duration: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Vertices, joints and what to add to them, m, when a frame of `duration` s begins and, if it lasts, ends."""
        poses = [(self.bodies.vertices[self.row], self.bodies.joints[self.row], np.zeros(3, np.float32))]
        if duration:
            vertices, joints = self.bodies.moved(self.row)
            # strides do not go on for longer than the bodies' time: only the way does
            way = (joints[0] - poses[0][1][0]) * [1, 1, 0] * (duration / FRAME_TIME - 1)
            poses.append((vertices, joints, way.astype(np.float32)))
        return poses

    def label(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (k V, 3) m of the body at all times of a frame, and joints (26, 3) m in the middle of it."""
        place, poses = self._lifted(), self._poses(duration)
        vertices = np.concatenate([place.of_body(vertices + way) for vertices, _, way in poses])
        return vertices, np.mean([place.of_body(joints + way) for _, joints, way in poses], axis=0)

    def meshes(self, duration: float) -> list[tuple[str | None, Mesh]]:
        """Kinds, None for the body and clothes, and meshes; with where they are when the frame ends."""
        place, poses = self._lifted(), self._poses(duration)
        body = [place.of_body(vertices + way) for vertices, _, way in poses]
        meshes: list[tuple[str | None, Mesh]] = [(None, Mesh(body[0], self.bodies.faces, None, *body[1:]))]
        for prop in self.props:
            name = None if prop.face_part is not None else _PROP_KINDS.get(prop.name, "belongings")
            moved = [place.of_body((prop.place(joints).vertices + way).astype(np.float32)) for _, joints, way in poses]
            meshes.append((name, Mesh(moved[0], prop.mesh.faces, None, *moved[1:])))
        return meshes


def _draw_people(site: Site, is_smeared: bool, is_training: bool, rng: np.random.Generator) -> list[_Person]:
    """Groups of one to five, some beside what stands there; who finds no room stays away."""
    indoors = site.layout.indoors
    area = float(np.prod(site.areas[:, [1, 3]] - site.areas[:, [0, 2]], axis=1).max())
    groups = rng.integers(4, 11) if not indoors else rng.integers(1 + is_training, int(np.clip(area / 12, 2, 7)) + 1)
    sizes = rng.choice([1, 2, 3, 4, 5], groups, p=[0.42, 0.27, 0.15, 0.09, 0.07])
    mix = _MIX_INDOORS if indoors else _MIX_OUTDOORS
    if is_training:
        mix = mix | _TRAINING_MIX | {"sit": _TRAINING_SITS[indoors]}
    bodies = draw_bodies(None, 0.0, int(sizes.sum()), int(rng.integers(2**31)), 0, moving=is_smeared, mix=mix)
    people: list[_Person] = []
    row = 0
    for size in sizes:
        distance = 2 + (site.reach - 2) * rng.random() ** 1.7
        if rng.random() < 0.25:
            middle = site.beside(rng, HALF_WIDTH + 0.4 * rng.random())
        else:
            middle = site.spot(distance, HALF_WIDTH, rng, seen=rng.random() < 0.85)
        style, course = rng.random(), rng.choice([0.0, pi / 2, pi, -pi / 2]) + rng.normal(0, 0.25)
        members: list[np.ndarray] = []
        for _ in range(size):
            kind = bodies.kinds[row]
            more = _MORE if kind in ("cycle", "push") else _MORE / 2 if is_training and kind in _LOW else 0.0
            for _attempt in range(8):
                place = middle
                if members:
                    angle, far = rng.uniform(-pi, pi), _APART + more + 0.9 * rng.random() ** 1.5
                    near = members[rng.integers(len(members))]
                    place = near + far * np.array([np.cos(angle), np.sin(angle)])
                apart = [np.hypot(*(person.place.feet[:2] - place)) for person in people]
                room = 0.9 * HALF_WIDTH + 0.5 * more
                if min(apart, default=9) >= _APART + more and site.is_free(place, room) and np.hypot(*place) > 1.0:
                    to_middle = float(np.arctan2(*(middle - place)[::-1]))
                    yaw = course if style < 0.4 else to_middle if style < 0.7 and members else rng.uniform(-pi, pi)
                    feet = np.array([*place, site.level(place)])
                    spot = Place(feet=feet, yaw=float(yaw), distance=float(np.hypot(*place)))
                    props = _draw_belongings(bodies, row, indoors, rng)
                    if is_training and kind == "sit" and rng.random() < _AT_TABLES:
                        props.append(_draw_table(rng))
                    people.append(_Person(bodies=bodies, row=row, place=spot, props=props))
                    members.append(place)
                    break
            row += 1
    return people


def _draw_belongings(bodies: Bodies, row: int, indoors: bool, rng: np.random.Generator) -> list[Prop]:
    """What somebody carries, pushes, sits on or rides."""
    kind, joints = bodies.kinds[row], bodies.joints[row]
    if kind == "sit" and not indoors or kind == "sit" and rng.random() < 0.15:
        mount = MOUNTS[pick(rng, dict(_SEATS))](joints.tolist(), rng.random(12).tolist())
        if mount is not None:
            return [mount]
    return draw_props(rng, kind=kind, joints=joints)


def _draw_table(rng: np.random.Generator) -> Prop:
    """Before somebody who sits: it hides the legs or the lap."""
    deep, far = rng.uniform(0.4, 0.9), rng.uniform(0.25, 0.5)
    mesh = shape("table", deep, rng.uniform(0.6, 1.8), rng.uniform(0.65, 0.78))

    def frame(points: list) -> tuple[list, list]:
        rows, pelvis = upright(points), points[PELVIS]
        return rows, [pelvis[axis] + (far + deep / 2) * rows[0][axis] for axis in (0, 1)] + [0.0]

    return rigid_prop("table", mesh, frame)


# --- the scan


def _scan(
    device: Sensor | RayPattern, mesh: Mesh, R_sensor_level: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) m in the level frame about the sensor and their faces."""
    R = R_sensor_level.astype(np.float32)
    vertices = mesh.vertices @ R.T
    hits: Hits
    if isinstance(device, RayPattern):
        moved = None if mesh.later is None else mesh.later @ R.T
        hits = scan_pattern(vertices, mesh.faces, device, int(rng.integers(device.frames)), moved=moved)
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
        left = hits.ring[returned] >= rng.uniform(0.05, 0.5) * device.rows
        points, face = points[left], face[left]
    return points @ R, face


def _into_leaves(points: np.ndarray, leaves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) m, those on leaves (n,) a little behind the few large ones of a mesh."""
    rows = np.flatnonzero(leaves)
    deep = rng.uniform(0.02, 0.2) * rng.standard_exponential(len(rows))
    moved = points.copy()
    moved[rows] *= (1 + deep / np.maximum(np.linalg.norm(points[rows], axis=1), 0.3))[:, None].astype(np.float32)
    return moved


def _go_astray(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Some returns come from between: mixed pixels, dust, rain. Points and the indices (k,) of strays."""
    share = rng.choice([0.0, 0.0005, 0.004], p=[0.4, 0.4, 0.2])
    stray = np.flatnonzero(rng.random(len(points)) < share)
    moved = points.copy()
    moved[stray] *= rng.uniform(0.1, 1.0, (len(stray), 1)).astype(np.float32)
    return moved, stray


def _cut(points: np.ndarray, thing: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, bool]:
    """(n,) bool: points that a user's file holds: all, without what is near the sensor, without the ground, or a piece
    of the place; and whether it is a piece."""
    kept, draw = np.ones(len(points), bool), rng.random(3)
    if draw[0] < 0.1:
        kept &= np.hypot(points[:, 0], points[:, 1]) > rng.uniform(1, 3)
    if draw[1] < 0.03:
        kept &= (thing != KINDS.index("ground")) | (rng.random(len(points)) < 0.02)
    if draw[2] < 0.1:
        size, turn = rng.uniform(6, 20, 2), rng.uniform(-pi, pi)
        middle = rng.uniform(3, 14) * np.array([np.cos(turn), np.sin(turn)])
        inside = (np.abs(points[:, :2] - middle) < size / 2).all(1)
        if inside.sum() > _LEAST_PIECE:
            return kept & inside, True
    return kept, False


@dataclass(frozen=True)
class _Frame:
    """The frame in which a scene is given: R (3, 3) from the level one, and where the sensor is in it, (3,) m."""

    R: np.ndarray
    origin: np.ndarray

    @classmethod
    def draw(cls, mount: Mount, rng: np.random.Generator, *, most: float) -> "_Frame":
        """Level within a degree or two, in a tenth tilted by 3 to `most` degrees. The sensor is its origin, or stands
        above a vehicle's."""
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
