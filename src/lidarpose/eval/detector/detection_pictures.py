"""Pictures of a detector's evaluation: crops of false positives and missed people from above and from the side."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.eval.detector.detection_scores import FALSE, REFERENCE, DetectorResult
from lidarpose.eval.detector.labeled_scans import LabeledScan, ScanSet
from lidarpose.io.files import shorten
from lidarpose.sample import Box
from lidarpose.viz.draw import ALERT, BLUE, FAINT, INK, default_settings, png_of
from lidarpose.viz.person_view import box_edges

# crops per sheet and per row; half the edge of a crop's view, m
MOST, _PER_ROW, _REACH = 30, 6, 2.0
_DPI, _MAX_POINTS = 90, 4000


@dataclass(frozen=True, kw_only=True, eq=False)
class _Crop:
    """Points (n, 3) m around a box, nearby boxes of labeled people, the direction (2,) to the sensor, and a label."""

    points: np.ndarray
    box: Box
    people: Sequence[Box]
    towards: np.ndarray
    label: str


def draw_false(result: DetectorResult, scans: ScanSet) -> bytes | None:
    """Crops of the false positives with the highest scores; None if there are none."""
    false_people = result.detections[result.detections.status == FALSE].sort_values(
        "score", ascending=False, kind="stable"
    )
    crops = []
    for row in false_people.head(MOST).itertuples():
        label_parts = (f"{row.score:.2f}", row.thing, f"{row.distance:.0f} m")
        crops.append(_crop(scans.loaders[row.scan](), result.boxes[row.scan][row.detection], label_parts))
    return _sheet(crops, f"{result.dataset}: false positives with the highest scores (red), labeled people (blue)")


def draw_missed(result: DetectorResult, scans: ScanSet) -> bytes | None:
    """Crops of the people missed at one false positive per scan, most points first; None if there are none."""
    threshold = result.thresholds[f"{REFERENCE:g}"]
    missed_people = result.people[result.people.score < threshold].sort_values("points", ascending=False, kind="stable")
    crops = []
    for row in missed_people.head(MOST).itertuples():
        scan, score = scans.loaders[row.scan](), f"{row.score:.2f}" if row.detection >= 0 else "no score"
        label_parts = (score, f"{row.points} points", f"{row.distance:.0f} m", "mounted" * row.mounted)
        crops.append(_crop(scan, scan.boxes[row.person], label_parts))
    title = (
        f"{result.dataset}: {len(missed_people)} people missed at threshold {threshold:.2f} (red), by number of points"
    )
    return _sheet(crops, title)


def _crop(scan: LabeledScan, box: Box, label_parts: Sequence[str]) -> _Crop:
    points = scan.points[(np.abs(scan.points[:, :2] - box.center[:2]) < 1.5 * _REACH).all(1)]
    num_inside = int(box.contains(points).sum())
    people = [other for other in scan.boxes if other is not box and np.hypot(*(other.center - box.center)[:2]) < _REACH]
    towards = (np.zeros(3) if scan.origin is None else scan.origin)[:2] - box.center[:2]
    where = shorten(f"{scan.name} {scan.sensor} {scan.kind}", 36)
    label = " · ".join(filter(None, label_parts)) + f"\n{where} · {num_inside} inside"
    return _Crop(
        points=points[evenly_spaced(len(points), _MAX_POINTS)],
        box=box,
        people=people,
        towards=towards / max(float(np.linalg.norm(towards)), 1e-9),
        label=label,
    )


@default_settings()
def _sheet(crops: Sequence[_Crop], title: str) -> bytes | None:
    """Each crop seen from above with the sensor at the bottom, and below that seen from the sensor."""
    from matplotlib.figure import Figure

    if not crops:
        return None
    rows = -(-len(crops) // _PER_ROW)
    figure = Figure(figsize=(2.6 * _PER_ROW, 5.5 * rows + 0.4), dpi=_DPI, facecolor="white", layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=INK, parse_math=False)
    axes = figure.subplots(2 * rows, _PER_ROW, squeeze=False)
    for ax in axes.ravel():
        ax.set_axis_off()
    for k, crop in enumerate(crops):
        row, column = divmod(k, _PER_ROW)
        # to the right as seen from the sensor, and away from the sensor
        right, away = np.array([-crop.towards[1], crop.towards[0], 0]), np.array([*-crop.towards, 0])
        _draw_crop(axes[2 * row, column], crop, right, away)
        _draw_crop(axes[2 * row + 1, column], crop, right, np.array([0, 0, 1.0]))
        axes[2 * row, column].set_title(crop.label, fontsize=7, color=INK, parse_math=False)
    return png_of(figure)


def _draw_crop(ax, crop: _Crop, right: np.ndarray, up: np.ndarray) -> None:
    """One view in meters about the box's center: points in the box are dark, the others gray."""
    from matplotlib.collections import LineCollection

    axes = np.stack([right, up], 1)
    points = crop.points - crop.box.center
    is_inside = crop.box.contains(crop.points)
    is_near = np.abs(points @ np.cross(right, up)) < (_REACH if up[2] else np.inf)
    for rows, color, size in ((is_near & ~is_inside, "#b5bcc4", 1.2), (is_inside, INK, 3.0)):
        ax.scatter(*(points[rows] @ axes).T, s=size, c=color, linewidths=0)
    for box, color in [(crop.box, ALERT), *((person, BLUE) for person in crop.people)]:
        edges = (box_edges(box) - crop.box.center) @ axes
        ax.add_collection(LineCollection(list(edges), colors=color, lw=0.9), autolim=False)
    ax.plot([-_REACH, -_REACH + 1], [-0.97 * _REACH] * 2, color=FAINT, lw=1.5)
    ax.set(xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH), aspect="equal")
