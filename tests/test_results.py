"""Tables of the docs: agreement with the scores, and confidence intervals of differences."""

import importlib
import json
import re
from argparse import Namespace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from motion_files import a_clip, joints_of

from lidarpose import evaluation
from lidarpose.sample import Box

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def results():
    return benchmark("results")


@pytest.fixture(scope="module")
def changed():
    return benchmark("ablation_tables")


def benchmark(name):
    # its imports are in the same folder
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return importlib.import_module(name)


def run(variant, seed, value, people=100, **more):
    shown = ("all", "plain", "clean", "cluttered", "company", "occluded", "turned round")
    figures = {name: {"value": value} for name in shown}
    return {"variant": variant, "seed": seed, "people": people, "what": variant, "figures": figures} | more


def write_motion(path):
    """One clip of a subject "s"."""
    clips = {"clip": np.array(["s_1"]), "clip_start": np.array([0]), "clip_length": np.array([40]), "fps": 10.0}
    np.savez(path, joints=joints_of(*a_clip(40)), **clips)


@pytest.mark.long
@pytest.mark.parametrize("name", ["paper, heatmaps", "paper, one stage", "ours"])
def test_against_paper_benchmark_runs(tmp_path, monkeypatch, name):
    write_motion(tmp_path / "m.npz")
    module, run = benchmark("against_paper"), evaluation.run
    monkeypatch.setattr(evaluation, "run", lambda model, sets: run(model, sets, limit=4))
    monkeypatch.setattr(module, "OWN_PEOPLE", 4)
    words = [name, "--motion", "m.npz", "--subjects", "s", "--held-out", "s", "--people", "16", "--out", "o"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["against_paper", *words])
    module.main()
    (path,) = Path("o").glob("*/scores.json")
    scores = json.loads(path.read_text())
    assert scores["variant"] == name and scores["figures"]["the paper's scene"]["value"] > 0
    monkeypatch.setattr("sys.argv", ["against_paper", "nothing", "--motion", "m.npz"])
    with pytest.raises(SystemExit, match="2"):
        module.main()


def test_pages_match_scores(results):
    for path in results.PAGES:
        page = path.read_text()
        assert results.written(page) == page, f"{path.name}: run python benchmarks/results.py"
        assert "<!-- table" in page


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_benchmark_can_be_imported(name):
    if name == "tracks":
        pytest.importorskip("trackeval")
    assert benchmark(name)


@pytest.mark.long
def test_heldout_benchmark_runs(tmp_path, monkeypatch):
    write_motion(tmp_path / "m.npz")
    words = [
        "heldout",
        "--motion",
        "m.npz",
        "--subjects",
        "s",
        "--people",
        "6",
        "--weights",
        "tiny",
        "--json",
        "o.json",
    ]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", words)
    benchmark("heldout").main()
    scores = json.loads((tmp_path / "o.json").read_text())
    assert scores["people"] == 6 and scores["mean pose, true facing"]["mpjpe"] > 0


def test_readme_has_the_detectors_scores():
    scores = json.loads((BENCHMARKS.parent / "docs" / "scores" / "detector.json").read_text())
    (heldout,) = [result for result in scores["results"] if result["dataset"] == "heldout"]

    def value(figure, **group):
        keys = {"figure": figure, "at": "default"} | group
        return next(row["value"] for row in heldout["rows"] if keys.items() <= row.items())

    everyone, near = value("recall", of="all", group="all"), value("recall", group="points", of="50 and more")
    text = " ".join((BENCHMARKS.parent / "README.md").read_text("utf-8").split())
    assert (
        f"finds {everyone:.0f} % of the people of 10 points and more within 40 m, {near:.0f} % of those of 50" in text
    )
    numbers = {5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}
    false = value("false_people", of="all", group="all")
    assert f"with one false person in {numbers[round(1 / false)]} scans" in text


def test_every_bundled_model_has_a_card(results):
    for name in results.BUNDLED:
        card = (BENCHMARKS.parent / "docs" / "cards" / f"{name}.md").read_text()
        for table in (f"{name} card", f"{name} by sensor", f"{name} by distance, m", f"{name} by all+condition"):
            assert f"<!-- table {table} -->" in card, table
        # subjects of the training motion
        assert re.search(r"^\| captured motion \| \S+, subjects (all|[0-9a-z, ]+) \|$", card, re.MULTILINE)


def test_pages_report_auroc_of_person_outputs(results):
    said = {x.figure: x.value for x in results.own_lines(results._scored("small-2").results[0])}
    for page in ("results.md", "cards/small.md"):
        text = (BENCHMARKS.parent / "docs" / page).read_text("utf-8")
        for name in ("person", "second_person"):
            assert re.search(rf"^\| `{name}`: .* \| {said[f'{name}_auroc']:.2f} \|$", text, re.MULTILINE), (page, name)


