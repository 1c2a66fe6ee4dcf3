"""Draws people from the front and from the side on one sheet: points, predicted and true skeletons.

Uses matplotlib's Agg canvas through its object interface, so that no global state (backend, current figure) is changed,
with its default settings; it is imported only when something is drawn.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.sample import Pose
from lidarpose.skeleton import SMPL24
from lidarpose.viz.person_view import (
    Panel,
    bone_pairs,
    bone_sides,
    box_edges,
    confidences,
    describe,
    facing_of,
    finite,
    is_known,
    middle,
    missing_pose,
    project,
    side,
    view_directions,
)

MAX_PEOPLE = 60  # more would make the sheet too large for a screen
MAX_POINTS_DRAWN = 3000  # per person; more points would only cover each other at this size

# blue and orange of Okabe and Ito's color-blind-safe palette (2008), the orange darker for contrast on white
BLUE, ORANGE = "#0072b2", "#e07000"
SIDE_COLORS = {"left": BLUE, "right": ORANGE, "center": "#2b2f36"}
# two shades per body side, which alternate along a limb so that neighboring parts differ
_PART_SHADES = {"left": ("#7db8dd", "#3b8fc4"), "right": ("#f5bd86", "#e8954a"), "center": ("#a9b0ba", "#7f8792")}
_NOT_BODY = "#dcb3cf"
_NEAR, _FAR = (0.45, 0.51, 0.57), (0.85, 0.87, 0.90)  # colors of points by depth: gray, as colors mark the skeleton
_TRUTH = "#4d545d"
INK, FAINT, HAIRLINE, ALERT = "#1f2328", "#7a828c", "#e3e6ea", "#b3261e"
_DASHES = (0, (3, 1.6))

# the sheet, in inches
_DPI = 100
_PER_ROW = 4
_CARD_WIDTH, _VIEW_HEIGHT, _CAPTION = 3.0, 2.4, 0.42
_GAP, _MARGIN, _RULER = 0.12, 0.16, 0.34
_TITLE, _LEGEND = 0.36, 0.3

_REACH = 2.5  # m: maximum extent of a view around the person; the rest is clipped
_TALLEST = 1.8  # m: minimum height of a view, so that most people on a sheet have the same scale
_DEPTH_SPAN = 0.35  # m in front of and behind the middle that the points' gray levels cover

_SETTINGS_LOCK = RLock()


@contextmanager
def default_settings() -> Iterator[None]:
    """Draws with matplotlib's default settings instead of the user's, which may need LaTeX or draw white on black. They
    are global, so one thread draws at a time."""
    from matplotlib import style

    with _SETTINGS_LOCK, style.context("default"), warnings.catch_warnings():
        # characters that the font lacks become boxes, without a warning
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


@default_settings()
def draw_people(panels: list[Panel], *, title: str = "", per_row: int = _PER_ROW) -> bytes:
    """Draws people from the front and from the side on one sheet.

    The front is the facing of the panel, else of the predicted pose, else of the true one, else +x. Left limbs are
    blue, right ones orange; bones with less confident ends are fainter and thinner.

    Args:
        panels: the people; at most the first 60 are drawn, which the sheet then states.
        title: printed at the top.
        per_row: number of people per row.

    Returns:
        The PNG's bytes.
    """
    from matplotlib.figure import Figure

    panels = list(panels)
    shown_panels = panels[:MAX_PEOPLE]
    columns = min(per_row, max(len(shown_panels), 1))
    rows = -(-max(len(shown_panels), 1) // columns)
    zoom = {1: 2.0, 2: 1.4}.get(columns, 1.0)
    card_width, card_height = _CARD_WIDTH * zoom, _VIEW_HEIGHT * zoom + _CAPTION
    width = columns * (card_width + _GAP) - _GAP + 2 * _MARGIN
    top = _MARGIN + (_TITLE if title or len(shown_panels) < len(panels) else 0) + _LEGEND
    height = top + rows * (card_height + _GAP) - _GAP + _MARGIN

    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    _draw_header(figure, panels, shown_panels, title)
    grid = {"left": _MARGIN / width, "right": 1 - _MARGIN / width, "wspace": _GAP / card_width}
    grid |= {"bottom": _MARGIN / height, "top": 1 - top / height, "hspace": _GAP / card_height}
    for i, ax in enumerate(figure.subplots(rows, columns, squeeze=False, gridspec_kw=grid).flat):
        ax.set(xticks=[], yticks=[], facecolor="white")
        ax.spines[:].set(color=HAIRLINE, linewidth=1)
        if i < len(shown_panels):
            _draw_card(ax, shown_panels[i], card_width, card_height)
        else:
            ax.set_axis_off()
    if not shown_panels:
        _text(figure, 0.5, 0.5, "no people", size=11, color=FAINT, ha="center")
    return png_of(figure)


def png_of(figure) -> bytes:
    """A matplotlib figure as the bytes of a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def stack_pictures(pictures: list[bytes]) -> bytes:
    """Stacks PNGs vertically in one PNG, with white beside the narrower ones."""
    from PIL import Image

    images = [Image.open(io.BytesIO(picture)).convert("RGB") for picture in pictures]
    sheet = Image.new("RGB", (max(i.width for i in images), sum(i.height for i in images)), "white")
    top = 0
    for image in images:
        sheet.paste(image, (0, top))
        top += image.height
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG")
    return buffer.getvalue()


