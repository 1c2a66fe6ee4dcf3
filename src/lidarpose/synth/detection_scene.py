"""Whole scans to find people in: places of all kinds, crowds, and what is taken for people, seen by any sensor.

A scene is laid out as `environment.layouts` draws it, with groups of people and the things of `environment.things` in
its free areas, a fifth of them beside people; then the ground is sloped and waved, all is seen by a sensor that may be
tilted, and points get lost or go astray. What is drawn depends on (seed, index, family) alone. Family "train" never
draws the things and rooms that are left out for judging; "heldout" draws them most often; "bench" draws all alike.

Letters: P people, n points of a scene, M meshes.
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
from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.layouts import LAYOUTS, LEFT_OUT, Item, Layout
from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.things import KINDS, LEAVES, THINGS, draw_thing
from lidarpose.synth.props import Prop, draw_props
from lidarpose.synth.props.attachments import MOUNTS
from lidarpose.synth.scene import Place, RandomStream
from lidarpose.synth.simulate import ScanConditions, add_sensor_noise, label_box

FAMILIES = ("train", "heldout", "bench")
# how often each place is drawn; the left-out ones only where they may be
_PLACES = {"street": 4.0, "square": 2.0, "path": 2.0, "room": 2.0, "car park": 0.8, "corridor": 1.2, "hall": 1.2}
# how much more often left-out things are drawn for judging
_LEFT_OUT_WEIGHT = 3.0
# sensors by name and how often they are drawn outdoors and indoors; "random": rings at random
_SENSORS = {
    "vlp-16": (1.0, 1.0),
    "vlp-32c": (1.0, 0.3),
    "hdl-32e": (0.8, 0.3),
    "hdl-64e": (0.8, 0.0),
    "os1-64": (1.0, 0.6),
    "os1-128": (0.5, 0.4),
    "os0-128": (0.6, 1.0),
    "pandar64": (1.0, 0.2),
    "av2": (1.2, 0.0),
    "waymo-top": (0.5, 0.0),
    "livox-mid360": (1.3, 1.5),
    "livox-avia": (1.0, 0.4),
    "livox-mid100": (0.4, 0.1),
    "depth-camera": (0.3, 1.5),
    "random": (2.5, 1.5),
}
# beams of a scan at most: what has more sends fewer columns
_MOST_BEAMS = 140_000
# people by activity, outdoors and indoors
_MIX_OUTDOORS = {
    **{"idle": 0.31, "walk": 0.34, "captured": 0.07, "run": 0.03, "step": 0.02, "bend": 0.035, "crouch": 0.035},
    **{"kneel": 0.01, "sit": 0.1, "cycle": 0.09, "push": 0.05, "sport": 0.02},
}
_MIX_INDOORS = _MIX_OUTDOORS | {"idle": 0.36, "walk": 0.2, "sit": 0.25, "cycle": 0.004, "run": 0.0}
# who sits, outdoors: what on, and how often
_SEATS = (("moped", 0.3), ("wheelchair", 0.25), ("chair", 0.45))
_MOUNTED = ("bicycle", "moped", "wheelchair")
_PROP_KINDS = {"chair": "chair", "bicycle": "bicycle", "moped": "moped", "pram": "cart", "trolley": "cart"}
# people and things stand within these distances, m, people at least so far apart
_NEAREST, _FARTHEST, _APART = 1.5, 40.0, 0.42
# points of a piece of a place at least
_LEAST_PIECE = 300
# share of the things beside people among those that are added last, a quarter of all
_BESIDE = 0.8
# half of a standing person's width, and what riders and who push something need more, m
_HALF, _MORE = 0.24, 0.4
# height of what of a person is to be seen, m
_CHEST = 1.1


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
    names = [name for name in _PLACES if family != "train" or name not in LEFT_OUT]
    place = str(_pick(rng, {name: _PLACES[name] for name in names}))
    layout = LAYOUTS[place](rng)
    device = _draw_sensor(layout.indoors, rng)
    mount = _draw_mount(device, layout, rng)
    duration = device.duration if isinstance(device, RayPattern) else 0.0
    site = _Site(layout, device, mount)
    weights = _draw_habits(layout.indoors, family, rng)
    count = int((rng.integers(3, 16) if layout.indoors else rng.integers(15, 61)) * layout.things)
    _add_own_vehicle(site, rng)
    _scatter(site, weights, count - count // 4, np.zeros((0, 2)), rng)
    people = _draw_people(site, duration > 0, rng)
    feet = np.array([person.place.feet[:2] for person in people]).reshape(-1, 2)
    _scatter(site, weights, count // 4, feet, rng)
    _add_screens(site, feet, rng)
    relief = _Relief.draw(layout.indoors, rng)
    shift = np.array([0, 0, -mount.height - layout.sensor[2]])
    meshes, owners, kinds = [], [], []
    for number, person in enumerate(people):
        person.place = replace(person.place, feet=person.place.feet + [0, 0, relief.at(person.place.feet)] + shift)
        for name, mesh in person.meshes(duration):
            meshes.append(mesh)
            owners.append(number if name is None else -1)
            kinds.append(-1 if name is None else KINDS.index(name))
    for name, mesh in site.items:
        mesh.vertices[:, 2] += relief.at(mesh.vertices.T)
        meshes.append(Mesh((mesh.vertices + shift).astype(np.float32), mesh.faces, mesh.part))
        owners.append(-1)
        kinds.append(KINDS.index(name))
    turn = rotation_about("z", mount.turn).T
    scene = union(meshes)
    points, face = _scan(device, _turned(scene, turn.astype(np.float32)), mount.R_sensor_level, rng)
    counts = [len(mesh.faces) for mesh in meshes]
    person_of, thing_of = (np.repeat(np.array(values, np.int16), counts)[face] for values in (owners, kinds))
    if scene.part is not None:
        points = _into_leaves(points, scene.part[face] == LEAVES, rng)
    points, stray = _go_astray(points, rng)
    person_of[stray], thing_of[stray] = -1, -1
    kept, is_piece = _cut(points, thing_of, rng)
    frame = _Frame.draw(mount, rng)
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


def _pick(rng: np.random.Generator, weights: dict[str, float]) -> str:
    shares = np.cumsum(list(weights.values()))
    return list(weights)[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]


def _turned(mesh: Mesh, turn: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices @ turn, mesh.faces, mesh.part, None if mesh.later is None else mesh.later @ turn)


# --- the sensor


@dataclass(frozen=True, kw_only=True)
class _Mount:
    """height m above the ground; R_sensor_level (3, 3); turn rad of the layout about the sensor; view: the middle of a
    narrow field of view in the layout, rad, and half its width."""

    height: float
    R_sensor_level: np.ndarray
    turn: float
    view: tuple[float, float]


def _draw_sensor(indoors: bool, rng: np.random.Generator) -> Sensor | RayPattern:
    name = _pick(rng, {name: shares[int(indoors)] for name, shares in _SENSORS.items()})
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


def _draw_mount(device: Sensor | RayPattern, layout: Layout, rng: np.random.Generator) -> _Mount:
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
    return _Mount(
        height=float(height),
        R_sensor_level=rotation_about("x", roll) @ rotation_about("y", -pitch),
        turn=yaw,
        view=(-yaw, half if narrow or pitch < np.radians(12) else 1.2),
    )


# --- where things and people stand


class _Site:
    """A layout about the sensor: its meshes, and where there is room.

    items: kinds and meshes, the sensor's ground at x = y = 0; low: (M, 5), what each takes of the ground, and its top.
    """

    def __init__(self, layout: Layout, device: Sensor | RayPattern, mount: _Mount):
        x, y, _ = layout.sensor
        self.layout, self.mount = layout, mount
        self.elevations = device.elevations[0], device.elevations[-1]
        self.reach = min(_FARTHEST, 0.95 * device.range_max)
        self.areas = np.array(layout.areas) - [x, x, y, y, 0]
        self.items: list[Item] = []
        self.low = np.zeros((0, 5))
        moved = [(name, mesh.moved((-x, -y, 0))) for name, mesh in layout.items]
        rows = np.array([_footprint(mesh) for _, mesh in moved])
        fixed = np.array([name in ("ground", "ceiling", "wall") for name, _ in moved])
        clear = fixed | (_gap(rows, np.zeros(2)) > 0.5)
        self.items = [item for item, keep in zip(moved, clear, strict=True) if keep]
        stands = np.array([name not in ("ground", "ceiling") for name, _ in moved])
        self.low = rows[clear & stands]
        self.low = self.low[np.isfinite(self.low[:, 0])]

    def add(self, name: str, mesh: Mesh) -> None:
        self.items.append((name, mesh))
        row = _footprint(mesh)
        if np.isfinite(row[0]):
            self.low = np.concatenate([self.low, row[None]])

    def level(self, place: np.ndarray) -> float:
        """z of the flat ground at (2,) m."""
        inside = (place[0] >= self.areas[:, 0]) & (place[0] <= self.areas[:, 1])
        inside &= (place[1] >= self.areas[:, 2]) & (place[1] <= self.areas[:, 3])
        return float(self.areas[np.argmax(inside), 4])

    def is_free(self, place: np.ndarray, room: float) -> bool:
        return bool(np.hypot(*place) > max(room, 0.3) and (_gap(self.low, place) > room).all())

    def is_hidden(self, places: np.ndarray) -> np.ndarray:
        """(k,) bool: whether something stands between the sensor and the chest of a person at places (k, 2) m, or the
        chest is above or below all beams."""
        up = np.full((len(places), 1), _CHEST - self.mount.height)
        chest = np.hstack([places, up]) @ rotation_about("z", self.mount.turn).T @ self.mount.R_sensor_level.T
        elevation = np.arctan2(chest[:, 2], np.hypot(*chest[:, :2].T))
        outside = (elevation < self.elevations[0]) | (elevation > self.elevations[1])
        ways = places[:, None, :]
        ways = np.where(np.abs(ways) < 1e-6, 1e-6, ways)
        near, far = self.low[:, :2] / ways, self.low[:, 2:4] / ways
        enter, leave = np.minimum(near, far).max(2), np.maximum(near, far).min(2)
        beam = self.mount.height + (_CHEST - self.mount.height) * enter
        return outside | np.any((enter < leave) & (enter > 0) & (enter < 0.97) & (self.low[:, 4] > beam), axis=1)

    def spot(self, distance: float, room: float, rng: np.random.Generator, *, seen: bool = False) -> np.ndarray:
        """Some free place (2,) m in the areas about so far from the sensor, in view where the view is narrow; where
        a person is `seen` if there is such a place."""
        middle, half = self.mount.view
        u = rng.random((48, 3))
        angle = middle + half * 0.95 * (2 * u[:24, 0] - 1)
        polar = distance * np.stack([np.cos(angle), np.sin(angle)], 1)
        area = self.areas[(u[24:, 0] * len(self.areas)).astype(int)]
        inside = area[:, [0, 2]] + u[24:, 1:] * (area[:, [1, 3]] - area[:, [0, 2]])
        places = np.concatenate([polar, inside])
        far = np.hypot(*places.T)
        cost = np.abs(far - distance) + 50 * (far > self.reach) + 100 * (far < max(room, _NEAREST))
        off = np.abs((np.arctan2(places[:, 1], places[:, 0]) - middle + pi) % (2 * pi) - pi)
        cost += 20 * (off > half)
        in_area = (places[:, None, :] >= self.areas[:, [0, 2]]) & (places[:, None, :] <= self.areas[:, [1, 3]])
        cost += 200 * ~np.any(np.all(in_area, axis=2), axis=1)
        if len(self.low):
            cost += 200 * (_gap(self.low, places) < room).any(1)
            cost += 30 * self.is_hidden(places) if seen else 0
        return places[np.argmin(cost)]

    def beside(self, rng: np.random.Generator, gap: float) -> np.ndarray:
        """A place (2,) m so near to something that stands there."""
        near = self.low[np.hypot(*((self.low[:, :2] + self.low[:, 2:4]) / 2).T) < self.reach]
        if not len(near):
            return self.spot(rng.uniform(_NEAREST, self.reach), _HALF, rng)
        low_x, low_y, high_x, high_y, _ = near[rng.integers(len(near))]
        u = rng.random(2)
        x, y = low_x + u[0] * (high_x - low_x), low_y + u[0] * (high_y - low_y)
        sides = [(low_x - gap, y), (high_x + gap, y), (x, low_y - gap), (x, high_y + gap)]
        return np.array(sides[int(4 * u[1])])


def _footprint(mesh: Mesh) -> np.ndarray:
    """(5,): least x, y, greatest x, y of what is below 1.9 m, inf where nothing is, and the top's z."""
    low = mesh.vertices[mesh.vertices[:, 2] < 1.9, :2]
    if not len(low):
        return np.full(5, np.inf)
    return np.array([*low.min(0), *low.max(0), mesh.vertices[:, 2].max()])


