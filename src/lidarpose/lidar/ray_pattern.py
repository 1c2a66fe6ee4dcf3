"""Sensors whose rays do not form rings: rosettes, whose pattern does not repeat from frame to frame, and depth cameras.

A frame is the list of rays that the sensor sends in `duration` seconds. Each ray has its own time, so moving bodies are
distorted as in real scans. Sensor frame: x forward, y left, z up.

Legend: N rays of a frame, V vertices, F faces, n hits.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lidarpose.errors import InputError, check_finite
from lidarpose.lidar.sensor import check_limits


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """The rays of a frame, by ascending azimuth: directions (N, 3) float64, unit vectors; time (N,) in [0, 1], as a
    fraction of the frame; line (N,) int32, the laser; azimuth and elevation (N,) rad."""

    directions: np.ndarray
    time: np.ndarray
    line: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class RayPattern:
    """A sensor defined by a list of rays.

    name; rays: frame number -> azimuth, elevation (N,) rad, time (N,) in [0, 1], line (N,); frames: number of distinct
    frames; duration s of a frame, 0 for a snapshot; azimuths and elevations: (lowest, highest) rad, the field of view;
    the others as in `sensor.Sensor`: range_min and range_max m, range_sigma m, dropout, height m, tilt rad.
    """

    name: str
    rays: Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    frames: int
    duration: float
    azimuths: tuple[float, float]
    elevations: tuple[float, float]
    range_min: float = 0.1
    range_max: float = 100.0
    range_sigma: float = 0.02
    # measured on people in real sweeps: 2.5 percent of the returns along a ring are missing
    dropout: float = 0.025
    height: float = 1.7
    tilt: float = 0.0
    _made: dict[int, Rays] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self):
        if self.frames < 1:
            raise InputError(f"RayPattern.frames must be 1 or more, got {self.frames}")
        for name in ("azimuths", "elevations"):
            low, high = getattr(self, name)
            if not (np.isfinite([low, high]).all() and low < high):
                raise InputError(f"RayPattern.{name} must be (lowest, highest) rad, got ({low}, {high})")
        check_finite("RayPattern.duration", self.duration)
        if self.duration < 0:
            raise InputError(f"RayPattern.duration must be 0 s or more, got {self.duration}")
        check_limits(self)

    @property
    def field_of_view(self) -> float:
        """Horizontal field of view, rad."""
        return self.azimuths[1] - self.azimuths[0]

    @property
    def is_narrow(self) -> bool:
        """Whether the field of view is less than a full turn in azimuth."""
        return self.field_of_view < 2 * np.pi - 1e-3

    def __getstate__(self) -> dict:
        # the cached frames are computed again in another process
        return self.__dict__ | {"_made": {}}

    def frame(self, number: int) -> Rays:
        """The rays of frame `number`, cached and read-only; frames repeat after `frames`."""
        number %= self.frames
        if number not in self._made:
            self._made[number] = self._sort(number)
        return self._made[number]

    def _sort(self, number: int) -> Rays:
        azimuth, elevation, time, line = self.rays(number)
        azimuth = np.mod(azimuth + np.pi, 2 * np.pi) - np.pi
        order = np.argsort(azimuth, kind="stable")
        azimuth, elevation = azimuth[order], elevation[order]
        c = np.cos(elevation)
        directions = np.stack([np.cos(azimuth) * c, np.sin(azimuth) * c, np.sin(elevation)], -1)
        rays = Rays(
            directions=directions,
            time=np.ascontiguousarray(time[order], float),
            line=np.ascontiguousarray(line[order], np.int32),
            azimuth=azimuth,
            elevation=elevation,
        )
        for values in vars(rays).values():
            values.flags.writeable = False
        return rays


# --- ray patterns of known sensors
#
# Livox publishes four seconds of each pattern as a table of angles (scan_mode/*.csv of Livox-SDK's
# livox_laser_simulation). The constants below were fitted to those tables. A model of two rotating wedges reproduces
# the tables of the Mid-40 and the Avia to 0.001 deg; the Mid-40's constants agree with those of Brazeal, Wilkinson and
# Hochmair (Sensors 2021, 21, 4722). The model of the Mid-360 reproduces its table to 0.09 deg, 0.37 at worst; the
# sensor's beams are precise to 0.15 deg.

# number of frames used of a pattern that never repeats
_KEPT = 16
_FRAME = 0.1

# angle of a wedge's slanted face, in the Mid-40 and in the Avia
_SLANT = np.radians(18.0)
# turns per minute of the two wedges, and their refractive index
_MID40_TURNS, _MID40_INDEX = (7294, -4664), 1.5089
_AVIA_TURNS, _AVIA_INDEX = (7893, -2448), 1.8144
# the Avia's lasers are stacked vertically
_AVIA_LINES, _AVIA_SPACING = 6, np.radians(0.8973)


def _phase(turns_a_minute: float, seconds: np.ndarray) -> np.ndarray:
    return 2 * np.pi * turns_a_minute / 60 * seconds


def _refracted(rays: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Unit rays (N, 3) behind a surface, by Snell's law. normal (N, 3) or (3,), in the direction of the rays; ratio:
    refractive index before the surface divided by that behind it."""
    cos_incidence = (rays * normal).sum(-1, keepdims=True)
    cos_refraction = np.sqrt(1 - ratio**2 * (1 - cos_incidence**2))
    return ratio * rays + (cos_refraction - ratio * cos_incidence) * normal


