"""Charts of an evaluation: errors by group of people and by joint, reliability, stability, people with large errors.

Drawn with matplotlib's Agg canvas and default settings, as in `viz.draw`; every function returns the bytes of a PNG.
"""

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np

from lidarpose.eval.dataset import EvalSample
from lidarpose.eval.predictions import Predictions
from lidarpose.eval.robustness import Curve, End, Stability
from lidarpose.eval.scores import BASELINE, OURS, Result, Setting
from lidarpose.sample import CONFIDENCE_RADIUS, Pose
from lidarpose.viz.draw import BLUE, FAINT, HAIRLINE, INK, ORANGE, Panel, default_settings, draw_people, png_of

# one color per network, from the palette of Okabe and Ito
_PALETTE = (BLUE, ORANGE, "#009e73", "#cc79a7", "#56b4e9", "#7a828c", "#b59a00")
_BAR, _GRAY = "#c9deec", "#9aa3ad"
_DPI = 100
_BINS = 10
# bin edges of the predicted spread, m, for comparing it with the true error
_SPREADS = (0.0, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, np.inf)
# bins with fewer joints than this are not drawn
_FEWEST = 20


@default_settings()
def draw_errors(result: Result) -> bytes:
    """MPJPE by distance, number of points, hidden share, joint and points near the joint, with intervals and numbers of
    people."""
    panels = {
        "distance, m": ("by distance from the sensor, m", "the sensor's position is not known"),
        "points": ("by number of points", "nobody"),
        "hidden share": ("by hidden share", "the dataset has no labels of hidden points"),
        "joints": ("by joint", "nobody"),
        "points near the joint": ("by number of points within 15 cm of the joint", "nobody"),
    }
    layout = [["distance, m", "points", "hidden share"], ["joints", "joints", "points near the joint"]]
    setting = result.setting
    figure = _figure(12.8, 6.6, f"{setting.dataset}: MPJPE of {setting.method}, mm", setting.summary)
    rows = [row for row in result.lines if row.figure == "mpjpe" and row.arithmetic == OURS and row.value is not None]
    overall_values = {row.method: row.value for row in rows if row.group == "all" and row.value is not None}
    for group, axes in figure.subplot_mosaic(layout).items():
        title, empty_text = panels[group]
        axes.set_title(title, fontsize=10, loc="left", color=INK)
        group_rows = [row for row in rows if row.group == group and row.method == setting.method]
        if not group_rows:
            _empty(axes, empty_text)
            continue
        values, low, high = _intervals(group_rows, "value")
        names = [f"{row.of}\n{row.people:,}" for row in group_rows]
        _bars(axes, values, low, high, names, [f"{value:.0f}" for value in values])
        for method, value in overall_values.items():
            if method == setting.method:
                _level(axes, value, f"all {value:.1f}", INK)
            elif value < axes.get_ylim()[1] * 1.6:
                axes.set_ylim(0, max(axes.get_ylim()[1], value * 1.12))
                _level(axes, value, method.removeprefix(BASELINE), ORANGE)
    return png_of(figure)


@default_settings()
def draw_reliability(predictions: Predictions, result: Result) -> bytes | None:
    """Predicted confidence against the share of joints within 10 cm, and predicted spread against the true error.

    Returns None if no labeled joint has both a confidence and a spread.
    """
    people = predictions.select(~predictions.moving)
    error = people.errors()
    is_stated = ~np.isnan(error) & ~np.isnan(people.confidence) & ~np.isnan(people.spread)
    if not is_stated.any():
        return None
    error, confidence, spread = (
        error[is_stated],
        people.confidence[is_stated].astype(float),
        people.spread[is_stated].astype(float),
    )
    setting = result.setting
    title = f"{setting.dataset}: confidence and spread predicted by {setting.method}"
    left_axes, right_axes = (figure := _figure(9.0, 4.3, title, setting.summary)).subplots(1, 2)
    _confidence(left_axes, confidence, error < 1e3 * CONFIDENCE_RADIUS, result)
    _spread(right_axes, spread * 1e3, error)
    return png_of(figure)


