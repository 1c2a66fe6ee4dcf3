"""Rows of tables of errors with perturbed points, from the stability.json files in docs/scores/stability, and from the
cells of the paper's figures in docs/scores/paper/cells.

lidarpose evaluate small bench --stability --out study        # study/stability.json -> small.json
"""

import json
from functools import lru_cache
from pathlib import Path

SCORES = Path(__file__).parents[1] / "docs" / "scores"
FOLDER, PAPER = SCORES / "stability", SCORES / "paper"


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


def networks(figure: str) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Header and rows of one of the paper's figures: a column per network whose curves are stored with its cell, a row
    per amount of perturbation and per end joint."""
    columns: dict[str, list[str]] = {}
    names: list[str] = []
    for cell in json.loads((PAPER / f"{figure}.json").read_text())["cells"]:
        path = PAPER / "cells" / f"{Path(cell['scores']).parent.name}.json"
        study = json.loads(path.read_text()).get("stability") if path.is_file() else None
        if study is not None:
            points = {curve["name"]: curve["points"] for curve in study["curves"]}
            jitter, clusters = points["jitter"], points["clusters"][1:]
            names = ["undisturbed", *(f"jitter, clip {point['label']} cm" for point in jitter[1:])]
            names += [f"two clusters of {point['label']} points" for point in clusters]
            names += [f"{end['group']}, worst {end['worst']} people" for end in study["ends"]]
            values = [point["mpjpe"] for point in (*jitter, *clusters)] + [end["mean"] for end in study["ends"]]
            columns[cell["row"]] = [f"{value:.1f}" for value in values]
    return ("MPJPE, mm", *columns), list(zip(names, *columns.values(), strict=True))


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
