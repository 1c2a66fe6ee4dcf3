"""Whole street scenes: people walking among houses, parked cars, trees and street furniture, in full turns of a sensor.

Layout, in the street's own frame: x along the street, y across it, z = 0 the road. A road between two sidewalks one
curb higher; house fronts, hedges or fences behind them; parked cars and street furniture along the curbs. The sensor
stands on the road or a sidewalk; the street's frame is rotated about it at random. Everything depends on (seed, index)
alone. Letters: P people, F frames, n points of a frame.
"""

from dataclasses import dataclass
from math import pi
from operator import index as as_index

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import sensor as named_sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.raycast import scan, scan_pattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import Box, Pose, Sample, center_of
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import Bodies, draw_moving_bodies
from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.place import Place
from lidarpose.synth.scene import RandomStream
from lidarpose.synth.simulate import ScanConditions, add_sensor_noise, label_box, looks

# distance of furniture from the curb, and half the length of the street, m
_RAIL, _LENGTH = 0.45, 45.0
# people start at a distance along the street between the first two minus 1 m, and never come nearer to the sensor than
# the first minus 1 m; the third is the minimum distance between people, m
_NEAREST, _FARTHEST, _APART = 2.5, 28.0, 0.75
_PLACE_TRIES = 200
# activities of people in streets, from `body.pose_prior.activities.KINDS`, and the maximum number of draws for one
_STREET_KINDS = ("walk", "idle", "run", "push", "step")
_KIND_TRIES = 12
# share of weak returns that is lost, and the standard deviation of the range error that a ring's points share, m
_INTENSITY_DROPOUT, _RING_BIAS = 0.6, 0.008
# minimum number of rings for which errors are drawn, so that later draws do not depend on the sensor
_RINGS = 256
# errors of a detector's box in `samples`: center m, size m, yaw rad
_OFF, _GROWN, _TURNED = 0.06, (0.0, 0.2), 0.08
# minimum number of points of a person in `samples`
_LEAST_IN_CROP = 15


@dataclass(frozen=True, kw_only=True)
class StreetFrame:
    """One turn of the sensor. points (n, 3) float32 m; ring (n,); person (n,) int16: index into `boxes`, -1 = none;
    part (n,) uint8 as in `Sample`; boxes: of all P people, visible or not, with track ids as ids; joints (P, 26, 3)
    float32 m, body26; boxes and joints are those of the frame's middle. All in the level frame at the sensor."""

    points: np.ndarray
    ring: np.ndarray
    person: np.ndarray
    part: np.ndarray
    boxes: tuple[Box, ...]
    joints: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Street:
    """A scene over time: frames at 10 Hz, the sensor's name and its height above the road, m."""

    frames: tuple[StreetFrame, ...]
    sensor: str
    height: float


def street(
    seed: int, index: int, *, sensor: str = "os1-128", people: tuple[int, int] = (3, 8), frames: int = 1
) -> Street:
    """Street `index` of `seed` with `people` (minimum, maximum), `frames` turns at 10 Hz. Raises InputError."""
    seed, index = check_int("seed", seed, least=0), check_int("index", index, least=0)
    frames = check_int("frames", frames, least=1)
    try:
        least, most = map(as_index, people)
    except (TypeError, ValueError):
        least, most = 0, 0
    if not 1 <= least <= most:
        raise InputError(f"people must be (least, most), whole numbers with 1 <= least <= most, got {people!r}")
    device = named_sensor(sensor)
    rng = np.random.default_rng([seed, RandomStream.STREET, index])
    plan = _draw_plan(device, rng)
    scenery = union(_scenery(plan, rng)).moved((0, 0, 0), plan.turn)
    walkers = _draw_walkers(plan, int(rng.integers(least, most + 1)), frames, rng)
    ring_normals = rng.standard_normal(max(_RINGS, device.rows if isinstance(device, Sensor) else 0), np.float32)
    turns = tuple(_scan_turn(device, scenery, walkers, frame, ring_normals, rng) for frame in range(frames))
    return Street(frames=turns, sensor=device.name, height=plan.height)


# --- static objects


@dataclass(frozen=True, kw_only=True)
class StreetPlan:
    """Sizes in m, in the street's frame: the sensor stands at (0, sensor_y), the road extends from -road to road, the
    sidewalks from there to +-front, `kerb` high; height: of the sensor above the road; turn: rotation of the street
    about it, rad; ahead: people start on the x > 0 side, where a sensor that does not rotate points."""

    road: float
    front: float
    kerb: float
    sensor_y: float
    height: float
    turn: float
    ahead: bool


