"""People drawn from the front and from the side, on one sheet: points, predicted and true skeletons.

Drawn with matplotlib's Agg canvas through its object interface, so that no global state (backend, current figure) is
touched; matplotlib is imported only when something is drawn.
"""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.io.files import check_suffix, write_atomic
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import SMPL24
from lidarpose.viz.person_view import (
    bone_sides,
    check_person,
    confidences,
    describe,
    facing_of,
    is_known,
    middle,
    missing_pose,
    project,
    side,
    thinned,
    view_directions,
)

MAX_PEOPLE = 60  # more would make a sheet that no screen shows
MAX_POINTS_DRAWN = 3000  # a person; more only cover each other at this size

# blue and orange of Okabe and Ito's color-blind-safe palette (2008), the orange darker to stand out on white
SIDE_COLORS = {"left": "#0072b2", "right": "#e07000", "center": "#2b2f36"}
# by body side, two shades that alternate along a limb, so that neighbouring parts differ
_PART_SHADES = {"left": ("#7db8dd", "#3b8fc4"), "right": ("#f5bd86", "#e8954a"), "center": ("#a9b0ba", "#7f8792")}
_NOT_BODY = "#dcb3cf"
_NEAR, _FAR = (0.45, 0.51, 0.57), (0.85, 0.87, 0.90)  # points by depth: gray, to leave the colors to the skeleton
_TRUTH, _INK, _FAINT, _HAIRLINE = "#4d545d", "#1f2328", "#7a828c", "#e3e6ea"

# the sheet, in inches
_DPI = 100
_PER_ROW = 4
_CARD_WIDTH, _VIEW_HEIGHT, _CAPTION = 3.0, 2.4, 0.42
_GAP, _MARGIN, _RULER = 0.12, 0.16, 0.34
_TITLE, _LEGEND = 0.36, 0.3

_REACH = 2.5  # m around the person that a view may show; what lies farther out is cut
_TALLEST = 1.8  # m that a view's height shows at least, so that people on a sheet share one scale
_DEPTH_SPAN = 0.35  # m in front of and behind the middle, over which the points' gray runs


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One person to draw.

    points (n, 3) m, z up, n = 0 is legal; pose and truth of one person in the points' frame, joints (J, 3) m, a joint
    that is not finite is left out; part (n,) int, 0 = not body, 1 + j = the bone of SMPL-24's joint j, colors the
    points; distance m is printed, by default that of the person from the frame's origin, none for NaN. Raises
    InputError on a wrong shape.
    """

    points: np.ndarray
    pose: Pose | None = None
    truth: Pose | None = None
    label: str = ""
    part: np.ndarray | None = None
    box: Box | None = None
    distance: float | None = None

    def __post_init__(self):
        check_person(self, "Panel")


def draw_people(panels: list[Panel], path: str | Path | None = None, *, title: str = "") -> bytes:
    """People from the front and from the side on one sheet, at most the first 60. Returns the PNG's bytes.

    The front is where the predicted pose looks to, else the true one, else +x. Left limbs are blue, right ones
    orange; a bone is the fainter and thinner the less confident its ends are. Writes `path` too where given.
    """
    from matplotlib.figure import Figure

    if path is not None:
        check_suffix(path, ".png")
    panels = list(panels)
    shown = panels[:MAX_PEOPLE]
    columns = min(_PER_ROW, max(len(shown), 1))
    rows = -(-max(len(shown), 1) // columns)
    zoom = {1: 2.0, 2: 1.4}.get(columns, 1.0)
    card_width, card_height = _CARD_WIDTH * zoom, _VIEW_HEIGHT * zoom + _CAPTION
    width = columns * (card_width + _GAP) - _GAP + 2 * _MARGIN
    top = _MARGIN + (_TITLE if title or len(shown) < len(panels) else 0) + _LEGEND
    height = top + rows * (card_height + _GAP) - _GAP + _MARGIN

    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.set_axis_off()
    _header(ax, panels, shown, title=title, at=(_MARGIN, height - _MARGIN))
    for i, panel in enumerate(shown):
        row, column = divmod(i, columns)
        left = _MARGIN + column * (card_width + _GAP)
        bottom = height - top - row * (card_height + _GAP) - card_height
        _card(ax, panel, at=(left, bottom), size=(card_width, card_height))
    if not shown:
        _text(ax, width / 2, _MARGIN + card_height / 2, "no people", size=11, color=_FAINT, ha="center")

    return png_of(figure, path)


def png_of(figure, path: str | Path | None) -> bytes:
    """A matplotlib figure as the bytes of a PNG, whatever the user's savefig settings; also written to `path`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # letters that the font lacks become boxes; no warning for the user
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    if path is not None:
        write_atomic(path, buffer.getvalue())
    return buffer.getvalue()


