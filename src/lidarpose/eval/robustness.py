"""The paper's stability study as curves, and what it left out: error against how much the points were disturbed.

Each amount is tried on the same people with the same random numbers, so a curve's points differ in the amount alone.
"""

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lidarpose.errors import InputError, MissingExtra
from lidarpose.eval.dataset import BENCH, Person, spread
from lidarpose.eval.metrics.aggregate import mean
from lidarpose.eval.metrics.bootstrap import interval, paired_interval
from lidarpose.eval.metrics.groups import joint_groups
from lidarpose.eval.perturb import DISTURBANCES
from lidarpose.eval.predictions import Judged, gathered
from lidarpose.eval.run import Task
from lidarpose.eval.scores import Setting, number
from lidarpose.sample import SEEN, Box
from lidarpose.skeleton import BODY26

SCHEMA = "lidarpose.stability/1"
# people of a dataset that are disturbed, evenly spread, and people cast anew for each sensor
PEOPLE, CAST = 1000, 200
# the paper's statistics of end joints are of so many instances; of fewer people the worst share
WORST, WORST_SHARE = 600, 0.3
ENDS = ("head", "wrists", "hands", "ankles", "feet")
# of the bench these alone are disturbed: the others have something wrong already
_CLEAN = "clean"
_REPEATS = 1000
# sensors that people are cast for anew, with few beams first; seeds that neither training nor the bench uses
SENSORS = (
    *("vlp-16", "hdl-32e", "vlp-32c", "os1-64", "hdl-64e", "os1-128", "pandar64", "waymo-top", "av2"),
    *("livox-mid360", "livox-avia"),
)
_SEED = 720_000
_DISTANCE = (4.0, 20.0)


@dataclass(frozen=True, kw_only=True)
class Point:
    """One amount. mpjpe mm with its 95 % interval; increase over the undisturbed, mm, of those who have a pose in both,
    with its paired interval; people, of whom no_pose have no answer; points: the median number of a person's points."""

    amount: float
    label: str
    mpjpe: float | None
    low: float | None
    high: float | None
    increase: float | None
    increase_low: float | None
    increase_high: float | None
    people: int
    no_pose: int
    points: float


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A disturbance's points, the first being the undisturbed (of sensors there is none: labels are their names)."""

    name: str
    title: str
    says: str
    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True)
class End:
    """Errors of an end joint's group in mm over the worst people: mean, standard deviation, quartiles; people; worst:
    how many of all judged."""

    group: str
    mean: float
    deviation: float
    quartiles: tuple[float, float, float]
    people: int
    worst: int


@dataclass(frozen=True, kw_only=True)
class Stability:
    """A study. who: the people disturbed, in words; notes: what could not be done."""

    setting: Setting
    who: str
    curves: tuple[Curve, ...]
    ends: tuple[End, ...]
    notes: tuple[str, ...]


