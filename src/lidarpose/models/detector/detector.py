"""Detects the people in a whole scan: a network scores proposals, and duplicate detections are suppressed."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.geometry import rows_near
from lidarpose.io.files import file_error
from lidarpose.models import weights_file
from lidarpose.models.decode import sigmoid
from lidarpose.models.detector.candidates import CHUNK, SceneIndex, suppress_near
from lidarpose.models.detector.detector_config import INPUTS, OUTPUT, DetectorConfig
from lidarpose.models.detector.ground import Ground, without_ground
from lidarpose.models.detector.map_ground import ground_under
from lidarpose.models.detector.proposals import heights_above, propose
from lidarpose.models.detector.range_image import SIDE, SLICES
from lidarpose.models.detector.render import render
from lidarpose.models.onnx import check_names, map_in_threads, open_network, thread_count

# default detection range, m; points farther than this beyond the range are ignored, m: a candidate at the end of the
# range still has its surroundings, and the ground below them is estimated as if there were no end
MAX_RANGE, BEYOND = 40.0, 14.0
# if the sensor is unknown, there is no range: points farther than this, m, from nearly all others, percentiles, are
# stray points, which would enlarge the cells of `SceneIndex`
_STRAY, _NEARLY_ALL = 100.0, (0.1, 99.9)
# detections nearer than this are one person, m: the network moves candidates of one person to the same position
SAME = 0.15
# distances from a person at which further people are searched, m; radius of the points that a proposal depends on, m
_BESIDE, _COLUMN = (0.3, 0.85), 1.0
# points used for a candidate: radius, m; half width of its view, m, plus a margin, rad; number of direction bins
_CONTEXT, _VIEW, _VIEW_MARGIN, _BINS = 8.0, 2.0, 0.1, 512
# if the sensor is unknown, limits apply to each area of this size, m2, counted in squares of this side, m, with points;
# number of points that are enough to count them, and for the median height; least points of an area
_AREA, _SQUARE, _ENOUGH, _SCAN = 6400.0, 10.0, 200_000, 100_000
# heights of this magnitude, m, are shifted to 0, since float32 resolves them badly
_HIGH = 1000.0
# boxes: side, side for a person who is mounted, margin added to the height, m; and bounds of the network's outputs, m
_SIDE, _MOUNTED_SIDE, _ROOM = 0.9, 1.1, 0.1
_MOST_SHIFT, _MOST_FOOT, _HEIGHTS = 0.6, 1.0, (0.5, 2.3)

# the network's inputs by name, see `render.render` -> (K, 6): logit of a person; true center minus candidate in the
# view frame, m; feet above the ground, m; height, m; logit of a person who rides or sits in a wheelchair
Scorer = Callable[[dict[str, np.ndarray]], np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """D detected people, highest-scoring first, in the level frame, meters.

    centers (D, 3): of their boxes, which are square, at yaw 0; sizes (D, 3); logit (D,); score (D,): probability of a
    person; mounted (D,): probability that the person rides or sits in a wheelchair; ground: under the people, in a
    frame that is `base` m higher; has_ground: whether a ground was found.
    """

    centers: np.ndarray
    sizes: np.ndarray
    logit: np.ndarray
    score: np.ndarray
    mounted: np.ndarray
    ground: Ground
    base: float
    has_ground: bool

    def __len__(self) -> int:
        return len(self.centers)


class Detector:
    """Detects people in scans.

    Args:
        scorer: ONNX file of a network, None for the bundled one; or a function in place of the network.
        threads: number of threads for the candidates, None for all available.

    Raises:
        InputError: one line, for a file that is damaged or not a detector.
    """

    def __init__(self, scorer: str | os.PathLike | Scorer | None = None, *, threads: int | None = None):
        self.header: dict[str, Any] = {}
        self._threads = 1
        if callable(scorer):
            self._score: Scorer = scorer
            return
        self._threads = thread_count(threads)
        session, self.header = open_detector(scorer)
        self._score = lambda arrays: session.run(None, arrays)[0]

    def detect(
        self,
        points: np.ndarray,
        origin: np.ndarray | None,
        *,
        max_range: float | None = MAX_RANGE,
        limit: int | None = None,
        moving: np.ndarray | None = None,
    ) -> Detections:
        """Detects the people in a scan.

        Args:
            points: (n, 3) m, level frame: z up.
            origin: (3,) m, sensor position; None if unknown: then the range is not limited.
            max_range: horizontal distance from the sensor up to which people are detected, m; None for no limit.
            limit: maximum number of detections; if the sensor is unknown, for each 6,400 m2 with 100,000 points.
            moving: (n,) bool, if a background is known: points that do not belong to it. Candidates are proposed from
                these points alone, but rendered with all points around them.

        Returns:
            All candidates after suppression, without a score threshold.
        """
        points, origin, base = _near_zero(points, origin)
        columns = list(points.T)
        if origin is not None and max_range is not None:
            square_distance = (columns[0] - origin[0]) ** 2 + (columns[1] - origin[1]) ** 2
            rows = np.flatnonzero(square_distance < (max_range + BEYOND) ** 2)
        else:
            rows = np.flatnonzero(_is_near_others(columns[0]) & _is_near_others(columns[1]))
        if len(rows) < len(points):
            columns = [values[rows] for values in columns]
        # each axis contiguous in memory, since every step reads one axis at a time
        points = np.ascontiguousarray(columns).T
        ground = ground_under(points, origin)
        has_ground = ground is not None
        ground = ground or without_ground(points, origin)
        heights = heights_above(points, ground)
        is_searched = np.ones(len(rows), bool) if moving is None else np.asarray(moving, bool)[rows]
        if origin is not None and max_range is not None:
            # columns beyond the range must not take the places of others
            is_searched &= square_distance[rows] < (max_range + _COLUMN) ** 2
        areas = 1.0
        if origin is None:
            # no more than the points would give in single scans: a thinned map has few points on each person
            areas = max(1.0, min(_covered_area(points) / _AREA, len(points) / _SCAN))
        searched_points = np.ascontiguousarray(points.T[:, is_searched]).T
        centers = propose(searched_points, ground, heights=heights[is_searched], areas=areas)
        if origin is not None and max_range is not None:
            centers = centers[np.hypot(centers[:, 0] - origin[0], centers[:, 1] - origin[1]) < max_range]
        scene = SceneIndex(points, ground, origin, heights=heights)
        return self._detections(scene, centers, has_ground, base, None if limit is None else round(limit * areas))

    def detect_beside(
        self,
        points: np.ndarray,
        origin: np.ndarray | None,
        ground: Ground,
        rows: np.ndarray,
        people: np.ndarray,
        *,
        moving: np.ndarray | None = None,
    ) -> Detections:
        """Detects people beside those that `detect` returned, if they shared one detection.

        Args:
            points, origin, moving: as for `detect`.
            ground: as returned by `detect`.
            rows: (m,) of the points that do not belong to these people.
            people: (K, 2) m, positions of the people.
        """
        points, origin, base = _near_zero(points, origin)
        selected_rows = rows if moving is None else rows[moving[rows]]
        near_rows = rows_near(people, points[selected_rows], _BESIDE[1] + _COLUMN)
        near_points = points[selected_rows[np.unique(np.concatenate([np.zeros(0, int), *near_rows]))]]
        places = propose(near_points, ground)
        distance = np.linalg.norm(places[:, None, :2] - people[None], axis=-1).min(1, initial=np.inf)
        places = places[(distance > _BESIDE[0]) & (distance < _BESIDE[1])]
        # each axis contiguous in memory, as above
        points = np.ascontiguousarray(points[rows[rows_that_matter(points[rows], origin, places)]].T).T
        return self._detections(SceneIndex(points, ground, origin), places, True, base, None)

    def _detections(
        self, scene: SceneIndex, places: np.ndarray, has_ground: bool, base: float, limit: int | None
    ) -> Detections:
        outputs = np.zeros((len(places), 6))
        shares = [slice(k, None, self._threads) for k in range(min(self._threads, len(places)))]
        results = map_in_threads(lambda share: self._outputs(scene, places[share]), shares, self._threads)
        for share, share_outputs in zip(shares, results, strict=True):
            outputs[share] = share_outputs
        centers, heights = predicted_boxes(places, scene.yaws(places), outputs)
        logit = outputs[:, 0]
        indices = suppress_near(centers, logit, SAME)[:limit]
        mounted = sigmoid(outputs[indices, 5])
        side = np.where(mounted > 0.5, _MOUNTED_SIDE, _SIDE)
        return Detections(
            centers=centers[indices] + [0.0, 0.0, base],
            sizes=np.stack([side, side, heights[indices] + _ROOM], 1),
            logit=logit[indices],
            score=self.probability(logit[indices]),
            mounted=mounted,
            ground=scene.ground,
            base=base,
            has_ground=has_ground,
        )

    def _outputs(self, scene: SceneIndex, places: np.ndarray) -> np.ndarray:
        """The network's outputs (K, 6) for positions (K, 3) m, K at least 1."""
        # memory that all pieces share: allocating it for each takes longer than everything else
        fine = np.empty((min(len(places), CHUNK), SLICES, SIDE, SIDE), np.float32)
        pieces = (render(piece, fine=fine[: len(piece)]) for piece in scene.pieces(places))
        return np.concatenate([np.asarray(self._score(inputs), float) for inputs in pieces])

    def probability(self, logit: np.ndarray) -> np.ndarray:
        """Probability of a person at each logit (D,), by the calibration in the file."""
        if "calibration" not in self.header:
            return sigmoid(logit)
        logits, probabilities = self.header["calibration"]
        return np.interp(logit, logits, probabilities)