def _text(artist, x: float, y: float, text: str, *, size: float, color: str = INK, **style) -> None:
    artist.text(x, y, text, fontsize=size, color=color, parse_math=False, **style)


def shortened(words: str, limit: int) -> str:
    # file names may contain lone surrogates, and fonts have no control characters
    words = " ".join("".join(c if c.isprintable() else " " for c in str(words)).split())
    # the ends of ids and paths are the most informative
    tail = (limit - 1) // 2
    return words if len(words) <= limit else f"{words[: limit - 1 - tail]}…{words[len(words) - tail :]}"


def _draw_header(figure, panels: list[Panel], shown_panels: list[Panel], title: str) -> None:
    """Draws the title, a note if people are omitted, and a legend."""
    width, height = figure.get_size_inches()
    left, top = _MARGIN / width, 1 - _MARGIN / height
    note = f"the first {len(shown_panels)} of {len(panels)} people" if len(shown_panels) < len(panels) else ""
    # a long title is smaller, a still longer one is shortened; letters are taken to be as wide as those of a hash
    room = (width - 2 * _MARGIN) / 0.127 - len(note)
    size = min(max(13 * room / max(len(title), 1), 8), 13)
    _text(figure, left, top, shortened(title, max(int(room * 13 / size), 12)), size=size, weight="bold", va="top")
    _text(figure, 1 - left, top - 0.03 / height, note, size=9, color=FAINT, va="top", ha="right")
    if handles := _legend_handles(shown_panels):
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(left, top - (_TITLE if title or note else 0) / height),
            borderaxespad=0,
            borderpad=0,
            ncols=len(handles),
            frameon=False,
            handlelength=1.3,
            handletextpad=0.5,
            columnspacing=1.3,
            labelcolor=INK,
            fontsize=8,
        )


def _legend_handles(panels: list[Panel]) -> list:
    from matplotlib.lines import Line2D

    parts = [part for panel in panels if (part := panel.part) is not None]
    dot: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4}
    entries: list[dict[str, Any]] = []
    if any(is_known(panel.pose) for panel in panels):
        entries += [{"label": name, "color": color, "lw": 2.6} for name, color in SIDE_COLORS.items()]
    if any(is_known(panel.truth) for panel in panels):
        entries.append({"label": "true", "color": _TRUTH, "lw": 1.2, "ls": _DASHES})
    if any((part > 0).any() for part in parts):
        entries += [{"label": f"{name} part", "color": color, **dot} for name, (_, color) in _PART_SHADES.items()]
    if any((part == 0).any() for part in parts):
        entries.append({"label": "background", "color": _NOT_BODY, **dot})
    if any(panel.part is None and len(panel.points) for panel in panels):
        entries += [{"label": "near point", "color": _NEAR, **dot}, {"label": "far point", "color": _FAR, **dot}]
    if any(facing_of(panel) is not None for panel in panels):
        entries.append({"label": "facing", "color": FAINT, "ls": "", "marker": ">", "ms": 4.5})
    return [Line2D([], [], **entry) for entry in entries]


