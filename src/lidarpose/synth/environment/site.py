"""Where things and people stand around a sensor: free places in a layout, scattered things, the ground's relief.

Coordinates are the layout's, moved so that the sensor is above x = y = 0. Legend: k places, M footprints of objects.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.synth.environment import mesh as shapes
from lidarpose.synth.environment.layouts import Item, Layout
from lidarpose.synth.environment.mesh import Mesh, shape, union
from lidarpose.synth.environment.things import THINGS, draw_thing

# range of people's and things' distance from the sensor, m
_NEAREST, _FARTHEST = 1.5, 40.0
# half the width of a standing person, and the height of the point that decides whether a person is visible, m
HALF_WIDTH, _CHEST = 0.24, 1.1
# probability of a place beside a person, for the quarter of the things that is added after the people
_BESIDE = 0.8
# factor on the weights of held-out things in the family "heldout"
_LEFT_OUT_WEIGHT = 3.0


def pick(rng: np.random.Generator, weights: dict[str, float]) -> str:
    """One of the names, drawn with probability proportional to its weight."""
    shares = np.cumsum(list(weights.values()))
    return list(weights)[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]


@dataclass(frozen=True, kw_only=True)
class Mount:
    """height m above the ground; R_sensor_level (3, 3); turn: rotation of the layout about the sensor, rad; view: the
    middle azimuth of the field of view in the layout and its half width, rad."""

    height: float
    R_sensor_level: np.ndarray
    turn: float
    view: tuple[float, float]


class Site:
    """A layout around the sensor: its meshes, and where there is free space.

    items: kinds and meshes, with the sensor above x = y = 0; low: (M, 5), footprints, see `_footprint`.
    """

    def __init__(self, layout: Layout, device: Sensor | RayPattern, mount: Mount):
        x, y, _ = layout.sensor
        self.layout, self.mount = layout, mount
        self.elevations = device.elevations[0], device.elevations[-1]
        self.reach = min(_FARTHEST, 0.95 * device.range_max)
        self.areas = np.array(layout.areas) - [x, x, y, y, 0]
        moved_items = [(name, mesh.moved((-x, -y, 0))) for name, mesh in layout.items]
        rows = np.array([_footprint(mesh) for _, mesh in moved_items])
        is_structure = np.array([name in ("ground", "ceiling", "wall") for name, _ in moved_items])
        is_clear = is_structure | (_gap(rows, np.zeros(2)) > 0.5)
        self.items: list[Item] = [item for item, keep in zip(moved_items, is_clear, strict=True) if keep]
        is_standing = np.array([name not in ("ground", "ceiling") for name, _ in moved_items])
        rows = rows[is_clear & is_standing]
        self.low = rows[np.isfinite(rows[:, 0])]

    def add(self, name: str, mesh: Mesh) -> None:
        """Adds a mesh, a kind of `things.KINDS`, at its own position."""
        self.items.append((name, mesh))
        row = _footprint(mesh)
        if np.isfinite(row[0]):
            self.low = np.concatenate([self.low, row[None]])

    def level(self, place: np.ndarray) -> float:
        """z of the flat ground at (2,) m."""
        if self.layout.road is not None:
            y = place[1] + self.layout.sensor[1]
            return 0.0 if abs(y) <= self.layout.road else float(self.areas[0, 4])
        is_inside = (place[0] >= self.areas[:, 0]) & (place[0] <= self.areas[:, 1])
        is_inside &= (place[1] >= self.areas[:, 2]) & (place[1] <= self.areas[:, 3])
        return float(self.areas[np.argmax(is_inside), 4])

    def is_free(self, place: np.ndarray, room: float) -> bool:
        """Whether neither an object nor the sensor is within `room` m of a place (2,) m."""
        return bool(np.hypot(*place) > max(room, 0.3) and (_gap(self.low, place) > room).all())

    def is_hidden(self, places: np.ndarray) -> np.ndarray:
        """(k,) bool: whether the chest of a person at places (k, 2) m is occluded by an object, or above or below all
        beams."""
        chest_z = np.full((len(places), 1), _CHEST - self.mount.height)
        chest = np.hstack([places, chest_z]) @ rotation_about("z", self.mount.turn).T @ self.mount.R_sensor_level.T
        elevation = np.arctan2(chest[:, 2], np.hypot(*chest[:, :2].T))
        is_outside = (elevation < self.elevations[0]) | (elevation > self.elevations[1])
        directions = places[:, None, :]
        directions = np.where(np.abs(directions) < 1e-6, 1e-6, directions)
        near, far = self.low[:, :2] / directions, self.low[:, 2:4] / directions
        enter, leave = np.minimum(near, far).max(2), np.maximum(near, far).min(2)
        beam = self.mount.height + (_CHEST - self.mount.height) * enter
        return is_outside | np.any((enter < leave) & (enter > 0) & (enter < 0.97) & (self.low[:, 4] > beam), axis=1)

    def spot(self, distance: float, room: float, rng: np.random.Generator, *, seen: bool = False) -> np.ndarray:
        """A random place (2,) m, preferably free, in the areas, in the field of view and about `distance` m from the
        sensor; with `seen`, preferably one where a person is visible."""
        middle, half_width = self.mount.view
        u = rng.random((48, 3))
        angle = middle + half_width * 0.95 * (2 * u[:24, 0] - 1)
        polar_places = distance * np.stack([np.cos(angle), np.sin(angle)], 1)
        area = self.areas[(u[24:, 0] * len(self.areas)).astype(int)]
        area_places = area[:, [0, 2]] + u[24:, 1:] * (area[:, [1, 3]] - area[:, [0, 2]])
        places = np.concatenate([polar_places, area_places])
        distances = np.hypot(*places.T)
        cost = np.abs(distances - distance) + 50 * (distances > self.reach) + 100 * (distances < max(room, _NEAREST))
        angle_errors = np.abs((np.arctan2(places[:, 1], places[:, 0]) - middle + pi) % (2 * pi) - pi)
        cost += 20 * (angle_errors > half_width)
        is_in_area = (places[:, None, :] >= self.areas[:, [0, 2]]) & (places[:, None, :] <= self.areas[:, [1, 3]])
        cost += 200 * ~np.any(np.all(is_in_area, axis=2), axis=1)
        if len(self.low):
            cost += 200 * (_gap(self.low, places) < room).any(1)
            cost += 30 * self.is_hidden(places) if seen else 0
        return places[np.argmin(cost)]

    def beside(self, rng: np.random.Generator, gap: float) -> np.ndarray:
        """A place (2,) m at distance `gap` m from an object."""
        footprints = self.low[np.hypot(*((self.low[:, :2] + self.low[:, 2:4]) / 2).T) < self.reach]
        if not len(footprints):
            return self.spot(rng.uniform(_NEAREST, self.reach), HALF_WIDTH, rng)
        low_x, low_y, high_x, high_y, _ = footprints[rng.integers(len(footprints))]
        u = rng.random(2)
        x, y = low_x + u[0] * (high_x - low_x), low_y + u[0] * (high_y - low_y)
        sides = [(low_x - gap, y), (high_x + gap, y), (x, low_y - gap), (x, high_y + gap)]
        return np.array(sides[int(4 * u[1])])


def _footprint(mesh: Mesh) -> np.ndarray:
    """(5,) m: minimum x, y and maximum x, y of the vertices below 1.9 m, and the z of the top; inf without such
    vertices."""
    low_points = mesh.vertices[mesh.vertices[:, 2] < 1.9, :2]
    if not len(low_points):
        return np.full(5, np.inf)
    return np.array([*low_points.min(0), *low_points.max(0), mesh.vertices[:, 2].max()])


def _gap(footprints: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distance of places (..., 2) from footprints (M, 5): (..., M) m, 0 inside."""
    places = places[..., None, :]
    offsets = np.maximum(np.maximum(footprints[:, :2] - places, places - footprints[:, 2:4]), 0)
    return np.hypot(offsets[..., 0], offsets[..., 1])


