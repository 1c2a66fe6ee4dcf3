"""Evaluation: a network and a dataset's samples -> predictions -> rows of metrics -> a folder of results.

The public part is in `lidarpose.evaluation`; docs/evaluate.md describes the protocols and the files.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from lidarpose._version import __version__
from lidarpose.data.shards import pyarrow
from lidarpose.errors import InputError
from lidarpose.eval.dataset import BENCH, Bench, EvalDataset, EvalSample, count_skipped, mean_poses, open_eval_dataset
from lidarpose.eval.metric_rows import baseline_rows, metric_rows, person_rows
from lidarpose.eval.metrics import aggregate
from lidarpose.eval.predictions import Predictions, concatenate, poses_parquet
from lidarpose.eval.protocols import EvalSetup, Model, eval_setup
from lidarpose.eval.robustness import Stability, people_to_perturb, study, to_json
from lidarpose.eval.scores import BASELINE, FILE, MetricRow, Result, Scores, Setting
from lidarpose.inference.predictor import Predictor, load
from lidarpose.io.atomic import check_writable, write_all_atomic
from lidarpose.io.files import content_digest, file_error, listed
from lidarpose.models import weights_name, weights_path
from lidarpose.models.checkpoint import runs_of
from lidarpose.sample import UNLABELED
from lidarpose.skeleton import BODY26, Skeleton, as_skeleton

# people per chunk, whose clouds are in memory together; a chunk may be longer, up to the end of a clip
_CHUNK = 512
# number of people with the largest errors whose points are kept for pictures
WORST = 24
# where results go unless a folder is named
FOLDER = "evaluation"


# ---- one dataset


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A dataset's result, its predictions, and the people with the largest errors, as cropped for the network, with
    their rows in the predictions."""

    result: Result
    predictions: Predictions
    worst: tuple[tuple[EvalSample, int], ...]


def evaluate_dataset(
    setup: EvalSetup, *, dapt_compat: bool = False, progress: Callable[[int, int], None] = lambda done, total: None
) -> Evaluation:
    """Predicts and scores all people of a dataset; progress(done, total) is called as people are predicted. Raises
    InputError if no person could be read."""
    dataset, setting = setup.dataset, setup.setting
    parts: list[Predictions] = []
    worst: list[tuple[float, int, EvalSample]] = []
    num_people = num_unknown = num_alone = 0
    progress(0, dataset.count)
    for chunk in _chunks(setup):
        chunk_predictions = setup.predict(chunk)
        errors = chunk_predictions.errors()
        for k in np.flatnonzero(~np.isnan(errors).all(1) & ~chunk_predictions.moving).tolist():
            worst.append((float(np.nanmean(errors[k])), num_people + k, chunk[k]))
        # keep the points of only the people with the largest errors
        worst = sorted(worst, key=lambda entry: (-entry[0], entry[1]))[:WORST]
        parts.append(chunk_predictions)
        num_people += len(chunk)
        num_unknown += sum(not person.sample.sensor_known for person in chunk)
        num_alone += sum(person.sample.background is None or person.sample.neighbors is None for person in chunk)
        progress(num_people, dataset.count)
    if not parts:
        reasons = "; ".join(f"{reason}: {entry['first']}" for reason, entry in dataset.skipped.items())
        raise InputError(f"no person of {dataset.name} could be scored ({reasons})")
    predictions = concatenate(parts)
    if setting.sensor == "known" and num_unknown:
        setting = replace(setting, sensor="unknown" if num_unknown == num_people else "of some people")
    lines = metric_rows(predictions, setting, dapt_compat=dapt_compat)
    if dataset.bench is not None:
        lines += _baselines(dataset.bench, predictions, setting)
        lines += _person_rows(setup, dataset.bench, predictions, setting)
    is_alone = ~predictions.moving
    counts = {"people": int(is_alone.sum()), "frames of clips": int((~is_alone).sum())}
    counts["without a pose"] = int((~predictions.posed & is_alone).sum())
    skipped = {reason: dict(entry) for reason, entry in dataset.skipped.items()}
    notes = tuple(_notes(setup, setting, predictions, num_alone))
    result = Result(setting=setting, counts=counts, skipped=skipped, notes=notes, lines=lines)
    return Evaluation(result=result, predictions=predictions, worst=tuple((person, k) for _, k, person in worst))


def _chunks(setup: EvalSetup) -> Iterator[list[EvalSample]]:
    """The people as cropped by the protocol, in chunks; networks of clips get whole clips."""
    chunk: list[EvalSample] = []
    for person in _shown(setup):
        if len(chunk) >= _CHUNK and setup.can_split(chunk, person):
            yield chunk
            chunk = []
        chunk.append(person)
    if chunk:
        yield chunk


