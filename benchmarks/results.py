"""The tables of docs/results.md, docs/evaluation.md and the model cards in docs/cards, from the scores in docs/scores.

    python benchmarks/results.py --collect runs/ablations     # runs' scores.json -> docs/scores/ablations.json
    python benchmarks/results.py                              # docs/scores -> the tables of the pages
    python benchmarks/results.py --check                      # exit code 1 where they differ

docs/scores/NAME.json is what `lidarpose evaluate NAME bench` wrote, stability/NAME.json what it writes besides with
`--stability`, test_time.json and visibility.json what the benchmarks of these names did.

A table stands between `<!-- table NAME -->` and `<!-- end -->`; the words around it are left as they are.

A difference to `base` is the mean over the seeds that both have, seed by seed: each seed shows both the same people.
Its 95 % interval is Student's, with the deviation between seeds taken over all variants of two seeds and more together.
"""

import argparse
import json
import math
import re
import sys
from collections.abc import Callable, Collection
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import stability_tables as disturbed

from lidarpose.data.files import write_atomic
from lidarpose.evaluate.result import OURS, Line, Result, Scores, read_scores
from lidarpose.model.bundled import BUNDLED, DEFAULT, bundled_path
from lidarpose.model.header import digest, read_header

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SCORES = DOCS / "scores"
PAGES = (DOCS / "results.md", DOCS / "evaluation.md", *(DOCS / "cards" / f"{name}.md" for name in BUNDLED))
RUNS = "ablations.json"
BASE = "base"
_MARKED = re.compile(r"(<!-- table ([^>]+?) -->\n).*?(<!-- end -->)", re.S)
# two-sided 95 % points of Student's t by degrees of freedom
_STUDENT = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 8: 2.31, 10: 2.23, 15: 2.13, 20: 2.09, 30: 2.04}
# figures of a run that tables show: (group, of, figure) of `evaluate.result.Line`
FIGURES = {
    "all": ("all", "all", "mpjpe"),
    "plain": ("plain", None, "mpjpe"),
    "clean": ("condition", "clean", "mpjpe"),
    "cluttered": ("condition", "cluttered", "mpjpe"),
    "company": ("condition", "company", "mpjpe"),
    "crop": ("condition", "crop", "mpjpe"),
    "occluded": ("condition", "occluded", "mpjpe"),
    "turned round": ("points", None, "turned_round"),
    "PA": ("all", "all", "pa_mpjpe"),
}
# studies of one seed, shown in one table
_MORE = ("levels", "mask", "scene", "motion", "network", "steps")
_SHOWN = ("plain", "clean", "cluttered", "occluded", "turned round")


def collect(folder: Path) -> list[dict]:
    """What the runs of a folder scored, in a fixed order."""
    runs = [json.loads(path.read_text()) for path in sorted(folder.rglob("scores.json"))]
    return sorted(runs, key=lambda run: (run["study"], run["variant"], run["begun"], run["people"], run["seed"]))