def draw_habits(indoors: bool, family: str, rng: np.random.Generator) -> dict[str, float]:
    """Weights of the kinds of things in a scene, randomized for each scene."""
    weights = {}
    for name, row in THINGS.items():
        weights[name] = (row.indoors if indoors else row.outdoors) * (family != "train" or not row.left_out)
        if row.left_out and family == "heldout":
            weights[name] *= _LEFT_OUT_WEIGHT
    return {name: weight * rng.gamma(0.7) for name, weight in weights.items()}


def scatter(site: Site, weights: dict[str, float], count: int, feet: np.ndarray, rng: np.random.Generator) -> None:
    """Adds `count` things that resemble people; if there are people at feet (k, 2) m, most things stand beside them."""
    ceiling = site.layout.ceiling
    for _ in range(count):
        name = pick(rng, weights)
        mesh = draw_thing(name, rng)
        mesh = mesh.moved((0, 0, 0), rng.choice([0.0, pi / 2, pi, -pi / 2]) + rng.normal(0, 0.15))
        if mesh.vertices[:, 2].max() > ceiling:
            mesh = mesh.scaled((1, 1, 0.97 * min(ceiling, 3.0) / mesh.vertices[:, 2].max()))
        footprint = _footprint(mesh)
        for _attempt in range(3):
            if len(feet) and name != "mannequin" and rng.random() < _BESIDE:
                angle, neighbor = rng.uniform(-pi, pi), feet[rng.integers(len(feet))]
                direction = np.array([np.cos(angle), np.sin(angle)])
                position = neighbor + direction * (HALF_WIDTH + 0.05 + 0.45 * rng.random())
                position = np.where(
                    np.abs(direction) < 0.3, neighbor, position - np.where(direction > 0, footprint[:2], footprint[2:4])
                )
            elif name in ("fragment", "mannequin") and not site.layout.indoors:
                position = site.spot(rng.uniform(18, 40), 0.3, rng, seen=True)
            else:
                position = site.spot(_NEAREST + (site.reach - _NEAREST) * rng.random() ** 1.2, 0.3, rng)
            row = footprint + [*position, *position, 0]
            if _gap(row[None], np.zeros(2)).min() > 0.6 and (not len(feet) or _gap(row[None], feet).min() > 0.2):
                site.add(name, mesh.moved((*position, site.level(position))))
                break


