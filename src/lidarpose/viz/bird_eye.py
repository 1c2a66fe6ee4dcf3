"""Whole scans from above: points colored by height; boxes, ids, headings, skeletons and tracks of people.

Drawn with matplotlib's object interface and default settings, as in `draw`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.models.detector.ground import Ground, estimate_ground
from lidarpose.models.detector.proposals import heights_above
from lidarpose.sample import Box, Pose
from lidarpose.viz.draw import (
    ALERT,
    FAINT,
    INK,
    SIDE_COLORS,
    default_settings,
    draw_people,
    png_of,
    shortened,
    stack_pictures,
)
from lidarpose.viz.person_view import Panel, bone_pairs, bone_sides, box_edges, finite, is_known

MAX_SCANS = 12
LONGEST_NAME = 12  # characters of a person's name that are drawn in a scan
_MAX_POINTS = 120_000  # per scan; more points would only cover each other at this size
_DPI, _PANEL, _TITLE = 110, 7.6, 0.6  # inches
_WIDE, _CARDS_IN_ROW = 11.5, 4  # width of a scan, inches, above the cards of at least this number of people
# pt: distances of a name from its box, size of a short name, font size
_LABEL_RADII, _LABEL_SIZE, _NAME_FONT = (15.0, 26.0, 38.0), 13.0, 9
# pt: room that the word "sensor" needs
_SENSOR_ROOM = 45.0
_MARGIN, _LEAST_SPAN = 3.0, 16.0  # m: margin around the people, and minimum side of a view
_LONG_NUMBERS = 10_000.0  # m: from here on, numbers at the left are upright, since the margin is narrow
_BELOW, _ABOVE = 0.25, 2.5  # range of heights that the colors cover, m above the ground
_GROUND, _HIGH = "#d5d9de", "#eceff2"


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanPanel:
    """One scan to draw; all coordinates in one frame, z up, m.

    Args:
        points: (n, 3).
        boxes: boxes of people; the id is printed beside a box, and an arrow marks its heading.
        headings: whether the heading of each box is known; by default it is.
        poses: joints (P, J, 3); labeled: whether these are ground truth.
        tracks: positions (F, 2) or (F, 3) of each person over time.
        places: (K, 2) or (K, 3), positions of people without track ids.
        label: printed above.
        sensor: x, y of the sensor; None if unknown.
        axes: names of the two axes that are drawn.
        names: names of the P people, shown instead of their numbers.
        frames: successive frames of the same scene, each with its people and their points; step: ms between frames.
    """

    points: np.ndarray
    boxes: Sequence[Box] = ()
    headings: Sequence[bool] = ()
    poses: Pose | None = None
    labeled: bool = False
    tracks: Sequence[np.ndarray] = ()
    places: np.ndarray | None = None
    label: str = ""
    sensor: tuple[float, float] | None = (0.0, 0.0)
    axes: tuple[str, str] = ("x", "y")
    names: Sequence[str] = ()
    frames: Sequence["ScanPanel"] = ()
    step: float = 100.0


def draw_scan_and_people(scan: ScanPanel, people: Sequence[Panel], *, title: str = "") -> bytes:
    """Draws a scan from above and, below it, a card for each person, as `draw_scans` and `draw_people` do; returns the
    PNG's bytes."""
    is_wide = len(people) >= _CARDS_IN_ROW
    pictures = [draw_scans([scan], title=title, panel_width=_WIDE if is_wide else _PANEL)]
    return stack_pictures([*pictures, draw_people(list(people))] if people else pictures)


