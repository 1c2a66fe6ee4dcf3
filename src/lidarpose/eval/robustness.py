"""The paper's stability study as curves, extended: error against the amount by which the points are perturbed.

Each amount is applied to the same people with the same random numbers, so the points of a curve differ only in the
amount. To add a perturbation: write a pure function of (points, box, amount, rng) and add it to `PERTURBATIONS`.
"""

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lidarpose.errors import InputError, MissingExtra
from lidarpose.eval.dataset import BENCH, EvalSample, evenly_drawn
from lidarpose.eval.metrics.aggregate import interval, joint_groups, mean, paired_interval
from lidarpose.eval.predictions import Predictions
from lidarpose.eval.protocols import EvalSetup
from lidarpose.eval.scores import Setting, number
from lidarpose.geometry import axis_angle_to_matrix
from lidarpose.sample import SEEN, Box, LabeledSample, Pose, center_of
from lidarpose.skeleton import BODY26
from lidarpose.synth.noise import jitter, noise_cluster, random_keep

SCHEMA = "lidarpose.stability/1"
# number of people of a dataset that are perturbed, evenly spread, and of people simulated for each sensor
PEOPLE, CAST = 1000, 200
# the paper's statistics of end joints use this many instances; smaller sets use this share of their people
WORST, WORST_SHARE = 600, 0.3
ENDS = ("head", "wrists", "hands", "ankles", "feet")
# condition of the only people of the bench that are perturbed: the others are already degraded
_CLEAN = "clean"
_REPEATS = 1000
# sensors that people are simulated for, those with few beams first; the seed is used by no training, but by bench-2
SENSORS = (
    *("vlp-16", "hdl-32e", "vlp-32c", "os1-64", "hdl-64e", "os1-128", "pandar64", "waymo-top", "av2"),
    *("livox-mid360", "livox-avia"),
)
_SEED = 720_000
_DISTANCE = (4.0, 20.0)
# number of clusters in the paper's perturbation, as in its released code
_CLUSTERS = 2
# standard deviation of the jitter as a multiple of its clip: 4.6 % of normal steps are clipped
_SIGMA = 0.5
# margin of the box about the points for datasets without boxes, m
_MARGIN = 0.05


# ---- perturbations: points (n, 3) m with the sensor at the origin, box, amount, rng -> points; 0 changes nothing


