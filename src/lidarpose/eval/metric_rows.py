"""From judged people to lines of figures: everything that scores.json says can be computed again from poses.parquet.

A line's interval is drawn with a generator of its own name, so that no line depends on what else is reported.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.dataset import hidden_share
from lidarpose.eval.metrics.aggregate import mean
from lidarpose.eval.metrics.bootstrap import interval
from lidarpose.eval.metrics.calibration import auroc, calibration_error
from lidarpose.eval.metrics.groups import DISTANCE_EDGES, OCCLUSION_EDGES, POINT_EDGES, joint_groups, span_rows
from lidarpose.eval.metrics.joint_errors import acceleration_errors, aligned_errors, joint_hits
from lidarpose.eval.metrics.keypoints import PCK_THRESHOLDS, box_hits, oks, oks_hits, oks_sigmas, pem
from lidarpose.eval.predictions import Judged
from lidarpose.eval.scores import RELEASED, Line, Setting, number
from lidarpose.sample import HIT, SEEN

# people of fewer points do not tell where they face
PLENTY = 100
_REPEATS = 1000
# frames count as evenly apart where two steps differ by less than this share
_EVEN = 0.2


def lines_of(judged: Judged, setting: Setting, *, legacy: bool = False) -> tuple[Line, ...]:
    """The lines of a dataset's people; legacy: also with the released code's arithmetic."""
    figures = _Figures(judged=judged.of(~judged.moving), setting=setting)
    lines = [*_whole(figures), *_by_joint(figures), *_by_people(figures), *_waymo(figures)]
    lines += [*_confidence(figures), *_motion(judged, setting)]
    if legacy:
        lines += _legacy(figures)
    return tuple(lines)


def headline(judged: Judged, setting: Setting) -> tuple[Line, ...]:
    """The lines over everybody and by condition alone: what is reported of a floor."""
    figures = _Figures(judged=judged.of(~judged.moving), setting=setting)
    conditions = (figures.lines("mpjpe", title, of, rows) for title, of, rows in _conditions(figures.judged))
    return tuple([*_whole(figures), *(line for lines in conditions for line in lines)])


@dataclass(frozen=True, kw_only=True)
class _Figures:
    """Tables of people in joints, and lines made of them."""

    judged: Judged
    setting: Setting
    tables: dict[str, np.ndarray] = field(init=False)
    units: dict[str, str] = field(init=False)

    def __post_init__(self):
        pred, true, known = self.judged.filled, self.judged.true, self.judged.labelled
        tables = {
            "mpjpe": self.judged.errors(),
            "pa_mpjpe": aligned_errors(pred, true, known),
            "pck3": joint_hits(pred, true, known, threshold=0.3),
            "pck5": joint_hits(pred, true, known, threshold=0.5),
        }
        object.__setattr__(self, "tables", tables)
        object.__setattr__(self, "units", {name: "%" if name.startswith("pck") else "mm" for name in tables})

    @cached_property
    def clusters(self) -> np.ndarray | None:
        """(N,) the sequence of each person, or None where people are independent."""
        return self.judged.sequence if self.setting.clusters else None

    def lines(
        self, figure: str, group: str, of: str, rows: np.ndarray, joints: np.ndarray | None = None
    ) -> Iterator[Line]:
        """The line of a table's figure for people `rows` (N,) bool and some joints; nothing where there is nobody."""
        if rows.any():
            table = self.tables[figure][rows]
            table = table if joints is None else table[:, joints]
            no_pose = int((~self.judged.posed[rows]).sum())
            clusters = None if self.clusters is None else self.clusters[rows]
            yield line(table, self.setting, figure, group, of, self.units[figure], clusters=clusters, no_pose=no_pose)


def line(
    table: np.ndarray,
    setting: Setting,
    figure: str,
    group: str,
    of: str,
    unit: str,
    *,
    average: str = "person",
    clusters: np.ndarray | None = None,
    no_pose: int = 0,
) -> Line:
    """The mean of a table (n, J) or (n,) as a line; see `Interval.stated`."""
    score = mean(table, average)
    name = f"{setting.method}/{figure}/{group}/{of}"
    rng = np.random.default_rng([setting.seed, zlib.crc32(name.encode())])
    low, high = interval(table, rng, average, clusters=clusters, repeats=_REPEATS).stated
    told = _told(setting)
    return Line(
        figure=figure,
        group=group,
        of=of,
        value=number(score),
        unit=unit,
        low=low,
        high=high,
        people=score.people,
        joints=score.joints,
        skipped=score.skipped - no_pose,
        no_pose=no_pose,
        **told,
    )


def _told(setting: Setting) -> dict:
    names = ("method", "protocol", "centring", "split", "limit")
    return {name: getattr(setting, name) for name in names}


