"""What people carry: each a function of the pose, of what its hands can do, and of uniforms."""

from dataclasses import dataclass

import numpy as np

from lidarpose.synth.props import meshes as meshes
from lidarpose.synth.props.attachment import HANDS, JOINT, PELVIS, Points, Prop, ahead_of_pelvis, fixed, middle, upright
from lidarpose.synth.props.garments import distance, girth, heading

_HEAD, _NECK, _SPINE3 = (JOINT[name] for name in ("head_center", "neck", "spine3"))
# from a hand's joint to its elbow's
_ELBOW = JOINT["left_elbow"] - JOINT["left_hand"]


@dataclass(frozen=True)
class _Arms:
    """Hands (joint indices) that hang, that are raised above their elbows, and that could lean on something; whether
    both hold something ahead of the body."""

    hanging: list[int]
    raised: list[int]
    leaning: list[int]
    both: bool


def _arms(points: Points) -> _Arms:
    pelvis = points[PELVIS][2]
    left, right = (points[hand] for hand in HANDS)
    both = abs(left[2] - right[2]) < 0.2 and 0.12 < distance(left, right) < 0.7 and 0.6 < left[2] < 1.5
    return _Arms(
        hanging=[h for h in HANDS if 0.4 < points[h][2] < pelvis + 0.12 and points[h][2] < points[h + _ELBOW][2]],
        raised=[h for h in HANDS if points[h][2] > points[h + _ELBOW][2] + 0.05],
        leaning=[
            h
            for h in HANDS
            if 0.5 < points[h][2] < 1.2 and points[h][2] < pelvis + 0.3 and ahead_of_pelvis(points, h) > -0.2
        ],
        both=both and min(ahead_of_pelvis(points, h) for h in HANDS) > 0.15,
    )


def carried(points: Points, u: list[float], kind: str) -> list[Prop | None]:
    """One of the things that the arms can carry; a few carry two."""
    arms = _arms(points)
    shares = {
        _rucksack: 0.26,
        _shoulder_bag: 0.14,
        _bag: 0.24 if arms.hanging else 0.0,
        _suitcase: 0.07 if arms.hanging and kind in ("walk", "idle") else 0.0,
        _stick: 0.08 if arms.leaning and kind in ("walk", "idle", "step", "bend") else 0.0,
        _phone: 0.30 if arms.raised else 0.0,
        _umbrella: 0.20 if arms.raised and kind in ("walk", "idle") else 0.0,
        _parcel: 0.4 if arms.both else 0.0,
        _ball: 0.5 if kind == "sport" else 0.02,
    }
    pick = u[1] * sum(shares.values())
    for make, share in shares.items():
        if pick < share:
            more = [_rucksack(points, u)] if make is not _rucksack and u[10] < 0.12 else []
            return [make(points, arms, u) if make in _BY_HAND else make(points, u), *more]
        pick -= share
    return []


def _bag(points: Points, arms: _Arms, u: list[float]) -> Prop:
    """A shopping bag or a briefcase, straight down from a hanging hand."""
    hand = arms.hanging[int(u[2] * len(arms.hanging))]
    tall = min(0.3 + 0.3 * u[3], points[hand][2] - 0.05)
    size = (0.22 + 0.22 * u[4], 0.07 + 0.13 * u[5], tall)

    def frame(p: Points):
        x, y, z = p[hand]
        return upright(p, size), [x, y, max(z - 0.01, tall + 0.01)]

    return fixed("bag", meshes.bag(), frame)


def _shoulder_bag(points: Points, u: list[float]) -> Prop:
    """At a hip, below the hanging hand's side."""
    sign = 1.0 if u[2] < 0.5 else -1.0
    deep, tall = 0.08 + 0.07 * u[3], 0.2 + 0.15 * u[4]
    size = (0.25 + 0.15 * u[5], deep, tall)

    def frame(p: Points):
        x, y = heading(p)
        aside = sign * (girth(p, "hip_side") + 0.015 + deep / 2)
        hip = p[PELVIS]
        back = -0.05
        return upright(p, size), [
            hip[0] - aside * y + back * x,
            hip[1] + aside * x + back * y,
            hip[2] - 0.12 - tall / 2,
        ]

    return fixed("shoulder bag", meshes.unit_box(), frame)


# the spine's joints lean this much from the line of the back, rad; how far below the neck a rucksack ends, m
_SPINE_LEAN, _BELOW_NECK = 0.18, 0.02


def _rucksack(points: Points, u: list[float]) -> Prop:
    """On the back, from below the neck."""
    size = (0.13 + 0.17 * u[2], 0.26 + 0.1 * u[3], 0.36 + 0.22 * u[4])

    def frame(p: Points):
        spine, neck = p[_SPINE3], p[_NECK]
        up = np.array([n - s for n, s in zip(neck, spine, strict=True)])
        across = np.array([a - b for a, b in zip(p[JOINT["left_collar"]], p[JOINT["right_collar"]], strict=True)])
        up /= max(float(np.sqrt(up @ up)), 1e-6)
        across -= (across @ up) * up
        across /= max(float(np.sqrt(across @ across)), 1e-6)
        (a0, a1, a2), (u0, u1, u2) = across.tolist(), up.tolist()
        ahead = np.array([a1 * u2 - a2 * u1, a2 * u0 - a0 * u2, a0 * u1 - a1 * u0])
        # the back is upright where the spine's joints lean forward
        up, ahead = up * _COS - ahead * _SIN, ahead * _COS + up * _SIN
        behind = girth(p, "back") + 0.01
        origin = np.array(spine) - behind * ahead + (distance(neck, spine) - _BELOW_NECK - size[2]) * up
        return [ahead * size[0], across * size[1], up * size[2]], origin

    return fixed("rucksack", meshes.pack(), frame)


