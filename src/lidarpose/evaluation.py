"""Judging a network on datasets: what `lidarpose evaluate` and `lidarpose table` call.

    from lidarpose import evaluation
    result = evaluation.evaluate("small", "bench")            # or a Predictor, and a folder of prepare or synth
    result.line("mpjpe").value, result.line("mpjpe", "joints", "wrists").low
    evaluation.write(evaluation.run("small", ["bench"]), "evaluation/small")
    print(evaluation.table(["evaluation/small"]))

docs/evaluate.md tells the protocols and the files.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose._version import __version__
from lidarpose.data.schema import pyarrow
from lidarpose.errors import InputError
from lidarpose.eval.dataset import BENCH, open_people
from lidarpose.eval.paper_table import published, table
from lidarpose.eval.predictions import Judged, read_poses, write_poses
from lidarpose.eval.protocols import PROTOCOLS
from lidarpose.eval.robustness import Stability, study, to_disturb, to_json
from lidarpose.eval.run import Evaluation, Model, Task, judge, task_of
from lidarpose.eval.scores import FILE, Line, Result, Scores, Setting, read_scores, scores_path
from lidarpose.inference.predictor import load
from lidarpose.io.files import atomic_path, check_writable, content_digest, file_error, listed
from lidarpose.models.bundled import weights_path
from lidarpose.sample import Pose

__all__ = [
    "BENCH",
    "Judged",
    "Line",
    "PROTOCOLS",
    "Result",
    "Run",
    "Scores",
    "Setting",
    "Stability",
    "evaluate",
    "new_folder",
    "published",
    "read_poses",
    "read_scores",
    "run",
    "scores_path",
    "table",
    "write",
]

# where results go unless a folder is named
FOLDER = "evaluation"


@dataclass(frozen=True, kw_only=True)
class Run:
    """All of one call: scores, what is in scores.json; evaluations, one a dataset; studies of their stability."""

    scores: Scores
    evaluations: tuple[Evaluation, ...]
    studies: tuple[Stability, ...] = ()


def evaluate(model: Model | str | os.PathLike, dataset: str | os.PathLike, **options: Any) -> Result:
    """One dataset's result; `options` as of `run`."""
    return run(model, [dataset], **options).scores.results[0]


def run(
    model: Model | str | os.PathLike,
    datasets: Sequence[str | os.PathLike],
    *,
    protocol: str = "clean",
    split: str | None = None,
    skeleton: str | None = None,
    limit: int | None = None,
    stability: bool = False,
    legacy: bool = False,
    sensor_unknown: bool = False,
    seed: int = 0,
    device: str = "cpu",
    backend: str | None = None,
    decode: str = "window",
    tta: int = 1,
    command: str = "",
    progress: Callable[[str, int, int], None] | None = None,
) -> Run:
    """Judges a network on datasets.

    model: a `Predictor`, anything that answers as it does, or what `load` takes; datasets: folders that `lidarpose
    prepare` or `synth` wrote, or "bench"; protocol: "clean" or "dapt"; split: by default test, else val, else "all",
    which is everybody; skeleton: judge its joints, by default the dataset's (of synthetic people human15's); limit: so
    many people, evenly spread; stability: disturb the points, too; legacy: also the released code's arithmetic;
    sensor_unknown: do not tell where the sensor stood; seed: of displaced boxes and intervals; device, backend,
    decode, tta: as of `load`, for weights by name or path; progress(dataset, done, total) is called as people are
    judged.

    Everything is checked before anybody is judged. Raises InputError, one line, for what does not fit; MissingExtra
    without pyarrow.
    """
    datasets = listed(datasets)
    if not datasets:
        raise InputError("expected a dataset to judge: a folder that lidarpose prepare or synth wrote, or bench")
    pyarrow()
    people = [open_people(dataset, split=split, limit=limit) for dataset in datasets]
    names = [one.name for one in people]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"two datasets are called {twice}: evaluate them one by one, or rename a folder")
    by_name = isinstance(model, str | os.PathLike)
    weights = _file(model) if by_name else {}
    predictor = load(model, device=device, backend=backend, decode=decode, tta=tta) if by_name else model
    if not hasattr(predictor, "predict"):
        raise InputError(f"expected a network to judge, weights by name or path or a predictor, got {model!r}")
    if not by_name and (device, backend, decode, tta) != ("cpu", None, "window", 1):
        raise InputError("device, backend, decode and tta are of weights by name or path: give them to load instead")
    options = {"protocol": protocol, "seed": seed, "skeleton": skeleton, "sensor_unknown": sensor_unknown}
    tasks = [task_of(predictor, one, **options) for one in people]
    disturbed = [to_disturb(task) for task in tasks] if stability else [None] * len(tasks)
    evaluations, studies = [], []
    for task, shown in zip(tasks, disturbed, strict=True):
        evaluations.append(judge(task, legacy=legacy, progress=_told(task, "", progress)))
        if shown is not None:
            more = _told(task, ", disturbed", progress)
            studies.append(study(task, evaluations[-1].judged, people=shown, progress=more))
    return Run(
        scores=Scores(
            weights=dict(predictor.model) | weights | _known(predictor),
            command=command,
            seed=tasks[0].setting.seed,
            results=tuple(one.result for one in evaluations),
        ),
        evaluations=tuple(evaluations),
        studies=tuple(studies),
    )