def _text(ax, x: float, y: float, words: str, *, size: float, color: str = _INK, **more) -> None:
    ax.text(x, y, words, fontsize=size, color=color, family="DejaVu Sans", parse_math=False, usetex=False, **more)


def _shortened(words: str, limit: int) -> str:
    # names of files may hold lone surrogates, and no font draws control letters
    words = " ".join("".join(c if c.isprintable() else " " for c in str(words)).split())
    # ids and paths tell most by their ends
    tail = (limit - 1) // 2
    return words if len(words) <= limit else f"{words[: limit - 1 - tail]}…{words[len(words) - tail :]}"


def _header(ax, panels: list[Panel], shown: list[Panel], *, title: str, at: tuple[float, float]) -> None:
    from matplotlib.lines import Line2D

    x, y = at
    width = ax.get_xlim()[1] - 2 * x
    note = f"the first {len(shown)} of {len(panels)} people" if len(shown) < len(panels) else ""
    if title:
        # a hash fits
        room = int(width / 0.127) - len(note)
        _text(ax, x, y, _shortened(title, max(room, 12)), size=13, weight="bold", va="top")
    if note:
        _text(ax, x + width, y - 0.03, note, size=9, color=_FAINT, va="top", ha="right")
    handles = []
    if any(is_known(p.pose) for p in shown):
        for name, color in SIDE_COLORS.items():
            handles.append(Line2D([], [], color=color, lw=2.6, label=name))
    if any(is_known(p.truth) for p in shown):
        handles.append(Line2D([], [], color=_TRUTH, lw=1.2, ls=(0, (3, 1.6)), label="true"))
    dot: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4}
    if any(p.part is not None and (p.part > 0).any() for p in shown):
        for name, (_, color) in _PART_SHADES.items():
            handles.append(Line2D([], [], color=color, label=f"{name} part", **dot))
    if any(p.part is not None and (p.part == 0).any() for p in shown):
        handles.append(Line2D([], [], color=_NOT_BODY, label="background", **dot))
    if any(p.part is None and len(p.points) for p in shown):
        handles.append(Line2D([], [], color=_NEAR, label="near point", **dot))
        handles.append(Line2D([], [], color=_FAR, label="far point", **dot))
    if any(facing_of(p) is not None for p in shown):
        handles.append(Line2D([], [], color=_FAINT, ls="", marker=">", ms=4.5, label="facing"))
    if handles:
        legend = ax.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(x, y - (_TITLE if title or note else 0)),
            bbox_transform=ax.transData,
            borderaxespad=0,
            borderpad=0,
            ncols=len(handles),
            frameon=False,
            handlelength=1.3,
            handletextpad=0.5,
            columnspacing=1.3,
            labelcolor=_INK,
            prop={"family": "DejaVu Sans", "size": 8},
        )
        legend.set_clip_on(False)


