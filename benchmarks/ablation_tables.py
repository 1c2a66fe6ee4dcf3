"""Tables of runs that each differ in one change, from the scores of ablations.py and against_paper.py.

A difference to `base` is an effect in an additive model: error = variant + seed + noise, fitted by least squares to all
runs of one length. With the same seed all variants train on the same people, so the seed's effect is shared. The noise
is the residual, assumed equal for all variants. The 95 % interval is from Student's t distribution with the remaining
degrees of freedom.
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
# figures of a run for the tables: (group, of, figure) of `eval.scores.MetricRow`
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
# figure of `against_paper.py`
OWN_SCENE = "the paper's scene"
_SHOWN = ("plain", "clean", "cluttered", "company", "occluded", "turned round")
# names of figures and conditions on the pages, if they differ from those in the data
WORDS = {"company": "second person", "crop": "poor box", "turned round": "facing > 90 deg off"}
_HEADER = tuple(WORDS.get(name, name) for name in _SHOWN)


def own_lines(result: Result) -> list[MetricRow]:
    """The rows of the evaluated method, without those of baselines, computed with this package's arithmetic."""
    return [x for x in result.lines if x.method == result.setting.method and x.arithmetic == OURS]


def figures(result: Result) -> dict[str, dict[str, float]]:
    """value, low and high of each figure in `FIGURES` that the result contains."""
    values = {}
    for name, (group, of, figure) in FIGURES.items():
        matches = (x for x in own_lines(result) if x.group == group and x.figure == figure and of in (None, x.of))
        if (line := next(matches, None)) is not None:
            values[name] = {"value": line.value, "low": line.low, "high": line.high}
    return values


def collect(folder: Path, known: list[dict]) -> list[dict]:
    """The scores of the runs in a folder and of the known runs that are not in it, in a fixed order."""
    new_runs = [json.loads(path.read_text()) for path in sorted(folder.rglob("scores.json"))]
    runs = {(run["variant"], run["begun"], run["people"], run["seed"]): run for run in known + new_runs}
    return [runs[key] for key in sorted(runs)]


class Runs:
    """Runs of one length, by variant and seed. freedom: degrees of freedom of the noise; deviation: standard deviation
    of the noise, mm, NaN without degrees of freedom."""

    def __init__(self, runs: list[dict], people: int):
        self.people = people
        self.by = {(run["variant"], run["seed"]): run for run in runs if run["people"] == people}
        variants = list(dict.fromkeys(name for name, _ in self.by))
        seeds = list(dict.fromkeys(seed for _, seed in self.by))
        self._columns = np.array(variants + [""] * len(seeds))
        self._design = np.array([[n == v for v in variants] + [s == x for x in seeds] for n, s in self.by], float)
        self._inverse = np.linalg.pinv(self._design.T @ self._design)
        self.freedom = len(self.by) - int(np.linalg.matrix_rank(self._design))
        errors = self._found("all")
        residual = errors - self._design @ self._effects(errors)
        self.deviation = float((residual @ residual / self.freedom) ** 0.5) if self.freedom else math.nan

    def seeds(self, variant: str) -> list[int]:
        return sorted(seed for name, seed in self.by if name == variant)

    def mean(self, variant: str, figure: str) -> float:
        return float(np.mean([self.by[variant, seed]["figures"][figure]["value"] for seed in self.seeds(variant)]))

    def difference(self, variant: str, figure: str = "all") -> float:
        """The variant's effect relative to `base`; NaN if no chain of shared seeds connects them."""
        contrast = self._contrast(variant)
        if not np.allclose(contrast @ self._inverse @ self._design.T @ self._design, contrast):
            return math.nan
        return float(contrast @ self._effects(self._found(figure)))

    def reach(self, variant: str) -> float:
        """Half the width of the difference's interval; NaN if the noise cannot be estimated."""
        if not self.freedom:
            return math.nan
        contrast = self._contrast(variant)
        point = next(value for freedom, value in reversed(_STUDENT.items()) if freedom <= self.freedom)
        return float(point * self.deviation * (contrast @ self._inverse @ contrast) ** 0.5)

    def difference_text(self, variant: str) -> str:
        """The difference and its interval, with a note if it is not significant."""
        difference, reach = self.difference(variant), self.reach(variant)
        if math.isnan(difference):
            return "-"
        if math.isnan(reach):
            return f"{difference:+.1f}"
        word = "" if abs(difference) > reach else ", unresolved"
        return f"{difference:+.1f} ± {reach:.1f}{word}"

    def _found(self, figure: str) -> np.ndarray:
        return np.array([run["figures"][figure]["value"] for run in self.by.values()])

    def _effects(self, values: np.ndarray) -> np.ndarray:
        return self._inverse @ self._design.T @ values

    def _contrast(self, variant: str) -> np.ndarray:
        return (self._columns == variant) * 1.0 - (self._columns == BASE)


Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]