def _draw_card(ax, panel: Panel, width: float, height: float) -> None:
    """Draws one person: caption, and the two views side by side in meters, with common ground and scale. The card is
    `width` x `height` inches."""
    from matplotlib.patches import Rectangle

    def write(words: str, *, up: float, right: float = width / 2, **style) -> None:
        _text(ax, right / width, up / height, words, ha="center", transform=ax.transAxes, **style)

    # the narrowest card is wide enough for a UUID
    write(shortened(panel.label, int(width / 0.083)), up=0.25, size=8.5, weight="bold")
    write(describe(panel), up=0.09, size=7.5, color=FAINT)
    anchor, note = middle(panel), missing_pose(panel)
    if anchor is None:
        write(note, up=(height + _CAPTION - 0.1) / 2, size=8, color=FAINT)
        return
    if note:
        write(note, up=height - 0.2, size=8, color=ALERT)

    forward = facing_of(panel)
    directions = view_directions(forward)
    extents = [_extent(panel, anchor, seen_from=direction) for direction in directions]
    low, high = extents[0][:, 1]
    spans = [max(extent[1, 0] - extent[0, 0], 0.5) for extent in extents]
    room, view_height = width - _RULER - 0.2, height - _CAPTION - 0.4
    scale = max(sum(spans) / room, (high - low) / view_height, _TALLEST / view_height)  # meters per inch
    margin = (room * scale - sum(spans)) / 2
    ground = _CAPTION + 0.1
    ax.set(xlim=(0, width * scale), ylim=(low - ground * scale, low + (height - ground) * scale))
    left = 0.1 * scale
    names = ("from +x", "from −y") if forward is None else ("front", "side")
    for direction, name, extent, span in zip(directions, names, extents, spans, strict=True):
        right = left + span + margin
        shift = (left + right) / 2 - extent[:, 0].mean()
        ax.plot([left, right], [low, low], color=HAIRLINE, lw=1.2, zorder=1)
        window = Rectangle(
            (left, low - 0.08 * scale), right - left, (view_height + 0.16) * scale, transform=ax.transData
        )
        _draw_view(ax, panel, seen_from=direction, shift=shift, window=window)
        if not note:
            write(name, up=height - 0.2, right=(left + right) / 2 / scale, size=7, color=FAINT)
        if forward is not None:
            x = project(anchor, seen_from=direction)[0] + shift
            _draw_arrow(ax, x, low - 0.045 * scale, 0.12 * scale, towards_viewer=float(forward @ direction) > 0.5)
        left = right + _RULER * scale
    # a bar of one meter between the views
    x = (0.1 + _RULER / 2) * scale + spans[0] + margin
    ax.plot([x, x], [low, low + 1], color=FAINT, lw=0.9, marker="_", ms=5)
    _text(ax, x - 0.06 * scale, low + 0.5, "1 m", size=6.5, color=FAINT, rotation=90, ha="right", va="center")


def _extent(panel: Panel, anchor: np.ndarray, *, seen_from: np.ndarray) -> np.ndarray:
    """(2, 2) m: minimum and maximum (right, up) that a view has to show."""
    clouds = [finite(pose.joints) for pose in (panel.pose, panel.truth) if pose is not None]
    if panel.box is not None:
        clouds.append(box_edges(panel.box).reshape(-1, 3))
    views = [project(cloud, seen_from=seen_from) for cloud in clouds]
    if len(points := finite(panel.points)):
        # a few outlying points must not shrink the person
        views.append(np.percentile(project(points, seen_from=seen_from), (1, 99), axis=0))
    view = np.concatenate(views)[:, :2]
    center = project(anchor, seen_from=seen_from)[:2]
    extent = np.clip([view.min(0), view.max(0)], center - _REACH, center + _REACH)
    return extent + np.array([[-0.08, 0], [0.08, 0.05]])


