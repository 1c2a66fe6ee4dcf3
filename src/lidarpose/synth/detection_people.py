"""The people of whole scans: groups in the free areas of a place, with the things they carry, push and ride."""

from dataclasses import dataclass
from math import pi

import numpy as np

from lidarpose.synth.bodies import FRAME_TIME, Bodies, draw_bodies
from lidarpose.synth.environment.mesh import Mesh, shape
from lidarpose.synth.environment.site import HALF_WIDTH, Site, pick
from lidarpose.synth.place import Place
from lidarpose.synth.props import Prop, draw_props
from lidarpose.synth.props.mounts import MOUNTS
from lidarpose.synth.props.prop import PELVIS, rigid_prop, upright

# share of people by activity, outdoors and indoors
_MIX_OUTDOORS = {"idle": 0.31, "walk": 0.34, "captured": 0.07, "run": 0.03, "step": 0.02, "bend": 0.035}
_MIX_OUTDOORS |= {"crouch": 0.035, "kneel": 0.01, "sit": 0.1, "cycle": 0.09, "push": 0.05, "sport": 0.02}
_MIX_INDOORS = _MIX_OUTDOORS | {"idle": 0.36, "walk": 0.2, "sit": 0.25, "cycle": 0.004, "run": 0.0}
# in training more people do not stand; shares of sitting people outdoors and indoors
_TRAINING_MIX, _TRAINING_SITS = {"bend": 0.07, "crouch": 0.1, "kneel": 0.08}, (0.16, 0.3)
# seats of people who sit outdoors, and how often each is used
_SEATS = (("moped", 0.3), ("wheelchair", 0.25), ("chair", 0.45))
_MOUNTED = ("bicycle", "moped", "wheelchair")
_PROP_KINDS = {name: name for name in ("chair", "table", "bicycle", "moped")} | {"pram": "cart", "trolley": "cart"}
# in training: share of sitting people who sit at a table, and activities that need half of the extra space `_MORE`
_AT_TABLES = 0.3
_LOW = ("bend", "crouch", "kneel", "sit")
# minimum distance between people, and extra distance for people who ride or push something, m
_APART, _MORE = 0.42, 0.4