def _shown(setup: EvalSetup) -> Iterator[EvalSample]:
    """The people as cropped by the protocol; people that it skips are counted."""
    for person in setup.dataset:
        cropped_person, reason = setup.crop_sample(person)
        if cropped_person is None:
            where = f"{person.sample.sequence}, frame {person.sample.frame}, track {person.sample.track}"
            count_skipped(setup.dataset.skipped, reason, where)
        else:
            yield cropped_person


def _baselines(bench: Bench, predictions: Predictions, setting: Setting) -> tuple[MetricRow, ...]:
    """Rows of the baselines that use no points, scored on the same people."""
    joint_indices = BODY26.map_to(predictions.skeleton)
    nan_values = np.full_like(predictions.confidence, np.nan)
    rows: tuple[MetricRow, ...] = ()
    for name, joints in mean_poses(bench).items():
        pred = joints[predictions.row][:, joint_indices].astype(np.float32)
        baseline = replace(predictions, pred=pred, confidence=nan_values, spread=nan_values, visible=nan_values)
        rows += baseline_rows(baseline, replace(setting, method=f"{BASELINE}{name}"))
    return rows


def _person_rows(setup: EvalSetup, bench: Bench, predictions: Predictions, setting: Setting) -> tuple[MetricRow, ...]:
    """Rows for a network that predicts whether a crop shows a person, if the set has crops of objects."""
    people = predictions.select(~predictions.moving)
    if not len(bench.objects) or np.isnan(people.person).all():
        return ()
    origin = np.zeros(3) if setting.sensor == "known" else None
    clouds = [bench.points[row] for row in bench.objects]
    answers = setup.answers(clouds, origin, bench.columns["box"][bench.objects, :3].astype(float))
    # an object without a pose counts as a prediction of no person
    probabilities = [None if answer.pose is None else answer.pose.person for answer in answers]
    objects = np.array([0.0 if probability is None else float(probability) for probability in probabilities])
    return tuple(person_rows(people, objects, bench.columns["others"][people.row], setting))


def _notes(setup: EvalSetup, setting: Setting, predictions: Predictions, num_alone: int) -> Iterator[str]:
    """Notes for the reader; setting: the setup's, with `sensor` updated to what the dataset knows; num_alone: number of
    people whose surroundings are not known."""
    header = getattr(setup.model, "header", None)
    runs = runs_of(getattr(header, "card", {}))
    yield from dict.fromkeys(note for run in runs for note in _notes_of_run(run, setup.dataset))
    if getattr(getattr(header, "config", None), "trans_center", False) and setting.protocol != "dapt":
        yield "the network was trained about the labels' trans (trans_center): score it by the protocol dapt"
    if num_alone and len(getattr(getattr(header, "config", None), "clouds", ())) > 1:
        yield f"surroundings of {num_alone:,} of {len(predictions.pred):,} people are not known: the network got none"
    if setting.not_judged:
        yield f"scored joints: {', '.join(setting.joints)}; {setting.not_judged}"
    if setting.leaks:
        yield f"the split leaks: {setting.leaks}"
    if setting.protocol == "dapt":
        yield "crop and center are made of labels, as in the released code: not comparable with the protocol clean"
        if setup.dataset.settings.get("level"):
            yield "sequences out of level were turned; for the released code's frame, prepare with --no-level"
    if setting.kind == "waymo" and not (predictions.labels == UNLABELED).all():
        boxes = "labeled" if setting.protocol == "dapt" else "displaced labeled"
        yield f"joints that are labeled as hidden count, except in PEM; people are predicted in their {boxes} boxes"
    sequences = len(np.unique(predictions.sequence[~predictions.moving]))
    if setting.clusters and sequences < aggregate.LEAST_UNITS:
        sequence_count = "only one sequence" if sequences == 1 else f"only {sequences} sequences"
        yield (
            f"{sequence_count}: no intervals, which need {aggregate.LEAST_UNITS}, since frames of a sequence are not "
            "independent"
        )
    if setting.kind == BENCH:
        yield "baselines use no points: the mean skeleton about the points' center, with the true facing or one for all"