def study(
    task: Task,
    judged: Judged,
    *,
    people: list["Shown"] | None = None,
    sensors: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Stability:
    """The study of a task's people, whom `judged` holds undisturbed; people: whom to disturb, by default `to_disturb`;
    sensors: also people cast anew for other sensors."""
    people = to_disturb(task) if people is None else people
    undisturbed = _answers(task, [one.person for one in people])
    base = undisturbed.errors()
    clusters = np.array([one.person.sequence for one in people]) if task.setting.clusters else None
    seed = task.setting.seed
    whole = _point(undisturbed, base, 0.0, "0", [len(one.person.points) for one in people], seed, clusters)
    curves = []
    for name, disturbance in DISTURBANCES.items():
        points = [whole]
        for amount in disturbance.amounts:
            shown = [_disturbed(task, one, name, amount) for one in people]
            counts = [len(one.points) for one in shown]
            label = f"{amount * disturbance.scale:.4g}"
            points.append(_point(_answers(task, shown), base, amount, label, counts, seed, clusters))
            if progress is not None:
                progress(len(people))
        curves.append(Curve(name=name, title=disturbance.title, says=disturbance.says, points=tuple(points)))
    notes = []
    if sensors and task.setting.protocol == "clean":
        try:
            curves.append(_sensors(task, progress))
        except (MissingExtra, ModuleNotFoundError):
            notes.append("other sensors need people cast anew: in the clone, pip install '.[synth]'")
    elif sensors:
        notes.append("other sensors: people cast anew have no released center")
    who = f"{len(people):,} {_who(task.setting)}"
    return Stability(setting=task.setting, who=who, curves=tuple(curves), ends=end_errors(judged), notes=tuple(notes))


def end_errors(judged: Judged) -> tuple[End, ...]:
    """The errors of the end joints over the 600 people whose mean errors are largest, of fewer than 2,000 people the
    worst 30 %."""
    table = judged.of(~judged.moving & judged.posed).errors()
    table = table[~np.isnan(table).all(1)]
    worst = min(WORST, int(np.ceil(WORST_SHARE * len(table))))
    table = table[np.argsort(-np.nanmean(table, 1), kind="stable")[:worst]]
    groups = joint_groups(judged.skeleton)
    out = []
    for name in ENDS:
        if name not in groups:
            continue
        error = table[:, groups[name]]
        own = error[~np.isnan(error)]
        if len(own):
            low, middle, high = np.quantile(own, [0.25, 0.5, 0.75]).tolist()
            people = int((~np.isnan(error)).any(1).sum())
            told = {"mean": float(own.mean()), "deviation": float(own.std()), "quartiles": (low, middle, high)}
            out.append(End(group=name, people=people, worst=worst, **told))
    return tuple(out)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Somebody as the protocol shows them; whole: with all points that the dataset holds; box: that of the crop."""

    person: Person
    whole: Person
    box: Box | None


def to_disturb(task: Task) -> list[Shown]:
    """Of lidarpose-bench its clean people, of other datasets at most `PEOPLE`, evenly spread. Raises InputError where
    nobody has a point."""
    setting = task.setting
    if setting.kind == BENCH:
        found = [one for one in task.people if one.condition == _CLEAN and not one.moving]
    else:
        chosen = set(spread(task.people.count, PEOPLE).tolist())
        found = [one for k, one in enumerate(task.people) if k in chosen]
    # who is not judged is not disturbed either
    fit = [(task.fit(one)[0], one) for one in found]
    shown = [
        Shown(person=seen, whole=one, box=task.box(one)) for seen, one in fit if seen is not None and len(seen.points)
    ]
    if not shown:
        raise InputError(f"none of the {_who(setting)} has a point to disturb: judge more people, or no --stability")
    return shown


def _who(setting: Setting) -> str:
    return f"{'clean ' if setting.kind == BENCH else ''}people of {setting.dataset}"


def _disturbed(task: Task, shown: Shown, name: str, amount: float) -> Person:
    person = shown.person
    seed = [task.setting.seed, zlib.crc32(name.encode()), person.shard, person.row]
    # a displaced box may let in what the dataset holds around the person
    points = (shown.whole if name == "crop" else person).points.astype(float)

    def does(places: np.ndarray) -> np.ndarray:
        return DISTURBANCES[name].does(places, shown.box, amount, np.random.default_rng(seed))

    if not DISTURBANCES[name].rigid:
        return replace(person, points=does(points))
    return replace(
        person,
        points=does(points),
        joints=does(person.joints),
        box=person.box and replace(person.box, center=does(person.box.center)),
        centers={name: does(center) for name, center in person.centers.items()},
    )


def _answers(task: Task, people: list[Person]) -> Judged:
    return gathered(task.joints, task.answered(people))


def _point(
    answers: Judged,
    base: np.ndarray,
    amount: float,
    label: str,
    counts: list[int],
    seed: int,
    clusters: np.ndarray | None = None,
) -> Point:
    """One amount's point; base (n, J) mm: the errors of the same people undisturbed."""
    rng = np.random.default_rng([zlib.crc32(label.encode()), seed])
    # NaN without a label, a row of NaN without a pose
    found = answers.errors()
    both = ~np.isnan(found) & ~np.isnan(base)
    first, second = np.where(both, found, np.nan), np.where(both, base, np.nan)
    low, high = interval(found, rng, clusters=clusters, repeats=_REPEATS).stated
    increase_low, increase_high = paired_interval(first, second, rng, clusters=clusters, repeats=_REPEATS).stated
    return Point(
        amount=amount,
        label=label,
        mpjpe=number(mean(found)),
        low=low,
        high=high,
        increase=number(mean(first - second)),
        increase_low=increase_low,
        increase_high=increase_high,
        people=len(found),
        no_pose=int((~answers.posed).sum()),
        points=float(np.median(counts)),
    )


def _sensors(task: Task, progress: Callable[[int], None] | None) -> Curve:
    """The same bodies in the same poses at the same places before each sensor, however little it sees of them, nothing
    around them."""
    from lidarpose.synth.generator import Generator
    from lidarpose.synth.scene import scene_config

    scene = scene_config("wild")
    scene = replace(
        scene,
        distance=_DISTANCE,
        # uniform: the law of counts would bring people nearer to coarser sensors
        median_points=0,
        **dict.fromkeys(("clutter", "occluder", "company"), 0.0),
        noise=replace(scene.noise, mask=0.0, clutter=0.0, missing_part=0.0),
        crop=replace(scene.crop, jitter=0.03, loose=0.0, cut=0.0),
    )
    pick = BODY26.map_to(task.people.skeleton)
    points = []
    for k, name in enumerate(SENSORS):
        generator = Generator(scene=replace(scene, sensors=(name,)), measure=False, redraw=False)
        samples = [generator.person(_SEED, index).sample for index in range(CAST)]
        people = [
            Person(
                shard=k,
                row=row,
                points=sample.points,
                joints=sample.pose.joints[pick],
                labels=np.full(len(pick), SEEN, np.uint8),
                box=sample.box,
                sequence=str(row),
                frame=0,
                track="0",
                time=np.nan,
                distance=float(np.linalg.norm(sample.center)),
                hidden=np.nan,
            )
            for row, sample in enumerate(samples)
        ]
        found = _answers(task, people)
        counts = [len(one.points) for one in people]
        made = _point(found, found.errors(), float(k), name, counts, task.setting.seed)
        points.append(replace(made, increase=None, increase_low=None, increase_high=None))
        if progress is not None:
            progress(len(people))
    return Curve(
        name="sensors",
        title="other sensors",
        says=f"{CAST} people of the procedural prior, {_DISTANCE[0]:g} to {_DISTANCE[1]:g} m away, cast anew for each "
        "sensor: the same bodies, poses and places, nothing around them",
        points=tuple(points),
    )


def to_json(studies: Sequence[Stability], *, head: dict[str, Any]) -> str:
    """stability.json; head: version, command, weights and seed, as in scores.json."""
    found = {"schema": SCHEMA} | head | {"studies": [asdict(study) for study in studies]}
    return json.dumps(found, indent=1) + "\n"
