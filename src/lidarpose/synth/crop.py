"""The box about a person as a detector draws it, and the points inside it."""

from math import cos, sin

import numpy as np

from lidarpose.sample import Box
from lidarpose.synth.noise import cut_box
from lidarpose.synth.placement import Place
from lidarpose.synth.scene import CropErrors

# what every box adds to the body's extent, and at most as much again at random, m
_ROOM, _MORE = 0.05, 0.2
# a box that is far too large adds between these, m
_LOOSE = (0.1, 0.8)
# the bottom edge: how often it is above the soles and how often in the ground, and between which depths, m
_RAISED, _RAISED_BY = 0.2, (0.03, 0.15)
_SUNK, _SUNK_BY = 0.3, (0.03, 0.25)
# no box is smaller, m
_LEAST_SIZE = 0.4
# what a crop without errors adds on each side, m
_ALL = 2.5


def draw_box(
    errors: CropErrors,
    hard: float,
    extent: tuple[list[float], list[float]],
    place: Place,
    rng: np.random.Generator,
    heading: float = 0.0,
) -> Box:
    """The box of a body, level frame, with the errors of a detector.

    extent: the body's least and greatest x, y, z in metres along its `heading` rad, in its own frame. Without errors
    the box has much room: nothing is cut but what the window of beams had not, as the paper crops nothing.
    """
    (x0, y0, z0), (x1, y1, z1) = extent
    yaw, cut = place.yaw + heading, 1.0
    if not errors.jitter:
        x0, y0, z0, x1, y1, z1 = x0 - _ALL, y0 - _ALL, z0 - _ALL, x1 + _ALL, y1 + _ALL, z1 + _ALL
    else:
        a, b, c, loose, how_loose, bottom, deep, cut = rng.random(8).tolist()
        dx, dy, dz, turn = (errors.jitter * rng.standard_normal(4)).tolist()
        more = _LOOSE[0] + how_loose * (_LOOSE[1] - _LOOSE[0]) if loose < errors.loose else 0.0
        if bottom < _RAISED:
            z0 += _RAISED_BY[0] + deep * (_RAISED_BY[1] - _RAISED_BY[0])
        elif bottom < _RAISED + _SUNK:
            z0 -= _SUNK_BY[0] + deep * (_SUNK_BY[1] - _SUNK_BY[0])
        a, b, c = ((_ROOM + _MORE * u + more) / 2 for u in (a, b, c))
        # heights are estimated better than places
        dz /= 2
        x0, y0, z0, x1, y1, z1 = x0 - a + dx, y0 - b + dy, z0 - c + dz, x1 + a + dx, y1 + b + dy, z1 + c + dz
        yaw += turn
    # the extent's middle, along the true heading
    c, s = cos(place.yaw + heading), sin(place.yaw + heading)
    x, y, z = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2
    center = place.feet + np.array([c * x - s * y, s * x + c * y, z])
    size = np.array([max(high - low, _LEAST_SIZE) for low, high in ((x0, x1), (y0, y1), (z0, z1))])
    box = Box(center=center, size=size, yaw=yaw)
    return cut_box(box, rng=rng) if cut < errors.cut * hard else box