class Runs:
    """Runs of one length, by variant and seed."""

    def __init__(self, runs: list[dict], people: int):
        self.people = people
        self.by = {(run["variant"], run["seed"]): run for run in runs if run["people"] == people}
        self.deviation, self.freedom = self._pooled()

    def seeds(self, variant: str) -> list[int]:
        return sorted(seed for name, seed in self.by if name == variant)

    def mean(self, variant: str, figure: str) -> float:
        return float(np.mean([self.value(variant, seed, figure) for seed in self.seeds(variant)]))

    def value(self, variant: str, seed: int, figure: str) -> float:
        return self.by[variant, seed]["figures"][figure]["value"]

    def differences(self, variant: str, figure: str = "all") -> np.ndarray:
        """One a seed that the variant and `base` have, mm."""
        seeds = [seed for seed in self.seeds(variant) if (BASE, seed) in self.by]
        return np.array([self.value(variant, seed, figure) - self.value(BASE, seed, figure) for seed in seeds])

    def told(self, variant: str) -> str:
        """The difference and its interval, and whether it is one."""
        found = self.differences(variant)
        if not len(found):
            return "-"
        if math.isnan(self.deviation):
            return f"{found.mean():+.1f}"
        reach = self.reach(len(found))
        word = "" if abs(found.mean()) > reach else ", unresolved"
        return f"{found.mean():+.1f} ± {reach:.1f}{word}"

    def reach(self, seeds: int) -> float:
        """Half an interval of a mean of so many differences."""
        point = next(value for freedom, value in reversed(_STUDENT.items()) if freedom <= self.freedom)
        return point * self.deviation / seeds**0.5

    def _pooled(self) -> tuple[float, int]:
        """The deviation of a difference between seeds, and its degrees of freedom."""
        square, freedom = 0.0, 0
        for variant in {name for name, _ in self.by} - {BASE}:
            found = self.differences(variant)
            if len(found) > 1:
                square += ((found - found.mean()) ** 2).sum()
                freedom += len(found) - 1
        return (square / freedom) ** 0.5 if freedom else math.nan, freedom


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table of markdown."""
    lines = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def study(runs: list[dict], studies: Collection[str] | None = None) -> str:
    """The variants of some studies, or of all, beside `base`, at the length that most runs have."""
    own = _common(runs)
    names = dict.fromkeys(run["variant"] for run in runs if studies is None or run["study"] in studies)
    chosen = [variant for variant in names if variant != BASE and own.seeds(variant)]
    chosen.sort(key=lambda variant: own.mean(variant, "all"))
    header = ("", "MPJPE mm", "against base", *_SHOWN, "seeds")
    return table(header, [_row(own, variant) for variant in (BASE, *chosen)])


def _row(own: Runs, variant: str) -> tuple[str, ...]:
    what = own.by[variant, own.seeds(variant)[0]]["what"]
    figures = [f"{own.mean(variant, figure):.1f}" for figure in ("all", *_SHOWN)]
    figures[-1] += " %"
    against = "" if variant == BASE else own.told(variant)
    return what, figures[0], against, *figures[1:], str(len(own.seeds(variant)))


def noise(runs: list[dict]) -> str:
    own = _common(runs)
    if math.isnan(own.deviation):
        return f"{own.people:,} people a run, one seed: differences have no interval.\n"
    return (
        f"{own.people:,} people a run. A difference of two runs of one seed deviates by {own.deviation:.1f} mm\n"
        f"from seed to seed ({own.freedom} degrees of freedom): that of one seed is resolved beyond\n"
        f"{own.reach(1):.1f} mm, of two beyond {own.reach(2):.1f}.\n"
    )


def scaling(runs: list[dict], shipped: dict | None = None) -> str:
    """`base` by the number of people seen; runs of their own, each cooled, and what ships as the longest."""
    seen = sorted({run["people"] for run in runs if run["variant"] == BASE})
    found = {people: {name: Runs(runs, people).mean(BASE, name) for name in ("all", *_SHOWN)} for people in seen}
    rows, before = [], None
    for people, figures in (found | (shipped or {})).items():
        fall = "" if before is None else f"{(figures['all'] - before[1]) / math.log2(people / before[0]):+.1f}"
        cells = [f"{figures[name]:.1f}" for name in ("all", *_SHOWN)]
        rows.append((f"{people:,}", cells[0], fall, *cells[1:-1], f"{cells[-1]} %"))
        before = people, figures["all"]
    return table(("people seen", "MPJPE mm", "a doubling", *_SHOWN), rows)


def figures(result: Result) -> dict[str, dict[str, float]]:
    """value, low and high of each of `FIGURES` that the result has."""
    found = {}
    for name, (group, of, figure) in FIGURES.items():
        fitting = (x for x in _own(result) if x.group == group and x.figure == figure and of in (None, x.of))
        if (line := next(fitting, None)) is not None:
            found[name] = {"value": line.value, "low": line.low, "high": line.high}
    return found


def _longest() -> dict[int, dict[str, float]]:
    """The figures of `tiny` as it ships, by the number of people that it has seen."""
    found = {name: figure["value"] for name, figure in figures(_scored("tiny").results[0]).items()}
    return {read_header(bundled_path("tiny")).card["people_seen"]: found}


def against_paper(runs: list[dict]) -> str:
    """`base` and the paper's design, at every length at which both ran."""
    rows = []
    for people in sorted({run["people"] for run in runs if run["study"] == "paper"}):
        own = Runs(runs, people)
        ways = [v for v in dict.fromkeys(run["variant"] for run in runs if run["study"] == "paper") if own.seeds(v)]
        rows += [_beside(own, variant) for variant in (BASE, *ways)]
    header = ("", "people seen", "parameters", "MPJPE mm", "plain", "clean", "cluttered", "lost to clutter")
    return table((*header, "processor minutes"), rows)


