"""What people push, sit on and ride: each a function of the pose and of uniforms."""

from collections.abc import Iterator

import numpy as np

from lidarpose.synth.environment.mesh import Mesh, union
from lidarpose.synth.props import meshes as meshes
from lidarpose.synth.props.attachment import HANDS, JOINT, PELVIS, Points, Prop, ahead_of_pelvis, fixed, middle, upright
from lidarpose.synth.props.garments import Point, distance, girth, heading


def _pushed(name: str, mesh: Mesh, points: Points) -> Prop | None:
    """Its handle is at the hands that are ahead, at their height."""
    hands = [hand for hand in HANDS if ahead_of_pelvis(points, hand) > 0.15]
    if not hands:
        return None

    def frame(p: Points):
        at = middle(p[hands[0]], p[hands[-1]])
        if len(hands) == 1:
            # the middle of the handle is before the middle of the body
            x, y = heading(p)
            aside = (p[PELVIS][1] - at[1]) * x - (p[PELVIS][0] - at[0]) * y
            at = [at[0] - aside * y, at[1] + aside * x, at[2]]
        return upright(p, (1.0, 1.0, min(max(at[2], 0.75), 1.2))), [at[0], at[1], 0.0]

    return fixed(name, mesh, frame)


def pram(points: Points, u: list[float]) -> Prop | None:
    return _pushed("pram", meshes.pram(), points)


def trolley(points: Points, u: list[float]) -> Prop | None:
    return _pushed("trolley", meshes.cart(), points)


# what one sits on is so far below the middle of the hips: a share of the thigh's radius, and m. Fitted to the drawn
# bodies that sit: 1.3 cm are left
_THIGH_SHARE, _BELOW_HIPS = 0.75, 0.034


def _hips(points: Points) -> Point:
    return middle(points[JOINT["left_hip"]], points[JOINT["right_hip"]])


def _seat_height(points: Points) -> float:
    thigh = girth(points, "hip_side") - distance(points[JOINT["left_hip"]], points[JOINT["right_hip"]]) / 2
    return _hips(points)[2] - _THIGH_SHARE * thigh - _BELOW_HIPS


def seat(points: Points, u: list[float]) -> Prop | None:
    """A chair, a stool or a bench from the ground to the thighs; nothing for who sits on the ground."""
    high = _seat_height(points)
    if high < 0.2:
        return None
    wide = 0.42 + (1.3 * u[2] if u[1] < 0.3 else 0.08 * u[2])
    size = (1.0, wide, high)

    def frame(p: Points):
        x, y, _ = _hips(p)
        return upright(p, size), [x, y, 0.0]

    return fixed("chair", meshes.chair() if u[3] < 0.65 else meshes.bench(), frame)


# a wheelchair's foot rests are this high, m, and its seat is at 0.5 of the mesh's
_FOOT_REST, _WHEELCHAIR_SEAT = 0.08, 0.5


def wheelchair(points: Points, u: list[float]) -> Prop | None:
    high = _seat_height(points) + _FOOT_REST
    if not 0.4 < high < 0.6:
        return None
    # the foot rest is where the feet are
    x, y = heading(points)
    foot = middle(points[JOINT["left_foot"]], points[JOINT["right_foot"]])
    hips = _hips(points)
    forward = min(max((foot[0] - hips[0]) * x + (foot[1] - hips[1]) * y, 0.25), 0.75)
    size = high / _WHEELCHAIR_SEAT
    rest = meshes.unit_box().scaled((0.24, 0.36, 0.025)).moved(((forward - 0.04) / size, 0, 0.05))
    mesh = union([meshes.wheelchair(), rest])

    def frame(p: Points):
        at = _hips(p)
        return upright(p, (size, size, size)), [at[0], at[1], -_FOOT_REST]

    return fixed("wheelchair", mesh, frame, lift=_FOOT_REST)


# a pedal at its lowest is this high above the ground, the saddle this far below the middle of the hips, m
_PEDAL, _SADDLE = 0.1, 0.05
# radius of the bars and cranks, of a bicycle of full size, m
_TUBE = 0.016


def bicycle(points: Points, u: list[float]) -> Prop:
    """As large as the rider needs: saddle under the hips, pedals under the feet, bars at the hands."""
    hips = _hips(points)
    size = min(max((hips[2] - _SADDLE + _PEDAL) / meshes.SADDLE[1], 0.45), 1.15)
    hands = [_within(points, points[hand], size) for hand in HANDS]
    # hands that are where bars can be; else straight ones
    held = [h for h in hands if 0.25 < h[0] < 0.9 and 0.75 < h[2] < 1.4]
    bar_x, bar_z = (sum(h[0] for h in held) / len(held), sum(h[2] for h in held) / len(held)) if held else (0.52, 1.05)
    neck = (meshes.NECK[0], 0.0, meshes.NECK[1])
    parts = [meshes.bicycle(), meshes.unit_box().scaled((0.04, 0.56, 0.035)).moved((bar_x, 0, bar_z - 0.03))]
    still = union([*parts, meshes.rod(neck, (bar_x, 0.0, bar_z), _TUBE)])

    def shape(p: Points) -> Mesh:
        """In the bicycle's frame, the pedals where the feet are."""
        return union([still, *_pedals([_within(p, p[JOINT[name]], size) for name in ("left_foot", "right_foot")])])

    def where(p: Points) -> np.ndarray:
        x, y, _ = _hips(p)
        return shape(p).placed(upright(p, (size, size, size)), [x, y, -_PEDAL]).vertices

    return Prop(name="bicycle", mesh=shape(points), where=where, lift=_PEDAL)


def _within(points: Points, point: Point, size: float) -> tuple[float, float, float]:
    """A point in the frame of the bicycle that is under these joints."""
    hips, (x, y) = _hips(points), heading(points)
    dx, dy = point[0] - hips[0], point[1] - hips[1]
    return ((dx * x + dy * y) / size, (dy * x - dx * y) / size, (point[2] + _PEDAL) / size)


def _pedals(feet: list[tuple[float, float, float]]) -> Iterator[Mesh]:
    """Left and right pedal and their cranks, on a circle about the axle, as near to the feet as it comes."""
    ax, az = meshes.CRANK
    for side, (px, _, pz) in zip((0.1, -0.1), feet, strict=True):
        dx, dz = px - ax, pz - 0.03 - az
        long = max((dx * dx + dz * dz) ** 0.5, 1e-6)
        pedal = (ax + 0.17 * dx / long, side, az + 0.17 * dz / long)
        yield meshes.unit_box().scaled((0.09, 0.09, 0.025)).moved(pedal)
        yield meshes.rod((ax, 0.6 * side, az), (pedal[0], 0.6 * side, pedal[2]), _TUBE)
