"""Tables of speed, from what `network.py --json` wrote; how its report tells rates and targets too."""

from collections.abc import Callable

# what is shown, by the names of network.py
NETWORKS = ("tiny", "tiny ONNX", "small", "small ONNX", "base", "base ONNX", "paper", "draft")
NETWORKS += ("ViT as small", "PointNet++ as small")
POINTS = (128, 256, 512, 1024)

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]


def rate(seconds: float) -> str:
    """People a second of seconds a person."""
    return f"{1 / seconds:,.0f}" if seconds < 0.05 else f"{1 / seconds:.1f}"


def medians(found: dict) -> Rows:
    """Latency, people a second forward and in training, by points."""
    seconds = {(one["section"], one["network"], one["points"]): one["median_s"] for one in found["times"]}
    rows = []

    def add(section: str, unit: str, points: int | str, told: Callable[[float], str]) -> None:
        own = [seconds.get((section, name, points)) for name in NETWORKS]
        rows.append((f"{section}, {unit}", shown(points), *("-" if value is None else told(value) for value in own)))

    for points in POINTS:
        add("latency", "ms", points, lambda value: f"{1e3 * value:.2f}")
    for section in ("forward", "training"):
        for points in (*POINTS, "crops"):
            add(section, "people/s", points, rate)
    return ("median", "points", *NETWORKS), rows


def ratios(targets: list[dict]) -> Rows:
    """Single figures of network.py, by the medians and by the best rounds, without what was asked of them."""
    rows = [(one["what"], *_figures(one)) for one in targets]
    return ("", "by medians", "by best rounds"), rows


def asked(targets: list[dict]) -> Rows:
    """Targets of network.py, and what came of them; figures are None where nothing was measured."""
    rows = []
    for one in targets:
        due = f"{'at most' if one['most'] else 'at least'} {one['target']:g} {one['unit']}".strip()
        met = {None: "not measured", True: "yes", False: "**no**"}[one["met"]]
        rows.append((one["what"], due, *_figures(one), met))
    return ("", "asked", "by medians", "by best rounds", "met by medians"), rows


def _figures(one: dict) -> list[str]:
    """By the medians and by the best rounds."""
    return ["-" if one[name] is None else f"{one[name]:,.2f} {one['unit']}".strip() for name in ("figure", "best")]


def shown(points: int | str) -> str:
    return points if isinstance(points, str) else f"{points:,}"