def _gap(low: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distance of places (..., 2) from footprints (M, 5): (..., M) m, 0 within."""
    places = places[..., None, :]
    outside = np.maximum(np.maximum(low[:, :2] - places, places - low[:, 2:4]), 0)
    return np.hypot(outside[..., 0], outside[..., 1])


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


def _draw_people(site: _Site, is_smeared: bool, rng: np.random.Generator) -> list[_Person]:
    """Groups of one to five, some beside what stands there; who finds no room stays away."""
    indoors = site.layout.indoors
    area = float(np.prod(site.areas[:, [1, 3]] - site.areas[:, [0, 2]], axis=1).max())
    groups = rng.integers(4, 11) if not indoors else rng.integers(1, int(np.clip(area / 12, 2, 7)) + 1)
    sizes = rng.choice([1, 2, 3, 4, 5], groups, p=[0.42, 0.27, 0.15, 0.09, 0.07])
    bodies = draw_bodies(
        None, 0.0, int(sizes.sum()), int(rng.integers(2**31)), 0, moving=is_smeared,
        mix=_MIX_INDOORS if indoors else _MIX_OUTDOORS,
    )  # fmt: skip
    people: list[_Person] = []
    row = 0
    for size in sizes:
        distance = 2 + (site.reach - 2) * rng.random() ** 1.7
        beside = rng.random() < 0.25
        middle = (
            site.beside(rng, _HALF + 0.4 * rng.random())
            if beside
            else site.spot(distance, _HALF, rng, seen=rng.random() < 0.85)
        )
        style, course = rng.random(), rng.choice([0.0, pi / 2, pi, -pi / 2]) + rng.normal(0, 0.25)
        members: list[np.ndarray] = []
        for _ in range(size):
            kind = bodies.kinds[row]
            more = _MORE if kind in ("cycle", "push") else 0.0
            for _attempt in range(8):
                place = middle
                if members:
                    angle, far = rng.uniform(-pi, pi), _APART + more + 0.9 * rng.random() ** 1.5
                    near = members[rng.integers(len(members))]
                    place = near + far * np.array([np.cos(angle), np.sin(angle)])
                apart = [np.hypot(*(person.place.feet[:2] - place)) for person in people]
                room = 0.9 * _HALF + 0.5 * more
                if min(apart, default=9) >= _APART + more and site.is_free(place, room) and np.hypot(*place) > 1.0:
                    to_middle = float(np.arctan2(*(middle - place)[::-1]))
                    yaw = course if style < 0.4 else to_middle if style < 0.7 and members else rng.uniform(-pi, pi)
                    feet = np.array([*place, site.level(place)])
                    spot = Place(feet=feet, yaw=float(yaw), distance=float(np.hypot(*place)))
                    props = _draw_belongings(bodies, row, indoors, rng)
                    people.append(_Person(bodies=bodies, row=row, place=spot, props=props))
                    members.append(place)
                    break
            row += 1
    return people


def _draw_belongings(bodies: Bodies, row: int, indoors: bool, rng: np.random.Generator) -> list[Prop]:
    """What somebody carries, pushes, sits on or rides."""
    kind, joints = bodies.kinds[row], bodies.joints[row]
    if kind == "sit" and not indoors or kind == "sit" and rng.random() < 0.15:
        mount = MOUNTS[_pick(rng, dict(_SEATS))](joints.tolist(), rng.random(12).tolist())
        if mount is not None:
            return [mount]
    return draw_props(rng, kind=kind, joints=joints)


def _draw_habits(indoors: bool, family: str, rng: np.random.Generator) -> dict[str, float]:
    """How often things stand in a scene: each scene has habits of its own."""
    weights = {}
    for name, row in THINGS.items():
        weights[name] = (row.indoors if indoors else row.outdoors) * (family != "train" or not row.left_out)
        if row.left_out and family == "heldout":
            weights[name] *= _LEFT_OUT_WEIGHT
    return {name: weight * rng.gamma(0.7) for name, weight in weights.items()}


def _scatter(site: _Site, weights: dict[str, float], count: int, feet: np.ndarray, rng: np.random.Generator) -> None:
    """Adds `count` things that are taken for people; where there are people at feet (k, 2) m most stand beside them."""
    ceiling = site.layout.ceiling
    for _ in range(count):
        name = _pick(rng, weights)
        mesh = draw_thing(name, rng)
        mesh = mesh.moved((0, 0, 0), rng.choice([0.0, pi / 2, pi, -pi / 2]) + rng.normal(0, 0.15))
        if mesh.vertices[:, 2].max() > ceiling:
            mesh = mesh.scaled((1, 1, 0.97 * min(ceiling, 3.0) / mesh.vertices[:, 2].max()))
        low = _footprint(mesh)
        for _attempt in range(3):
            if len(feet) and name != "mannequin" and rng.random() < _BESIDE:
                angle, near = rng.uniform(-pi, pi), feet[rng.integers(len(feet))]
                across = np.array([np.cos(angle), np.sin(angle)])
                place = near + across * (_HALF + 0.05 + 0.45 * rng.random()) - np.where(across > 0, low[:2], low[2:4])
                place = np.where(np.abs(across) < 0.3, near, place)
            elif name in ("fragment", "mannequin") and not site.layout.indoors:
                place = site.spot(rng.uniform(18, 40), 0.3, rng, seen=True)
            else:
                place = site.spot(_NEAREST + (site.reach - _NEAREST) * rng.random() ** 1.2, 0.3, rng)
            row = low + [*place, *place, 0]
            if _gap(row[None], np.zeros(2)).min() > 0.6 and (not len(feet) or _gap(row[None], feet).min() > 0.2):
                site.add(name, mesh.moved((*place, site.level(place))))
                break


def _add_screens(site: _Site, feet: np.ndarray, rng: np.random.Generator) -> None:
    """Plates and leaves close before the sensor, in a quarter of the scenes; none in people at feet (k, 2) m."""
    for _ in range(rng.integers(1, 7) if rng.random() < 0.25 else 0):
        far, angle, u = rng.uniform(0.6, 3.0), rng.uniform(-pi, pi), rng.random(3).tolist()
        wide, low = (0.03 + 0.5 * u[0] ** 2) * far, max(0.0, site.mount.height - u[1] * far)
        screen = shapes.box((0.03, wide, min(0.1 + 1.2 * u[2], site.layout.ceiling - low)))
        if rng.random() < 0.3:
            screen = shapes.foliage((wide, wide, 0.2 + 1.0 * u[2]), 80, 0.08, rng)
        place = np.array([far * np.cos(angle), far * np.sin(angle)])
        if not len(feet) or np.hypot(*(feet - place).T).min() > 0.3 + wide / 2:
            site.add("screen", screen.moved((*place, low + site.level(place)), angle))


def _add_own_vehicle(site: _Site, rng: np.random.Generator) -> None:
    """What carries the sensor, where the sensor sees it."""
    if rng.random() < 0.4:
        own = _own_vehicle(site.mount.height, site.layout.by_car, rng)
        site.items.append(("own vehicle", own.moved((0, 0, site.layout.sensor[2]))))
        # nobody stands in it, and it hides nothing that is higher than it
        site.low = np.concatenate([site.low, [[*_footprint(own)[:4], 0]]])


def _own_vehicle(height: float, by_car: bool, rng: np.random.Generator) -> Mesh:
    """A car below its roof sensor, a robot's deck, or the mast or tripod that carries the sensor."""
    u = rng.random(4)
    if by_car and height > 1.4:
        roof = height - 0.1 - 0.25 * u[0]
        return shape("car" if roof < 1.8 else "van", 4.4 + u[1], 1.85, roof).moved((0.8 * (u[2] - 0.5), 0, 0))
    if height < 1.4:
        deck = shapes.box((0.3 + 0.5 * u[0], 0.3 + 0.3 * u[1], 0.8 * height))
        return deck.moved((-0.2 * u[2], 0, 0), 2 * pi * u[3])
    legs = [
        shape("tube", 0.02, 0.02, 0.9 * height).placed(
            [[1, 0, 0], [0, 1, 0], [np.cos(a) * 0.02, np.sin(a) * 0.02, 1]], (0.15 * np.cos(a), 0.15 * np.sin(a), 0)
        )
        for a in (0, 2.1, 4.2)
    ]
    return union(legs)


@dataclass(frozen=True)
class _Relief:
    """Slope (2,) and long waves of the ground: rows of wave vector (2,) rad/m, phase, amplitude m."""

    slope: np.ndarray
    waves: np.ndarray

    @classmethod
    def draw(cls, indoors: bool, rng: np.random.Generator) -> "_Relief":
        if indoors:
            return cls(np.zeros(2), np.zeros((0, 4)))
        slope = rng.normal(0, 0.035 if rng.random() < 0.6 else 0.0, 2).clip(-0.12, 0.12)
        waves = []
        for _ in range(rng.integers(1, 4) if rng.random() < 0.45 else 0):
            long, angle, phase = rng.uniform(14, 70), rng.uniform(-pi, pi), rng.uniform(-pi, pi)
            k = 2 * pi / long
            waves.append([k * np.cos(angle), k * np.sin(angle), phase, rng.uniform(0, 0.08) / k])
        return cls(slope, np.array(waves).reshape(-1, 4))

    def at(self, places: np.ndarray) -> np.ndarray:
        """Height m of the ground at places (2 or 3, ...) m, 0 below the sensor."""
        x, y = places[0], places[1]
        z = self.slope[0] * x + self.slope[1] * y
        for a, b, phase, high in self.waves:
            z = z + high * (np.sin(a * x + b * y + phase) - np.sin(phase))
        return z


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
    def draw(cls, mount: _Mount, rng: np.random.Generator) -> "_Frame":
        """Level within a degree or two; now and then as tilted as the sensor, or as a floor that was taken for level.
        The sensor is its origin, or it stands above a vehicle's."""
        angle, degrees = rng.uniform(-pi, pi), abs(rng.normal(0, 1.2))
        if rng.random() < 0.1:
            degrees = rng.uniform(3, 15)
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
