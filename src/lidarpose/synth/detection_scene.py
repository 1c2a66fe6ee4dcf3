"""Whole scans for detecting people: all kinds of places, crowds, and objects that resemble people, with any sensor.

A scene has a layout of `environment.layouts`, with groups of people and the things of `environment.things` in its free
areas, a fifth of the things beside people. The ground gets a slope and waves, the sensor may be tilted, and points are
lost or stray. A scene depends on (seed, index, family) alone. Family "train" never draws the things and rooms that are
held out for evaluation; "heldout" draws the held-out things most often; "bench" draws all with the same weights.

Letters: P people, n points of a scene.
"""

import hashlib
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import check_int, check_name
from lidarpose.geometry import rotation_about
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26
from lidarpose.synth.detection_people import PlacedPerson, draw_people
from lidarpose.synth.detection_scan import (
    SceneFrame,
    add_strays,
    cut_scan,
    draw_mount,
    draw_sensor,
    scan_scene,
    scatter_leaves,
)
from lidarpose.synth.environment.layouts import LAYOUTS
from lidarpose.synth.environment.mesh import Mesh, union
from lidarpose.synth.environment.plants import LEAVES
from lidarpose.synth.environment.site import (
    Relief,
    Site,
    add_own_vehicle,
    add_screens,
    draw_habits,
    pick,
    scatter,
)  # fmt: skip
from lidarpose.synth.environment.things import KINDS
from lidarpose.synth.environment.traffic import add_surroundings, with_windows
from lidarpose.synth.scene import RandomStream
from lidarpose.synth.simulate import label_box

FAMILIES = ("train", "heldout", "bench")
# weight of each place; held-out places only outside training
_PLACES = {"street": 4.0, "square": 2.0, "path": 2.0, "room": 2.0, "car park": 0.8, "corridor": 1.2, "hall": 1.2}
_TRAINING_PLACES = {"street": 4.0, "square": 2.0, "path": 2.0, "room": 2.4, "small room": 1.8, "car park": 0.8}
# in training, additional things among people, with their weights
_AMONG_PEOPLE = {"pole": 2.0, "sign": 1.0, "bollard": 0.5, "moped": 0.5, "bicycle": 0.5, "wall end": 0.5, "bush": 0.5}


@dataclass(frozen=True, kw_only=True)
class DetectionScene:
    """A scan and the people in it, in one frame, z approximately up, meters.

    Args:
        points: (n, 3) float32.
        origin: (3,), position of the sensor.
        boxes: of all P people, visible or not: tight around the body, 0.1 added; ids 0 to P - 1.
        person: (n,) int16, index into `boxes`, -1: no person.
        joints: (P, 26, 3) float32, body26.
        mounted: (P,) bool: whether a person rides or sits in a wheelchair.
        sensor: name.
        kind: of the place; "fragment": a piece of a place.
        negatives: kinds of `things.KINDS` in the scene.
        thing: (n,) int16, index into `things.KINDS`, -1: a person or a stray point.
        up: (3,), the true up direction; its z is 1 if the frame is level.
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
        """Names of all kinds; `thing` holds indices into them."""
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
    if not is_training:
        # the heldout and bench scenes are frozen: everything not in the middle of the road stands at sidewalk height
        layout = replace(layout, road=None)
    device = draw_sensor(layout.indoors, is_training, rng)
    mount = draw_mount(device, layout, rng)
    duration = device.duration if isinstance(device, RayPattern) else 0.0
    site = Site(layout, device, mount)
    weights = draw_habits(layout.indoors, family, rng)
    count = int((rng.integers(3, 16) if layout.indoors else rng.integers(15, 61)) * layout.things)
    add_own_vehicle(site, rng)
    if is_training and not layout.indoors:
        add_surroundings(site, place, rng)
    scatter(site, weights, count - count // 4, np.zeros((0, 2)), rng)
    people = draw_people(site, duration > 0, is_training, rng)
    feet = np.array([person.place.feet[:2] for person in people]).reshape(-1, 2)
    scatter(site, weights, count // 4, feet, rng)
    if is_training and len(feet):
        scatter(site, _AMONG_PEOPLE, int(rng.integers(0, 5)), feet, rng)
    add_screens(site, feet, rng)
    items = site.items
    if is_training:
        items = [(name, with_windows(mesh, rng) if name == "car" else mesh) for name, mesh in items]
    people, items = _on_relief(people, items, Relief.draw(layout.indoors, rng), mount.height + layout.sensor[2])
    meshes = [(number, *item) for number, person in enumerate(people) for item in person.meshes(duration)]
    meshes += [(-1, *item) for item in items]
    # bodies and clothes have an owner and no kind; things, belongings included, have a kind and no owner
    owners = [number if name is None else -1 for number, name, _ in meshes]
    kinds = [-1 if name is None else KINDS.index(name) for _, name, _ in meshes]
    counts = [len(mesh.faces) for _, _, mesh in meshes]
    turn = rotation_about("z", mount.turn).T
    scene = union([mesh for _, _, mesh in meshes])
    turned_scene = scene.mapped(lambda vertices: vertices @ turn.astype(np.float32))
    points, face = scan_scene(device, turned_scene, mount.R_sensor_level, rng)
    person_of, thing_of = (np.repeat(np.array(values, np.int16), counts)[face] for values in (owners, kinds))
    if scene.part is not None:
        points = scatter_leaves(points, scene.part[face] == LEAVES, rng)
    points, stray_rows = add_strays(points, rng)
    person_of[stray_rows], thing_of[stray_rows] = -1, -1
    keep_mask, is_piece = cut_scan(points, thing_of, rng)
    frame = SceneFrame.draw(mount, rng, most=30.0 if is_training else 15.0)
    labels = [[frame.of(level_points @ turn) for level_points in person.label(duration)] for person in people]
    return DetectionScene(
        points=frame.of(points[keep_mask]).astype(np.float32),
        origin=frame.origin,
        boxes=tuple(
            label_box(vertices, frame.yaw(person.place.yaw + mount.turn), number)
            for number, (person, (vertices, _)) in enumerate(zip(people, labels, strict=True))
        ),
        person=person_of[keep_mask],
        joints=np.array([joints for _, joints in labels], np.float32).reshape(-1, len(BODY26), 3),
        mounted=np.array([person.mounted for person in people], bool),
        sensor=device.name,
        kind="fragment" if is_piece else place,
        negatives=sorted({KINDS[kind] for kind in kinds if kind >= 0}),
        thing=thing_of[keep_mask],
        up=frame.R[:, 2].copy(),
        height=mount.height,
        activities=tuple(person.bodies.kinds[person.row] for person in people),
    )


def _on_relief(
    people: list[PlacedPerson], items: list[tuple[str, Mesh]], relief: Relief, height: float
) -> tuple[list[PlacedPerson], list[tuple[str, Mesh]]]:
    """People and things lifted onto the ground's slope and waves, with the sensor, `height` m above its flat ground, at
    z = 0."""
    offset = np.array([0, 0, -height])

    def lifted(vertices: np.ndarray) -> np.ndarray:
        vertices = vertices.copy()
        vertices[:, 2] += relief.at(vertices.T)
        return (vertices + offset).astype(np.float32)

    lifted_people = []
    for person in people:
        feet = person.place.feet + [0, 0, relief.at(person.place.feet)] + offset
        lifted_people.append(replace(person, place=replace(person.place, feet=feet)))
    return lifted_people, [(name, mesh.mapped(lifted)) for name, mesh in items]
