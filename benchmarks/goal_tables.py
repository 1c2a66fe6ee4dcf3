"""Rows of the table of goals: what this version should reach, and what it reaches, from docs/scores.

heldout.json there collects the outputs of heldout.py, by motion and network:

python benchmarks/heldout.py --motion hdm05_motion.npz --subjects bk --json bk-small.json
python benchmarks/goal_tables.py bk-small.json idle-small.json ...  # named MOTION-NETWORK.json
"""

import argparse
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import stability_tables as disturbed
from ablation_tables import own_lines

from lidarpose.eval.scores import read_scores
from lidarpose.io.atomic import write_atomic

SCORES = Path(__file__).parents[1] / "docs" / "scores"
# motion of held-out people: as in the names of files, and in words
_MOTION = {"bk": "HDM05 bk, exercises", "idle": "ReActIdle 14 and 15, standing", "cmu": "CMU 6 and 7"}
# the plain people of a bench
_PLAIN = "upright, whole, uncluttered, 100 points"
_NETWORKS = {"small-0.2.0": "`small` of 0.2.0", "small": "`small`"}


@lru_cache
def _read(name: str) -> Any:
    return json.loads((SCORES / f"{name}.json").read_text())


def heldout() -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """MPJPE of held-out people by motion: all, and plain ones."""
    content = _read("heldout")
    rows = []
    for motion, words in _MOTION.items():
        cells = [content[motion][network] for network in _NETWORKS]
        figures = [f"{c['all']:.1f} (plain {c['plain']:.1f})" for c in cells]
        rows.append((words, *figures, f"{content[motion]['small']['box centers']:.1f}", f"{cells[0]['people']:,}"))
    return ("MPJPE, mm", *_NETWORKS.values(), "`small` with box centers", "people"), rows


def _clouds() -> dict[str, Any]:
    """Scores of point_times.py on people by condition, without whole scans."""
    return {name: scores for name, scores in _read("point_times").items() if name != "whole scans"}


def whole_scans() -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """People found in clouds of several whole scans by the points that are used; see point_times.py."""
    rows = []
    for sensor, scores in _read("point_times")["whole scans"].items():
        cells = [scores[name] for name in ("all points", "newest scan", "both")]
        figures = [f"{cell['found']} ({cell['false']}), {cell['mpjpe']:.1f} mm" for cell in cells]
        rows.append((sensor, *figures, f"{scores['people']}", f"{scores['in all']}"))
    names = ("all points", "the newest scan alone", "times of points")
    return ("found (false), MPJPE", *names, "people", "found in all three"), rows


def point_times() -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """MPJPE of clouds of several scans by the points that are used; see point_times.py."""
    rows = []
    for condition, scores in _clouds().items():
        cells = [scores.get(name) for name in ("all points", "newest scan", "both")]
        figures = ["-" if c is None else f"{c['value']:.1f} [{c['low']:.1f}, {c['high']:.1f}]" for c in cells]
        low, high = scores["both"]["change"] if "both" in scores else (None, None)
        change = "-" if low is None else f"{cells[2]['value'] - cells[0]['value']:.1f} [{low:.1f}, {high:.1f}]"
        rows.append((condition, *figures, change, f"{scores['people']:,}"))
    return ("MPJPE, mm", "all points", "the newest scan alone", "both", "both minus all points", "people"), rows