def with_clusters(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Adds two clusters of `amount` clutter points each around the person."""
    center = center_of(points)
    # one generator per cluster: the positions of the clusters do not depend on the amount
    return np.concatenate([points, *(noise_cluster(center, count=int(amount), rng=r) for r in rng.spawn(_CLUSTERS))])


def behind_an_edge(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Removes a share `amount` of the points, those behind an opaque object with one straight edge: the end of a wall,
    a parapet, a car. The edge is straight as seen from the origin and has a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    center = points.mean(0)
    # coordinates as seen from the sensor: left and up, as tangents of the angles from the direction of the points' mean
    forward = np.array([center[0], center[1], 0]) / max(np.hypot(center[0], center[1]), 1e-6)
    depth = np.maximum(points @ forward, 1e-3)
    left = points @ np.array([-forward[1], forward[0], 0]) / depth
    coordinate = np.cos(angle) * left + np.sin(angle) * points[:, 2] / depth
    is_visible = np.ones(len(points), bool)
    is_visible[np.argsort(coordinate, kind="stable")[: int(round(amount * len(points)))]] = False
    return points[is_visible]


def moved_box(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> Box:
    """The person's box moved by `amount` m in a random horizontal direction; without a box, the points' bounding box
    with a margin of 5 cm."""
    if box is None:
        low, high = points.min(0) - _MARGIN, points.max(0) + _MARGIN
        box = Box(center=(low + high) / 2, size=high - low)
    angle = rng.uniform(0, 2 * np.pi)
    return replace(box, center=box.center + amount * np.array([np.cos(angle), np.sin(angle), 0]))


def out_of_level(points: np.ndarray, box: Box | None, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Rotates everything by `amount` rad about a random horizontal axis through the sensor, as if the sensor were
    mounted at a tilt and its own axis were taken as up."""
    angle = rng.uniform(0, 2 * np.pi)
    R_tilted_level = axis_angle_to_matrix(amount * np.array([np.cos(angle), np.sin(angle), 0.0]))
    return points @ R_tilted_level.T


@dataclass(frozen=True)
class Perturbation:
    """apply(points, box, amount, rng) -> points; title, with the unit of the amounts; amounts that a study applies;
    says: a description in words; scale: amounts are printed times this; rigid: the whole frame moves, labels too."""

    apply: Callable[[np.ndarray, Box | None, float, np.random.Generator], np.ndarray]
    title: str
    amounts: tuple[float, ...]
    says: str
    scale: float = 100
    rigid: bool = False


PERTURBATIONS = {
    "jitter": Perturbation(
        lambda points, box, amount, rng: jitter(points, sigma=_SIGMA * amount, clip=amount, rng=rng),
        "point jitter, clip in cm",
        (0.02, 0.05, 0.1, 0.15, 0.2),
        "normal noise on each coordinate, clipped, with half the clip as standard deviation",
    ),
    "clusters": Perturbation(
        with_clusters,
        "points in each of two noise clusters",
        (10, 25, 50, 100, 200),
        "two clusters of 0.3 m radius, up to 0.4 m (in height 0.8 m) from the middle of the points",
        scale=1,
    ),
    "dropped": Perturbation(
        # points dropped at one amount are also dropped at each larger one
        lambda points, box, amount, rng: points[random_keep(len(points), share=amount, rng=rng)],
        "points dropped, %",
        (0.25, 0.5, 0.75, 0.9, 0.95),
        "a random share of the points is removed",
    ),
    "occluder": Perturbation(
        behind_an_edge,
        "points behind an edge, %",
        (0.1, 0.25, 0.4, 0.55, 0.7),
        "all points on one side of a straight edge in the sensor's view are removed; its direction is random",
    ),
    "crop": Perturbation(
        lambda points, box, amount, rng: points[moved_box(points, box, amount, rng).contains(points)],
        "box displaced, cm",
        (0.05, 0.1, 0.2, 0.3, 0.4),
        "the crop's box is moved in a random level direction; points outside it are removed, none are added unless "
        "the dataset contains points around the box",
    ),
    "tilt": Perturbation(
        out_of_level,
        "frame out of level, deg",
        tuple(np.radians([5.0, 10.0, 15.0, 20.0, 30.0]).tolist()),
        "the sensor is tilted in a random direction, and its own axis is taken as up",
        scale=180 / np.pi,
        rigid=True,
    ),
}


# ---- results of a study; the fields are the keys of stability.json


@dataclass(frozen=True, kw_only=True)
class Point:
    """One amount. mpjpe mm with its 95 % interval; increase over the unperturbed points, mm, of people with a pose in
    both cases, with its paired interval; people, of which no_pose have no pose; points: the median number of points per
    person."""

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
    """A perturbation's points, the first one unperturbed (none for sensors, whose labels are their names)."""

    name: str
    title: str
    says: str
    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True)
class End:
    """Errors of a group of end joints in mm over the people with the largest errors: mean, standard deviation,
    quartiles; people; worst: number of people selected from all scored."""

    group: str
    mean: float
    deviation: float
    quartiles: tuple[float, float, float]
    people: int
    worst: int


@dataclass(frozen=True, kw_only=True)
class Stability:
    """A study. who: the perturbed people, in words; notes: what could not be evaluated."""

    setting: Setting
    who: str
    curves: tuple[Curve, ...]
    ends: tuple[End, ...]
    notes: tuple[str, ...]


def to_json(studies: Sequence[Stability], *, head: dict[str, Any]) -> str:
    """stability.json; head: version, command, weights and seed, as in scores.json."""
    return json.dumps({"schema": SCHEMA} | head | {"studies": [asdict(study) for study in studies]}, indent=1) + "\n"


# ---- the study


@dataclass(frozen=True, kw_only=True)
class CroppedPerson:
    """A person as cropped by the protocol (`shown`); whole: with all points that the dataset holds."""

    shown: EvalSample
    whole: EvalSample


def people_to_perturb(setup: EvalSetup) -> list[CroppedPerson]:
    """The clean people of lidarpose-bench, or at most `PEOPLE` people of another dataset, evenly spread. Raises
    InputError if none of them has a point."""
    if setup.setting.kind == BENCH:
        samples = [person for person in setup.dataset if person.condition == _CLEAN and not person.moving]
    else:
        rows = set(evenly_drawn(setup.dataset.count, PEOPLE).tolist())
        samples = [person for k, person in enumerate(setup.dataset) if k in rows]
    # people that are not scored are not perturbed either
    pairs = [(setup.crop_sample(person)[0], person) for person in samples]
    people = [
        # perturbed points have no times
        CroppedPerson(shown=replace(crop, point_times=None), whole=person)
        for crop, person in pairs
        if crop is not None and len(crop.points)
    ]
    if not people:
        raise InputError(
            f"none of the {_people_text(setup)} has a point to perturb: score more people, or leave stability out"
        )
    return people


