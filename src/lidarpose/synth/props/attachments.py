"""Things that people carry, wear, push, sit on and ride: meshes attached to a body's joints, drawn to suit its pose.

A prop computes its vertices from the joints of a pose, so it moves with the body from pose to pose. Bodies stand on
z = 0. A `Frame` places a prop in the body's own frame: three rows, the images of the prop's x, y and z axes, and its
origin.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import cos, hypot, sin
from typing import Any

import numpy as np

from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.things import moped
from lidarpose.synth.props.garments import JOINT, Point, Points, distance, girth, hat_frame, heading, middle, skirt

PELVIS = JOINT["pelvis"]
HANDS = (JOINT["left_hand"], JOINT["right_hand"])
# offset from a hand's joint index to its elbow's
_ELBOW = JOINT["left_elbow"] - JOINT["left_hand"]
_HEAD_PART = np.uint8(1 + JOINT["head"])
Frame = Callable[[Points], tuple[Sequence, Sequence]]


@dataclass(frozen=True, kw_only=True)
class Prop:
    """A thing or a garment of a person.

    Args:
        name: as in `_CARRIED` and `_RIDES`, or "skirt" or "hat".
        mesh: in the prop's own frame; for clothes and bicycles, its shape in the pose for which it was drawn.
        where: joints, 26 lists of x, y, z -> the vertices (V, 3) m for that pose.
        face_part: (F,) uint8 = 1 + SMPL joint for clothes; None for things, which are not part of the person.
        lift: height of the body's lowest point above the ground with this prop, as for a cyclist, m.
    """

    name: str
    mesh: Mesh
    where: Callable[[Points], np.ndarray]
    face_part: np.ndarray | None = None
    lift: float = 0.0

    def place(self, joints: np.ndarray) -> Mesh:
        """The mesh for a pose: joints (26, 3) m in BODY26's order."""
        return Mesh(self.where(joints.tolist()), self.mesh.faces)


def rigid_prop(name: str, mesh: Mesh, frame: Frame, **more: Any) -> Prop:
    """A prop that keeps its shape."""
    return Prop(name=name, mesh=mesh, where=lambda points: mesh.placed(*frame(points)).vertices, **more)


def draw_props(rng: np.random.Generator, *, kind: str, joints: np.ndarray) -> list[Prop]:
    """Draws a person's props. Usually there are none; cyclists have a bicycle, many sitting people a chair, and about
    one in three standing or walking people carries something that suits the pose of the arms.

    Args:
        kind: the activity, a name of `body.pose_prior.activities.KINDS`.
        joints: (26, 3) m, the pose.
    """
    u = rng.random(12).tolist()
    carry_share, ride_options = _CARRIES.get(kind, _OTHERS_CARRY), _RIDES.get(kind)
    has_skirt = kind in _ON_FEET and u[8] < _DRESSED
    if ride_options is None and u[0] >= carry_share and not has_skirt and u[9] >= _HATS:
        return []
    points = joints.tolist()
    props: list[Prop | None] = []
    if ride_options:
        maker = next((maker for share, maker in ride_options if u[0] < share), None)
        props.append(maker(points, u) if maker else None)
    elif u[0] < carry_share:
        props += _draw_carried(points, u, kind)
    if has_skirt:
        vertices, mesh, parts = skirt(points, u[4:8])
        props.append(Prop(name="skirt", mesh=mesh, where=vertices, face_part=parts))
    if (u[9] < (_HELMETS if kind == "cycle" else _HATS)) and kind not in _HATLESS:
        mesh, edge = shape("cap" if kind == "cycle" or u[11] < 0.6 else "hat"), 0.25 + 0.3 * u[6]
        face_part = np.full(len(mesh.faces), _HEAD_PART)
        props.append(rigid_prop("hat", mesh, lambda p: hat_frame(p, edge), face_part=face_part))
    return [prop for prop in props if prop is not None]