def _whole(figures: _Figures) -> Iterator[Line]:
    everybody = np.ones(len(figures.judged), bool)
    for figure in figures.tables:
        yield from figures.lines(figure, "all", "all", everybody)
    turned = turned_round(figures.judged)
    plenty = figures.judged.points >= PLENTY
    if plenty.any() and not np.isnan(turned[plenty]).all():
        no_pose = int((~figures.judged.posed[plenty]).sum())
        clusters = None if figures.clusters is None else figures.clusters[plenty]
        of = f"{PLENTY} and more"
        table = 100 * turned[plenty]
        yield line(table, figures.setting, "turned_round", "points", of, "%", clusters=clusters, no_pose=no_pose)


def _by_joint(figures: _Figures) -> Iterator[Line]:
    everybody = np.ones(len(figures.judged), bool)
    for name, joints in joint_groups(figures.judged.skeleton).items():
        if name != "all":
            for figure in figures.tables:
                yield from figures.lines(figure, "joints", name, everybody, joints)


def _conditions(judged: Judged) -> Iterator[tuple[str, str, np.ndarray]]:
    """(title, name, rows) of what synthetic people are told apart by."""
    for title in ("condition", "poses", "sensor"):
        values = getattr(judged, title)
        for of in sorted(set(values[values != ""].tolist())):
            yield title, of, values == of
    if judged.plain.any():
        yield "plain", "upright, whole, uncluttered, 100 points", judged.plain


def _by_people(figures: _Figures) -> Iterator[Line]:
    judged = figures.judged
    spans = {"distance, m": (judged.distance, DISTANCE_EDGES), "points": (judged.points.astype(float), POINT_EDGES)}
    hidden = judged.hidden if not np.isnan(judged.hidden).all() else hidden_share(judged.labels)
    spans["hidden share"] = (hidden, OCCLUSION_EDGES)
    groups = [*_conditions(judged)]
    for title, (values, edges) in spans.items():
        groups += ((title, of, rows) for of, rows in span_rows(values, edges).items() if rows.any())
    for title, of, rows in groups:
        for figure in ("mpjpe", "pa_mpjpe"):
            yield from figures.lines(figure, title, of, rows)


def _waymo(figures: _Figures) -> Iterator[Line]:
    """Waymo's own figures, where boxes are labelled and it has a sigma for each joint."""
    judged, setting = figures.judged, figures.setting
    if setting.kind != "waymo":
        return
    try:
        sigmas = oks_sigmas(judged.skeleton)
    except InputError:
        return
    boxed = np.isfinite(judged.box).all(1)
    if (judged.posed & boxed).any():
        yield from _in_boxes(figures, judged.posed & boxed, sigmas)
    if boxed.any():
        yield _pem(judged.of(boxed), setting)


def _in_boxes(figures: _Figures, rows: np.ndarray, sigmas: np.ndarray) -> Iterator[Line]:
    """PCK and OKS-AP of people `rows` (N,) who have a pose and a box."""
    judged, setting = figures.judged, figures.setting
    some = judged.of(rows)
    pred, true, known, size = some.pred, some.true, some.labelled, some.box[:, 3:6]
    clusters = None if figures.clusters is None else figures.clusters[rows]
    no_pose = int((~judged.posed).sum())
    for threshold in PCK_THRESHOLDS:
        table = box_hits(pred, true, size, known, threshold=threshold)
        made = line(table, setting, f"pck_box@{threshold:g}", "all", "all", "%", average="joint", clusters=clusters)
        yield replace(made, no_pose=no_pose)
    table = oks_hits(oks(pred, true, size, known, sigmas=sigmas))
    yield replace(line(table, setting, "oks_ap", "all", "all", "%", clusters=clusters), no_pose=no_pose)


def _pem(judged: Judged, setting: Setting) -> Line:
    """People are predicted in their own labelled boxes, so nobody is made up; who has no pose is missed. Labels that
    are hidden do not count, as in Waymo's rules."""
    frames = {}
    for k, key in enumerate(zip(judged.sequence.tolist(), judged.frame.tolist(), strict=True)):
        frames.setdefault(key, []).append(k)
    seen = judged.labels == SEEN
    rows = [np.array(own) for own in frames.values()]
    found = pem(
        [judged.pred[own][judged.posed[own]] for own in rows],
        [judged.true[own] for own in rows],
        [judged.box[own] for own in rows],
        [seen[own] for own in rows],
    )
    return Line(
        figure="pem",
        group="all",
        of="all",
        value=number(found.pem),
        unit="mm",
        people=found.people,
        joints=found.matched + found.missed + found.extra,
        skipped=found.people_excused,
        no_pose=int((~judged.posed).sum()),
        **_told(setting),
    )