def study(
    setup: EvalSetup,
    predictions: Predictions,
    setting: Setting | None = None,
    *,
    people: list[CroppedPerson] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Stability:
    """The study of a dataset's people.

    Args:
        predictions: of the unperturbed dataset.
        setting: of the result of `evaluate_dataset`, which knows of which people the sensor position is known; None
            for that of `setup`.
        people: people to perturb, by default `people_to_perturb`.
        progress: progress(done, 0) is called as people are predicted.
    """
    people = people_to_perturb(setup) if people is None else people
    setting = setting or setup.setting
    if setup.dataset.count > PEOPLE:
        # a draw from the dataset, as with a limit
        setup = replace(setup, dataset=replace(setup.dataset, limit=PEOPLE))
        if setting.kind != BENCH:
            setting = replace(setting, limit=PEOPLE)
    num_predicted = 0

    def advance(count: int) -> None:
        nonlocal num_predicted
        progress(num_predicted := num_predicted + count, 0)

    advance(0)
    base_predictions = setup.predict([person.shown for person in people])
    base_errors = base_predictions.errors()
    base_point = _point(base_predictions, base_errors, 0.0, "0", setup.setting)
    curves = []
    for name, perturbation in PERTURBATIONS.items():
        points = [base_point]
        for amount in perturbation.amounts:
            perturbed_predictions = setup.predict([_perturbed(setup, person, name, amount) for person in people])
            label = f"{amount * perturbation.scale:.4g}"
            points.append(_point(perturbed_predictions, base_errors, amount, label, setup.setting))
            advance(len(people))
        curves.append(Curve(name=name, title=perturbation.title, says=perturbation.says, points=tuple(points)))
    notes = []
    if setup.setting.protocol == "clean":
        try:
            curves.append(_sensor_curve(setup, advance))
        except (MissingExtra, ModuleNotFoundError):
            notes.append('other sensors need new ray casts of people: in the clone, pip install ".[synth]"')
    else:
        notes.append("other sensors: people in new ray casts have no released center")
    who, ends = f"{len(people):,} {_people_text(setup)}", end_errors(predictions)
    return Stability(setting=setting, who=who, curves=tuple(curves), ends=ends, notes=tuple(notes))


def end_errors(predictions: Predictions) -> tuple[End, ...]:
    """The errors of the end joints over the 600 people with the largest mean errors; with fewer than 2,000 people, over
    the worst 30 %."""
    table = predictions.select(~predictions.moving & predictions.posed).errors()
    table = table[~np.isnan(table).all(1)]
    num_worst = min(WORST, int(np.ceil(WORST_SHARE * len(table))))
    table = table[np.argsort(-np.nanmean(table, 1), kind="stable")[:num_worst]]
    groups = joint_groups(predictions.skeleton)
    ends = []
    for name in ENDS:
        errors = table[:, groups.get(name, [])]
        is_labeled = ~np.isnan(errors)
        if is_labeled.any():
            group_errors = errors[is_labeled]
            values = {"mean": float(group_errors.mean()), "deviation": float(group_errors.std())}
            quartiles = tuple(np.quantile(group_errors, [0.25, 0.5, 0.75]).tolist())
            people = int(is_labeled.any(1).sum())
            ends.append(End(group=name, **values, quartiles=quartiles, people=people, worst=num_worst))
    return tuple(ends)


def _people_text(setup: EvalSetup) -> str:
    return f"{'clean ' if setup.setting.kind == BENCH else ''}people of {setup.setting.dataset}"


def _perturbed(setup: EvalSetup, person: CroppedPerson, name: str, amount: float) -> EvalSample:
    eval_sample, sample, box = person.shown, person.shown.sample, person.shown.crop_box
    seed = [setup.setting.seed, zlib.crc32(name.encode()), eval_sample.shard, eval_sample.row]
    # a displaced box may include other points that the dataset holds around the person
    points = (person.whole if name == "crop" else eval_sample).points.astype(float)

    def apply(positions: np.ndarray) -> np.ndarray:
        return PERTURBATIONS[name].apply(positions, eval_sample.crop_box, amount, np.random.default_rng(seed))

    if PERTURBATIONS[name].rigid:
        sample = replace(
            sample,
            pose=Pose(joints=apply(sample.joints), skeleton=sample.skeleton),
            box=sample.box and replace(sample.box, center=apply(sample.box.center)),
            centers={name: apply(center) for name, center in sample.centers.items()},
            background=None if sample.background is None else apply(sample.background).astype(np.float32),
            neighbors=None if sample.neighbors is None else apply(sample.neighbors).astype(np.float32),
        )
        box = box and replace(box, center=apply(box.center))
    elif name == "crop" and box is not None:
        box = moved_box(points, box, amount, np.random.default_rng(seed))
        # the released code's center of Waymo and HumanM3
        box_centers = dict.fromkeys({"box", "joints_box"} & set(sample.centers), box.center)
        sample = replace(sample, centers=sample.centers | box_centers)
    return replace(eval_sample, points=apply(points), sample=sample, crop_box=box)


def _point(predictions: Predictions, base_errors: np.ndarray, amount: float, label: str, setting: Setting) -> Point:
    """The point of one amount; base_errors (n, J) mm: errors of the same people without perturbation."""
    rng = np.random.default_rng([zlib.crc32(label.encode()), setting.seed])
    clusters = predictions.sequence if setting.clusters else None
    # NaN without a label, a row of NaN without a pose
    errors = predictions.errors()
    has_both = ~np.isnan(errors) & ~np.isnan(base_errors)
    paired_errors, paired_base = np.where(has_both, errors, np.nan), np.where(has_both, base_errors, np.nan)
    low, high = interval(errors, rng, clusters=clusters, repeats=_REPEATS).stated
    increase_low, increase_high = paired_interval(
        paired_errors, paired_base, rng, clusters=clusters, repeats=_REPEATS
    ).stated
    return Point(
        amount=amount,
        label=label,
        mpjpe=number(mean(errors)),
        low=low,
        high=high,
        increase=number(mean(paired_errors - paired_base)),
        increase_low=increase_low,
        increase_high=increase_high,
        people=len(errors),
        no_pose=int((~predictions.posed).sum()),
        points=float(np.median(predictions.points)),
    )


def _sensor_curve(setup: EvalSetup, advance: Callable[[int], None]) -> Curve:
    """The same bodies in the same poses at the same distances for each sensor, with nothing around them, even if a
    sensor sees little of them. Heights of sensors and directions to people differ."""
    from lidarpose.synth.generator import Generator
    from lidarpose.synth.scene import scene_config

    scene, points = scene_config("wild"), []
    num_people = min(CAST, setup.setting.limit or CAST)
    noise, crop = replace(scene.noise, mask=0.0, clutter=0.0, missing_part=0.0), replace(scene.crop, loose=0.0, cut=0.0)
    # uniform distances: `median_points` would place people nearer to coarser sensors
    scene = replace(scene, distance=_DISTANCE, median_points=0, clutter=0.0, occluder=0.0, company=0.0)
    scene = replace(scene, noise=noise, crop=replace(crop, jitter=0.03))
    for k, name in enumerate(SENSORS):
        generator = Generator(scene=replace(scene, sensors=(name,)), measure=False, redraw=False)
        samples = [generator.person(_SEED, index).sample for index in range(num_people)]
        predictions = setup.predict([_simulated(sample, setup, k, row) for row, sample in enumerate(samples)])
        # each person is a sequence of their own
        setting = replace(setup.setting, clusters=False)
        point = _point(predictions, predictions.errors(), float(k), name, setting)
        points.append(replace(point, increase=None, increase_low=None, increase_high=None))
        advance(len(samples))
    says = f"{num_people} people of the procedural prior, {_DISTANCE[0]:g} to {_DISTANCE[1]:g} m away, with a new ray "
    says += "cast for each sensor: the same bodies, poses and distances, nothing around them"
    return Curve(name="sensors", title="other sensors", says=says, points=tuple(points))


def _simulated(sample, setup: EvalSetup, shard: int, row: int) -> EvalSample:
    """A simulated sample with the joints of the evaluated dataset, all labeled as seen."""
    skeleton = setup.dataset.skeleton
    labeled_sample = LabeledSample(
        points=sample.points,
        center=sample.center,
        pose=Pose(joints=sample.pose.joints[BODY26.map_to(skeleton)], skeleton=skeleton),
        box=sample.box,
        joint_labels=np.full(len(skeleton), SEEN, np.uint8),
        sequence=str(row),
    )
    return EvalSample(sample=labeled_sample, points=sample.points, shard=shard, row=row, crop_box=sample.box)