def upright(points: Points, size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> list:
    """Rows of a frame: forward, left and up, with the lengths `size`."""
    x, y = heading(points)
    a, b, c = size
    return [[a * x, a * y, 0.0], [-b * y, b * x, 0.0], [0.0, 0.0, c]]


def rod_rows(start: tuple, end: tuple, radius: float) -> tuple[list, list]:
    """Rows (3, 3) and an origin that put the mesh "tube" or "rod" between two points (x, y, z)."""
    dx, dy, dz = (b - a for a, b in zip(start, end, strict=True))
    length = max((dx * dx + dy * dy + dz * dz) ** 0.5, 1e-6)
    flat_length = hypot(dx, dy)
    side_axis = (-dy / flat_length, dx / flat_length, 0.0) if flat_length > 1e-3 * length else (0.0, 1.0, 0.0)
    x, y, z = side_axis
    second_axis = (
        z * dy / length - y * dz / length,
        x * dz / length - z * dx / length,
        y * dx / length - x * dy / length,
    )
    return [[radius * a for a in side_axis], [radius * a for a in second_axis], [dx, dy, dz]], list(start)


def _ahead_of_pelvis(points: Points, point: Point) -> float:
    """Distance by which a point is ahead of the pelvis, m."""
    x, y = heading(points)
    return (point[0] - points[PELVIS][0]) * x + (point[1] - points[PELVIS][1]) * y


# --- carried things: each a frame from the pose, the carrying hand, and uniform numbers


def _bag(points: Points, hand: int, u: list[float]) -> Frame:
    """A shopping bag or a briefcase, straight below a hanging hand."""
    height = min(0.3 + 0.3 * u[3], points[hand][2] - 0.05)
    size = (0.22 + 0.22 * u[4], 0.07 + 0.13 * u[5], height)
    return lambda p: (upright(p, size), [*p[hand][:2], max(p[hand][2] - 0.01, height + 0.01)])


def _shoulder_bag(points: Points, hand: int, u: list[float]) -> Frame:
    """At the left or right hip."""
    sign = 1.0 if u[2] < 0.5 else -1.0
    depth, height = 0.08 + 0.07 * u[3], 0.2 + 0.15 * u[4]
    size, back_offset = (0.25 + 0.15 * u[5], depth, height), -0.05

    def frame(p: Points):
        (x, y), hip = heading(p), p[PELVIS]
        lateral_offset = sign * (girth(p, "hip_side") + 0.015 + depth / 2)
        origin = [
            hip[0] - lateral_offset * y + back_offset * x,
            hip[1] + lateral_offset * x + back_offset * y,
            hip[2] - 0.12 - height / 2,
        ]
        return upright(p, size), origin

    return frame


# angle between the line of the spine's joints and the back, rad; distance of a rucksack's top below the neck, m
_SPINE_LEAN, _BELOW_NECK = 0.18, 0.02


def _rucksack(points: Points, hand: int, u: list[float]) -> Frame:
    """On the back, with its top just below the neck."""
    size = (0.13 + 0.17 * u[2], 0.26 + 0.1 * u[3], 0.36 + 0.22 * u[4])
    c, s = cos(_SPINE_LEAN), sin(_SPINE_LEAN)

    def frame(p: Points):
        spine, neck = p[JOINT["spine3"]], p[JOINT["neck"]]
        up = np.array([n - s for n, s in zip(neck, spine, strict=True)])
        lateral = np.array([a - b for a, b in zip(p[JOINT["left_collar"]], p[JOINT["right_collar"]], strict=True)])
        up /= max(float(np.sqrt(up @ up)), 1e-6)
        lateral -= (lateral @ up) * up
        lateral /= max(float(np.sqrt(lateral @ lateral)), 1e-6)
        (a0, a1, a2), (u0, u1, u2) = lateral.tolist(), up.tolist()
        forward = np.array([a1 * u2 - a2 * u1, a2 * u0 - a0 * u2, a0 * u1 - a1 * u0])
        # the line of the spine's joints leans forward of the back, which is upright
        up, forward = up * c - forward * s, forward * c + up * s
        back_distance = girth(p, "back") + 0.01
        origin = np.array(spine) - back_distance * forward + (distance(neck, spine) - _BELOW_NECK - size[2]) * up
        return [forward * size[0], lateral * size[1], up * size[2]], origin

    return frame


def _phone(points: Points, hand: int, u: list[float]) -> Frame:
    return lambda p: (upright(p, (0.012, 0.075, 0.155)), [*p[hand][:2], p[hand][2] - 0.02])


def _ball(points: Points, hand: int, u: list[float]) -> Frame:
    """Held in a hand: beyond the hand along the forearm, and not below the ground."""
    hand, radius = HANDS[u[2] < 0.5], 0.1 + 0.03 * u[3]

    def frame(p: Points):
        hand_point, wrist = p[hand], p[hand - 2]
        length = max(distance(hand_point, wrist), 1e-6)
        x, y, z = (a + 0.9 * radius * (a - w) / length for a, w in zip(hand_point, wrist, strict=True))
        return [[radius, 0, 0], [0, radius, 0], [0, 0, radius]], [x, y, max(z, radius)]

    return frame


def _parcel(points: Points, hand: int, u: list[float]) -> Frame:
    """A box between the hands or on them, in front of the body."""
    hand_distance = distance(points[HANDS[0]], points[HANDS[1]])
    depth, height = 0.2 + 0.2 * u[2], 0.15 + 0.25 * u[3]
    size, is_under = (depth, max(hand_distance - 0.04, 0.25), height), hand_distance < 0.29

    def frame(p: Points):
        (x, y), hands_middle = heading(p), middle(p[HANDS[0]], p[HANDS[1]])
        # its back must not be inside the belly
        push = max(0.0, girth(p, "hip_front") + 0.04 + depth / 2 - _ahead_of_pelvis(p, hands_middle))
        bottom = hands_middle[2] + 0.02 if is_under else hands_middle[2] - 0.4 * height
        return upright(p, size), [hands_middle[0] + push * x, hands_middle[1] + push * y, bottom]

    return frame


def _stick(points: Points, hand: int, u: list[float]) -> Frame:
    """From a hand to the ground a little ahead: a cane, a crutch, a pole."""
    lean, radius, overhang = 0.02 + 0.25 * u[3], 0.011 + 0.007 * u[4], 0.03 + (0.3 * u[5] if u[6] < 0.3 else 0.0)

    def frame(p: Points):
        (x, y), top = heading(p), p[hand]
        foot = (top[0] + lean * x, top[1] + lean * y, 0.0)
        scale = 1 + overhang / max(top[2], 0.1)
        return rod_rows(foot, tuple(f + scale * (t - f) for f, t in zip(foot, top, strict=True)), radius)

    return frame


def _umbrella(points: Points, hand: int, u: list[float]) -> Frame:
    """Open, held by the shaft in a raised hand, leaning so that it is above the head."""
    width, handle_length = 0.9 + 0.3 * u[3], 0.12

    def frame(p: Points):
        hand_point, head = p[hand], p[JOINT["head_center"]]
        top = [
            hand_point[0] + 0.55 * (head[0] - hand_point[0]),
            hand_point[1] + 0.55 * (head[1] - hand_point[1]),
            max(head[2] + 0.32, hand_point[2] + 0.5),
        ]
        shaft_length = distance(top, hand_point)
        start = tuple(a - handle_length * ((t - a) / shaft_length) for t, a in zip(top, hand_point, strict=True))
        # the width of the canopy does not depend on the length of the shaft
        (x, y, z), origin = rod_rows(start, tuple(top), 1.0)
        return [[width * a for a in x], [width * a for a in y], z], origin

    return frame


def _suitcase(points: Points, hand: int, u: list[float]) -> Frame:
    """On wheels behind the hand that pulls it, or upright beside a standing person."""
    drag_offset, width = 0.05 + 0.4 * u[3], 0.8 + 0.35 * u[4]

    def frame(p: Points):
        (x, y), top = heading(p), p[hand]
        height = max(top[2], 0.3)
        rows = [
            [width * x, width * y, width * drag_offset / height],
            [-width * y, width * x, 0.0],
            [drag_offset * x, drag_offset * y, height],
        ]
        return rows, [top[0] - drag_offset * x, top[1] - drag_offset * y, width * 0.28 * drag_offset / height]

    return frame


@dataclass(frozen=True)
class _Carried:
    """A mesh; its weight among the carried things if the hands (see `_free_hands`) and the activity suit it, or
    `otherwise` for other activities; and how it is attached. Empty `kinds`: all activities."""

    mesh: str
    share: float
    attach: Callable[[Points, int, list[float]], Frame]
    hands: str = "any"
    kinds: tuple[str, ...] = ()
    otherwise: float = 0.0


_CARRIED = {
    "rucksack": _Carried("pack", 0.26, _rucksack),
    "shoulder bag": _Carried("box", 0.14, _shoulder_bag),
    "bag": _Carried("bag", 0.24, _bag, "hanging"),
    "suitcase": _Carried("suitcase", 0.07, _suitcase, "hanging", ("walk", "idle")),
    "stick": _Carried("tube", 0.08, _stick, "leaning", ("walk", "idle", "step", "bend")),
    "phone": _Carried("box", 0.30, _phone, "raised"),
    "umbrella": _Carried("umbrella", 0.20, _umbrella, "raised", ("walk", "idle")),
    "box": _Carried("box", 0.4, _parcel, "both"),
    "ball": _Carried("ball", 0.5, _ball, "any", ("sport",), 0.02),
}


def _draw_carried(points: Points, u: list[float], kind: str) -> list[Prop]:
    """One of the things that suit the pose of the arms; a few people carry a rucksack, too."""
    hands = _free_hands(points)
    shares = {
        name: (row.share if not row.kinds or kind in row.kinds else row.otherwise) if hands[row.hands] else 0.0
        for name, row in _CARRIED.items()
    }
    pick = u[1] * sum(shares.values())
    for name, share in shares.items():
        if pick < share:
            names = [name, "rucksack"] if name != "rucksack" and u[10] < 0.12 else [name]
            return [_carried_prop(name, points, hands[_CARRIED[name].hands], u) for name in names]
        pick -= share
    return []


def _carried_prop(name: str, points: Points, hands: list[int], u: list[float]) -> Prop:
    row = _CARRIED[name]
    return rigid_prop(name, shape(row.mesh), row.attach(points, hands[int(u[2] * len(hands))], u))


def _free_hands(points: Points) -> dict[str, list[int]]:
    """Hands (joint indices) by use: any hand, those that hang, those raised above their elbows, those that could lean
    on something, and both if they can hold something in front of the body."""
    pelvis = points[PELVIS][2]
    left, right = (points[hand] for hand in HANDS)
    ahead_distance = {hand: _ahead_of_pelvis(points, points[hand]) for hand in HANDS}
    can_hold = abs(left[2] - right[2]) < 0.2 and 0.12 < distance(left, right) < 0.7 and 0.6 < left[2] < 1.5
    z = {joint: points[joint][2] for hand in HANDS for joint in (hand, hand + _ELBOW)}
    return {
        "any": list(HANDS),
        "hanging": [h for h in HANDS if 0.4 < z[h] < pelvis + 0.12 and z[h] < z[h + _ELBOW]],
        "raised": [h for h in HANDS if z[h] > z[h + _ELBOW] + 0.05],
        "leaning": [h for h in HANDS if 0.5 < z[h] < 1.2 and z[h] < pelvis + 0.3 and ahead_distance[h] > -0.2],
        "both": list(HANDS) if can_hold and min(ahead_distance.values()) > 0.15 else [],
    }


# --- things that people push and sit on


def _pushed(name: str, points: Points, u: list[float]) -> Prop | None:
    """Its handle is at the hands that are in front of the body, at their height; None if there are none."""
    hands = [hand for hand in HANDS if _ahead_of_pelvis(points, points[hand]) > 0.15]
    if not hands:
        return None

    def frame(p: Points):
        handle = middle(p[hands[0]], p[hands[-1]])
        if len(hands) == 1:
            # the middle of the handle is in front of the middle of the body
            x, y = heading(p)
            lateral_offset = (p[PELVIS][1] - handle[1]) * x - (p[PELVIS][0] - handle[0]) * y
            handle = [handle[0] - lateral_offset * y, handle[1] + lateral_offset * x, handle[2]]
        return upright(p, (1.0, 1.0, min(max(handle[2], 0.75), 1.2))), [handle[0], handle[1], 0.0]

    return rigid_prop(name, shape(name), frame)


# distance of a seat below the middle of the hips: a share of the thigh's radius, plus a constant, m. Fitted to the
# drawn bodies that sit; the residual is 1.3 cm
_THIGH_SHARE, _BELOW_HIPS = 0.75, 0.034


def _hips(points: Points) -> Point:
    return middle(points[JOINT["left_hip"]], points[JOINT["right_hip"]])


def _seat_height(points: Points) -> float:
    thigh = girth(points, "hip_side") - distance(points[JOINT["left_hip"]], points[JOINT["right_hip"]]) / 2
    return _hips(points)[2] - _THIGH_SHARE * thigh - _BELOW_HIPS


def _under_hips(size: tuple[float, float, float], z: float) -> Frame:
    return lambda p: (upright(p, size), [*_hips(p)[:2], z])


def _seat(points: Points, u: list[float]) -> Prop | None:
    """A chair, a stool or a bench, from the ground to the thighs; None for a person who sits on the ground."""
    height = _seat_height(points)
    if height < 0.2:
        return None
    width = 0.42 + (1.3 * u[2] if u[1] < 0.3 else 0.08 * u[2])
    return rigid_prop("chair", shape("chair" if u[3] < 0.65 else "seat"), _under_hips((1.0, width, height), 0.0))


# height of a wheelchair's foot rests, m, and of the mesh's seat, m
_FOOT_REST, _WHEELCHAIR_SEAT = 0.08, 0.5


def _wheelchair(points: Points, u: list[float]) -> Prop | None:
    height = _seat_height(points) + _FOOT_REST
    if not 0.4 < height < 0.6:
        return None
    # the foot rest is placed under the feet
    (x, y), hips = heading(points), _hips(points)
    foot = middle(points[JOINT["left_foot"]], points[JOINT["right_foot"]])
    foot_distance = min(max((foot[0] - hips[0]) * x + (foot[1] - hips[1]) * y, 0.25), 0.75)
    size = height / _WHEELCHAIR_SEAT
    foot_rest = shape("box", 0.24, 0.36, 0.025).moved(((foot_distance - 0.04) / size, 0, 0.05))
    frame = _under_hips((size, size, size), -_FOOT_REST)
    return rigid_prop("wheelchair", union([shape("wheelchair"), foot_rest]), frame, lift=_FOOT_REST)


# heights of the seat and the foot board of `things.moped`, m
_MOPED_SEAT, _FOOT_BOARD = 0.75, 0.28


def _moped(points: Points, u: list[float]) -> Prop | None:
    """A scooter under a sitting person: its seat under the hips, its foot board under the feet."""
    height = _seat_height(points) + _FOOT_BOARD
    if not 0.6 < height < 0.95:
        return None
    frame = _under_hips((1.0, 1.0, height / _MOPED_SEAT), -_FOOT_BOARD)
    return rigid_prop("moped", moped(), frame, lift=_FOOT_BOARD)


# --- bicycles

# positions (x, z) of parts of the mesh, m; the mesh stands on the ground, with its saddle above the origin
_SADDLE, CRANK, REAR_AXLE, FRONT_AXLE, NECK = (0.0, 0.97), (0.17, 0.28), (-0.29, 0.34), (0.77, 0.34), (0.6, 0.84)
# lowest height of a pedal above the ground, and distance of the saddle below the middle of the hips, m
_PEDAL, _BELOW_SADDLE = 0.1, 0.05
# radius of the bars and cranks of a full-size bicycle, m
_TUBE = 0.016


def _bicycle(points: Points, u: list[float]) -> Prop:
    """A bicycle scaled to the rider: saddle under the hips, pedals under the feet, bars at the hands."""
    size = min(max((_hips(points)[2] - _BELOW_SADDLE + _PEDAL) / _SADDLE[1], 0.45), 1.15)
    hands = [_in_bicycle(points, points[hand], size) for hand in HANDS]
    # hands that are where handlebars can be; without any, the handlebars are at a default position
    grips = [h for h in hands if 0.25 < h[0] < 0.9 and 0.75 < h[2] < 1.4]
    bar_x, bar_z = (
        (sum(h[0] for h in grips) / len(grips), sum(h[2] for h in grips) / len(grips)) if grips else (0.52, 1.05)
    )
    bars = shape("box", 0.04, 0.56, 0.035).moved((bar_x, 0, bar_z - 0.03))
    frame_mesh = union([shape("bicycle"), bars, _rod((NECK[0], 0.0, NECK[1]), (bar_x, 0.0, bar_z))])

    def mesh(p: Points) -> Mesh:
        """The mesh in the bicycle's frame, with the pedals under the feet."""
        return union(
            [frame_mesh, *_pedals([_in_bicycle(p, p[JOINT[f"{side}_foot"]], size) for side in ("left", "right")])]
        )

    frame = _under_hips((size, size, size), -_PEDAL)
    return Prop(name="bicycle", mesh=mesh(points), where=lambda p: mesh(p).placed(*frame(p)).vertices, lift=_PEDAL)


def _in_bicycle(points: Points, point: Point, size: float) -> tuple[float, float, float]:
    """A point in the frame of the bicycle for these joints."""
    hips, (x, y) = _hips(points), heading(points)
    dx, dy = point[0] - hips[0], point[1] - hips[1]
    return ((dx * x + dy * y) / size, (dy * x - dx * y) / size, (point[2] + _PEDAL) / size)


def _pedals(feet: list[tuple[float, float, float]]) -> Iterator[Mesh]:
    """Left and right pedals and their cranks, at the points of a circle about the crank axle that are nearest to the
    feet."""
    ax, az = CRANK
    for side, (px, _, pz) in zip((0.1, -0.1), feet, strict=True):
        dx, dz = px - ax, pz - 0.03 - az
        length = max((dx * dx + dz * dz) ** 0.5, 1e-6)
        pedal = (ax + 0.17 * dx / length, side, az + 0.17 * dz / length)
        yield shape("box", 0.09, 0.09, 0.025).moved(pedal)
        yield _rod((ax, 0.6 * side, az), (pedal[0], 0.6 * side, pedal[2]))


def _rod(start: tuple, end: tuple) -> Mesh:
    return shape("rod").placed(*rod_rows(start, end, _TUBE))


# things to sit on by name, for callers that want a certain one: joints as lists and uniform numbers (12,) -> a prop, or
# None if the pose does not suit it
MOUNTS: dict[str, Callable[[Points, list[float]], Prop | None]] = {
    "bicycle": _bicycle,
    "moped": _moped,
    "wheelchair": _wheelchair,
    "chair": _seat,
}
# by activity: (cumulative share, prop)
_RIDES: dict[str, tuple[tuple[float, Callable[[Points, list[float]], Prop | None]], ...]] = {
    "cycle": ((1.0, _bicycle),),
    "push": ((0.5, partial(_pushed, "pram")), (0.95, partial(_pushed, "trolley"))),
    "sit": ((0.12, _wheelchair), (0.85, _seat)),
}
# activities whose poses make no sense without the thing that is ridden, pushed or sat on
POSED_WITH_A_PROP = frozenset(_RIDES)
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
