"""What people have with them: things they carry, sit on, push and ride, and what they wear that stands away."""

import numpy as np

from lidarpose.synth.props import meshes as meshes
from lidarpose.synth.props.attachment import JOINT, Points, Prop, fixed
from lidarpose.synth.props.carried import carried
from lidarpose.synth.props.garments import hat_frame, skirt
from lidarpose.synth.props.rides import bicycle, pram, seat, trolley, wheelchair

_RIDES = {
    "cycle": ((1.0, bicycle),),
    "push": ((0.5, pram), (0.95, trolley)),
    "sit": ((0.12, wheelchair), (0.85, seat)),
}
# how often somebody of a kind carries something
_CARRIES = {
    "walk": 0.36,
    "idle": 0.36,
    "step": 0.3,
    "captured": 0.15,
    "run": 0.12,
    "sport": 0.2,
    "lie": 0.0,
    "fall": 0.05,
}
_OTHERS_CARRY = 0.12
# skirts, dresses and long coats of those on their feet; hats; helmets of cyclists
_DRESSED, _HATS, _HELMETS = 0.15, 0.12, 0.5
_ON_FEET = ("walk", "idle", "step", "push")


def draw_props(rng: np.random.Generator, *, kind: str, joints: np.ndarray) -> list[Prop]:
    """What somebody has with them who does `kind` (a name of `body.pose_prior.activities.KINDS`) in the pose
    joints (26, 3) m: usually nothing; cyclists ride, many sit on chairs, about one in three who stand or walk carries
    something that their arms can carry."""
    u = rng.random(12).tolist()
    carries = _CARRIES.get(kind, _OTHERS_CARRY)
    rides = _RIDES.get(kind)
    on_feet = kind in _ON_FEET
    if rides is None and u[0] >= carries and not (on_feet and u[8] < _DRESSED) and u[9] >= _HATS:
        return []
    points = joints.tolist()
    found: list[Prop | None] = []
    if rides:
        for share, make in rides:
            if u[0] < share:
                found.append(make(points, u))
                break
    elif u[0] < carries:
        found += carried(points, u, kind)
    if on_feet and u[8] < _DRESSED:
        found.append(_dress(points, u))
    if (u[9] < (_HELMETS if kind == "cycle" else _HATS)) and kind not in ("lie", "fall"):
        found.append(_hat(points, u, kind))
    return [prop for prop in found if prop is not None]


def _dress(points: Points, u: list[float]) -> Prop:
    vertices, mesh, parts = skirt(points, u[4:8])
    return Prop(name="skirt", mesh=mesh, where=vertices, face_part=parts)


_HEAD_PART = np.uint8(1 + JOINT["head"])


def _hat(points: Points, u: list[float], kind: str) -> Prop:
    brim = 0.0 if kind == "cycle" or u[11] < 0.6 else 0.5
    mesh = meshes.hat(brim)
    edge = 0.25 + 0.3 * u[6]
    part = np.full(len(mesh.faces), _HEAD_PART)
    return fixed("hat", mesh, lambda p: hat_frame(p, edge), face_part=part)