def test_headline_and_condition_figures_match_scores(results):
    """The default model with known and unknown sensor position, the mean pose, and the five figures of the README."""
    page = (BENCHMARKS.parent / "docs" / "results.md").read_text("utf-8")
    rows = {
        "sensor's position known": (results.DEFAULT, results.DEFAULT),
        "unknown": (f"{results.DEFAULT}-unknown", results.DEFAULT),
        "the mean pose with the true facing": (results.DEFAULT, "floor: mean pose, true facing"),
    }
    groups = [("all", "all"), *(("condition", name) for name in ("clean", "cluttered", "company", "crop", "occluded"))]
    groups.append(("plain", "upright, whole, uncluttered, 100 points"))
    headline = []
    for name, (file, method) in rows.items():
        shown = re.search(rf"^\| {name} \|(.*)\|$", page, re.MULTILINE)[1].split("|")
        lines = [x for x in results._scored(file).results[0].lines if x.method == method and x.figure == "mpjpe"]
        known = {(x.group, x.of): x.value for x in lines if x.arithmetic == "lidarpose"}
        assert [cell.strip() for cell in shown] == [f"{known[group]:.1f}" for group in groups], name
        if file == results.DEFAULT:
            readme_groups = [("all", "all"), *(("points near the joint", of) for of in ("20 and more", "0 to 1"))]
            headline += [f"{known[group]:.1f}" for group in readme_groups if group in known]
    readme = (BENCHMARKS.parent / "README.md").read_text("utf-8")
    # the last figure is the paper's for Waymo, 51.59
    assert re.findall(r"^\| .*?(\d+\.\d)\b.*\|$", readme, re.MULTILINE)[:5] == [*headline, "51.6"]


def test_difference_compares_runs_of_same_seed(changed):
    own = changed.Runs([run("base", 1, 10.0), run("base", 2, 20.0), run("x", 1, 11.0), run("x", 2, 22.0)], 100)
    assert own.difference("x") == pytest.approx(1.5) and own.freedom == 1
    # errors of seed 2 are higher for all variants; x, run on seed 2 only, is compared on seed 2
    own = changed.Runs([run("base", 1, 10.0), run("base", 2, 20.0), run("x", 2, 19.0)], 100)
    assert own.difference("x") == pytest.approx(-1.0)
    assert np.isnan(own.deviation) and own.difference_text("x") == "-1.0"
    # no difference without seeds that link the variant to base, directly or through other variants
    own = changed.Runs([run("base", 1, 10.0), run("x", 2, 19.0)], 100)
    assert own.difference_text("x") == "-"


def test_difference_links_variants_without_common_seed(changed):
    runs = [run("base", 1, 10.0), run("y", 1, 12.0), run("y", 2, 22.0), run("x", 2, 19.0)]
    assert changed.Runs(runs, 100).difference("x") == pytest.approx(-1.0)


def test_difference_intervals_have_nominal_coverage(changed):
    """95 % of the intervals contain the true difference of 3 mm, for variants with one, two and three seeds."""
    rng = np.random.default_rng(0)
    held = {1: [], 2: [], 3: []}
    for _ in range(1500):
        seeds = 100.0 + 8.0 * rng.normal(size=3)
        runs = [run("base", seed, seeds[seed] + rng.normal()) for seed in range(3)]
        for count in held:
            for k in range(2):
                runs += [run(f"{count}{k}", seed, 3.0 + seeds[seed] + rng.normal()) for seed in range(count)]
        own = changed.Runs(runs, 100)
        assert own.freedom == 15 - 7 - 2
        for count, found in held.items():
            found.append(abs(own.difference(f"{count}0") - 3.0) <= own.reach(f"{count}0"))
    for count, found in held.items():
        assert 0.935 < np.mean(found) < 0.965, count


def test_difference_within_noise_is_unresolved(changed):
    runs = [run("base", seed, 100.0) for seed in (1, 2)]
    runs += [run("large", 1, 150.0), run("large", 2, 151.0), run("small", 1, 100.5), run("small", 2, 99.6)]
    own = changed.Runs(runs, 100)
    assert "unresolved" not in own.difference_text("large") and own.difference_text("large").startswith("+50.5 ± ")
    assert own.difference_text("small").endswith("unresolved")


def test_collect_adds_new_runs_to_known_runs(changed, tmp_path):
    known = [run("base", 1, 10.0, begun=0), run("x", 1, 12.0, begun=0)]
    again, new = run("x", 1, 11.0, begun=0), run("base", 2, 13.0, begun=0)
    for one in (again, new):
        folder = tmp_path / f"{one['variant']}-{one['seed']}"
        folder.mkdir()
        (folder / "scores.json").write_text(json.dumps(one))
    assert changed.collect(tmp_path, known) == [known[0], new, again]