def _near_zero(points: np.ndarray, origin: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None, float]:
    """points (n, 3) and origin (3,) m with heights that float32 resolves, and the whole meters subtracted: in the level
    frame of a tilted sensor, map coordinates become heights."""
    points = np.asarray(points)
    base = float(np.round(np.median(points[:: 1 + len(points) // _ENOUGH, 2]))) if len(points) else 0.0
    if abs(base) < _HIGH:
        return points, origin, 0.0
    shift = np.array([0.0, 0.0, base])
    return (points.T - shift[:, None]).T, None if origin is None else origin - shift, base


def _covered_area(points: np.ndarray) -> float:
    """The area, m2, of the squares of 10 m with points (n, 3) m."""
    squares = np.floor(points[:: 1 + len(points) // _ENOUGH, :2] / _SQUARE).astype(np.int64)
    width = 1 + np.ptp(squares[:, 1]) if len(squares) else 1
    return _SQUARE**2 * len(np.unique(squares @ [width, 1]))


def rows_that_matter(points: np.ndarray, origin: np.ndarray | None, places: np.ndarray) -> np.ndarray:
    """The rows (k,) of points (n, 3) m that `SceneIndex` uses for a few positions (K, 3) m.

    These are the points around each position, and all points in its direction from a sensor at origin (3,) m.
    """
    is_used = np.zeros(len(points), bool)
    for rows in rows_near(places, points, _CONTEXT):
        is_used[rows] = True
    if origin is not None and len(places):
        x, y = (places[:, i] - origin[i] for i in (0, 1))
        half_widths = np.arcsin(np.minimum(_VIEW / np.hypot(x, y).clip(1e-6), 1)) + _VIEW_MARGIN
        # in whole bins; a candidate nearer than its view is wide may cover any direction
        half_widths[np.hypot(x, y) < _VIEW] = np.pi
        middles = (np.arange(_BINS) + 0.5) * (2 * np.pi / _BINS) - np.pi
        turns = np.abs((middles[:, None] - np.arctan2(y, x) + np.pi) % (2 * np.pi) - np.pi)
        is_seen = (turns < half_widths + np.pi / _BINS).any(1)
        x, y = ((points[:, i] - origin[i]).astype(np.float32) for i in (0, 1))
        bins = ((np.arctan2(y, x) + np.float32(np.pi)) * np.float32(_BINS / (2 * np.pi))).astype(np.int32)
        is_used |= is_seen[np.minimum(bins, _BINS - 1)]
    return np.flatnonzero(is_used)


def predicted_boxes(places: np.ndarray, yaw: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The positions that the network predicts, within bounds: centers (K, 3) and heights (K,) m of boxes.

    places: (K, 3) m of candidates, on the ground; yaw: (K,) rad of their view frames; outputs: (K, 6), see `Scorer`.
    """
    x, y = np.clip(outputs[:, 1:3], -_MOST_SHIFT, _MOST_SHIFT).T
    foot, height = np.clip(outputs[:, 3], -_MOST_FOOT, _MOST_FOOT), np.clip(outputs[:, 4], *_HEIGHTS)
    centers = places.astype(float)
    centers[:, 0] += np.cos(yaw) * x - np.sin(yaw) * y
    centers[:, 1] += np.sin(yaw) * x + np.cos(yaw) * y
    centers[:, 2] += foot + height / 2
    return centers, height


def _is_near_others(values: np.ndarray) -> np.ndarray:
    """Coordinates (n,) m of points -> (n,) bool: False for stray ones."""
    if not len(values):
        return np.zeros(0, bool)
    # a sample of the points is enough
    sample = values[:: -(-len(values) // 20_000)]
    low = np.percentile(sample, _NEARLY_ALL[0], method="higher")
    high = np.percentile(sample, _NEARLY_ALL[1], method="lower")
    return (values > low - _STRAY) & (values < high + _STRAY)


def detector_path(suffix: str = ".onnx") -> Path:
    """Path of the bundled detector, or, with the suffix .safetensors, of its checkpoint."""
    return weights_file(f"detector{suffix}")


def open_detector(path: str | os.PathLike | None = None) -> tuple[Any, dict]:
    """The session of a detector (None: the bundled one), and its header.

    The header holds "version" and the card of its training, with "calibration" ([logits], [probabilities]),
    "default_score" and "verification" once it is calibrated.

    Raises InputError, one line, for a file that is damaged, of another format, or holds another network.
    """
    path = detector_path() if path is None else path
    session, header = open_network(path)
    if not isinstance(header.config, DetectorConfig):
        raise file_error(path, f"expected a detector, got a network of the kind {header.network}: give a detector")
    check_names(path, session, INPUTS, (OUTPUT,))
    return session, {"version": header.version, **header.card}