def _draw_plan(device: Sensor | RayPattern, rng: np.random.Generator) -> StreetPlan:
    a, b, c, d, e, f, g = rng.random(7)
    road = 2.8 + 1.7 * a
    front = road + 2.2 + 2.3 * b
    kerb = 0.08 + 0.08 * c
    # on the road, like a car, or on a sidewalk, like a robot or a tripod
    on_road = d < 0.6
    sensor_y = (2 * e - 1) * (road - 2.0) if on_road else (road + front) / 2 * (1 if e < 0.5 else -1)
    height = device.height + 0.15 * (2 * g - 1) + (0 if on_road else kerb)
    ahead = isinstance(device, RayPattern) and device.is_narrow
    turn = (2 * f - 1) * (0.3 if ahead else pi)
    return StreetPlan(road=road, front=front, kerb=kerb, sensor_y=sensor_y, height=height, turn=turn, ahead=ahead)


def _scenery(plan: StreetPlan, rng: np.random.Generator) -> list[Mesh]:
    """All static objects, in the street's frame moved so that the sensor is the origin."""
    meshes = [_ground(plan)]
    for side in (-1, 1):
        meshes += _house_fronts(plan, side, rng)
        meshes += _kerb_row(plan, side, rng)
    shift = np.array([0, -plan.sensor_y, -plan.height])
    moved_meshes = [mesh.moved(shift) for mesh in meshes]
    # no object contains the sensor or is close to it
    clear_meshes = [m for m in moved_meshes[1:] if np.hypot(*m.vertices[:, :2].T).min() > 1.2 and not _around(m)]
    return moved_meshes[:1] + clear_meshes


def _around(mesh: Mesh) -> bool:
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return bool((low[:2] < 1.0).all() and (high[:2] > -1.0).all())


def _ground(plan: StreetPlan) -> Mesh:
    """The road, two curb faces, two sidewalks."""
    strips = []
    for y0, z0, y1, z1 in (
        (-plan.road, 0.0, plan.road, 0.0),
        (plan.road, 0.0, plan.road, plan.kerb),
        (-plan.road, plan.kerb, -plan.road, 0.0),
        (plan.road, plan.kerb, plan.front + 12, plan.kerb),
        (-plan.front - 12, plan.kerb, -plan.road, plan.kerb),
    ):
        corners = [[-_LENGTH, y0, z0], [_LENGTH, y0, z0], [_LENGTH, y1, z1], [-_LENGTH, y1, z1]]
        strips.append(Mesh(np.array(corners, np.float32), shapes.QUAD_FACES))
    return shapes.union(strips)


def _house_fronts(plan: StreetPlan, side: int, rng: np.random.Generator) -> list[Mesh]:
    """House fronts with doors and windows, hedges, fences and gaps, one after the other behind a sidewalk."""
    meshes, x = [], -_LENGTH
    while x < _LENGTH:
        a, b, c, d = rng.random(4).tolist()
        length = 4.0 + 6.0 * a
        y = side * (plan.front + 0.2 + (1.5 * b if c > 0.6 else 0.1 * b))
        middle = (x + length / 2, y, plan.kerb)
        if c < 0.6:
            bays = max(1, int(length / 2.5))
            bay_width = length / bays
            for bay in range(bays):
                sill, top = (0.0, 2.1) if (bay + int(10 * d)) % 3 == 0 else (0.9, 2.2)
                opening = (-0.25 * bay_width, 0.25 * bay_width, sill, top)
                front = shapes.wall(bay_width, 3.5 + 3 * d, thick=0.3, opening=opening)
                meshes.append(front.moved((x + (bay + 0.5) * bay_width, y, plan.kerb), pi / 2))
            # the back walls of the rooms
            meshes.append(shapes.box((length, 0.1, 3.5)).moved((middle[0], y + side * (1.5 + 3 * d), plan.kerb)))
        elif c < 0.75:
            for k in range(int(length)):
                bush = shapes.foliage((1.3, 0.9, 0.9 + d), 120, 0.11, rng)
                meshes.append(bush.moved((x + k + 0.5, y, plan.kerb)))
        elif c < 0.9:
            fence = shapes.rail_fence(length, 1.0, 3) if d < 0.4 else shapes.lattice_fence(length, 0.8 + d, 0.14, 0.04)
            meshes.append(fence.moved(middle, pi / 2))
        x += length + (0 if c < 0.6 else 0.5 + d)
    return meshes


