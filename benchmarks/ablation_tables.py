"""Tables of runs that differ in one thing each, from the scores of ablations.py and against_paper.py.

A difference to `base` is an effect of an additive model: error = variant + seed + noise, by least squares over all runs
of one length. A seed shows all variants the same people, so its effect is shared; the noise, taken as alike for all
variants, is what is left. The 95 % interval is Student's with the degrees of freedom that are left.
"""

import json
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from lidarpose.eval.scores import OURS, MetricRow, Result

BASE = "base"
# two-sided 95 % points of Student's t by degrees of freedom
_STUDENT = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 7: 2.36, 8: 2.31, 10: 2.23, 12: 2.18, 15: 2.13}
_STUDENT |= {20: 2.09, 30: 2.04, 60: 2.00}
# figures of a run that tables show: (group, of, figure) of `eval.scores.MetricRow`
FIGURES = {
    "all": ("all", "all", "mpjpe"),
    "plain": ("plain", None, "mpjpe"),
    "clean": ("condition", "clean", "mpjpe"),
    "cluttered": ("condition", "cluttered", "mpjpe"),
    "company": ("condition", "company", "mpjpe"),
    "crop": ("condition", "crop", "mpjpe"),
    "occluded": ("condition", "occluded", "mpjpe"),
    "turned round": ("points", "100 and more", "turned_round"),
    "PA": ("all", "all", "pa_mpjpe"),
}
_SHOWN = ("plain", "clean", "cluttered", "company", "occluded", "turned round")
# what the pages call figures and conditions, where the data has another name
WORDS = {"company": "second person", "crop": "poor box", "turned round": "facing > 90 deg off"}
_HEADER = tuple(WORDS.get(name, name) for name in _SHOWN)


def own_lines(result: Result) -> list[MetricRow]:
    """The lines of what was judged, without the floors', by this package's arithmetic."""
    return [x for x in result.lines if x.method == result.setting.method and x.arithmetic == OURS]


def figures(result: Result) -> dict[str, dict[str, float]]:
    """value, low and high of each of `FIGURES` that the result has."""
    found = {}
    for name, (group, of, figure) in FIGURES.items():
        fitting = (x for x in own_lines(result) if x.group == group and x.figure == figure and of in (None, x.of))
        if (line := next(fitting, None)) is not None:
            found[name] = {"value": line.value, "low": line.low, "high": line.high}
    return found


def collect(folder: Path, known: list[dict]) -> list[dict]:
    """What the runs of a folder scored, and those known that it does not hold, in a fixed order."""
    found = [json.loads(path.read_text()) for path in sorted(folder.rglob("scores.json"))]
    runs = {(run["variant"], run["begun"], run["people"], run["seed"]): run for run in known + found}
    return [runs[key] for key in sorted(runs)]


class Runs:
    """Runs of one length, by variant and seed. freedom: degrees of freedom of the noise; deviation: of a run but for
    its variant and seed, mm, NaN where nothing tells it."""

    def __init__(self, runs: list[dict], people: int):
        self.people = people
        self.by = {(run["variant"], run["seed"]): run for run in runs if run["people"] == people}
        variants = list(dict.fromkeys(name for name, _ in self.by))
        seeds = list(dict.fromkeys(seed for _, seed in self.by))
        self._columns = np.array(variants + [""] * len(seeds))
        self._design = np.array([[n == v for v in variants] + [s == x for x in seeds] for n, s in self.by], float)
        self._inverse = np.linalg.pinv(self._design.T @ self._design)
        self.freedom = len(self.by) - int(np.linalg.matrix_rank(self._design))
        found = self._found("all")
        left = found - self._design @ self._effects(found)
        self.deviation = float((left @ left / self.freedom) ** 0.5) if self.freedom else math.nan

    def seeds(self, variant: str) -> list[int]:
        return sorted(seed for name, seed in self.by if name == variant)

    def mean(self, variant: str, figure: str) -> float:
        return float(np.mean([self.by[variant, seed]["figures"][figure]["value"] for seed in self.seeds(variant)]))

    def difference(self, variant: str, figure: str = "all") -> float:
        """The variant's effect against `base`; NaN where no chain of seeds joins them."""
        contrast = self._contrast(variant)
        if not np.allclose(contrast @ self._inverse @ self._design.T @ self._design, contrast):
            return math.nan
        return float(contrast @ self._effects(self._found(figure)))

    def reach(self, variant: str) -> float:
        """Half the difference's interval; NaN where nothing tells the noise."""
        if not self.freedom:
            return math.nan
        contrast = self._contrast(variant)
        point = next(value for freedom, value in reversed(_STUDENT.items()) if freedom <= self.freedom)
        return float(point * self.deviation * (contrast @ self._inverse @ contrast) ** 0.5)

    def told(self, variant: str) -> str:
        """The difference and its interval, and whether it is one."""
        found, reach = self.difference(variant), self.reach(variant)
        if math.isnan(found):
            return "-"
        if math.isnan(reach):
            return f"{found:+.1f}"
        word = "" if abs(found) > reach else ", unresolved"
        return f"{found:+.1f} ± {reach:.1f}{word}"

    def _found(self, figure: str) -> np.ndarray:
        return np.array([run["figures"][figure]["value"] for run in self.by.values()])

    def _effects(self, found: np.ndarray) -> np.ndarray:
        return self._inverse @ self._design.T @ found

    def _contrast(self, variant: str) -> np.ndarray:
        return (self._columns == variant) * 1.0 - (self._columns == BASE)


Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]