@dataclass(frozen=True, kw_only=True)
class PlacedPerson:
    """Row `row` of `bodies` at a place, with props; mounted: on a bicycle, moped or wheelchair."""

    bodies: Bodies
    row: int
    place: Place
    props: list[Prop]

    @property
    def mounted(self) -> bool:
        return any(prop.name in _MOUNTED for prop in self.props)

    def _poses(self, duration: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Vertices, joints and an offset to add to both, m, at the start of a frame of `duration` s and, unless that
        is 0, at its end."""
        poses = [(self.bodies.vertices[self.row], self.bodies.joints[self.row], np.zeros(3, np.float32))]
        if duration:
            vertices, joints = self.bodies.moved(self.row)
            # the pose is not extrapolated beyond `FRAME_TIME`, only the translation is
            displacement = (joints[0] - poses[0][1][0]) * [1, 1, 0] * (duration / FRAME_TIME - 1)
            poses.append((vertices, joints, displacement.astype(np.float32)))
        return poses

    def label(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (k V, 3) m of the body at the k times of `_poses`, concatenated, and joints (26, 3) m in the middle
        of the frame."""
        place, poses = self.place.on_props(self.props), self._poses(duration)
        vertices = np.concatenate([place.of_body(vertices + displacement) for vertices, _, displacement in poses])
        return vertices, np.mean([place.of_body(joints + displacement) for _, joints, displacement in poses], axis=0)

    def meshes(self, duration: float) -> list[tuple[str | None, Mesh]]:
        """Kinds (None for the body and clothes) and meshes; `Mesh.later` is their position at the end of the frame."""
        place, poses = self.place.on_props(self.props), self._poses(duration)
        body = [place.of_body(vertices + displacement) for vertices, _, displacement in poses]
        meshes: list[tuple[str | None, Mesh]] = [(None, Mesh(body[0], self.bodies.faces, None, *body[1:]))]
        for prop in self.props:
            name = None if prop.face_part is not None else _PROP_KINDS.get(prop.name, "belongings")
            prop_vertices = [
                place.of_body((prop.place(joints).vertices + displacement).astype(np.float32))
                for _, joints, displacement in poses
            ]
            meshes.append((name, Mesh(prop_vertices[0], prop.mesh.faces, None, *prop_vertices[1:])))
        return meshes


def draw_people(site: Site, is_smeared: bool, is_training: bool, rng: np.random.Generator) -> list[PlacedPerson]:
    """Groups of one to five people, some beside things that stand there; people without free space are left out."""
    indoors = site.layout.indoors
    area = float(np.prod(site.areas[:, [1, 3]] - site.areas[:, [0, 2]], axis=1).max())
    groups = rng.integers(4, 11) if not indoors else rng.integers(1 + is_training, int(np.clip(area / 12, 2, 7)) + 1)
    sizes = rng.choice([1, 2, 3, 4, 5], groups, p=[0.42, 0.27, 0.15, 0.09, 0.07])
    mix = _MIX_INDOORS if indoors else _MIX_OUTDOORS
    if is_training:
        mix = mix | _TRAINING_MIX | {"sit": _TRAINING_SITS[indoors]}
    bodies = draw_bodies(None, 0.0, int(sizes.sum()), int(rng.integers(2**31)), 0, moving=is_smeared, mix=mix)
    people: list[PlacedPerson] = []
    row = 0
    for size in sizes:
        distance = 2 + (site.reach - 2) * rng.random() ** 1.7
        if rng.random() < 0.25:
            group_center = site.beside(rng, HALF_WIDTH + 0.4 * rng.random())
        else:
            group_center = site.spot(distance, HALF_WIDTH, rng, seen=rng.random() < 0.85)
        style, course = rng.random(), rng.choice([0.0, pi / 2, pi, -pi / 2]) + rng.normal(0, 0.25)
        members: list[np.ndarray] = []
        for _ in range(size):
            kind = bodies.kinds[row]
            extra_room = _MORE if kind in ("cycle", "push") else _MORE / 2 if is_training and kind in _LOW else 0.0
            for _attempt in range(8):
                position = group_center
                if members:
                    angle, offset = rng.uniform(-pi, pi), _APART + extra_room + 0.9 * rng.random() ** 1.5
                    neighbor = members[rng.integers(len(members))]
                    position = neighbor + offset * np.array([np.cos(angle), np.sin(angle)])
                distances = [np.hypot(*(person.place.feet[:2] - position)) for person in people]
                room = 0.9 * HALF_WIDTH + 0.5 * extra_room
                if (
                    min(distances, default=9) >= _APART + extra_room
                    and site.is_free(position, room)
                    and np.hypot(*position) > 1.0
                ):
                    to_middle = float(np.arctan2(*(group_center - position)[::-1]))
                    yaw = course if style < 0.4 else to_middle if style < 0.7 and members else rng.uniform(-pi, pi)
                    feet = np.array([*position, site.level(position)])
                    place = Place(feet=feet, yaw=float(yaw), distance=float(np.hypot(*position)))
                    props = _draw_belongings(bodies, row, indoors, rng)
                    if is_training and kind == "sit" and rng.random() < _AT_TABLES:
                        props.append(_draw_table(rng))
                    people.append(PlacedPerson(bodies=bodies, row=row, place=place, props=props))
                    members.append(position)
                    break
            row += 1
    return people


def _draw_belongings(bodies: Bodies, row: int, indoors: bool, rng: np.random.Generator) -> list[Prop]:
    """The things that a person carries, pushes, sits on or rides."""
    kind, joints = bodies.kinds[row], bodies.joints[row]
    if kind == "sit" and (not indoors or rng.random() < 0.15):
        mount = MOUNTS[pick(rng, dict(_SEATS))](joints.tolist(), rng.random(12).tolist())
        if mount is not None:
            return [mount]
    return draw_props(rng, kind=kind, joints=joints)


def _draw_table(rng: np.random.Generator) -> Prop:
    """A table in front of a sitting person; it occludes the legs or the lap."""
    depth, distance = rng.uniform(0.4, 0.9), rng.uniform(0.25, 0.5)
    mesh = shape("table", depth, rng.uniform(0.6, 1.8), rng.uniform(0.65, 0.78))

    def frame(points: list) -> tuple[list, list]:
        rows, pelvis = upright(points), points[PELVIS]
        return rows, [pelvis[axis] + (distance + depth / 2) * rows[0][axis] for axis in (0, 1)] + [0.0]

    return rigid_prop("table", mesh, frame)