def _notes_of_run(run: dict, dataset: EvalDataset) -> Iterator[str]:
    """Whether the network was trained on these people, according to a run in its checkpoint."""
    recipe = run.get("recipe")
    if not isinstance(recipe, dict):
        return
    # pre-training on shards uses all people
    data, split = run.get("data") or recipe.get("shards"), recipe.get("split", "all")
    if isinstance(data, list) and dataset.name in data:
        if split == dataset.split or "all" in (split, dataset.split):
            yield f"the network was trained on split {split} of {dataset.name}: it has seen the people it is scored on"
        elif dataset.split == (recipe.get("validation_split") or "val") and "validation_mm" in run:
            yield "the network's run was validated on this split: its best.safetensors was selected on these people"
    settings = dataset.settings if dataset.kind == "synth" else {}
    is_synthetic = recipe["mix"] if "mix" in recipe else not recipe.get("shards")
    has_same_settings = settings.get("what") == "people" and all(
        settings.get(name) == recipe.get(name) for name in ("seed", "scene")
    )
    if is_synthetic and has_same_settings:
        people = f"synthesized people of seed {settings['seed']}, like these: they may be identical"
        yield f"the network was trained on {people}; make others with lidarpose synth --seed"


# ---- one call


@dataclass(frozen=True, kw_only=True)
class Run:
    """Results of one call: scores, the content of scores.json; evaluations, one per dataset; studies of stability."""

    scores: Scores
    evaluations: tuple[Evaluation, ...]
    studies: tuple[Stability, ...] = ()


def evaluate(model: Model | str | os.PathLike, dataset: str | os.PathLike, **options: Any) -> Result:
    """One dataset's result, in millimeters and percent; `options` and errors as in `run`."""
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
    dapt_compat: bool = False,
    sensor_unknown: bool = False,
    seed: int = 0,
    device: str = "cpu",
    backend: str | None = None,
    decode: str = "window",
    tta: int = 1,
    command: str = "",
    progress: Callable[[str, int, int], None] | None = None,
    legacy: bool = False,
) -> Run:
    """Scores a network on datasets. All arguments are checked before the first prediction.

    Args:
        model: a `Predictor`, anything that `load` takes, or an object with the joints `skeleton` and `predict(clouds,
            sensor_origin=, skeleton=)`, which returns for each cloud an object whose `pose` is a `Pose` or None.
        datasets: folders written by `lidarpose prepare` or `synth`, or "bench" or "bench-2".
        protocol: "clean" or "dapt".
        split: by default test, else val, else "all", which is all people.
        skeleton: score its joints, by default the dataset's (human15's for synthetic people).
        limit: score only this many people, evenly spread.
        stability: also evaluate with perturbed points.
        dapt_compat: also use the released code's arithmetic; `legacy` is its old name.
        sensor_unknown: do not pass the sensor's position to the network.
        seed: of displaced boxes and intervals.
        device: as in `load`, for weights by name or path.
        backend: as `device`.
        decode: as `device`.
        tta: as `device`.
        command: the command line to record in scores.json.
        progress: progress(dataset, done, total) is called as people are predicted.

    Raises:
        InputError: one line, for invalid arguments.
        MissingExtra: without pyarrow.
    """
    eval_datasets = _opened(datasets, split, limit)
    predictor, weights = _loaded(model, device=device, backend=backend, decode=decode, tta=tta)
    options: dict[str, Any] = {"protocol": protocol, "seed": seed, "skeleton": skeleton}
    setups = [eval_setup(predictor, dataset, sensor_unknown=sensor_unknown, **options) for dataset in eval_datasets]
    perturbed_people = [people_to_perturb(setup) if stability else None for setup in setups]
    progress = progress or (lambda dataset, done, total: None)
    evaluations, studies = [], []
    for setup, people in zip(setups, perturbed_people, strict=True):
        name = setup.dataset.name
        evaluations.append(evaluate_dataset(setup, dapt_compat=dapt_compat or legacy, progress=partial(progress, name)))
        if people is not None:
            study_progress = partial(progress, f"{name}, perturbed")
            studies.append(
                study(
                    setup,
                    evaluations[-1].predictions,
                    evaluations[-1].result.setting,
                    people=people,
                    progress=study_progress,
                )
            )
    results = tuple(evaluation.result for evaluation in evaluations)
    scores = Scores(weights=weights, command=command, seed=setups[0].setting.seed, results=results)
    return Run(scores=scores, evaluations=tuple(evaluations), studies=tuple(studies))


def _opened(datasets: str | os.PathLike | Sequence[str | os.PathLike], split, limit) -> list[EvalDataset]:
    datasets = listed(datasets)
    if not datasets:
        raise InputError("expected a dataset to evaluate on: a folder that lidarpose prepare or synth wrote, or bench")
    pyarrow()
    eval_datasets = [open_eval_dataset(dataset, split=split, limit=limit) for dataset in datasets]
    names = [dataset.name for dataset in eval_datasets]
    if duplicate := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"two datasets are called {duplicate}: evaluate them one by one, or rename a folder")
    return eval_datasets