def _box_edges(box: Box) -> np.ndarray:
    """(12, 2, 3) m: the edges of a box."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * box.size / 2
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    corner = corner @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + box.center
    return np.array([corner[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit])


def _card(ax, panel: Panel, *, at: tuple[float, float], size: tuple[float, float]) -> None:
    """One person: frame, caption, and the two views side by side on a common ground and scale."""
    from matplotlib.patches import FancyBboxPatch

    (left, bottom), (width, height) = at, size
    frame = FancyBboxPatch(
        at, width, height, boxstyle="round,pad=0,rounding_size=0.06", fc="white", ec=_HAIRLINE, lw=1, zorder=0
    )
    ax.add_patch(frame)
    center = left + width / 2
    # a UUID fits on the narrowest card
    letters = int(width / 0.083)
    _text(ax, center, bottom + 0.25, _shortened(panel.label, letters), size=8.5, weight="bold", ha="center")
    _text(ax, center, bottom + 0.09, describe(panel), size=7.5, color=_FAINT, ha="center")

    anchor = middle(panel)
    note = missing_pose(panel)
    view_height = height - _CAPTION - 0.1
    if anchor is None:
        _text(ax, center, bottom + _CAPTION + view_height / 2, note, size=8, color=_FAINT, ha="center")
        return
    forward = facing_of(panel)
    directions = view_directions(forward)
    names = ("from +x", "from −y") if forward is None else ("front", "side")
    if note:
        _text(ax, center, bottom + height - 0.2, note, size=8, color="#b3261e", ha="center")

    # both views share the scale and the ground, the lowest point or joint
    extents = [_extent(panel, anchor, seen_from=d) for d in directions]
    low, high = extents[0][:, 1]
    spans = [max(e[1, 0] - e[0, 0], 0.5) for e in extents]
    room = width - _RULER - 0.2
    top_space = 0.2  # inches for the names of the views
    ground = bottom + _CAPTION + 0.1
    tall = view_height - top_space - 0.1
    scale = max(sum(spans) / room, (high - low) / tall, _TALLEST / tall)  # meters an inch
    spare = (room - sum(spans) / scale) / 2
    edge = left + 0.1
    for view, (direction, name) in enumerate(zip(directions, names, strict=True)):
        wide = spans[view] / scale + spare
        center_u = extents[view][:, 0].mean()
        origin = np.array([edge + wide / 2 - center_u / scale, ground - low / scale])
        window = (edge, ground - 0.08, wide, tall + 0.16)
        _text(ax, edge + wide / 2, bottom + height - 0.2, "" if note else name, size=7, color=_FAINT, ha="center")
        _view(ax, panel, seen_from=direction, origin=origin, scale=scale, ground=ground, window=window)
        if forward is not None:
            x = project(anchor, seen_from=direction)[0] / scale + origin[0]
            _arrow(ax, x, ground, towards_viewer=float(forward @ direction) > 0.5)
        edge += wide + _RULER
        if view == 0:
            _ruler(ax, edge - _RULER / 2, ground, 1 / scale)


def _extent(panel: Panel, anchor: np.ndarray, *, seen_from: np.ndarray) -> np.ndarray:
    """(2, 2) m: the lowest and highest (right, up) that a view has to show."""
    clouds = []
    points = panel.points[np.isfinite(panel.points).all(-1)]
    if len(points):
        # single far points must not shrink the person
        clouds.append(np.percentile(project(points, seen_from=seen_from), (1, 99), axis=0)[:, :2])
    for pose in (panel.pose, panel.truth):
        if is_known(pose):
            clouds.append(project(pose.joints[np.isfinite(pose.joints).all(-1)], seen_from=seen_from)[:, :2])
    if panel.box is not None:
        clouds.append(project(_box_edges(panel.box).reshape(-1, 3), seen_from=seen_from)[:, :2])
    cloud = np.concatenate(clouds)
    at = project(anchor, seen_from=seen_from)[:2]
    extent = np.clip([cloud.min(0), cloud.max(0)], at - _REACH, at + _REACH)
    return extent + np.array([[-0.08, 0], [0.08, 0.05]])


def _ruler(ax, x: float, ground: float, meter: float) -> None:
    """A bar of one metre, `meter` inches long, that stands on the ground."""
    tick = 0.03
    ax.plot(
        [x - tick, x + tick, x, x, x - tick, x + tick],
        [ground, ground, ground, ground + meter, ground + meter, ground + meter],
        color=_FAINT,
        lw=0.9,
        solid_capstyle="butt",
    )
    _text(ax, x - 0.06, ground + meter / 2, "1 m", size=6.5, color=_FAINT, rotation=90, ha="right", va="center")


def _view(ax, panel: Panel, *, seen_from, origin, scale, ground, window) -> None:
    """One view; `origin` is where (right, up) = 0 lies, in inches, `window` (left, bottom, width, height) cuts."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    clip = Rectangle(window[:2], *window[2:], transform=ax.transData)

    def placed(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = project(points, seen_from=seen_from)
        return flat[..., :2] / scale + origin, flat[..., 2]

    def add_lines(segments, *, zorder, **style) -> None:
        lines = LineCollection(segments, zorder=zorder, **style)
        ax.add_collection(lines, autolim=False)
        lines.set_clip_path(clip)

    ax.plot([window[0], window[0] + window[2]], [ground, ground], color=_HAIRLINE, lw=1.2, zorder=1)
    if panel.box is not None:
        add_lines(placed(_box_edges(panel.box))[0], zorder=1.5, colors=_HAIRLINE, linewidths=1.0)

    keep = np.flatnonzero(np.isfinite(panel.points).all(-1))
    keep = keep[thinned(len(keep), MAX_POINTS_DRAWN)]
    if len(keep):
        at, depth = placed(panel.points[keep])
        order = np.argsort(depth, kind="stable")
        colors = _depth_colors(depth) if panel.part is None else _part_colors(panel.part[keep])
        area = np.clip(60 / np.sqrt(len(keep)), 1.8, 9)
        dots = ax.scatter(*at[order].T, s=area, c=colors[order], linewidths=0, zorder=2)
        dots.set_clip_path(clip)

    if is_known(panel.truth):
        at, _ = placed(panel.truth.joints)
        bones = [at[[a, b]] for a, b in panel.truth.skeleton.bones if np.isfinite(at[[a, b]]).all()]
        add_lines(bones, zorder=3, colors=_TRUTH, linewidths=1.2, linestyles=[(0, (3, 1.6))])
    if is_known(panel.pose):
        at, depth = placed(panel.pose.joints)
        segments, styles = _bones(panel.pose, at, depth)
        add_lines(segments, zorder=4, capstyle="round", **styles)
        known = np.isfinite(at).all(-1)
        weight = confidences(panel.pose)[known]
        side_colors = [SIDE_COLORS[side(name)] for name in panel.pose.skeleton.joints]
        dots = ax.scatter(
            *at[known].T,
            s=3 + 5 * weight,
            c=[c for c, k in zip(side_colors, known, strict=True) if k],
            edgecolors="white",
            linewidths=0.4,
            alpha=0.25 + 0.75 * weight,
            zorder=5,
        )
        dots.set_clip_path(clip)


def _arrow(ax, x: float, ground: float, *, towards_viewer: bool) -> None:
    """Where the person looks, on the ground: a dot in a ring comes towards the viewer, else it goes right."""
    y = ground - 0.045
    if towards_viewer:
        ax.plot([x], [y], ls="", marker="o", ms=5, mfc="white", mec=_FAINT, mew=0.9, zorder=6)
        ax.plot([x], [y], ls="", marker="o", ms=1.6, color=_FAINT, mew=0, zorder=7)
    else:
        ax.plot([x - 0.12, x + 0.12], [y, y], color=_FAINT, lw=1.1, zorder=6)
        ax.plot([x + 0.14], [y], ls="", marker=">", ms=4, color=_FAINT, mew=0, zorder=7)


def _bones(pose: Pose, at: np.ndarray, depth: np.ndarray) -> tuple[list[np.ndarray], dict[str, list]]:
    """Segments in the order of drawing, far ones first, each over a white one that parts it from what lies behind."""
    from matplotlib.colors import to_rgba

    weight = confidences(pose)
    segments, colors, widths = [], [], []
    bones = [
        (depth[a] + depth[b], a, b, s) for (a, b), s in zip(pose.skeleton.bones, bone_sides(pose.skeleton), strict=True)
    ]
    for _, a, b, s in sorted(bone for bone in bones if np.isfinite(at[[bone[1], bone[2]]]).all()):
        mean = (weight[a] + weight[b]) / 2
        line = 1.0 + 1.8 * mean
        segments += [at[[a, b]], at[[a, b]]]
        colors += [to_rgba("white", 0.7 * mean), to_rgba(SIDE_COLORS[s], 0.25 + 0.75 * mean)]
        widths += [line + 0.9, line]
    return segments, {"colors": colors, "linewidths": widths}


def _depth_colors(depth: np.ndarray) -> np.ndarray:
    """(n, 3) in [0, 1]: near points dark, far ones light."""
    near = np.clip(0.5 + (depth - np.median(depth)) / (2 * _DEPTH_SPAN), 0, 1)[:, None]
    return near * np.array(_NEAR) + (1 - near) * np.array(_FAR)


def _part_colors(part: np.ndarray) -> np.ndarray:
    """part (n,), 0 = not body, 1 + j = SMPL-24's joint j -> (n, 3) in [0, 1]: the body side's two shades in turn."""
    from matplotlib.colors import to_rgb

    level = [0] * len(SMPL24)
    table = [to_rgb(_NOT_BODY)]
    for j, parent in enumerate(SMPL24.parents):
        level[j] = level[parent] + 1 if parent >= 0 else 0
        table.append(to_rgb(_PART_SHADES[side(SMPL24.joints[j])][level[j] % 2]))
    return np.array(table)[np.clip(part, 0, len(SMPL24)).astype(int)]