def _file(model: str | os.PathLike) -> dict[str, str]:
    path = weights_path(model)
    # a missing file is told by `load`
    return {"file": path.name, "digest": content_digest(path, expected="a checkpoint")} if path.is_file() else {}


def _known(model: Model) -> dict[str, Any]:
    """What a checkpoint tells of itself: whether a dataset's own sequences were trained on shows only there."""
    card = getattr(getattr(model, "header", None), "card", {})
    return {"skeleton": model.skeleton.name, "trained by": card.get("command")}


def _told(task: Task, what: str, progress) -> Callable[[int], None] | None:
    if progress is None:
        return None
    done = 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        progress(task.setting.dataset + what, done, 0 if what else task.people.count)

    return tell


def new_folder(checkpoint: str | os.PathLike, folder: str | os.PathLike = FOLDER) -> Path:
    """FOLDER/NAME of the checkpoint, or FOLDER/NAME-2, ..., the first that is not there."""
    name = weights_path(checkpoint).stem
    path, number = Path(folder) / name, 2
    while path.exists():
        path, number = Path(folder) / f"{name}-{number}", number + 1
    return path


def check_folder(folder: str | os.PathLike) -> Path:
    """The folder to write to. Raises InputError unless it is new or empty, and can be written."""
    path = Path(folder)
    remedy = "give a new or empty folder for the results (--out DIR)"
    if path.exists() and not path.is_dir():
        raise file_error(path, f"is a file; {remedy}")
    if path.is_dir() and any(path.iterdir()):
        raise file_error(path, f"holds other files; {remedy}")
    check_writable(path / FILE)
    return path


def write(run: Run, folder: str | os.PathLike) -> list[Path]:
    """Writes scores.json, poses.parquet, pictures and, where there are studies, stability.json into a new or empty
    folder, all of them or none, and returns their paths. Raises InputError where the folder holds something."""
    from lidarpose.eval import charts

    folder = check_folder(folder)
    files: dict[str, bytes] = {FILE: run.scores.to_json().encode()}
    for one in run.evaluations:
        name = one.result.setting.dataset
        files[f"{name}-errors.png"] = charts.draw_errors(one.result)
        if (drawn := charts.draw_reliability(one.judged, one.result)) is not None:
            files[f"{name}-reliability.png"] = drawn
        if one.worst:
            files[f"{name}-worst.png"] = _worst(one)
    for study_ in run.studies:
        files[f"{study_.setting.dataset}-stability.png"] = charts.draw_stability(study_)
    if run.studies:
        scores = run.scores
        head = {"version": __version__, "command": scores.command, "seed": scores.seed, "weights": scores.weights}
        files["stability.json"] = to_json(run.studies, head=head).encode()
    judged = {one.result.setting.dataset: one.judged for one in run.evaluations}
    with ExitStack() as stack:
        write_poses(stack.enter_context(atomic_path(folder / "poses.parquet")), judged)
        for name, content in files.items():
            stack.enter_context(atomic_path(folder / name)).write_bytes(content)
    return [folder / name for name in (*files, "poses.parquet")]


def _worst(one: Evaluation) -> bytes:
    from lidarpose.viz.draw import Panel, draw_people

    judged, setting = one.judged, one.result.setting
    errors = judged.errors()
    panels = []
    for person, k in one.worst:
        own = errors[k][judged.labels[k] > 0]
        where = f"{person.sequence} {person.frame} {person.track}"
        if person.sensor:
            where = f"#{person.row} {person.condition or person.sensor}"
        confidence = None if np.isnan(judged.confidence[k]).any() else judged.confidence[k].astype(float)
        pose = Pose(joints=judged.pred[k].astype(float), skeleton=judged.skeleton, confidence=confidence)
        truth = Pose(joints=judged.true[k].astype(float), skeleton=judged.skeleton)
        label = f"{own.mean():.0f} mm · {where}"
        panels.append(Panel(points=person.points, label=label, distance=float(person.distance), pose=pose, truth=truth))
    title = f"{setting.dataset}: the {len(panels)} largest mean errors of {setting.method} · {setting.told}"
    return draw_people(panels, title=title)