@default_settings()
def draw_stability(study: Stability) -> bytes:
    """The curves of a study, the other sensors, and the end-joint errors of the people with the largest errors."""
    columns, count = 4, len(study.curves) + bool(study.ends)
    rows = -(-count // columns)
    title = f"{study.setting.method}, points perturbed: MPJPE of {study.who}, mm"
    figure = _figure(13.6, 0.5 + 3.0 * rows, title, study.setting.summary)
    axes = iter(np.ravel(figure.subplots(rows, columns)))
    curves = [curve for curve in study.curves if curve.name != "sensors"]
    values = [p.high or p.mpjpe for curve in curves for p in curve.points if p.mpjpe is not None]
    for curve in study.curves:
        if all(point.mpjpe is None for point in curve.points):
            _empty(next(axes), "no person has a pose", curve.title)
        elif curve.name == "sensors":
            _sensors(next(axes), curve)
        else:
            _curve(next(axes), curve, 1.08 * max(values))
    if study.ends:
        _end_joints(next(axes), study.ends)
    for unused_axes in axes:
        unused_axes.set_axis_off()
    return png_of(figure)


@default_settings()
def compare_stability(studies: dict[str, dict[str, Any]]) -> bytes:
    """Curves of several networks in one chart. Paper: Figure 7.

    Args:
        studies: name of a network -> a study of stability.json.
    """
    names, first_study = ("jitter", "clusters"), next(iter(studies.values()))
    figure = _figure(5.2 * len(names), 4.2, "points perturbed: MPJPE in mm", _scored(first_study["who"], first_study))
    for axes, name in zip(np.ravel(figure.subplots(1, len(names))), names, strict=True):
        for (network, study), color in zip(studies.items(), cycle(_PALETTE), strict=False):
            curve = next(curve for curve in study["curves"] if curve["name"] == name)
            # an amount at which no person has a pose leaves a gap; the others keep their positions
            values = [np.nan if point["mpjpe"] is None else point["mpjpe"] for point in curve["points"]]
            axes.plot(values, "o-", color=color, ms=4, lw=1.5, label=network)
            axes.set_xticks(range(len(values)), [point["label"] for point in curve["points"]], fontsize=8)
            title = curve["title"]
        axes.set_ylim(0, None)
        _styled(axes, title)
    # below the axes, where it cannot cover a curve
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, frameon=False, ncols=3, loc="outside lower center")
    return png_of(figure)


@default_settings()
def compare_ends(studies: dict[str, dict[str, Any]]) -> bytes:
    """End-joint errors over the people with the largest errors, for several networks: means, and quartiles as lines.
    Paper: Figure 8.

    Args:
        studies: as in `compare_stability`.
    """
    first_study = next(iter(studies.values()))
    subtitle = _scored(first_study["setting"]["dataset"], first_study)
    figure = _figure(9.6, 4.4, "end joints of each network's worst people: error in mm", subtitle)
    axes, width = figure.subplots(), 0.8 / max(len(studies), 1)
    for k, ((network, study), color) in enumerate(zip(studies.items(), cycle(_PALETTE), strict=False)):
        ends = study["ends"]
        positions = np.arange(len(ends)) + (k - (len(studies) - 1) / 2) * width
        axes.bar(positions, [end["mean"] for end in ends], 0.9 * width, color=color, label=network, zorder=2)
        low, _, high = np.array([end["quartiles"] for end in ends]).T
        axes.vlines(positions, low, high, color=INK, lw=1, zorder=3)
        axes.set_xticks(np.arange(len(ends)), [f"{end['group']}\nworst {end['worst']:,}" for end in ends])
    _styled(axes, "means; lines from the lower to the upper quartile")
    axes.legend(fontsize=8, frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, -0.32))
    return png_of(figure)


def _scored(people: str, study: dict[str, Any]) -> str:
    """The subtitle: which people were scored, and the protocol, which all studies in a chart share."""
    return f"{people} · protocol {study['setting']['protocol']}"