def test_scaling_reports_change_per_doubling(changed):
    _, rows = changed.scaling([run("base", 1, 200.0), run("base", 1, 180.0, 200), run("base", 1, 150.0, 800)])
    assert [row[2] for row in rows] == ["", "-20.0", "-15.0"]


def test_strays_say_dataset_and_version_where_rows_differ(results):
    rows = results.strays(paper="a", ours="b").splitlines()[2:]
    assert rows[0].startswith("| a (bench-1.1, version 0.3.0.dev0) | ")
    assert rows[1].startswith("| b (bench-1, version 0.1.0) | ")
    assert results.strays(paper="a", small="b").splitlines()[2].startswith("| a | ")


def test_visibility_leaves_out_conditions_without_comparable_people(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    condition = ["clean"] * 40 + ["cluttered"] * 40 + ["occluded"] * 40
    hidden = np.repeat([0.01, 0.01, 0.7], 40)
    errors = rng.uniform(20, 60, (120, 3)).tolist()
    columns = {"condition": condition, "hidden": hidden, "moving": [False] * 120, "error_mm": errors}
    pq.write_table(pa.table(columns), tmp_path / "poses.parquet")
    (tmp_path / "scores.json").write_text('{"weights": {"name": "x"}}')
    module = benchmark("visibility")
    monkeypatch.setattr(module, "ROUNDS", 20)
    monkeypatch.setattr("sys.argv", ["visibility", str(tmp_path), "--out", str(tmp_path / "o.json")])
    module.main()
    (entry,) = json.loads((tmp_path / "o.json").read_text())["x"]
    assert entry["condition"] == "cluttered" and entry["people"] == 40
    assert "occluded   left out" in capsys.readouterr().out


def test_background_benchmark_counts_detections_of_hidden_people_as_false(monkeypatch):
    module = benchmark("background")
    boxes = [Box(center=(x, 0.0, 0.0), size=(0.8, 0.8, 1.8), score=0.9) for x in (5.0, 9.0)]
    # the second person has no points
    frame = Namespace(boxes=boxes, person=np.zeros(20, int), points=np.zeros((20, 3)))
    monkeypatch.setattr(module, "street", lambda *args, **named: Namespace(frames=[frame] * module.FRAMES))
    monkeypatch.setattr(module, "learn_background", lambda frames: None)
    monkeypatch.setattr(module.lidarpose, "detect", lambda *args, **named: boxes)
    rows = module.of_street(0, seed=0, scores=(None,))
    assert {(row["false"], row["found"], row["people"]) for row in rows} == {(1, 1, 1)}


def test_tracks_benchmark_keeps_detections_of_hidden_people():
    pytest.importorskip("trackeval")
    module = benchmark("tracks")
    boxes = [Box(center=(x, 0.0, 0.0), size=(0.8, 0.8, 1.8)) for x in (5.0, 9.0, 12.0)]
    # the second person has no points, the third too few to count
    frame = {"people": [box.to_dict() for box in boxes], "points": [50, 0, 5], "sensor": [0.0, 0.0, 0.0]}
    given = module.evaluated([frame], [boxes], [[7, 8, 9]])
    assert given["tracker_ids"][0].tolist() == [0, 1] and given["gt_ids"][0].tolist() == [0]


def test_rejection_does_not_round_errors():
    predictions = Namespace(confidence=np.ones((1, 1)), errors=lambda: np.array([[47.249]]))
    assert benchmark("test_time").rejection(predictions)[0] == {"kept": 100, "people": 47.249, "joints": 47.249}


def test_detector_table_lists_recall(results, monkeypatch):
    recall = {"figure": "recall", "count": 1200}
    rows = [
        recall | {"at": at, "group": group, "of": of, "value": value, "low": low, "high": value}
        for at, value, low in (("1", 91.26, 90.0), ("3", 100.0, 100.0), ("default", None, None))
        for group, of in (("all", "all"), ("points", "50 and more"), ("kind", "room"))
    ]
    document = {"results": [{"dataset": "heldout", "thresholds": {"1": 0.5, "3": 0.4, "default": 0.6}, "rows": rows}]}
    monkeypatch.setattr(results, "_read", lambda name: {"detector": document}[name])
    assert results.detector("heldout", "all", "points").splitlines() == [
        "| recall, % (false people a scan) | people | 1 | 3 | default |",
        "| --- | --- | --- | --- | --- |",
        "| all | 1,200 | 91.3 [90, 91] | 100.0 |  |",
        "| points: 50 and more | 1,200 | 91.3 [90, 91] | 100.0 |  |",
    ]
