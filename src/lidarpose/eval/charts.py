"""Charts of an evaluation: errors by distance, points, hidden share and joint; reliability; stability.

Drawn with matplotlib's Agg canvas through its object interface, as `picture` draws people; every function returns the
bytes of a PNG.
"""

import io
from collections.abc import Sequence

import numpy as np

from lidarpose.eval.predictions import Judged
from lidarpose.eval.robustness import Curve, End, Stability
from lidarpose.eval.scores import OURS, Line, Result
from lidarpose.sample import HIT

# blue and orange of Okabe and Ito's color-blind-safe palette (2008), the orange darker to stand out on white
_BLUE, _ORANGE = "#0072b2", "#e07000"
_BAR, _GRAY, _INK, _FAINT, _HAIRLINE = "#c9deec", "#9aa3ad", "#1f2328", "#7a828c", "#e3e6ea"
_DPI = 100
_BINS = 10
# edges of stated spread, m, in which it is held against the true error
_SPREADS = (0.0, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, np.inf)
# points on a chart that stand for fewer joints say little
_FEWEST = 20


def draw_errors(result: Result) -> bytes:
    """MPJPE by distance, number of points, hidden share and joint, with intervals and numbers of people."""
    panels = {
        "distance, m": ("by distance from the sensor, m", "the sensor's place is not known"),
        "points": ("by number of points", "nobody"),
        "hidden share": ("by share that is hidden", "the dataset does not tell what is hidden"),
        "joints": ("by joint", "nobody"),
    }
    figure, canvas = _figure(9.6, 6.6)
    _title(figure, f"{result.setting.dataset}: MPJPE of {result.setting.method}, mm", result.setting.told)
    whole = result.line("mpjpe")
    floors = [line for line in result.lines if line.figure == "mpjpe" and line.of == "all" and _is_floor(line, result)]
    for axes, (group, (title, nothing)) in zip(figure.subplots(2, 2).ravel(), panels.items(), strict=True):
        lines = [
            line for line in result.lines if (line.figure, line.group) == ("mpjpe", group) and _is_own(line, result)
        ]
        lines = [line for line in lines if line.value is not None]
        axes.set_title(title, fontsize=10, loc="left", color=_INK)
        if not lines:
            _nothing(axes, nothing)
            continue
        _bars(axes, [line.of for line in lines], lines)
        if whole.value is not None:
            axes.axhline(whole.value, color=_INK, lw=0.8, ls=(0, (4, 3)), zorder=3)
            _note(axes, whole.value, f"all {whole.value:.1f}")
        for floor in floors:
            if floor.value is not None and floor.value < axes.get_ylim()[1] * 1.6:
                axes.set_ylim(0, max(axes.get_ylim()[1], floor.value * 1.12))
                axes.axhline(floor.value, color=_ORANGE, lw=0.8, ls=(0, (1, 2)), zorder=3)
                _note(axes, floor.value, floor.method.removeprefix("floor: "), _ORANGE)
    return _png(canvas)


def draw_reliability(judged: Judged, result: Result) -> bytes | None:
    """Stated confidence against the share of joints within 10 cm, and stated spread against the true error; None where
    the network states neither."""
    some = judged.of(~judged.moving)
    error = some.errors()
    known = ~np.isnan(error) & ~np.isnan(some.confidence) & ~np.isnan(some.spread)
    if not known.any():
        return None
    error, confidence, spread = error[known], some.confidence[known].astype(float), some.spread[known].astype(float)
    figure, canvas = _figure(9.0, 4.3)
    _title(figure, f"{result.setting.dataset}: what {result.setting.method} says of itself", result.setting.told)
    left, right = figure.subplots(1, 2)
    _confidence(left, confidence, error < 1e3 * HIT, result)
    _spread(right, spread * 1e3, error)
    return _png(canvas)