def goals() -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Goal, its bound, and the figure; bold where it is missed."""
    first, second = _figures("small"), _figures("small-2")
    sensors = {words[0]: float(words[2].split()[0]) for words in disturbed.sensors("small")}
    scans = next(result for result in _read("detector")["results"] if result["dataset"] == "heldout")["rows"]
    recall = {(row["group"], row["of"]): row["value"] for row in scans if (row["figure"], row["at"]) == ("recall", "1")}
    extra_error = next(row["value"] for row in scans if (row["figure"], row["at"]) == ("mpjpe_difference", "default"))
    clean = second["mpjpe", "clean"]
    timed = {name: scores.get("both", scores["all points"])["value"] for name, scores in _clouds().items()}
    before = _figures("small-before")["mpjpe_p95", "all"]
    ways = {way["what"]: way["figures"]["all"]["value"] for way in _read("test_time")["small"]["ways"]}
    one_more = ways["`--tta 1`, the first pass mirrored and averaged"] - ways["`--tta 4`"]
    rows: list[tuple[str, str, float, float, bool]] = [
        ("MPJPE on the bench", "mm", 45, first["mpjpe", "all"], False),
        ("plain people of the bench", "mm", 30, first["mpjpe", _PLAIN], False),
        ("95th percentile of people's errors on the bench", "mm", 0.75 * before, first["mpjpe_p95", "all"], False),
        ("one prediction instead of four", "mm more", 1, one_more, False),
        *(
            (f"held-out {_MOTION[name]}", "mm", bound, _read("heldout")[name]["small"]["all"], False)
            for name, bound in (("bk", 55), ("idle", 46), ("cmu", 48))
        ),
        ("merged LiDARs, relative to one clean scan", "", 1.25, second["mpjpe", "merged"] / clean, False),
        ("accumulated frames, relative to one clean scan", "", 1.25, second["mpjpe", "accumulated"] / clean, False),
        ("accumulated frames with times of points", "", 1.25, timed["accumulated"] / timed["clean"], False),
        ("clean people scanned by a Mid-360 instead", "mm", 95, sensors["livox-mid360"], False),
        ("by a VLP-16", "mm", 95, sensors["vlp-16"], False),
        *(
            (f"facing > 90 deg off on {bench}, {words}", "%", bound, figures["turned_round", points], False)
            for bench, figures in (("bench-1", first), ("bench-2", second))
            for words, points, bound in (
                ("100 points and more", "100 and more", 0.3),
                ("20 to 100 points", "20 to 100", 1),
            )
        ),
        ("AUROC of `person` on bench-2", "%", 99.5, second["person_auroc", "all"], True),
        ("found at one false person a scan, 50 points and more", "%", 92, recall["points", "50 and more"], True),
        ("20 to 49 points", "%", 78, recall["points", "20 to 50"], True),
        ("10 to 19 points", "%", 60, recall["points", "10 to 20"], True),
        ("indoors, 50 points and more", "%", 92, recall["kind, 50 points and more", "indoors"], True),
        ("riders and wheelchairs", "%", 70, recall["mounted, all", "all"], True),
        ("poses in found instead of labeled boxes, at the default score", "mm more", 5, extra_error, False),
    ]
    cells = []
    for words, unit, bound, value, is_least in rows:
        is_reached = value >= bound if is_least else value <= bound
        # so many decimals that a missed bound does not look reached
        digits = 2 if bound in (1.25, 0.3, 99.5) else 1
        text = f"{value:.{digits}f}"
        bound_text = f"{'at least' if is_least else 'at most'} {bound:.3g} {unit}".rstrip()
        cells.append((words, bound_text, text if is_reached else f"**{text}**"))
    return ("goal", "bound", "reached (bold: not)"), cells


def _figures(file: str) -> dict[tuple[str, str], float]:
    """The figures of the network by (figure, entry of the group)."""
    lines = own_lines(read_scores(SCORES / f"{file}.json").results[0])
    return {(line.figure, line.of): line.value for line in lines}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    content: dict[str, dict[str, dict[str, float]]] = {}
    for path in parser.parse_args().files:
        motion, _, network = path.stem.partition("-")
        scores = json.loads(path.read_text())
        groups, boxed = scores["sensor known"]["groups"], scores["sensor known, box centers"]["groups"]
        everybody, plain = groups["all"], groups["upright, whole, uncluttered"]
        figures = {"people": everybody["people"], "all": everybody["mpjpe"], "plain": plain["mpjpe"]}
        figures["box centers"] = boxed["all"]["mpjpe"]
        content.setdefault(motion, {})[network] = figures
    write_atomic(SCORES / "heldout.json", json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