def _kerb_row(plan: StreetPlan, side: int, rng: np.random.Generator) -> list[Mesh]:
    """Parked cars at the curb and furniture on the sidewalk beside it."""
    meshes, x = [], -_LENGTH + 4 * rng.random()
    has_parked_cars = rng.random() < 0.8
    while has_parked_cars and x < _LENGTH - 6:
        a, b, c, d = rng.random(4).tolist()
        length = 3.7 + 1.2 * a
        if b < 0.6:
            heading = 0.0 if side < 0 else pi
            car = shape("car", length, 1.8, 1.45 + 0.2 * c) if c < 0.8 else shape("van", length + 1, 2.0, 2.0 + 0.4 * d)
            meshes.append(car.moved((x + length / 2, side * (plan.road - 1.05), 0.0), heading + 0.04 * (d - 0.5)))
        x += length + 1.6 + 1.5 * d
    x = -_LENGTH + 6 * rng.random()
    while x < _LENGTH:
        a, b, c, d = rng.random(4).tolist()
        position, inward_yaw = (x, side * (plan.road + _RAIL), plan.kerb), -side * pi / 2
        if a < 0.25:
            meshes.append(shape("pole", 0.05 + 0.06 * b, 0.05 + 0.06 * b, 5.0).moved(position))
        elif a < 0.5:
            # a tree: trunk and crown
            crown = shapes.foliage((2.2 + b, 2.2 + b, 2.0), 120, 0.28, rng)
            meshes.append(shape("pole", 0.10 + 0.10 * c, 0.10 + 0.10 * c, 2.6).moved(position))
            meshes.append(crown.moved((x, position[1], plan.kerb + 2.2)))
        elif a < 0.62:
            meshes.append(shapes.sign(2.0 + 0.6 * b, 0.5).moved(position, inward_yaw))
        elif a < 0.75:
            meshes.append(shape("wheeled bin", 0.5 + 0.2 * b, 0.5 + 0.2 * b, 1.0 + 0.1 * c).moved(position, 2 * pi * d))
        elif a < 0.82:
            meshes.append(shape("bench", 1.0, 1.6).moved(position, inward_yaw))
        elif a < 0.9:
            meshes.append(shapes.foliage((0.8, 0.8, 0.7 + b), 100, 0.1, rng).moved(position))
        else:
            meshes.append(shape("traffic cone", 0.6, 0.6, 0.6).moved((x, side * (plan.road - 0.3), 0.0)))
        x += 3.0 + 7.0 * d
    return meshes


# --- the people: each one's frames and start

Walker = tuple[Bodies, Place]


def _path(walker: Walker) -> np.ndarray:
    """(F, 2) m: x, y of the pelvis."""
    bodies, place = walker
    return place.of_body(bodies.joints[:, 0])[:, :2]


def _draw_walkers(plan: StreetPlan, count: int, frames: int, rng: np.random.Generator) -> list[Walker]:
    """People on the sidewalks and the road, apart from each other in all frames; fewer than `count` if space is short.

    In the first half of the tries, a person must stay on one surface; in the second half, they may leave it.
    """
    walkers: list[Walker] = []
    paths: list[np.ndarray] = []
    for _ in range(count):
        bodies = _draw_pedestrian(frames, rng)
        for attempt in range(_PLACE_TRIES):
            place, is_on_surface = _draw_start(plan, bodies, rng)
            path = _path((bodies, place))
            if np.linalg.norm(path, axis=1).min() < _NEAREST - 1:
                continue
            distances = [np.linalg.norm(path - other_path, axis=1).min() for other_path in paths]
            if (is_on_surface or 2 * attempt > _PLACE_TRIES) and min(distances, default=np.inf) > _APART:
                walkers.append((bodies, place))
                paths.append(path)
                break
    return walkers


def _draw_pedestrian(frames: int, rng: np.random.Generator) -> Bodies:
    """A person with an activity of `_STREET_KINDS`: sitting, for example, would need a seat."""
    for _ in range(_KIND_TRIES):
        bodies = draw_moving_bodies(None, 0.0, 1, frames, rng)[0]
        if bodies.kinds[0] in _STREET_KINDS:
            break
    return bodies


def _draw_start(plan: StreetPlan, bodies: Bodies, rng: np.random.Generator) -> tuple[Place, bool]:
    """Where a person starts, and whether they stay on one surface and clear of the cars and furniture at the curbs."""
    surface_draw, distance_draw, lateral_share, direction_draw, yaw_draw = rng.random(5)
    turn = rotation_about("z", plan.turn)
    x = (1 if distance_draw < 0.5 or plan.ahead else -1) * (
        _NEAREST - 1 + (_FARTHEST - _NEAREST) * abs(2 * distance_draw - 1) ** 1.5
    )
    if surface_draw < 0.8:
        # along a sidewalk, between the furniture and the fronts
        side = 1 if surface_draw < 0.4 else -1
        low, high = plan.road + _RAIL + 0.5, plan.front - 0.3
        y, z = side * (low + lateral_share * (high - low)), plan.kerb
        yaw = (0.0 if direction_draw < 0.5 else pi) + 0.3 * (yaw_draw - 0.5)
        bounds = sorted((side * low, side * high))
    else:
        # across the road, between the parked cars
        bounds, z = [-(plan.road - 2.2), plan.road - 2.2], 0.0
        y = bounds[0] + lateral_share * (bounds[1] - bounds[0])
        yaw = (pi / 2 if direction_draw < 0.5 else -pi / 2) + 1.2 * (yaw_draw - 0.5)
    start = turn @ np.array([x, y - plan.sensor_y, z - plan.height])
    place = Place(feet=start, yaw=float(yaw + plan.turn), distance=float(np.hypot(*start[:2])))
    path_y = (_path((bodies, place)) @ turn[:2, :2])[:, 1] + plan.sensor_y
    return place, bool(((path_y > bounds[0] - 0.1) & (path_y < bounds[1] + 0.1)).all())


