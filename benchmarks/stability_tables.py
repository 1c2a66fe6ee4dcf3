"""Rows of tables of errors with perturbed points, from the stability.json files in docs/scores/stability.

lidarpose evaluate small bench --stability --out study        # study/stability.json -> small.json
"""

import json
from functools import lru_cache
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "scores" / "stability"


@lru_cache
def _document(name: str) -> dict:
    return json.loads((FOLDER / f"{name}.json").read_text())


def read(name: str) -> dict:
    """The stability study of a network."""
    (study,) = _document(name)["studies"]
    return study


def source(name: str) -> str:
    """The dataset of a study, and the version of the package that made it."""
    return f"{read(name)['setting']['dataset'].removeprefix('lidarpose-')}, version {_document(name)['version']}"


def curves(name: str) -> list[tuple[str, ...]]:
    """One row per perturbation: title, unperturbed MPJPE, "amount: MPJPE (people without a pose)" for each amount."""
    rows = []
    for curve in _curves(name).values():
        if curve["name"] == "sensors":
            continue
        undisturbed, *points = curve["points"]
        cells = [f"{point['label']}: {_error(point)}" for point in points]
        rows.append((curve["title"], f"{undisturbed['mpjpe']:.1f}", *cells))
    return rows


def sensors(name: str) -> list[tuple[str, ...]]:
    """One row per sensor: name, median points of a person, MPJPE."""
    points = _curves(name)["sensors"]["points"]
    return [
        (point["label"], f"{point['points']:.0f}", _error(point)) for point in sorted(points, key=lambda p: p["points"])
    ]


def ends(name: str) -> list[tuple[str, ...]]:
    """One row per end joint: mean and standard deviation over the worst people."""
    return [(end["group"], f"{end['mean']:.1f}", f"{end['deviation']:.1f}") for end in read(name)["ends"]]


def strays(name: str) -> tuple[str, ...]:
    """Unperturbed MPJPE, and the increase with its interval for each amount of stray points."""
    undisturbed, *points = _curves(name)["clusters"]["points"]
    increases = (f"{p['increase']:+.1f} [{p['increase_low']:.1f}, {p['increase_high']:.1f}]" for p in points)
    return f"{undisturbed['mpjpe']:.1f}", *increases


def amounts(name: str) -> tuple[str, ...]:
    """The amounts of stray points in a cluster."""
    return tuple(point["label"] for point in _curves(name)["clusters"]["points"][1:])


def _curves(name: str) -> dict[str, dict]:
    return {curve["name"]: curve for curve in read(name)["curves"]}


def _error(point: dict) -> str:
    no_pose_text = f" ({point['no_pose']})" if point["no_pose"] else ""
    return f"{point['mpjpe']:.1f}{no_pose_text}"