def _confidence(figures: _Figures) -> Iterator[Line]:
    """How far stated confidence is from the truth, in percent, and how well it ranks hits before misses."""
    judged = figures.judged
    error = figures.tables["mpjpe"]
    known = ~np.isnan(error) & ~np.isnan(judged.confidence)
    if not known.any():
        return
    stated, hit = judged.confidence[known].astype(float), error[known] < 1e3 * HIT
    found = {"calibration_error": 100 * calibration_error(stated, hit)}
    if 0 < hit.mean() < 1:
        found["auroc"] = 100 * auroc(stated, hit)
    people = int(known.any(1).sum())
    for figure, value in found.items():
        yield Line(
            figure=figure,
            group="all",
            of="all",
            value=number(value),
            unit="%",
            people=people,
            joints=int(known.sum()),
            skipped=int((judged.posed & ~known.any(1)).sum()),
            no_pose=int((~judged.posed).sum()),
            **_told(figures.setting),
        )


def triples(judged: Judged) -> np.ndarray:
    """(T, 3) rows: frames of one person in one sequence, each with a pose, that follow each other evenly."""
    names = zip(judged.sequence.tolist(), judged.track.tolist(), strict=True)
    _, owner = np.unique([f"{sequence}\0{track}" for sequence, track in names], return_inverse=True)
    order = np.lexsort((judged.frame, owner))
    if len(order) < 3:
        return np.empty((0, 3), int)
    rows = np.stack([order[:-2], order[1:-1], order[2:]], 1)
    first, second = (np.diff(judged.time[rows], axis=1)[:, k] for k in (0, 1))
    with np.errstate(invalid="ignore"):
        # of one person: a step from one track's end to the next one's beginning is nobody's
        even = (owner[rows] == owner[rows[:, :1]]).all(1) & (first > 0) & (np.abs(second - first) < _EVEN * first)
        # the sequence's own step: not one that skips frames
        step = np.full(int(owner.max()) + 1, np.inf)
        np.minimum.at(step, owner[rows[even, 0]], first[even])
        even &= first < (1 + _EVEN) * step[owner[rows[:, 0]]]
    return rows[even & judged.posed[rows].all(1)]


def _motion(judged: Judged, setting: Setting) -> Iterator[Line]:
    """Acceleration error over all triples of frames that follow each other, in mm a frame squared."""
    # people evenly picked out of sequences do not follow each other
    rows = triples(judged) if setting.limit is None else np.empty((0, 3), int)
    if not len(rows):
        return
    known = judged.labelled[rows]
    table = acceleration_errors(judged.filled[rows], judged.true[rows], 1.0, known)
    clusters = judged.sequence[rows[:, 0]]
    yield line(table, setting, "acceleration", "all", "frames in a row", "mm/frame²", clusters=clusters)


def _legacy(figures: _Figures) -> Iterator[Line]:
    """The released code's arithmetic on people with a pose; see docs/evaluate.md for what differs."""
    judged = figures.judged
    tables = {name: table[judged.posed] for name, table in figures.tables.items()}
    some = judged.of(judged.posed)
    if not len(some):
        return
    # its alignment takes every joint, so it has none where a joint is not labelled
    tables.pop("pa_mpjpe")
    if not np.isnan(some.true).any():
        tables["pa_mpjpe"] = aligned_errors(some.pred, some.true, legacy=True)
    for figure, table in tables.items():
        for name, joints in joint_groups(judged.skeleton).items():
            if figure.startswith("pck") and name != "all":
                continue
            score = mean(table[:, joints], empty=np.nan if figure.startswith("pck") else 0.0)
            yield Line(
                figure=figure,
                group="all" if name == "all" else "joints",
                of=name,
                value=number(score),
                unit=figures.units[figure],
                people=score.people,
                joints=score.joints,
                skipped=0,
                no_pose=len(judged) - len(some),
                arithmetic=RELEASED,
                **_told(figures.setting),
            )


def turned_round(judged: Judged) -> np.ndarray:
    """(N,): 1 where the predicted person faces over 90 degrees away from the true one, by hips and shoulders seen from
    above, else 0; NaN where these are not labelled or there is no pose."""
    of = judged.skeleton
    pairs = [
        (of.index(f"left_{joint}"), of.index(f"right_{joint}"))
        for joint in ("hip", "shoulder")
        if f"left_{joint}" in of.joints and f"right_{joint}" in of.joints
    ]
    if not pairs:
        return np.full(len(judged), np.nan)
    ends = np.array(pairs)
    known = judged.labelled[:, ends.ravel()].all(1)
    across = [
        np.where(known[:, None, None], j, 0)
        for j in (
            judged.filled[:, ends[:, 0]] - judged.filled[:, ends[:, 1]],
            judged.true[:, ends[:, 0]] - judged.true[:, ends[:, 1]],
        )
    ]
    predicted, true = (one.sum(1)[:, :2] for one in across)
    return np.where(known, ((predicted * true).sum(1) < 0).astype(float), np.nan)