def draw_stability(study: Stability) -> bytes:
    """The curves of a study, the other sensors, and the errors of end joints over the worst people."""
    curves = [curve for curve in study.curves if curve.name != "sensors"]
    sensors = next((curve for curve in study.curves if curve.name == "sensors"), None)
    count = len(curves) + (sensors is not None) + bool(study.ends)
    columns = 4
    rows = -(-count // columns)
    figure, canvas = _figure(13.6, 0.5 + 3.0 * rows)
    _title(figure, f"{study.setting.method} disturbed: MPJPE of {study.who}, mm", study.setting.told)
    axes = list(np.ravel(figure.subplots(rows, columns)))
    values = [p.high or p.mpjpe for curve in curves for p in curve.points if p.mpjpe is not None]
    top = 1.08 * max(values, default=1.0)
    for curve in curves:
        _curve(axes.pop(0), curve, top)
    if sensors is not None:
        _sensors(axes.pop(0), sensors)
    if study.ends:
        _ends(axes.pop(0), study.ends)
    for one in axes:
        one.set_axis_off()
    return _png(canvas)


# ---- panels


def _bars(axes, names: Sequence[str], lines: Sequence[Line]) -> None:
    """A bar a line, its interval, its value, and below how many people it is of."""
    at = np.arange(len(lines))
    values = np.array([line.value for line in lines])
    axes.bar(at, values, 0.7, color=_BAR, zorder=1)
    ends = [
        (line.value if line.low is None else line.low, line.value if line.high is None else line.high) for line in lines
    ]
    low, high = np.array(ends).T
    axes.vlines(at, low, high, color=_BLUE, lw=1.6, zorder=4)
    axes.plot(at, values, "o", ms=4, color=_BLUE, zorder=5)
    for x, value, top in zip(at, values, high, strict=True):
        axes.annotate(
            f"{value:.0f}",
            (x, top),
            (0, 4),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=_INK,
            zorder=6,
            bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6},
        )
    axes.set_xticks(at, [f"{name}\n{line.people:,}" for name, line in zip(names, lines, strict=True)], fontsize=7.5)
    axes.set_ylim(0, 1.18 * high.max())
    # a single bar is no wider than one of four
    spare = max(4 - len(lines), 0) / 2
    axes.set_xlim(-0.6 - spare, len(lines) - 0.4 + spare)
    _plain(axes)


def _confidence(axes, stated: np.ndarray, hit: np.ndarray, result: Result) -> None:
    index = np.minimum((stated * _BINS).astype(int), _BINS - 1)
    count = np.bincount(index, minlength=_BINS)
    some = count >= _FEWEST
    mean = np.bincount(index, stated, _BINS)[some] / count[some]
    share = np.bincount(index, hit.astype(float), _BINS)[some] / count[some]
    axes.bar(
        (np.arange(_BINS) + 0.5) / _BINS, count / count.sum(), 0.092, color=_BAR, label="share of joints", zorder=1
    )
    axes.plot([0, 1], [0, 1], color=_GRAY, lw=0.9, zorder=2)
    axes.plot(mean, share, "o-", color=_BLUE, ms=4.5, lw=1.4, label="within 10 cm", zorder=3)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="stated confidence")
    axes.tick_params(labelsize=8)
    axes.xaxis.label.set_fontsize(9)
    figures = {line.figure: line.value for line in result.lines if line.group == "all"}
    told = [f"expected calibration error {figures['calibration_error']:.1f} %"]
    if figures.get("auroc") is not None:
        told.append(f"AUROC {figures['auroc'] / 100:.3f}")
    axes.set_title(", ".join(told), fontsize=9.5, loc="left", color=_INK)
    axes.legend(fontsize=8, loc="upper left", frameon=False)
    _plain(axes)


def _spread(axes, stated: np.ndarray, error: np.ndarray) -> None:
    edges = 1e3 * np.array(_SPREADS)
    index = np.digitize(stated, edges) - 1
    bins = [index == k for k in range(len(edges) - 1)]
    bins = [rows for rows in bins if rows.sum() >= _FEWEST]
    mean = [stated[rows].mean() for rows in bins]
    quartiles = np.array([np.quantile(error[rows], [0.25, 0.75]) for rows in bins]).reshape(-1, 2)
    top = 1.1 * max([*mean, *(error[rows].mean() for rows in bins), *quartiles[:, 1], 1.0])
    axes.plot([0, top], [0, top], color=_GRAY, lw=0.9, zorder=2)
    axes.fill_between(mean, *quartiles.T, color=_BAR, lw=0, label="middle half", zorder=1)
    axes.plot(mean, [error[rows].mean() for rows in bins], "o-", color=_BLUE, ms=4.5, lw=1.4, label="mean", zorder=3)
    axes.set(xlim=(0, top), ylim=(0, top), xlabel="stated spread, mm", ylabel="true error, mm")
    axes.tick_params(labelsize=8)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_fontsize(9)
    axes.set_title(
        f"spread {stated.mean():.0f} mm stated, {error.mean():.0f} mm true", fontsize=9.5, loc="left", color=_INK
    )
    axes.legend(fontsize=8, loc="upper left", frameon=False)
    _plain(axes)