def _draw_view(ax, panel: Panel, *, seen_from: np.ndarray, shift: float, window) -> None:
    """Draws one view, moved to the right by `shift` m and clipped to the rectangle `window`."""
    from matplotlib.collections import LineCollection

    def place(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions of points on the card, and their nearness to the viewer."""
        view = project(points, seen_from=seen_from)
        return view[..., :2] + [shift, 0], view[..., 2]

    def add_lines(segments, **style) -> None:
        ax.add_collection(LineCollection(segments, **style), autolim=False).set_clip_path(window)

    if panel.box is not None:
        add_lines(place(box_edges(panel.box))[0], zorder=1.5, colors=HAIRLINE, linewidths=1.0)
    rows = np.flatnonzero(np.isfinite(panel.points).all(-1))
    rows = rows[evenly_spaced(len(rows), MAX_POINTS_DRAWN)]
    if len(rows):
        positions, depth = place(panel.points[rows])
        order = np.argsort(depth, kind="stable")
        colors = _depth_colors(depth) if panel.part is None else _part_colors(panel.part[rows])
        area = np.clip(60 / np.sqrt(len(rows)), 1.8, 9)
        ax.scatter(*positions[order].T, s=area, c=colors[order], linewidths=0, zorder=2).set_clip_path(window)
    if is_known(panel.truth):
        bones = place(panel.truth.joints)[0][bone_pairs(panel.truth.skeleton)]
        add_lines(bones, zorder=3, colors=_TRUTH, linewidths=1.2, linestyles=[_DASHES])
    if is_known(panel.pose):
        positions, depth = place(panel.pose.joints)
        segments, style = _bones(panel.pose, positions, depth)
        add_lines(segments, zorder=4, capstyle="round", **style)
        is_finite = np.isfinite(positions).all(-1)
        weight = confidences(panel.pose)[is_finite]
        ax.scatter(
            *positions[is_finite].T,
            s=3 + 5 * weight,
            c=np.array([SIDE_COLORS[side(name)] for name in panel.pose.skeleton.joints])[is_finite],
            edgecolors="white",
            linewidths=0.4,
            alpha=0.25 + 0.75 * weight,
            zorder=5,
        ).set_clip_path(window)


def _draw_arrow(ax, x: float, y: float, length: float, *, towards_viewer: bool) -> None:
    """Draws the facing: a dot in a ring towards the viewer, else an arrow to the right."""
    if towards_viewer:
        ax.plot(x, y, ls="", marker="o", ms=5, mfc="white", mec=FAINT, mew=0.9, zorder=6)
        ax.plot(x, y, ls="", marker="o", ms=1.6, color=FAINT, mew=0, zorder=7)
    else:
        ax.plot([x - length, x + length], [y, y], color=FAINT, lw=1.1, marker=">", ms=4, mew=0, markevery=[1], zorder=6)


def _bones(pose: Pose, positions: np.ndarray, depth: np.ndarray) -> tuple[list[np.ndarray], dict[str, list]]:
    """Segments in drawing order, far ones first, each on a white one that separates it from those behind."""
    from matplotlib.colors import to_rgba

    pairs, sides, weight = bone_pairs(pose.skeleton), bone_sides(pose.skeleton), confidences(pose)
    segments, colors, widths = [], [], []
    for k in np.argsort(depth[pairs].sum(1), kind="stable"):
        mean = weight[pairs[k]].mean()
        line_width = 1.0 + 1.8 * mean
        segments += [positions[pairs[k]]] * 2
        colors += [to_rgba("white", 0.7 * mean), to_rgba(SIDE_COLORS[sides[k]], 0.25 + 0.75 * mean)]
        widths += [line_width + 0.9, line_width]
    return segments, {"colors": colors, "linewidths": widths}


def _depth_colors(depth: np.ndarray) -> np.ndarray:
    """Colors (n, 3) in [0, 1]: near points dark, far ones light."""
    nearness = np.clip(0.5 + (depth - np.median(depth)) / (2 * _DEPTH_SPAN), 0, 1)[:, None]
    return nearness * np.array(_NEAR) + (1 - nearness) * np.array(_FAR)


def _part_colors(part: np.ndarray) -> np.ndarray:
    """part (n,), 0 = background, 1 + j = SMPL-24's joint j -> colors (n, 3) in [0, 1]: the side's shades in turn."""
    from matplotlib.colors import to_rgb

    level = [0] * len(SMPL24)
    table = [to_rgb(_NOT_BODY)]
    for j, parent in enumerate(SMPL24.parents):
        level[j] = level[parent] + 1 if parent >= 0 else 0
        table.append(to_rgb(_PART_SHADES[side(SMPL24.joints[j])][level[j] % 2]))
    return np.array(table)[np.clip(part, 0, len(SMPL24)).astype(int)]