_COS, _SIN = float(np.cos(_SPINE_LEAN)), float(np.sin(_SPINE_LEAN))


def _phone(points: Points, arms: _Arms, u: list[float]) -> Prop:
    hand = arms.raised[int(u[2] * len(arms.raised))]

    def frame(p: Points):
        x, y, z = p[hand]
        return upright(p, (0.012, 0.075, 0.155)), [x, y, z - 0.02]

    return fixed("phone", meshes.unit_box(), frame)


def _ball(points: Points, u: list[float]) -> Prop:
    """Held: beyond the hand along the forearm, not in the ground."""
    hand, radius = HANDS[u[2] < 0.5], 0.1 + 0.03 * u[3]

    def frame(p: Points):
        at, wrist = p[hand], p[hand - 2]
        long = max(distance(at, wrist), 1e-6)
        x, y, z = (a + 0.9 * radius * (a - w) / long for a, w in zip(at, wrist, strict=True))
        return [[radius, 0, 0], [0, radius, 0], [0, 0, radius]], [x, y, max(z, radius)]

    return fixed("ball", meshes.ball(), frame)


def _parcel(points: Points, u: list[float]) -> Prop:
    """A box between the hands or on them, before the body."""
    apart = distance(points[HANDS[0]], points[HANDS[1]])
    deep, tall = 0.2 + 0.2 * u[2], 0.15 + 0.25 * u[3]
    size = (deep, max(apart - 0.04, 0.25), tall)
    under = apart < 0.29

    def frame(p: Points):
        x, y = heading(p)
        at = middle(p[HANDS[0]], p[HANDS[1]])
        # behind its back is the belly
        gone = (at[0] - p[PELVIS][0]) * x + (at[1] - p[PELVIS][1]) * y
        push = max(0.0, girth(p, "hip_front") + 0.04 + deep / 2 - gone)
        low = at[2] + 0.02 if under else at[2] - 0.4 * tall
        return upright(p, size), [at[0] + push * x, at[1] + push * y, low]

    return fixed("box", meshes.unit_box(), frame)


def _stick(points: Points, arms: _Arms, u: list[float]) -> Prop:
    """From a hand to the ground a little ahead: a cane, a crutch, a pole."""
    hand = arms.leaning[int(u[2] * len(arms.leaning))]
    lean, radius, above = 0.02 + 0.25 * u[3], 0.011 + 0.007 * u[4], 0.03 + (0.3 * u[5] if u[6] < 0.3 else 0.0)

    def frame(p: Points):
        x, y = heading(p)
        top = p[hand]
        foot = (top[0] + lean * x, top[1] + lean * y, 0.0)
        over = 1 + above / max(top[2], 0.1)
        return meshes.rod_rows(foot, tuple(f + over * (t - f) for f, t in zip(foot, top, strict=True)), radius)

    return fixed("stick", meshes.tube(), frame)


def _umbrella(points: Points, arms: _Arms, u: list[float]) -> Prop:
    """Open, its shaft through a raised hand, leaning to above the head."""
    hand = arms.raised[int(u[2] * len(arms.raised))]
    wide, low = 0.9 + 0.3 * u[3], 0.12

    def frame(p: Points):
        at, head = p[hand], p[_HEAD]
        top = [at[0] + 0.55 * (head[0] - at[0]), at[1] + 0.55 * (head[1] - at[1])]
        top.append(max(head[2] + 0.32, at[2] + 0.5))
        long = distance(top, at)
        up = [(t - a) / long for t, a in zip(top, at, strict=True)]
        start = tuple(a - low * v for a, v in zip(at, up, strict=True))
        # the canopy is as wide as it is, however long the shaft
        rows, origin = meshes.rod_rows(start, tuple(top), 1.0)
        return [[wide * a for a in rows[0]], [wide * a for a in rows[1]], rows[2]], origin

    return fixed("umbrella", meshes.umbrella(), frame)


def _suitcase(points: Points, arms: _Arms, u: list[float]) -> Prop:
    """On wheels behind a hand that pulls it, or upright beside who stands."""
    hand = arms.hanging[int(u[2] * len(arms.hanging))]
    behind, wide = 0.05 + 0.4 * u[3], 0.8 + 0.35 * u[4]

    def frame(p: Points):
        x, y = heading(p)
        top = p[hand]
        tall = max(top[2], 0.3)
        rows = [[wide * x, wide * y, wide * behind / tall], [-wide * y, wide * x, 0.0], [behind * x, behind * y, tall]]
        return rows, [top[0] - behind * x, top[1] - behind * y, wide * 0.28 * behind / tall]

    return fixed("suitcase", meshes.suitcase(), frame)


_BY_HAND = (_bag, _phone, _stick, _umbrella, _suitcase)
