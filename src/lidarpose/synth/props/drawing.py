"""Draws what a person carries, wears, pushes, sits on or rides, to suit the pose."""

import numpy as np

from lidarpose.synth.environment.mesh import shape
from lidarpose.synth.props.carried import draw_carried
from lidarpose.synth.props.garments import JOINT, hat_frame, skirt
from lidarpose.synth.props.mounts import RIDES
from lidarpose.synth.props.prop import Prop, rigid_prop

_HEAD_PART = np.uint8(1 + JOINT["head"])


# activities whose poses make no sense without the thing that is ridden, pushed or sat on
POSED_WITH_A_PROP = frozenset(RIDES)
# share of people who carry something, by activity
_CARRIES = {
    **dict.fromkeys(("walk", "idle"), 0.36),
    **{"step": 0.3, "captured": 0.15, "run": 0.12, "sport": 0.2, "lie": 0.0, "fall": 0.05},
    **{"stoop": 0.3, "throw": 0.2, "kick": 0.1, "lie_down": 0.0, "lie_side": 0.0, "lie_front": 0.0, "all_fours": 0.0},
}
_OTHERS_CARRY = 0.12
# shares of people with a skirt, dress or long coat (in activities of `_ON_FEET`), with a hat, and of cyclists with a
# helmet
_DRESSED, _HATS, _HELMETS = 0.15, 0.12, 0.5
_HATLESS = ("lie", "fall", "lie_down", "lie_side", "lie_front")
_ON_FEET = ("walk", "idle", "step", "push")


def draw_props(rng: np.random.Generator, *, kind: str, joints: np.ndarray) -> list[Prop]:
    """Draws a person's props. Usually there are none; cyclists have a bicycle, many sitting people a chair, and about
    one in three standing or walking people carries something that suits the pose of the arms.

    Args:
        kind: the activity, a name of `body.pose_prior.activities.KINDS`.
        joints: (26, 3) m, the pose.
    """
    u = rng.random(12).tolist()
    carry_share, ride_options = _CARRIES.get(kind, _OTHERS_CARRY), RIDES.get(kind)
    has_skirt = kind in _ON_FEET and u[8] < _DRESSED
    if ride_options is None and u[0] >= carry_share and not has_skirt and u[9] >= _HATS:
        return []
    points = joints.tolist()
    props: list[Prop | None] = []
    if ride_options:
        maker = next((maker for share, maker in ride_options if u[0] < share), None)
        props.append(maker(points, u) if maker else None)
    elif u[0] < carry_share:
        props += draw_carried(points, u, kind)
    if has_skirt:
        vertices, mesh, parts = skirt(points, u[4:8])
        props.append(Prop(name="skirt", mesh=mesh, where=vertices, face_part=parts))
    if (u[9] < (_HELMETS if kind == "cycle" else _HATS)) and kind not in _HATLESS:
        mesh, edge = shape("cap" if kind == "cycle" or u[11] < 0.6 else "hat"), 0.25 + 0.3 * u[6]
        face_part = np.full(len(mesh.faces), _HEAD_PART)
        props.append(rigid_prop("hat", mesh, lambda p: hat_frame(p, edge), face_part=face_part))
    return [prop for prop in props if prop is not None]