def _curve(axes, curve: Curve, top: float) -> None:
    points = [point for point in curve.points if point.mpjpe is not None]
    if not points:
        axes.set_title(curve.title, fontsize=9.5, loc="left", color=_INK)
        _nothing(axes, "nobody has a pose")
        return
    # amounts are not evenly apart, but each is one step of the study
    at = np.array([k for k, point in enumerate(curve.points) if point.mpjpe is not None])
    values = np.array([point.mpjpe for point in points])
    ends = [(p.mpjpe if p.low is None else p.low, p.mpjpe if p.high is None else p.high) for p in points]
    axes.fill_between(at, *np.array(ends).T, color=_BAR, lw=0, zorder=1)
    axes.plot(at, values, "o-", color=_BLUE, ms=4.5, lw=1.4, zorder=3)
    axes.axhline(values[0], color=_GRAY, lw=0.8, ls=(0, (4, 3)), zorder=2)
    for x, value in zip(at, values, strict=True):
        axes.annotate(
            f"{value:.0f}", (x, value), (0, 6), textcoords="offset points", ha="center", fontsize=8, color=_INK
        )
    lost = [f"\n({point.no_pose})" if point.no_pose else "" for point in curve.points]
    names = [f"{point.label}{extra}" for point, extra in zip(curve.points, lost, strict=True)]
    axes.set_xticks(np.arange(len(names)), names, fontsize=8)
    axes.set(ylim=(0, top), xlim=(-0.4, len(curve.points) - 0.6))
    axes.set_title(curve.title + (" (no pose)" if any(lost) else ""), fontsize=9.5, loc="left", color=_INK)
    _plain(axes)


def _sensors(axes, curve: Curve) -> None:
    points = sorted((p for p in curve.points if p.mpjpe is not None), key=lambda point: point.points)
    if not points:
        axes.set_title(curve.title, fontsize=9.5, loc="left", color=_INK)
        _nothing(axes, "nobody has a pose")
        return
    at = np.arange(len(points))[::-1]
    values = np.array([point.mpjpe for point in points])
    axes.barh(at, values, 0.72, color=_BAR, zorder=1)
    axes.hlines(
        at, [p.low or p.mpjpe for p in points], [p.high or p.mpjpe for p in points], color=_BLUE, lw=1.6, zorder=3
    )
    axes.plot(values, at, "o", ms=3.5, color=_BLUE, zorder=4)
    for y, point in zip(at, points, strict=True):
        axes.annotate(
            f"{point.mpjpe:.0f}",
            (point.high or point.mpjpe, y),
            (4, -3),
            textcoords="offset points",
            fontsize=8,
            color=_INK,
        )
    axes.set_yticks(at, [f"{point.label} · {point.points:.0f}" for point in points], fontsize=7.5)
    axes.set_xlim(0, 1.15 * max(p.high or p.mpjpe for p in points))
    axes.set_title("other sensors · points of half the people", fontsize=9.5, loc="left", color=_INK)
    _plain(axes, grid="x")


def _ends(axes, ends: Sequence[End]) -> None:
    at = np.arange(len(ends))
    axes.bar(at, [end.mean for end in ends], 0.6, color=_BAR, zorder=1)
    axes.vlines(
        at, [end.quartiles[0] for end in ends], [end.quartiles[2] for end in ends], color=_BLUE, lw=5, alpha=0.55
    )
    axes.plot(at, [end.quartiles[1] for end in ends], "o", ms=5, color=_BLUE, mec="white", zorder=4)
    for x, end in zip(at, ends, strict=True):
        axes.annotate(
            f"{end.mean:.0f} ± {end.deviation:.0f}",
            (x, max(end.mean, end.quartiles[2])),
            (0, 4),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=_INK,
        )
    axes.set_xticks(at, [end.group for end in ends], fontsize=8.5)
    axes.set_xlim(-0.6, len(ends) - 0.4)
    axes.set_ylim(0, 1.15 * max(max(end.mean, end.quartiles[2]) for end in ends))
    axes.set_title(f"end joints of the worst {ends[0].worst:,}: mean, quartiles", fontsize=9.5, loc="left", color=_INK)
    _plain(axes)


# ---- the sheet


def _figure(width: float, height: float):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white", layout="constrained")
    return figure, FigureCanvasAgg(figure)


def _title(figure, title: str, told: str) -> None:
    words = {"parse_math": False, "family": "DejaVu Sans"}
    figure.suptitle(f"{title}\n{told}", x=0.01, ha="left", fontsize=10.5, color=_INK, **words)


def _plain(axes, grid: str = "y") -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_GRAY)
    axes.grid(axis=grid, color=_HAIRLINE, lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(labelcolor=_INK, length=2.5, color=_GRAY)
    axes.tick_params(axis="y" if grid == "y" else "x", labelsize=8)


def _note(axes, y: float, words: str, color: str = _INK) -> None:
    """Words above the right end of a level line."""
    place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right"}
    axes.annotate(words, (1.0, y), (-2, 2), fontsize=7.5, color=color, zorder=7, **place)


def _nothing(axes, words: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", fontsize=9, color=_FAINT)


def _is_own(line: Line, result: Result) -> bool:
    return line.method == result.setting.method and line.arithmetic == OURS


def _is_floor(line: Line, result: Result) -> bool:
    return line.method != result.setting.method and line.group == "all"


def _png(canvas) -> bytes:
    buffer = io.BytesIO()
    # print_figure would follow the user's savefig settings
    canvas.print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()
