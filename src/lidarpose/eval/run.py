"""Judging: from a network and a dataset's people to what was predicted and how good it is."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from lidarpose.data.dapt_crops import released_box
from lidarpose.errors import InputError, whole
from lidarpose.eval.bench import floors
from lidarpose.eval.dataset import BENCH, BenchPeople, People, Person, note
from lidarpose.eval.metric_rows import headline, lines_of
from lidarpose.eval.metrics.bootstrap import LEAST_UNITS
from lidarpose.eval.predictions import Judged, gathered, subset
from lidarpose.eval.protocols import RELEASED, centring, check_protocol, crop, cropped, detector_box, released_center
from lidarpose.eval.scores import Line, Result, Setting
from lidarpose.models.header import runs_of
from lidarpose.sample import UNLABELED, Box
from lidarpose.skeleton import BODY26, Skeleton
from lidarpose.skeleton import skeleton as skeleton_of

# people predicted at once: so many clouds are in memory
_CHUNK = 512
# the worst people whose points are kept for pictures
WORST = 24


class Model(Protocol):
    """What is judged: `lidarpose.Predictor`, or anything that answers as it does."""

    skeleton: Skeleton
    model: dict[str, Any]
    backend: Any

    def predict(self, points, *, sensor_origin=None, skeleton: str | None = None, progress: bool = False): ...

    def outputs(self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None): ...


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A dataset's result, what it was computed from, and the worst people with the points that the network saw."""

    result: Result
    judged: Judged
    worst: tuple[tuple[Person, int], ...]


@dataclass(frozen=True, kw_only=True)
class Task:
    """A network before a dataset, all that can be wrong about the two being checked: see `task_of`."""

    model: Model
    people: People
    setting: Setting
    joints: Skeleton
    sensor_unknown: bool

    def prepared(self, person: Person) -> Person:
        """The person as the protocol shows them to the network."""
        setting = self.setting
        return cropped(setting.protocol, setting.kind, person, setting.seed)

    def box(self, person: Person) -> Box | None:
        """The box that a crop is displaced from: a detector's in the protocol clean, the released code's in dapt, else
        the dataset's, if any."""
        setting = self.setting
        if setting.protocol == "dapt":
            return released_box(person.joints, person.centers, person.box)
        return detector_box(setting.kind, person, setting.seed) or person.box

    def fit(self, person: Person) -> tuple[Person | None, str]:
        """The person as the protocol shows them; or None, and why it leaves them out."""
        kind = self.setting.kind
        if self.setting.protocol != "dapt":
            return self.prepared(person), ""
        released = RELEASED[kind]
        if released_center(kind, person) is None:
            return None, f"people without the center {released.center!r}"
        if kind == "humanm3" and (person.labels == UNLABELED).all():
            return None, "people without a labelled joint, whom their box is made of"
        shown = self.prepared(person)
        if len(shown.points) < released.least:
            return None, f"people of under {released.least} points, as the released code skips them"
        return shown, ""

    def answered(self, people: list[Person]) -> list[dict]:
        """Rows for `judged.gathered`: what the network says of people as the protocol shows them."""
        return [_row(self, person, found) for person, found in zip(people, self.predict(people), strict=True)]

    def predict(self, people: list[Person]) -> list[dict | None]:
        """What the network says of people as the protocol shows them: pred (J, 3) m, confidence, spread and visible
        (J,) of the judged joints, NaN for what it does not tell; None where it has no answer."""
        out: list[dict | None] = [None] * len(people)
        for known in (True, False):
            rows = [k for k, one in enumerate(people) if (one.sensor_known and not self.sensor_unknown) == known]
            origin = np.zeros(3) if known else None
            answer = self._clean if self.setting.protocol == "clean" else self._released
            for k, found in zip(rows, answer([people[k] for k in rows], origin), strict=True):
                out[k] = found
        return out

    def _clean(self, people: list[Person], origin: np.ndarray | None) -> Iterator[dict | None]:
        name = self.model.skeleton.name
        if people:
            clouds = [person.points for person in people]
            for person in self.model.predict(clouds, sensor_origin=origin, skeleton=name):
                yield None if person.pose is None else self._picked(person.pose, slice(None))

    def _released(self, people: list[Person], origin: np.ndarray | None) -> Iterator[dict | None]:
        """One pass about the released center."""
        batch = self.model.backend.batch
        for start in range(0, len(people), batch):
            some = people[start : start + batch]
            centers = np.stack([released_center(self.setting.kind, person) for person in some])
            clouds = [person.points.astype(float) for person in some]
            found = self.model.outputs(clouds, centers, origin)
            for k, center in enumerate(centers):
                answer = self._picked(found, k)
                answer["pred"] = answer["pred"] + center
                yield answer if np.isfinite(answer["pred"]).all() else None

    def _picked(self, found, which) -> dict:
        pick = self.model.skeleton.map_to(self.joints)
        nothing = np.full(len(pick), np.nan)
        told = {name: getattr(found, name) for name in ("confidence", "spread", "visible")}
        told = {name: nothing if value is None else value[which][..., pick] for name, value in told.items()}
        return {"pred": found.joints[which][..., pick, :]} | told


