"""Tables of speed from the output of `network.py --json`; also formats rates and targets for its report."""

from collections.abc import Callable

# the shown networks, by their names in network.py
NETWORKS = ("tiny", "tiny ONNX", "small", "small ONNX", "base", "base ONNX", "paper", "draft")
NETWORKS += ("ViT as small", "PointNet++ as small")
POINTS = (128, 256, 512, 1024)

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]


def rate(seconds: float) -> str:
    """People per second, from seconds per person."""
    return f"{1 / seconds:,.0f}" if seconds < 0.05 else f"{1 / seconds:.1f}"


def medians(record: dict) -> Rows:
    """Latency, and people per second in forward passes and in training, by number of points."""
    seconds = {(entry["section"], entry["network"], entry["points"]): entry["median_s"] for entry in record["times"]}
    rows = []

    def add(section: str, unit: str, points: int | str, format_value: Callable[[float], str]) -> None:
        values = [seconds.get((section, name, points)) for name in NETWORKS]
        rows.append(
            (f"{section}, {unit}", shown(points), *("-" if value is None else format_value(value) for value in values))
        )

    for points in POINTS:
        add("latency", "ms", points, lambda value: f"{1e3 * value:.2f}")
    for section in ("forward", "training"):
        for points in (*POINTS, "crops"):
            add(section, "people/s", points, rate)
    return ("median", "points", *NETWORKS), rows


def ratios(targets: list[dict]) -> Rows:
    """Single figures of network.py, from the medians and from the best rounds, without their targets."""
    rows = [(target["what"], *_figures(target)) for target in targets]
    return ("", "by medians", "by best rounds"), rows


def asked(targets: list[dict]) -> Rows:
    """Targets of network.py and their results; figures are None if not measured."""
    rows = []
    for target in targets:
        requirement = f"{'at most' if target['most'] else 'at least'} {target['target']:g} {target['unit']}".strip()
        verdict = {None: "not measured", True: "yes", False: "**no**"}[target["met"]]
        rows.append((target["what"], requirement, *_figures(target), verdict))
    return ("", "asked", "by medians", "by best rounds", "met by medians"), rows


def _figures(target: dict) -> list[str]:
    """The figures from the medians and from the best rounds."""
    return [
        "-" if target[name] is None else f"{target[name]:,.2f} {target['unit']}".strip() for name in ("figure", "best")
    ]


def shown(points: int | str) -> str:
    return points if isinstance(points, str) else f"{points:,}"