def study(runs: list[dict], studies: Collection[str] | None = None) -> Rows:
    """The variants of some studies, or of all, beside `base`, at the length that most runs have."""
    own = _common(runs)
    names = dict.fromkeys(run["variant"] for run in runs if studies is None or run["study"] in studies)
    chosen = [variant for variant in names if variant != BASE and own.seeds(variant)]
    chosen.sort(key=lambda variant: own.mean(variant, "all"))
    header = ("", "MPJPE mm", "against base", *_HEADER, "seeds")
    return header, [_row(own, variant) for variant in (BASE, *chosen)]


def _row(own: Runs, variant: str) -> tuple[str, ...]:
    what = own.by[variant, own.seeds(variant)[0]]["what"]
    found = [f"{own.mean(variant, figure):.1f}" for figure in ("all", *_SHOWN)]
    found[-1] += " %"
    against = "" if variant == BASE else own.told(variant)
    return what, found[0], against, *found[1:], str(len(own.seeds(variant)))


def noise(runs: list[dict]) -> str:
    own = _common(runs)
    if not own.freedom:
        return f"{own.people:,} people per run, one seed: differences have no interval.\n"
    return (
        f"{own.people:,} people per run. Runs that differ only in their seed have a standard deviation of "
        f"{own.deviation:.1f} mm,\n"
        f"after removing what all variants of a seed share ({own.freedom} degrees of freedom).\n"
    )


def scaling(runs: list[dict], shipped: dict | None = None) -> Rows:
    """`base` by the number of people seen; runs of their own, each cooled, and what ships as the longest."""
    seen = sorted({run["people"] for run in runs if run["variant"] == BASE})
    lengths = {people: Runs(runs, people) for people in seen}
    found = {people: {name: own.mean(BASE, name) for name in ("all", *_SHOWN)} for people, own in lengths.items()}
    rows, before = [], None
    for people, own in (found | (shipped or {})).items():
        fall = "" if before is None else f"{(own['all'] - before[1]) / math.log2(people / before[0]):+.1f}"
        cells = [f"{own[name]:.1f}" for name in ("all", *_SHOWN)]
        rows.append((f"{people:,}", cells[0], fall, *cells[1:-1], f"{cells[-1]} %"))
        before = people, own["all"]
    return ("people seen", "MPJPE mm", "per doubling", *_HEADER), rows


def against_paper(runs: list[dict]) -> Rows:
    """`base` and the paper's design, at every length at which both ran."""
    rows = []
    for people in sorted({run["people"] for run in runs if run["study"] == "paper"}):
        own = Runs(runs, people)
        ways = [v for v in dict.fromkeys(run["variant"] for run in runs if run["study"] == "paper") if own.seeds(v)]
        rows += [_beside(own, variant) for variant in (BASE, *ways)]
    header = ("", "people seen", "parameters", "MPJPE mm", "plain", "clean", "cluttered", "lost to clutter")
    return (*header, "processor minutes"), rows


def _beside(own: Runs, variant: str) -> tuple[str, ...]:
    one = own.by[variant, own.seeds(variant)[0]]
    lost = own.mean(variant, "cluttered") - own.mean(variant, "clean")
    what = f"ours: {one['what']}" if variant == BASE else one["what"]
    found = [f"{own.mean(variant, figure):.1f}" for figure in ("all", "plain", "clean", "cluttered")]
    minutes = np.mean([own.by[variant, seed]["processor_seconds"] for seed in own.seeds(variant)]) / 60
    return what, f"{own.people:,}", f"{one['parameters']:,}", *found, f"{lost:+.1f}", f"{minutes:.0f}"


def _common(runs: list[dict]) -> Runs:
    """The runs of the length that most have."""
    lengths = [run["people"] for run in runs]
    return Runs(runs, max(set(lengths), key=lengths.count))