def task_of(
    model: Model,
    people: People,
    *,
    protocol: str = "clean",
    seed: int = 0,
    skeleton: str | None = None,
    sensor_unknown: bool = False,
) -> Task:
    """Puts a network before a dataset. Raises InputError, one line, where the protocol does not fit the dataset, the
    dataset lacks joints of the `skeleton` asked for, or it and the network have no joint in common."""
    seed = whole("seed", seed, least=0)
    check_protocol(protocol, people.kind, people.split_by, people.name)
    if protocol == "dapt" and model.model.get("tta", 1) > 1:
        raise InputError("the protocol dapt is one look at each person, as the released code's: leave --tta away")
    wanted = people.judged
    if skeleton is not None:
        wanted = skeleton_of(skeleton)
        if missing := [name for name in wanted.joints if name not in people.skeleton.joints]:
            raise InputError(
                f"{people.name} has no {', '.join(missing)}, which {wanted.name} asks for: its joints are "
                f"{people.skeleton.name}"
            )
    without = RELEASED[people.kind].without if protocol == "dapt" else ()
    own = model.skeleton.joints
    shared = [name for name in wanted.joints if name in own and name not in without]
    if not shared:
        raise InputError(
            f"{people.name} has the joints {', '.join(wanted.joints)}, the network {', '.join(own)}: none in common"
        )
    reasons = {"the network has no": [name for name in wanted.joints if name not in own]}
    reasons["the released means leave out"] = [name for name in wanted.joints if name in own and name in without]
    setting = Setting(
        dataset=people.name,
        kind=people.kind,
        method=str(model.model["name"]),
        protocol=protocol,
        centring=centring(protocol, people.kind),
        crop=crop(protocol, people.kind),
        split=people.split,
        split_source=people.split_source,
        leaks=people.leaks,
        joints=tuple(shared),
        not_judged="; ".join(f"{reason} {', '.join(names)}" for reason, names in reasons.items() if names),
        sensor="unknown" if sensor_unknown else "known",
        total=people.total,
        limit=people.limit,
        clusters=people.clusters,
        seed=seed,
    )
    joints = subset(wanted, shared)
    return Task(model=model, people=people, setting=setting, joints=joints, sensor_unknown=sensor_unknown)


def judge(task: Task, *, legacy: bool = False, progress: Callable[[int], None] | None = None) -> Evaluation:
    """Predicts everybody and judges it; progress(n) is told of every n people done. Raises InputError where nobody
    could be read."""
    setting, people = task.setting, task.people
    rows: list[dict] = []
    worst: list[tuple[float, int, Person]] = []
    unknown = 0
    for chunk in _chunks(_fit(task)):
        for person, row in zip(chunk, task.answered(chunk), strict=True):
            unknown += not person.sensor_known
            if (error := _mean_error(row)) is not None and not person.moving:
                worst.append((error, len(rows), person))
            rows.append(row)
        worst = sorted(worst, key=lambda one: (-one[0], one[1]))[:WORST]
        if progress is not None:
            progress(len(chunk))
    judged = gathered(task.joints, rows)
    if not len(judged):
        left = "; ".join(f"{reason}: {entry['first']}" for reason, entry in people.skipped.items())
        raise InputError(f"nobody of {people.name} could be judged ({left})")
    if setting.sensor == "known" and unknown:
        told = "unknown" if unknown == len(judged) else "of some people"
        setting = replace(setting, sensor=told)
    lines = lines_of(judged, setting, legacy=legacy)
    if isinstance(people, BenchPeople):
        lines += _floor_lines(people, judged, setting)
    alone = ~judged.moving
    counts = {"people": int(alone.sum()), "frames of clips": int((~alone).sum())}
    counts["without a pose"] = int((~judged.posed & alone).sum())
    result = Result(
        setting=setting,
        counts=counts,
        skipped={reason: dict(entry) for reason, entry in people.skipped.items()},
        notes=tuple(_notes(task, setting, judged)),
        lines=lines,
    )
    return Evaluation(result=result, judged=judged, worst=tuple((person, k) for _, k, person in worst))


def _fit(task: Task) -> Iterator[Person]:
    """The people as the protocol shows them; who has nothing to show is counted."""
    for person in task.people:
        shown, why = task.fit(person)
        if shown is None:
            where = f"{person.sequence}, frame {person.frame}, track {person.track}"
            note(task.people.skipped, why, where)
        else:
            yield shown