@default_settings()
def draw_scans(panels: Sequence[ScanPanel], *, title: str = "", panel_width: float = _PANEL) -> bytes:
    """Draws scans from above, side by side.

    Args:
        panels: at most the first 12 are drawn.
        title: printed at the top.
        panel_width: width of each panel, inches.

    Returns:
        The PNG's bytes.
    """
    from matplotlib.figure import Figure

    panels = list(panels)[:MAX_SCANS]
    columns = min(2, max(len(panels), 1))
    rows = max(-(-len(panels) // columns), 1)
    width, height = columns * panel_width, rows * _PANEL + _TITLE
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    heading = shortened(title, int(4.7 * width))
    figure.text(0.15 / width, 1 - 0.15 / height, heading, fontsize=13, weight="bold", va="top", parse_math=False)
    tracks = "; dotted: path over the frames" if any(panel.tracks for panel in panels) else ""
    limbs = "; left limbs blue, right ones orange" if any(is_known(panel.poses) for panel in panels) else ""
    dots = "; dots: people of all frames" if any(panel.places is not None for panel in panels) else ""
    arrows = "arrow: facing, of given boxes their heading" if any(any(_is_headed(panel)) for panel in panels) else ""
    note = f"{arrows}{tracks}{dots}{limbs}".removeprefix("; ")
    figure.text(0.15 / width, 1 - 0.42 / height, note, fontsize=8, color=FAINT, va="top")
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        place = ((column * panel_width + 0.55) / width, (height - _TITLE - (row + 1) * _PANEL + 0.45) / height)
        size = np.array([panel_width - 0.7, _PANEL - 0.75])
        _draw_panel(figure.add_axes((*place, *size / (width, height))), panel, size)
    return png_of(figure)


def _draw_panel(ax, panel: ScanPanel, size: np.ndarray) -> None:
    """Draws one scan; size: width and height of the axes, inches."""
    from matplotlib.collections import LineCollection

    points = finite(panel.points)
    center, scale = _window(panel, points, size)
    low, high = center - size * scale / 2, center + size * scale / 2
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    for name, set_label in zip(panel.axes, (ax.set_xlabel, ax.set_ylabel), strict=True):
        set_label(f"{name}, m", fontsize=7, color=FAINT, labelpad=1)
    ax.set_title(panel.label, fontsize=10, parse_math=False)
    # coordinates of maps as they are, not as a sum with an offset
    ax.ticklabel_format(style="plain", useOffset=False)
    ax.tick_params(labelsize=7, color=FAINT, labelcolor=FAINT)
    if np.abs((low[1], high[1])).max() >= _LONG_NUMBERS:
        for text in ax.get_yticklabels():
            text.set(rotation=90, va="center")
    ax.spines[:].set_color(_HIGH)
    inside_points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(1)]
    _draw_points(ax, inside_points[evenly_spaced(len(inside_points), _MAX_POINTS)], estimate_ground(points))
    if panel.sensor is not None:
        ax.plot(*panel.sensor, ls="", marker="^", ms=8, color=INK, mec="white", zorder=5)
        fits = (high[0] - panel.sensor[0]) * 72 / scale > _SENSOR_ROOM
        ax.annotate(
            "sensor", panel.sensor, (7 if fits else -7, -3), textcoords="offset points",
            ha="left" if fits else "right", fontsize=8, zorder=5,
        )  # fmt: skip
    for track in panel.tracks:
        ax.plot(track[:, 0], track[:, 1], color=ALERT, lw=1.2, ls=":", zorder=4)
        ax.plot(*track[-1, :2], ls="", marker="o", ms=2.5, color=ALERT, zorder=4)
    if panel.places is not None and len(panel.places):
        ax.plot(panel.places[:, 0], panel.places[:, 1], ls="", marker="o", ms=2.5, color=ALERT, alpha=0.5, zorder=4)
    centers = np.array([box.center[:2] for box in panel.boxes]).reshape(-1, 2)
    arrow_tips = np.array([_arrow_tip(box) for box in panel.boxes]).reshape(-1, 2)
    widths = np.array([_name_width(_name(box)) for box in panel.boxes])
    limits = np.stack([low, high]) * 72 / scale
    offsets = label_offsets(centers * 72 / scale, arrow_tips * 72 / scale, widths, limits)
    for box, is_headed, offset in zip(panel.boxes, _is_headed(panel), offsets.tolist(), strict=True):
        _draw_box(ax, box, offset, is_headed)
    if is_known(panel.poses):
        skeleton = panel.poses.skeleton
        bones = panel.poses.joints.reshape(-1, len(skeleton), 3)[:, bone_pairs(skeleton), :2]
        colors = [SIDE_COLORS[side] for side in bone_sides(skeleton)] * len(bones)
        ax.add_collection(
            LineCollection(list(bones.reshape(-1, 2, 2)), colors=colors, lw=1.6, zorder=6, capstyle="round")
        )


def _window(panel: ScanPanel, points: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, float]:
    """The section that axes of a size (2,) inches show: center (2,) m, and scale in meters per inch. It contains the
    people and their tracks, else most of the points, and the sensor."""
    extent_points = [box.center[None, :2] for box in panel.boxes] + [np.asarray(track)[:, :2] for track in panel.tracks]
    if panel.places is not None and len(panel.places):
        extent_points.append(np.asarray(panel.places)[:, :2])
    if not extent_points:
        extent_points = [np.percentile(points[:, :2], (2, 98), axis=0) if len(points) else np.zeros((1, 2))]
    if panel.sensor is not None:
        extent_points.append(np.array([panel.sensor]))
    low, high = np.concatenate(extent_points).min(0), np.concatenate(extent_points).max(0)
    scale = max(float(((high - low + 2 * _MARGIN) / size).max()), _LEAST_SPAN / float(size.min()))
    return (low + high) / 2, scale


def _draw_points(ax, points: np.ndarray, ground: Ground | None) -> None:
    """Draws the ground in light gray, points above it colored by height, and points higher than people even fainter."""
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle

    if ground is not None:
        height = heights_above(points, ground)
    else:
        height = points[:, 2] - (np.percentile(points[:, 2], 2) if len(points) else 0)
    is_colored = (height >= _BELOW) & (height <= _ABOVE)
    # objects on the ground are drawn last, so that nothing covers them
    order = np.argsort(is_colored, kind="stable")
    size = np.clip(20_000 / max(len(points), 1), 0.3, 4) * np.where(is_colored, 1.5, 1)
    cmap = colormaps["viridis_r"].with_extremes(under=_GROUND, over=_HIGH)
    limits = {"cmap": cmap, "vmin": _BELOW, "vmax": _ABOVE}
    dots = ax.scatter(*points[order, :2].T, s=size[order], c=height[order], linewidths=0, zorder=2, **limits)
    corner = Rectangle((0.008, 0.03), 0.085, 0.24, transform=ax.transAxes, fc="white", alpha=0.85, zorder=4.5)
    ax.add_patch(corner)
    bar = ax.figure.colorbar(dots, cax=ax.inset_axes((0.02, 0.05, 0.012, 0.2)), extend="neither")
    bar.set_label("height, m", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    bar.outline.set_visible(False)


def label_offsets(
    centers: np.ndarray, arrow_tips: np.ndarray, widths: np.ndarray, limits: np.ndarray | None = None
) -> np.ndarray:
    """Offsets (B, 2) of names with widths (B,) from the centers (B, 2) of their boxes, all in pt: between the lower and
    upper `limits` (2, 2), away from arrows with tips (A, 2), other boxes and names placed before, else to the upper
    right."""
    angles = np.pi / 4 * (1 + np.arange(8))
    directions = np.stack([np.cos(angles), np.sin(angles)], -1).round(6)
    distance_effort = np.repeat(np.array(_LABEL_RADII) / _LABEL_RADII[0], 8) * 0.05
    widths = np.maximum(widths, _LABEL_SIZE)
    offsets = np.zeros((len(centers), 2))
    low, high = (-np.inf, np.inf) if limits is None else limits
    for i, center in enumerate(centers):
        # a wide name moves aside by half of its additional width
        aside = np.sign(directions) * ((widths[i] - _LABEL_SIZE) / 2, 0)
        candidates = np.concatenate([radius * directions + aside for radius in _LABEL_RADII])
        others = np.concatenate([np.delete(centers, i, 0), centers[:i] + offsets[:i], arrow_tips])
        other_widths = np.full(len(others), _LABEL_SIZE)
        other_widths[len(centers) - 1 : len(centers) - 1 + i] = widths[:i]
        apart = (others[:, None] - (center + candidates)) / _LABEL_SIZE
        apart[..., 0] *= (2 * _LABEL_SIZE / (widths[i] + other_widths))[:, None]
        # a name that is cut off may read as another one: worse than any overlap
        half_size = np.array([widths[i], _LABEL_SIZE]) / 2
        cut_off = np.maximum(low - (center + candidates - half_size), center + candidates + half_size - high)
        effort = distance_effort + _LABEL_SIZE * cut_off.clip(min=0).max(-1)
        offsets[i] = candidates[np.argmin(np.exp(-(apart**2).sum(-1)).sum(0).round(3) + effort)]
    return offsets


def _name(box: Box) -> str:
    """The name that is drawn beside a box."""
    return "" if box.id is None else shortened(str(box.id), LONGEST_NAME)


def _name_width(name: str) -> float:
    """Width of a drawn name, pt."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=_NAME_FONT, weight="bold")
    return text_to_path.get_text_width_height_descent(name, font, ismath=False)[0]


def _is_headed(panel: ScanPanel) -> list[bool]:
    """Whether each box has an arrow."""
    return list(panel.headings) or [True] * len(panel.boxes)


def _arrow_tip(box: Box) -> np.ndarray:
    """Tip (2,) m of the arrow that shows the heading."""
    return box.center[:2] + np.array([np.cos(box.yaw), np.sin(box.yaw)]) * (box.size[0] / 2 + 0.6)


def _draw_box(ax, box: Box, offset: tuple[float, float], is_headed: bool) -> None:
    """Draws a box's outline, its heading if it is known, and its id at `offset` pt from the center."""
    from matplotlib.collections import LineCollection

    ax.add_collection(LineCollection(list(box_edges(box)[..., :2]), colors=ALERT, lw=1.1, zorder=5))
    if is_headed:
        ax.annotate(
            "", _arrow_tip(box), box.center[:2], arrowprops={"arrowstyle": "->", "color": ALERT, "lw": 1.1}, zorder=5
        )
    if box.id is not None:
        ax.annotate(
            _name(box), box.center[:2], offset, textcoords="offset points", fontsize=_NAME_FONT,
            weight="bold", color=ALERT, zorder=7, parse_math=False,
            bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 0.8},
            ha="center", va="center", arrowprops={"arrowstyle": "-", "color": ALERT, "lw": 0.4, "shrinkB": 6},
        )  # fmt: skip