def _beside(own: Runs, variant: str) -> tuple[str, ...]:
    one = own.by[variant, own.seeds(variant)[0]]
    lost = own.mean(variant, "cluttered") - own.mean(variant, "clean")
    what = "ours: `tiny` and its recipe" if variant == BASE else one["what"]
    figures = [f"{own.mean(variant, figure):.1f}" for figure in ("all", "plain", "clean", "cluttered")]
    minutes = np.mean([own.by[variant, seed]["processor_seconds"] for seed in own.seeds(variant)]) / 60
    return what, f"{own.people:,}", f"{one['parameters']:,}", *figures, f"{lost:+.1f}", f"{minutes:.0f}"


def strays(**networks: str) -> str:
    """What clusters of stray points cost networks, by the name of their study."""
    header = ("", "undisturbed, mm", *(f"two of {amount} points" for amount in disturbed.amounts(next(iter(networks)))))
    return table(header, [(what, *disturbed.strays(name)) for name, what in networks.items()])


def _common(runs: list[dict]) -> Runs:
    """The runs of the length that most have."""
    lengths = [run["people"] for run in runs]
    return Runs(runs, max(set(lengths), key=lengths.count))


@lru_cache
def _scored(model: str) -> Scores:
    """What a bundled model scored on lidarpose-bench."""
    return read_scores(SCORES / f"{model}.json")


def _own(result: Result) -> list[Line]:
    """The lines of what was judged, without the floors', by this package's arithmetic."""
    return [x for x in result.lines if x.method == result.setting.method and x.arithmetic == OURS]


def shipped(model: str, group: str) -> str:
    """MPJPE of a bundled model by groups of people or joints."""
    rows = []
    for line in _own(_scored(model).results[0]):
        if line.group in group.split("+") and line.figure == "mpjpe":
            rows.append((line.of, f"{line.value:.1f}", _interval(line), f"{line.people:,}"))
    return table((group.split("+")[-1], "MPJPE mm", "95 %", "people"), rows)


def _interval(line: Line) -> str:
    return "" if line.low is None else f"[{line.low:.1f}, {line.high:.1f}]"


def headline(*models: str) -> str:
    """The bundled models side by side."""
    wanted = {
        "MPJPE, mm": ("all", "mpjpe"),
        "PA-MPJPE, mm": ("all", "pa_mpjpe"),
        "PCK-3, %": ("all", "pck3"),
        "upright, whole, uncluttered, 100 points: MPJPE, mm": ("plain", "mpjpe"),
        "turned round, of 100 points and more, %": ("points", "turned_round"),
        "confidence: calibration error, %": ("all", "calibration_error"),
        "confidence: AUROC, %": ("all", "auroc"),
    }
    rows = []
    for name, (group, figure) in wanted.items():
        cells = []
        for model in models:
            line = next(x for x in _own(_scored(model).results[0]) if x.group == group and x.figure == figure)
            cells.append(f"{line.value:.1f} {_interval(line)}".rstrip())
        rows.append((name, *cells))
    return table(("lidarpose-bench", *(f"`{model}`" for model in models)), rows)


def card(model: str) -> str:
    """How a bundled model was made, as its file says."""
    path = bundled_path(model)
    told = read_header(path).card
    if _scored(model).weights["digest"] != digest(path):
        raise SystemExit(f"docs/scores/{model}.json is of other weights: run lidarpose evaluate {model} bench")
    rows = [
        ("file", f"`{path.name}`, {path.stat().st_size / 1e6:.1f} MB in float16"),
        ("as ONNX", f"`{model}.onnx`, {bundled_path(model, '.onnx').stat().st_size / 1e6:.1f} MB"),
        ("command", f"`{told['command']}`"),
        ("seed", str(told["recipe"]["seed"])),
        ("people seen", f"{told['people_seen']:,}"),
        ("hours", f"{told['hours']:.2f}"),
        ("captured motion", f"{told['motion']}, subjects {', '.join(told['recipe']['subjects'])}"),
    ]
    stages, stage = [], told
    while "init_card" in stage:
        name, stage = stage["recipe"]["init"], stage["init_card"]
        stages.append(f"{name}, {stage['people_seen']:,} people before")
    if stages:
        rows.append(("begun as", "; itself begun as ".join(stages)))
    if "note" in told:
        rows.append(("note", told["note"]))
    return table(("", ""), rows)


def extras(model: str) -> str:
    """What test-time extras bring; see test_time.py."""
    rows = []
    found = json.loads((SCORES / "test_time.json").read_text())[model]
    usual = next(one for one in found["ways"] if one["usual"])
    for one in found["ways"]:
        cost = one["seconds"] / usual["seconds"]
        figures = [f"{one['figures'][name]['value']:.1f}" for name in ("all", "plain", "cluttered", "occluded")]
        rows.append((one["what"], *figures, f"{one['figures']['turned round']['value']:.1f} %", f"{cost:.1f}"))
    return table(("", "MPJPE mm", "plain", "cluttered", "occluded", "turned round", "cost"), rows)


