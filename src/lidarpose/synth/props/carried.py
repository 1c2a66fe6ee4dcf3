"""Things that people carry: each has a frame from the pose, the carrying hand, and uniform numbers."""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, sin

import numpy as np

from lidarpose.synth.environment.mesh import shape
from lidarpose.synth.props.garments import JOINT, Points, distance, girth, heading, middle
from lidarpose.synth.props.prop import HANDS, PELVIS, Frame, Prop, ahead_of_pelvis, rigid_prop, rod_rows, upright

# offset from a hand's joint index to its elbow's
_ELBOW = JOINT["left_elbow"] - JOINT["left_hand"]


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
        push = max(0.0, girth(p, "hip_front") + 0.04 + depth / 2 - ahead_of_pelvis(p, hands_middle))
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
    """A mesh; its weight among the carried things if the hands (see `free_hands`) and the activity suit it, or
    `otherwise` for other activities; and how it is attached. Empty `kinds`: all activities."""

    mesh: str
    share: float
    attach: Callable[[Points, int, list[float]], Frame]
    hands: str = "any"
    kinds: tuple[str, ...] = ()
    otherwise: float = 0.0


CARRIED = {
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


def draw_carried(points: Points, u: list[float], kind: str) -> list[Prop]:
    """One of the things that suit the pose of the arms; a few people carry a rucksack, too."""
    hands = free_hands(points)
    shares = {
        name: (row.share if not row.kinds or kind in row.kinds else row.otherwise) if hands[row.hands] else 0.0
        for name, row in CARRIED.items()
    }
    pick = u[1] * sum(shares.values())
    for name, share in shares.items():
        if pick < share:
            names = [name, "rucksack"] if name != "rucksack" and u[10] < 0.12 else [name]
            return [carried_prop(name, points, hands[CARRIED[name].hands], u) for name in names]
        pick -= share
    return []


def carried_prop(name: str, points: Points, hands: list[int], u: list[float]) -> Prop:
    row = CARRIED[name]
    return rigid_prop(name, shape(row.mesh), row.attach(points, hands[int(u[2] * len(hands))], u))


def free_hands(points: Points) -> dict[str, list[int]]:
    """Hands (joint indices) by use: any hand, those that hang, those raised above their elbows, those that could lean
    on something, and both if they can hold something in front of the body."""
    pelvis = points[PELVIS][2]
    left, right = (points[hand] for hand in HANDS)
    ahead_distance = {hand: ahead_of_pelvis(points, points[hand]) for hand in HANDS}
    can_hold = abs(left[2] - right[2]) < 0.2 and 0.12 < distance(left, right) < 0.7 and 0.6 < left[2] < 1.5
    z = {joint: points[joint][2] for hand in HANDS for joint in (hand, hand + _ELBOW)}
    return {
        "any": list(HANDS),
        "hanging": [h for h in HANDS if 0.4 < z[h] < pelvis + 0.12 and z[h] < z[h + _ELBOW]],
        "raised": [h for h in HANDS if z[h] > z[h + _ELBOW] + 0.05],
        "leaning": [h for h in HANDS if 0.5 < z[h] < 1.2 and z[h] < pelvis + 0.3 and ahead_distance[h] > -0.2],
        "both": list(HANDS) if can_hold and min(ahead_distance.values()) > 0.15 else [],
    }