def _loaded(model: Model | str | os.PathLike, **options: Any) -> tuple[Model, dict[str, Any]]:
    """The network, and the description of its weights for scores.json."""
    weights: dict[str, Any] = {}
    if isinstance(model, str | os.PathLike):
        path = weights_path(model)
        # `load` reports a missing file
        if path.is_file():
            weights = {"file": path.name, "digest": content_digest(path, expected="a checkpoint")}
        model = load(model, **options)
    elif not callable(getattr(model, "predict", None)):
        raise InputError(f"expected a network to evaluate, weights by name or path or a predictor, got {model!r}")
    elif options != {"device": "cpu", "backend": None, "decode": "window", "tta": 1}:
        raise InputError("device, backend, decode and tta are for weights by name or path: give them to load instead")
    elif not isinstance(model, Predictor):
        model = _described(model)
    # only the checkpoint shows whether it was trained on the dataset's own sequences
    card = getattr(getattr(model, "header", None), "card", {})
    return model, dict(model.model) | weights | {"skeleton": model.skeleton.name, "trained by": card.get("command")}


def _described(model: Any) -> Model:
    """A user's own model with missing attributes added. Raises InputError if its skeleton is unknown."""
    kind, skeleton, known = type(model).__name__, getattr(model, "skeleton", None), getattr(model, "model", None)
    if not isinstance(skeleton, str | Skeleton):
        raise InputError(
            f"{kind}.skeleton: expected a Skeleton or its name, got {skeleton!r}: give the skeleton of its joints"
        )
    names = ("predict", "predict_in", "outputs", "backend", "header", "uses_box_centers")
    parts: dict[str, Any] = {name: getattr(model, name) for name in names if hasattr(model, name)}
    known = {"name": kind} | (known if isinstance(known, dict) else {})
    return cast(Model, SimpleNamespace(**parts, skeleton=as_skeleton(skeleton), model=known))


# ---- the folder of results


def new_folder(checkpoint: str | os.PathLike, folder: str | os.PathLike = FOLDER) -> Path:
    """FOLDER/NAME of the checkpoint, or the first of FOLDER/NAME-2, FOLDER/NAME-3, ... that does not exist."""
    name = weights_name(weights_path(checkpoint))
    path, number = Path(folder) / name, 2
    while path.exists():
        path, number = Path(folder) / f"{name}-{number}", number + 1
    return path


def check_folder(folder: str | os.PathLike) -> Path:
    """The folder to write to. Raises InputError unless it is new or empty, and writable."""
    path = Path(folder)
    remedy = "give a new or empty folder for the results (--out DIR)"
    if path.exists() and not path.is_dir():
        raise file_error(path, f"is a file; {remedy}")
    if path.is_dir() and any(path.iterdir()):
        raise file_error(path, f"holds other files; {remedy}")
    check_writable(path / FILE)
    return path


def write(run: Run, folder: str | os.PathLike) -> list[Path]:
    """Writes scores.json, poses.parquet, pictures and, if there are studies, stability.json; returns their paths.

    Args:
        folder: a new or empty folder. Either all files are written or none.

    Raises:
        InputError: the folder is not empty.
    """
    from lidarpose.eval import charts

    folder, scores = check_folder(folder), run.scores
    files: dict[str, Any] = {FILE: scores.to_json().encode()}
    for evaluation in run.evaluations:
        name = evaluation.result.setting.dataset
        files[f"{name}-errors.png"] = charts.draw_errors(evaluation.result)
        files[f"{name}-reliability.png"] = charts.draw_reliability(evaluation.predictions, evaluation.result)
        arguments = (evaluation.predictions, evaluation.result.setting, evaluation.worst)
        files[f"{name}-worst.png"] = evaluation.worst and charts.draw_worst(*arguments)
    for stability in run.studies:
        files[f"{stability.setting.dataset}-stability.png"] = charts.draw_stability(stability)
    if run.studies:
        head = {"version": __version__, "command": scores.command, "seed": scores.seed, "weights": scores.weights}
        files["stability.json"] = to_json(run.studies, head=head).encode()
    poses = {evaluation.result.setting.dataset: evaluation.predictions for evaluation in run.evaluations}
    files["poses.parquet"] = poses_parquet(poses)
    contents = {folder / name: content for name, content in files.items() if content}
    write_all_atomic(contents)
    return list(contents)