def visibility() -> str:
    """Conditions against clean people of whom as much is hidden; see visibility.py."""
    rows = []
    for model, found in json.loads((SCORES / "visibility.json").read_text()).items():
        for one in found:
            ratio = f"{one['ratio']:.2f} [{one['low']:.2f}, {one['high']:.2f}]"
            mm, clean = f"{one['mm']:.1f}", f"{one['clean']:.1f}"
            rows.append((f"`{model}`", one["condition"], mm, clean, ratio, str(one["people"])))
    return table(("", "condition", "MPJPE mm", "clean, as much hidden", "ratio", "people"), rows)


def real() -> str:
    """Real people; see real.py."""
    rows = [
        (
            one["sweep"].removeprefix("sweep_"),
            one["person"],
            str(one["points"]),
            f"{one['distance']:.1f}",
            f"{one['turn']:.0f} deg",
            f"{100 * one['near']:.0f} %",
            f"{one['lean']:.0f} deg",
            f"{one['confidence']:.2f}",
        )
        for one in json.loads((SCORES / "real.json").read_text())
    ]
    header = ("sweep", "person", "points", "distance m", "facing against the box", "points within 15 cm of a bone")
    return table((*header, "lean of the trunk", "confidence"), rows)


def rejection(model: str) -> str:
    found = json.loads((SCORES / "test_time.json").read_text())[model]["rejection"]
    rows = [(f"{one['kept']:.0f} %", f"{one['people']:.1f}", f"{one['joints']:.1f}") for one in found]
    return table(("kept", "people of the highest mean confidence: mm", "joints of the highest confidence: mm"), rows)


def tables() -> dict[str, Callable[[], str]]:
    """What makes each table, by name."""
    every = json.loads((SCORES / RUNS).read_text())
    runs, later = ([run for run in every if bool(run["begun"]) == begun] for begun in (False, True))
    made = {f"study {name}": partial(study, runs, {name}) for name in {run["study"] for run in runs}}
    made["study more"] = partial(study, runs, _MORE)
    made |= {"scaling": lambda: scaling(runs, _longest()), "noise": partial(noise, runs)}
    made |= {"continued": partial(study, later), "noise continued": partial(noise, later)}
    made |= {"against the paper": partial(against_paper, runs)}
    made |= {"visibility": visibility, "real": real}
    made["headline"] = partial(headline, *BUNDLED)
    made["stability"] = lambda: table(("", "undisturbed", *5 * ("",)), disturbed.curves(DEFAULT))
    made["stability sensors"] = lambda: table(("sensor", "points", "MPJPE mm"), disturbed.sensors(DEFAULT))
    made["stability ends"] = lambda: table(("", "mean, mm", "deviation"), disturbed.ends(DEFAULT))
    made["strays"] = partial(
        strays,
        paper="the paper's design, faster rates, 98,304 people",
        ours="ours: `tiny` and its recipe, 98,304 people",
        small="`small` as it ships",
    )
    for model in BUNDLED:
        made[f"{model} card"] = partial(card, model)
        groups = dict.fromkeys(["all+condition", *(line.group for line in _own(_scored(model).results[0]))])
        made |= {f"{model} by {group}": partial(shipped, model, group) for group in groups}
        made |= {f"{model} extras": partial(extras, model), f"{model} rejection": partial(rejection, model)}
    return made


def written(page: str) -> str:
    """The page, its tables made anew. Raises KeyError for a table that nothing makes."""
    made = tables()
    return _MARKED.sub(lambda found: found[1] + "\n" + made[found[2]]() + "\n" + found[3], page)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--collect", type=Path, metavar="DIR", help="folder of runs whose scores are taken over")
    parser.add_argument("--check", action="store_true", help="write nothing, say whether the page is up to date")
    options = parser.parse_args()
    if options.collect:
        runs = collect(options.collect)
        write_atomic(SCORES / RUNS, "[\n" + ",\n".join(json.dumps(run) for run in runs) + "\n]\n")
        print(f"{len(runs)} runs -> {SCORES / RUNS}")
        return
    for path in PAGES:
        page = path.read_text()
        new = written(page)
        if options.check and new != page:
            sys.exit(f"{path.name} is not what docs/scores say: run benchmarks/results.py")
        if not options.check:
            write_atomic(path, new)


if __name__ == "__main__":
    main()