def add_screens(site: Site, feet: np.ndarray, rng: np.random.Generator) -> None:
    """Plates and leaves close to the sensor, in a quarter of the scenes; they keep clear of people at feet (k, 2) m."""
    for _ in range(rng.integers(1, 7) if rng.random() < 0.25 else 0):
        distance, angle, u = rng.uniform(0.6, 3.0), rng.uniform(-pi, pi), rng.random(3).tolist()
        width, bottom = (0.03 + 0.5 * u[0] ** 2) * distance, max(0.0, site.mount.height - u[1] * distance)
        screen = shapes.box((0.03, width, min(0.1 + 1.2 * u[2], site.layout.ceiling - bottom)))
        if rng.random() < 0.3:
            screen = shapes.foliage((width, width, 0.2 + 1.0 * u[2]), 80, 0.08, rng)
        position = np.array([distance * np.cos(angle), distance * np.sin(angle)])
        if not len(feet) or np.hypot(*(feet - position).T).min() > 0.3 + width / 2:
            site.add("screen", screen.moved((*position, bottom + site.level(position)), angle))


def add_own_vehicle(site: Site, rng: np.random.Generator) -> None:
    """In 40 percent of the scenes, adds the vehicle or stand that carries the sensor."""
    if rng.random() < 0.4:
        own_mesh = _own_vehicle(site.mount.height, site.layout.by_car, rng)
        site.items.append(("own vehicle", own_mesh.moved((0, 0, site.layout.sensor[2]))))
        # people cannot stand inside it; its top is set to 0 so that it does not occlude anything in `is_hidden`
        site.low = np.concatenate([site.low, [[*_footprint(own_mesh)[:4], 0]]])


def _own_vehicle(height: float, by_car: bool, rng: np.random.Generator) -> Mesh:
    """A car below its roof sensor, a robot's deck, or the tripod that carries the sensor."""
    u = rng.random(4)
    if by_car and height > 1.4:
        roof = height - 0.1 - 0.25 * u[0]
        return shape("car" if roof < 1.8 else "van", 4.4 + u[1], 1.85, roof).moved((0.8 * (u[2] - 0.5), 0, 0))
    if height < 1.4:
        deck = shapes.box((0.3 + 0.5 * u[0], 0.3 + 0.3 * u[1], 0.8 * height))
        return deck.moved((-0.2 * u[2], 0, 0), 2 * pi * u[3])
    leg = shape("tube", 0.02, 0.02, 0.9 * height)
    directions = [np.array([np.cos(angle), np.sin(angle)]) for angle in (0, 2.1, 4.2)]
    return union(
        [
            leg.placed([[1, 0, 0], [0, 1, 0], [*(0.02 * direction), 1]], (*(0.15 * direction), 0))
            for direction in directions
        ]
    )


@dataclass(frozen=True)
class Relief:
    """Slope (2,) and long waves of the ground: rows of wave vector (2,) rad/m, phase, amplitude m."""

    slope: np.ndarray
    waves: np.ndarray

    @classmethod
    def draw(cls, indoors: bool, rng: np.random.Generator) -> "Relief":
        """Flat indoors, else slopes of a few percent and wavelengths of 14 to 70 m."""
        if indoors:
            return cls(np.zeros(2), np.zeros((0, 4)))
        slope = rng.normal(0, 0.035 if rng.random() < 0.6 else 0.0, 2).clip(-0.12, 0.12)
        waves = []
        for _ in range(rng.integers(1, 4) if rng.random() < 0.45 else 0):
            wavelength, angle, phase = rng.uniform(14, 70), rng.uniform(-pi, pi), rng.uniform(-pi, pi)
            k = 2 * pi / wavelength
            waves.append([k * np.cos(angle), k * np.sin(angle), phase, rng.uniform(0, 0.08) / k])
        return cls(slope, np.array(waves).reshape(-1, 4))

    def at(self, places: np.ndarray) -> np.ndarray:
        """Height of the ground, m, at places (2 or 3, ...) m; 0 below the sensor."""
        x, y = places[0], places[1]
        z = self.slope[0] * x + self.slope[1] * y
        for a, b, phase, amplitude in self.waves:
            z = z + amplitude * (np.sin(a * x + b * y + phase) - np.sin(phase))
        return z