def _chunks(people: Iterator[Person]) -> Iterator[list[Person]]:
    chunk: list[Person] = []
    for person in people:
        chunk.append(person)
        if len(chunk) == _CHUNK:
            yield chunk
            chunk = []
    if chunk:
        yield chunk


def _row(task: Task, person: Person, answer: dict | None) -> dict:
    pick = task.people.skeleton.map_to(task.joints)
    nothing = np.full(len(pick), np.nan)
    if answer is None:
        answer = {"pred": np.full((len(pick), 3), np.nan), "confidence": nothing, "spread": nothing, "visible": nothing}
    box = person.box
    names = ("shard", "row", "sequence", "frame", "track", "time", "sensor", "condition", "poses", "plain", "moving")
    return {name: getattr(person, name) for name in names} | {
        "points": len(person.points),
        "distance": person.distance,
        "hidden": person.hidden,
        "box": np.full(7, np.nan) if box is None else np.concatenate([box.center, box.size, [box.yaw]]),
        "true": person.joints[pick],
        "labels": person.labels[pick],
        **answer,
    }


def _mean_error(row: dict) -> float | None:
    """m, over the labelled joints."""
    known = row["labels"] != UNLABELED
    if not known.any() or np.isnan(row["pred"]).any():
        return None
    return float(np.linalg.norm(row["pred"] - row["true"], axis=1)[known].mean())


def _floor_lines(people: BenchPeople, judged: Judged, setting: Setting) -> tuple[Line, ...]:
    """What knows no points, judged on the same people."""
    pick = BODY26.map_to(judged.skeleton)
    nothing = np.full(judged.confidence.shape, np.nan, np.float32)
    out = ()
    for name, joints in floors(people.bench).items():
        pred = joints[judged.row][:, pick].astype(np.float32)
        shown = replace(judged, pred=pred, confidence=nothing, spread=nothing, visible=nothing)
        out += headline(shown, replace(setting, method=f"floor: {name}"))
    return out


def _notes(task: Task, setting: Setting, judged: Judged) -> Iterator[str]:
    """What the reader must know; setting: the task's, as it turned out."""
    yield from _acquainted(task)
    if setting.not_judged:
        yield f"judged are {', '.join(setting.joints)}; {setting.not_judged}"
    if setting.leaks:
        yield f"the split leaks: {setting.leaks}"
    if setting.protocol == "dapt":
        yield "crop and center are made of labels, as in the released code: not comparable with the protocol clean"
        if task.people.level:
            yield "sequences out of level were turned; for the released code's frame, prepare with --no-level"
    if setting.kind == "waymo" and not (judged.labels == UNLABELED).all():
        yield "joints that are labelled as hidden count, but in PEM; people are predicted in their labelled boxes"
    if setting.clusters and (sequences := len(np.unique(judged.sequence[~judged.moving]))) < LEAST_UNITS:
        few = "one sequence alone" if sequences == 1 else f"{sequences} sequences alone"
        yield f"{few}: no intervals, which take {LEAST_UNITS}, since frames of a sequence are not independent"
    if setting.kind == BENCH:
        yield "the floors know no points: the mean skeleton about the points' center, turned to the true facing or not"


def _acquainted(task: Task) -> Iterator[str]:
    """That the network knows these people, by what its checkpoint tells of the runs that made it."""
    card = getattr(getattr(task.model, "header", None), "card", {})
    yield from dict.fromkeys(note for run in runs_of(card) for note in _learned_by(run, task))


def _learned_by(run: dict, task: Task) -> Iterator[str]:
    """What one run, by its card, had of the people."""
    recipe, people, judged = run.get("recipe"), task.people, task.setting.split
    if not isinstance(recipe, dict):
        return
    # pre-training on shards takes everybody
    data, learned = run.get("data") or recipe.get("shards"), recipe.get("split", "all")
    if isinstance(data, list) and people.name in data:
        if learned == judged or "all" in (learned, judged):
            yield f"the network learned from split {learned} of {people.name}: it is judged on people whom it knows"
        elif judged == "val" and "validation_mm" in run:
            yield "the network's run was validated on this split: its best.safetensors was chosen by these people"
    made = people.dataset.card.settings if people.kind == "synth" else {}
    synthesized = recipe["mix"] if "mix" in recipe else not recipe.get("shards")
    alike = made.get("what") == "people" and all(made.get(name) == recipe.get(name) for name in ("seed", "scene"))
    if synthesized and alike:
        yield (
            f"the network learned from synthesized people of seed {made['seed']}, as these are: they may be the "
            "very same; make others by lidarpose synth --seed"
        )