def _label(walker: Walker, frame: int, track: int) -> Box:
    """The box around a person, aligned with their heading."""
    bodies, place = walker
    return label_box(place.of_body(bodies.vertices[frame]), place.yaw + bodies.heading[frame], track)


# --- a turn of the sensor


def _scan_turn(
    device: Sensor | RayPattern,
    scenery: Mesh,
    walkers: list[Walker],
    frame: int,
    ring_normals: np.ndarray,
    rng: np.random.Generator,
) -> StreetFrame:
    people = []
    for bodies, place in walkers:
        pelvis = place.of_body(bodies.joints[frame, :1])[0]
        vertices = [place.of_body(bodies.between(frame, time)[0]) for time in looks(device, pelvis)]
        people.append(Mesh(vertices[0], bodies.faces, bodies.face_part, *vertices[1:]))
    scene = union([*people, scenery])
    R_sensor_level = rotation_about("y", -device.tilt).astype(np.float32)
    mesh = Mesh(scene.vertices @ R_sensor_level.T, scene.faces)
    end_vertices = (scene.vertices if scene.later is None else scene.later) @ R_sensor_level.T
    if isinstance(device, RayPattern):
        hits = scan_pattern(mesh.vertices, mesh.faces, device, frame % device.frames, moved=end_vertices)
    else:
        hits = scan(mesh.vertices, mesh.faces, device, moved=end_vertices)
    conditions = ScanConditions(sigma=device.range_sigma, bias=_RING_BIAS, intensity_dropout=_INTENSITY_DROPOUT)
    points, returned = add_sensor_noise(hits, mesh, device, conditions, rng, ring_normals=ring_normals)
    face, joints = hits.face[returned], [place.of_body(bodies.joints[frame]) for bodies, place in walkers]
    # the people's faces come first, one person after the other
    face_person = np.repeat(np.arange(len(people) + 1), [len(m.faces) for m in (*people, scenery)]).astype(np.int16)
    face_person[face_person == len(people)] = -1
    return StreetFrame(
        points=points @ R_sensor_level,
        ring=hits.ring[returned],
        person=face_person[face],
        part=np.zeros(len(face), np.uint8) if scene.part is None else scene.part[face],
        boxes=tuple(_label(walker, frame, track) for track, walker in enumerate(walkers)),
        joints=np.array(joints, np.float32).reshape(-1, len(BODY26), 3),
    )


# --- people of a street as samples


def samples(scene: Street, rng: np.random.Generator) -> list[tuple[int, Sample]]:
    """(frame, sample) of all people with at least 15 points in the crop; its box has a detector's errors.

    The box's id is the track id; frame_id is "frame/track".
    """
    pairs = []
    for number, frame in enumerate(scene.frames):
        for track, label in enumerate(frame.boxes):
            shift, extra_size, yaw_error = rng.normal(0, _OFF, 3), rng.uniform(*_GROWN, 3), rng.normal(0, _TURNED)
            center = label.center + shift * [1, 1, 0.5]
            box = Box(center=center, size=label.size + extra_size, yaw=label.yaw + yaw_error, id=label.id)
            is_inside = box.contains(frame.points)
            is_person = is_inside & (frame.person == track)
            if np.count_nonzero(is_person) < _LEAST_IN_CROP:
                continue
            points = frame.points[is_inside]
            sample = Sample(
                points=points,
                center=center_of(points),
                # another person in the crop is not this body
                part=np.where(is_person, frame.part, 0)[is_inside].astype(np.uint8),
                ring=frame.ring[is_inside],
                pose=Pose(joints=frame.joints[track], skeleton=BODY26, frame="sensor"),
                box=box,
                source=f"synth/street/{scene.sensor}",
                frame_id=f"{number}/{track}",
            )
            pairs.append((number, sample))
    return pairs