def _through_wedge(rays: np.ndarray, phase: np.ndarray, index: float, *, slant_first: bool) -> np.ndarray:
    """Unit rays (N, 3), approximately along +x, behind a wedge rotated by `phase` (N,) rad about x."""
    flat_normal = np.array([1.0, 0.0, 0.0])
    sin_slant = np.sin(_SLANT)
    slanted_normal = np.stack(
        [np.full_like(phase, np.cos(_SLANT)), sin_slant * np.cos(phase), sin_slant * np.sin(phase)], -1
    )
    first_normal, second_normal = (slanted_normal, flat_normal) if slant_first else (flat_normal, slanted_normal)
    return _refracted(_refracted(rays, first_normal, 1 / index), second_normal, index)


def _angles(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation (N,) of unit rays (N, 3)."""
    return np.arctan2(rays[:, 1], rays[:, 0]), np.arcsin(rays[:, 2].clip(-1, 1))


def _mid40(frame: int, *, phase: float = 0.0):
    """A rosette 38.4 deg across, 100,000 points per second: the wedges' slanted faces face each other."""
    share = np.arange(10_000) / 10_000
    t = (frame + share) * _FRAME
    rays = np.tile([1.0, 0.0, 0.0], (len(t), 1))
    rays = _through_wedge(rays, _phase(_MID40_TURNS[0], t) + np.pi + phase, _MID40_INDEX, slant_first=False)
    rays = _through_wedge(rays, _phase(_MID40_TURNS[1], t), _MID40_INDEX, slant_first=True)
    return *_angles(rays), share, np.zeros(len(t), np.int32)


def _mid100(frame: int):
    """Three Mid-40 side by side, 30 deg apart: 98.4 x 38.4 deg, 300,000 points per second. Their phases differ."""
    units = [_mid40(frame, phase=k * 2 * np.pi / 3) for k in range(3)]
    azimuth = [unit[0] + np.radians(30.0 * (k - 1)) for k, unit in enumerate(units)]
    line = np.repeat(np.arange(3, dtype=np.int32), len(azimuth[0]))
    return np.concatenate(azimuth), *(np.concatenate([unit[k] for unit in units]) for k in (1, 2)), line


def _avia(frame: int):
    """Six simultaneous lines on a rosette of 70.4 x 77.2 deg, 240,000 points per second: the wedges' slanted faces face
    outward."""
    share = np.repeat(np.arange(4000) / 4000, _AVIA_LINES)
    t = (frame + share) * _FRAME
    line = np.tile(np.arange(_AVIA_LINES, dtype=np.int32), 4000)
    line_elevation = ((_AVIA_LINES - 1) / 2 - line) * _AVIA_SPACING
    rays = np.stack([np.cos(line_elevation), np.zeros(len(t)), np.sin(line_elevation)], -1)
    rays = _through_wedge(rays, _phase(_AVIA_TURNS[0], t) + np.pi, _AVIA_INDEX, slant_first=True)
    rays = _through_wedge(rays, _phase(_AVIA_TURNS[1], t), _AVIA_INDEX, slant_first=False)
    return *_angles(rays), share, line


# Mid-360: a rotating head bends the beam, and a mirror below it rotates a little faster than the head. Per second, the
# azimuth makes 182 turns while the elevation swings down and up ten times.
_MID360_MIRROR, _MID360_HEAD = 10_945, 10_345
_MID360_ELEVATIONS = (np.radians(-7.2), np.radians(52.0))
_MID360_STARTS = np.radians([90.65, 91.21])
_MID360_LEAN = np.radians(124.164)
# deflection of the beam by the head, deg, as a complex vector across the beam: {m: size} for components with the
# phase mirror - m * lag, where lag is that of the head behind the mirror
_MID360_BEND = {1: 24.987, 2: 0.073, 3: 1.918, 5: 0.078, -1: -1.121, -2: 0.073, -3: 0.136}
# positions of the four lasers in units of their spacing, which turns and stretches: it is 1j times a complex sum, deg,
# of {(a, b): size} with the phases a * mirror + b * lag
_MID360_LASERS = np.array([1.5, 0.5, -0.5, -1.5])
_MID360_FAN = {(0, 0): 1.880, (0, 1): 0.162, (0, 2): 0.030, (2, -2): -0.368, (2, -1): -0.161, (2, -4): -0.058}


def _mid360(frame: int):
    """Four lines that move between 52 and -7 deg while they rotate: 360 x 59 deg, 200,000 points per second."""
    share = np.repeat(np.arange(5000) / 5000, 4)
    t = (frame + share) * _FRAME
    line = np.tile(np.arange(4, dtype=np.int32), 5000)
    mirror = _phase(_MID360_MIRROR, t) + _MID360_STARTS[0]
    lag = mirror - _phase(_MID360_HEAD, t) - _MID360_STARTS[1]
    bend = sum(size * np.exp(1j * (mirror - m * lag)) for m, size in _MID360_BEND.items())
    fan = sum(size * np.exp(1j * (a * mirror + b * lag)) for (a, b), size in _MID360_FAN.items())
    deflection = np.pi / 180 * (bend + 1j * _MID360_LASERS[line] * fan)
    deflection_angle = np.abs(deflection)
    sideways = deflection / deflection_angle * np.sin(deflection_angle)
    rays = np.stack([sideways.real, sideways.imag, np.cos(deflection_angle)], -1)
    sin_lean = np.sin(_MID360_LEAN)
    normal = np.stack([sin_lean * np.cos(mirror), sin_lean * np.sin(mirror), np.full(len(t), np.cos(_MID360_LEAN))], -1)
    rays = rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal
    # the pattern runs clockwise as seen from above
    azimuth, elevation = _angles(rays)
    return -azimuth, elevation, share, line


# columns and rows of the camera, and its field of view (horizontal, vertical), degrees
_PIXELS, _PINHOLE = (320, 240), (58.4, 45.5)


def _pinhole(frame: int):
    """The pixels of a pinhole camera, all at time 0; the line is the row, 0 is the lowest."""
    (columns, rows), (width_deg, height_deg) = _PIXELS, _PINHOLE
    y = np.tan(np.radians(width_deg / 2)) * (1 - 2 * (np.arange(columns) + 0.5) / columns)
    z = np.tan(np.radians(height_deg / 2)) * (2 * (np.arange(rows) + 0.5) / rows - 1)
    y, z = (grid.ravel() for grid in np.meshgrid(y, z))
    line = np.repeat(np.arange(rows, dtype=np.int32), columns)
    return np.arctan2(y, 1.0), np.arctan2(z, np.hypot(1.0, y)), np.zeros(len(y)), line


def _fan(degrees: float) -> tuple[float, float]:
    return -np.radians(degrees) / 2, np.radians(degrees) / 2


def _livox(name: str, rays: Callable, azimuths: tuple[float, float], elevations: tuple[float, float], **fields: float):
    return RayPattern(
        name=name, rays=rays, frames=_KEPT, duration=_FRAME, azimuths=azimuths, elevations=elevations, **fields
    )


# Point rates, ranges (for targets of 80 percent reflectivity) and fields of view are the manufacturers', the last
# widened by up to 0.2 deg to include the whole patterns. Heights are those of usual mounts.
PATTERNS = (
    _livox("livox-mid40", _mid40, _fan(38.4), _fan(38.4), range_min=1.0, range_max=260.0, height=1.5),
    _livox("livox-mid100", _mid100, _fan(98.4), _fan(38.4), range_min=1.0, range_max=260.0, height=2.0),
    _livox("livox-avia", _avia, _fan(70.6), _fan(77.2), range_min=1.0, range_max=320.0, height=1.5),
    _livox("livox-mid360", _mid360, (-np.pi, np.pi), _MID360_ELEVATIONS, range_max=70.0, height=0.5),
    # fields of view and ranges of usual structured-light and time-of-flight cameras, a quarter of their pixels. The
    # noise is constant here, that of 2 to 4 m; a structured-light camera's grows with the square of the range.
    RayPattern(
        name="depth-camera",
        rays=_pinhole,
        frames=1,
        duration=0.0,
        azimuths=_fan(_PINHOLE[0]),
        elevations=_fan(_PINHOLE[1]),
        range_min=0.3,
        range_max=8.0,
        range_sigma=0.012,
        dropout=0.02,
        height=1.2,
    ),
)
