"""Things that people push, sit on and ride, placed by the pose of the body."""

from collections.abc import Callable, Iterator
from functools import partial

from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.things import moped
from lidarpose.synth.props.garments import JOINT, Point, Points, distance, girth, heading, middle
from lidarpose.synth.props.prop import HANDS, PELVIS, Frame, Prop, ahead_of_pelvis, rigid_prop, rod_rows, upright


def _pushed(name: str, points: Points, u: list[float]) -> Prop | None:
    """Its handle is at the hands that are in front of the body, at their height; None if there are none."""
    hands = [hand for hand in HANDS if ahead_of_pelvis(points, points[hand]) > 0.15]
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
RIDES: dict[str, tuple[tuple[float, Callable[[Points, list[float]], Prop | None]], ...]] = {
    "cycle": ((1.0, _bicycle),),
    "push": ((0.5, partial(_pushed, "pram")), (0.95, partial(_pushed, "trolley"))),
    "sit": ((0.12, _wheelchair), (0.85, _seat)),
}
