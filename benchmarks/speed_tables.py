"""Tables of speed, from what `network.py --json` wrote."""

from collections.abc import Callable

# what is shown, by the names of network.py
NETWORKS = ("tiny", "tiny ONNX", "small", "small ONNX", "base", "base ONNX", "paper", "draft")
NETWORKS += ("ViT as small", "PointNet++ as small")
POINTS = (128, 256, 512, 1024)

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]


def medians(found: dict) -> Rows:
    """Latency, people a second forward and in training, by points."""
    seconds = {(one["section"], one["network"], one["points"]): one["median_s"] for one in found["times"]}
    rows = []

    def add(section: str, unit: str, points: int | str, told: Callable[[float], str]) -> None:
        own = [seconds.get((section, name, points)) for name in NETWORKS]
        shown = points if isinstance(points, str) else f"{points:,}"
        rows.append((f"{section}, {unit}", shown, *("-" if value is None else told(value) for value in own)))

    for points in POINTS:
        add("latency", "ms", points, lambda value: f"{1e3 * value:.2f}")
    for section in ("forward", "training"):
        for points in (*POINTS, "crops"):
            add(section, "people/s", points, lambda value: f"{1 / value:,.0f}" if value < 0.05 else f"{1 / value:.1f}")
    return ("median", "points", *NETWORKS), rows


def asked(found: dict) -> Rows:
    """The targets of network.py, and what came of them."""
    rows = []
    for one in found["targets"]:
        due = f"{'at most' if one['most'] else 'at least'} {one['target']:g} {one['unit']}".strip()
        figures = (f"{one[name]:,.2f} {one['unit']}".strip() for name in ("figure", "best"))
        rows.append((one["what"], due, *figures, "yes" if one["met"] else "**no**"))
    return ("", "asked", "by medians", "by best rounds", "met by medians"), rows