def study(runs: list[dict], studies: Collection[str] | None = None) -> Rows:
    """The variants of the given studies, by default of all, and `base`, at the most frequent run length."""
    common_runs = _common(runs)
    names = dict.fromkeys(run["variant"] for run in runs if studies is None or run["study"] in studies)
    variants = [variant for variant in names if variant != BASE and common_runs.seeds(variant)]
    variants.sort(key=lambda variant: common_runs.mean(variant, "all"))
    header = ("", "MPJPE mm", "against base", *_HEADER, "seeds")
    return header, [_row(common_runs, variant) for variant in (BASE, *variants)]


def _row(runs: Runs, variant: str) -> tuple[str, ...]:
    what = runs.by[variant, runs.seeds(variant)[0]]["what"]
    cells = [f"{runs.mean(variant, figure):.1f}" for figure in ("all", *_SHOWN)]
    cells[-1] += " %"
    difference = "" if variant == BASE else runs.difference_text(variant)
    return what, cells[0], difference, *cells[1:], str(len(runs.seeds(variant)))


def noise(runs: list[dict]) -> str:
    common_runs = _common(runs)
    if not common_runs.freedom:
        return f"{common_runs.people:,} people per run, one seed: differences have no interval.\n"
    return (
        f"{common_runs.people:,} people per run. Runs that differ only in their seed have a standard deviation of "
        f"{common_runs.deviation:.1f} mm,\n"
        f"after removing what all variants of a seed share ({common_runs.freedom} degrees of freedom).\n"
    )


def scaling(runs: list[dict], shipped: dict | None = None) -> Rows:
    """`base` by the number of training people, with a separate run and a full schedule for each number, and the
    released network as the longest run."""
    run_lengths = sorted({run["people"] for run in runs if run["variant"] == BASE})
    runs_by_length = {people: Runs(runs, people) for people in run_lengths}
    figures_by_length = {
        people: {name: group.mean(BASE, name) for name in ("all", *_SHOWN)} for people, group in runs_by_length.items()
    }
    rows, previous = [], None
    for people, values in (figures_by_length | (shipped or {})).items():
        slope = "" if previous is None else f"{(values['all'] - previous[1]) / math.log2(people / previous[0]):+.1f}"
        cells = [f"{values[name]:.1f}" for name in ("all", *_SHOWN)]
        rows.append((f"{people:,}", cells[0], slope, *cells[1:-1], f"{cells[-1]} %"))
        previous = people, values["all"]
    return ("people seen", "MPJPE mm", "per doubling", *_HEADER), rows


def against_paper(runs: list[dict]) -> Rows:
    """Our recipe and the paper's design, by the number of people and the error."""
    rows = []
    for people in sorted({run["people"] for run in runs if run["study"] == "paper"}):
        length_runs = Runs(runs, people)
        names = dict.fromkeys(run["variant"] for run in runs if run["study"] == "paper" and run["people"] == people)
        variants = sorted(names, key=lambda variant: length_runs.mean(variant, "all"))
        rows += [_beside(length_runs, variant) for variant in variants]
    header = ("", "people seen", "parameters", "MPJPE mm", "plain", "clean", "cluttered", "lost to clutter")
    return (*header, OWN_SCENE, "processor minutes"), rows


def _beside(runs: Runs, variant: str) -> tuple[str, ...]:
    run = runs.by[variant, runs.seeds(variant)[0]]
    clutter_cost = runs.mean(variant, "cluttered") - runs.mean(variant, "clean")
    *cells, own = (f"{runs.mean(variant, name):.1f}" for name in ("all", "plain", "clean", "cluttered", OWN_SCENE))
    minutes = np.mean([runs.by[variant, seed]["processor_seconds"] for seed in runs.seeds(variant)]) / 60
    people, parameters = f"{runs.people:,}", f"{run['parameters']:,}"
    return run["what"], people, parameters, *cells, f"{clutter_cost:+.1f}", own, f"{minutes:.0f}"


def _common(runs: list[dict]) -> Runs:
    """The runs of the most frequent length."""
    lengths = [run["people"] for run in runs]
    return Runs(runs, max(set(lengths), key=lengths.count))