def draw_worst(p: Predictions, setting: Setting, worst: Sequence[tuple[EvalSample, int]]) -> bytes:
    """The people with the largest mean errors: points, predicted pose and true pose.

    Args:
        worst: people and their rows in the predictions.
    """
    errors = p.errors()
    panels = []
    for person, k in worst:
        where = f"{p.sequence[k]} {p.frame[k]} {p.track[k]}"
        if p.sensor[k]:
            where = f"#{p.row[k]} {p.condition[k] or p.sensor[k]}"
        confidence = None if np.isnan(p.confidence[k]).any() else p.confidence[k].astype(float)
        pose = Pose(joints=p.pred[k].astype(float), skeleton=p.skeleton, confidence=confidence)
        truth = Pose(joints=p.true[k].astype(float), skeleton=p.skeleton)
        label, distance = f"{np.nanmean(errors[k]):.0f} mm · {where}", float(p.distance[k])
        panels.append(Panel(points=person.points, label=label, distance=distance, pose=pose, truth=truth))
    title = f"{setting.dataset}: the {len(panels)} largest mean errors of {setting.method} · {setting.summary}"
    return draw_people(panels, title=title)


# ---- panels


def _bars(axes, values: np.ndarray, low, high, names: list[str], texts: list[str], *, horizontal: bool = False) -> None:
    """Draws one bar per value with its interval and a text at its end, vertical or `horizontal`."""
    positions = np.arange(len(values))
    (axes.barh if horizontal else axes.bar)(positions, values, 0.7, color=_BAR, zorder=1)
    (axes.hlines if horizontal else axes.vlines)(positions, low, high, color=BLUE, lw=1.6, zorder=4)
    axes.plot(*((values, positions) if horizontal else (positions, values)), "o", ms=4, color=BLUE, zorder=5)
    ends = np.maximum(values, high)
    for k, end, text in zip(positions, ends, texts, strict=True):
        anchor, offset = ((end, k), (4, -3)) if horizontal else ((k, end), (0, 4))
        annotation = _text(axes, text, anchor, offset, ha="left" if horizontal else "center", zorder=6)
        annotation.set_bbox({"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6})
    (axes.set_yticks if horizontal else axes.set_xticks)(positions, names, fontsize=7.5)
    (axes.set_xlim if horizontal else axes.set_ylim)(0, 1.18 * ends.max())
    # fewer than four bars are as wide as four would be
    margin = max(4 - len(positions), 0) / 2
    (axes.set_ylim if horizontal else axes.set_xlim)(-0.6 - margin, len(positions) - 0.4 + margin)
    _styled(axes, grid="x" if horizontal else "y")


def _confidence(axes, confidence: np.ndarray, is_hit: np.ndarray, result: Result) -> None:
    index = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    count = np.bincount(index, minlength=_BINS)
    is_populated = count >= _FEWEST
    mean = np.bincount(index, confidence, _BINS)[is_populated] / count[is_populated]
    share = np.bincount(index, is_hit.astype(float), _BINS)[is_populated] / count[is_populated]
    centers = (np.arange(_BINS) + 0.5) / _BINS
    axes.bar(centers, count / count.sum(), 0.092, color=_BAR, label="share of joints", zorder=1)
    axes.plot([0, 1], [0, 1], color=_GRAY, lw=0.9, zorder=2)
    axes.plot(mean, share, "o-", color=BLUE, ms=4.5, lw=1.4, label="within 10 cm", zorder=3)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    values = {row.figure: row.value for row in result.lines if row.group == "all"}
    title = f"expected calibration error {values['calibration_error']:.1f} %"
    if (auroc := values.get("auroc")) is not None:
        title += f", AUROC {auroc / 100:.3f}"
    _styled(axes, title, xlabel="predicted confidence", legend=True)


def _spread(axes, spread: np.ndarray, error: np.ndarray) -> None:
    edges = 1e3 * np.array(_SPREADS)
    index = np.digitize(spread, edges) - 1
    bins = [index == k for k in range(len(edges) - 1) if (index == k).sum() >= _FEWEST]
    spread_means, error_means = (np.array([values[rows].mean() for rows in bins]) for values in (spread, error))
    quartiles = np.array([np.quantile(error[rows], [0.25, 0.75]) for rows in bins]).reshape(-1, 2)
    top = 1.1 * max([*spread_means, *error_means, *quartiles[:, 1], 1.0])
    axes.plot([0, top], [0, top], color=_GRAY, lw=0.9, zorder=2)
    axes.fill_between(spread_means, *quartiles.T, color=_BAR, lw=0, label="middle half", zorder=1)
    axes.plot(spread_means, error_means, "o-", color=BLUE, ms=4.5, lw=1.4, label="mean", zorder=3)
    axes.set(xlim=(0, top), ylim=(0, top))
    title = f"spread {spread.mean():.0f} mm predicted, {error.mean():.0f} mm true"
    _styled(axes, title, xlabel="predicted spread, mm", ylabel="true error, mm", legend=True)


def _curve(axes, curve: Curve, top: float) -> None:
    # the amounts are not evenly spaced, but each is one step on the axis
    positions = np.array([k for k, point in enumerate(curve.points) if point.mpjpe is not None])
    points = [curve.points[k] for k in positions]
    values, low, high = _intervals(points, "mpjpe")
    axes.fill_between(positions, low, high, color=_BAR, lw=0, zorder=1)
    axes.plot(positions, values, "o-", color=BLUE, ms=4.5, lw=1.4, zorder=3)
    axes.axhline(values[0], color=_GRAY, lw=0.8, ls=(0, (4, 3)), zorder=2)
    for x, value in zip(positions, values, strict=True):
        _text(axes, f"{value:.0f}", (x, value), (0, 6))
    names = [point.label + (f"\n({point.no_pose})" if point.no_pose else "") for point in curve.points]
    axes.set_xticks(np.arange(len(names)), names, fontsize=8)
    axes.set(ylim=(0, top), xlim=(-0.4, len(names) - 0.6))
    _styled(axes, curve.title + (" (no pose)" if any(point.no_pose for point in curve.points) else ""))


def _sensors(axes, curve: Curve) -> None:
    points = sorted((p for p in curve.points if p.mpjpe is not None), key=lambda point: -point.points)
    values, low, high = _intervals(points, "mpjpe")
    names = [f"{point.label} · {point.points:.0f}" for point in points]
    _bars(axes, values, low, high, names, [f"{value:.0f}" for value in values], horizontal=True)
    _styled(axes, "other sensors · median number of points", grid="x")


def _end_joints(axes, ends: Sequence[End]) -> None:
    low, medians, high = np.array([end.quartiles for end in ends]).T
    texts = [f"{end.mean:.0f} ± {end.deviation:.0f}" for end in ends]
    _bars(axes, np.array([end.mean for end in ends]), low, high, [end.group for end in ends], texts)
    axes.plot(np.arange(len(ends)), medians, "o", ms=5, color=_GRAY, mec="white", zorder=4)
    _styled(axes, f"end joints of the worst {ends[0].worst:,}: mean, quartiles")


# ---- layout and styles


def _figure(width: float, height: float, title: str, subtitle: str):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white", layout="constrained")
    figure.suptitle(f"{title}\n{subtitle}", x=0.01, ha="left", fontsize=10.5, color=INK, parse_math=False)
    return figure


def _intervals(rows: Sequence, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The attribute `name` of each row and the ends of its interval; without an interval, the value itself."""
    values, low, high = (np.array([getattr(row, key) for row in rows], float) for key in (name, "low", "high"))
    return values, np.where(np.isnan(low), values, low), np.where(np.isnan(high), values, high)


def _styled(
    axes, title: str = "", *, grid: str = "y", xlabel: str = "", ylabel: str = "", legend: bool = False
) -> None:
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(_GRAY)
    axes.grid(axis=grid, color=HAIRLINE, lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(labelcolor=INK, length=2.5, color=_GRAY)
    axes.tick_params(axis="both" if xlabel else grid, labelsize=8)
    if title:
        axes.set_title(title, fontsize=9.5, loc="left", color=INK)
    axes.set_xlabel(xlabel, fontsize=9)
    axes.set_ylabel(ylabel, fontsize=9)
    if legend:
        axes.legend(fontsize=8, loc="upper left", frameon=False)


def _text(axes, text: str, position: tuple[Any, Any], offset: tuple[float, float], *, ha: str = "center", **options):
    return axes.annotate(text, position, offset, textcoords="offset points", ha=ha, fontsize=8, color=INK, **options)


def _level(axes, y: float, text: str, color: str) -> None:
    """A horizontal line with a text above its right end."""
    dashes = (4, 3) if color == INK else (1, 2)
    axes.axhline(y, color=color, lw=0.8, ls=(0, dashes), zorder=3)
    options = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right"}
    axes.annotate(text, (1.0, y), (-2, 2), fontsize=7.5, color=color, zorder=7, **options)


def _empty(axes, text: str, title: str = "") -> None:
    if title:
        axes.set_title(title, fontsize=9.5, loc="left", color=INK)
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=9, color=FAINT)
