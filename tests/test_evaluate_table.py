"""The table of published figures and those of scores.json, by protocol, and its command line."""

import json

import pytest

from lidarpose import evaluation
from lidarpose.cli import main
from lidarpose.eval.scores import MetricRow, Result, Scores, Setting


def scores(folder, *, method="mine", kind="waymo", protocol="clean", value=70.0, digest="ab" * 32, **more):
    """Writes a scores.json of one dataset, without PA-MPJPE."""
    shared = {"protocol": protocol, "centring": "somewhere", "split": "val", "limit": more.get("limit")}
    setting = Setting(
        dataset=more.get("dataset", kind), kind=kind, method=method, crop="so", split_source="a list",
        leaks=more.get("leaks", ""), joints=("nose", "left_hip"), not_judged="", sensor="known", total=200,
        clusters=True, seed=0, **shared,
    )  # fmt: skip
    counted = {"group": "all", "of": "all", "unit": "mm", "people": 9, "joints": 18, "skipped": 0}
    rows = tuple(
        MetricRow(method=who, figure=name, value=v, arithmetic=arithmetic, **counted, **shared)
        for who, name, v, arithmetic in (
            (method, "mpjpe", value, "lidarpose"),
            (method, "pck3", None, "lidarpose"),
            (method, "mpjpe", value - 1, "released"),
            ("floor: nobody", "mpjpe", 300.0, "lidarpose"),
        )
    )
    counts = {"people": 9, "frames of clips": 0, "without a pose": 2}
    result = Result(setting=setting, counts=counts, skipped=more.get("skipped", {}), notes=(), lines=rows)
    made = Scores(weights={"name": method, "digest": digest}, command="c", seed=0, results=(result,))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scores.json").write_text(made.to_json())
    assert evaluation.read_scores(folder) == made
    return folder


def test_published_figures_match_paper():
    published = evaluation.published()
    methods = {method["method"]: method["figures"] for method in published["methods"]}
    assert list(methods) == ["LiDARCap", "NE", "LPFormer", "PRN", "DAPT"]
    assert methods["DAPT"] == {
        "waymo": {"mpjpe": 51.59, "pck3": 97.34, "pck5": 98.98},
        "humanm3": {"mpjpe": 59.76, "pck3": 95.39, "pck5": 98.30},
        "lidarhuman26m": {"mpjpe": 73.47, "pa_mpjpe": 58.40, "pck3": 90.54, "pck5": 97.06},
        "sloper4d": {"mpjpe": 28.01, "pa_mpjpe": 21.52, "pck3": 99.30, "pck5": 99.87},
    }
    assert set(methods["NE"]) == set(methods["LiDARCap"]) == {"lidarhuman26m", "sloper4d"}
    assert "not reproduced here" in published["note"] and "Table 1" in published["source"]
    assert all("oracle" in about["protocol"] for about in published["datasets"].values())


def test_table_without_scores_has_only_published_figures():
    text = evaluation.table([])
    assert "Evaluated here" not in text and text.count("| DAPT |") == 1
    # 3 + 3 + 4 + 4 figures of DAPT, PRN and LPFormer, 8 of the others
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    figures = [cell.strip() for row in rows for cell in row.split("|")[2:-1]]
    assert len(rows) == 5 and len(figures) == 70 and figures.count("-") == 12


def test_table_separates_protocols(tmp_path):
    paths = [scores(tmp_path / "a"), scores(tmp_path / "b", protocol="dapt", value=66.0, leaks="much")]
    text = evaluation.table(paths)
    published, dapt, clean = text.split("**Evaluated here")
    assert "Not comparable with the blocks above" in clean and "70.00" not in published + dapt
    assert "66.00" in dapt and "66.00" not in published + clean.partition("\n\n[")[0]
    assert "| mine, released arithmetic | 69.00 [" in clean
    row = next(line for line in clean.splitlines() if line.startswith("| mine |"))
    mark = row.split("|")[2].split()[1]
    note = next(line for line in text.splitlines() if line.startswith(mark + " "))
    words = "protocol clean", "center: somewhere", "crop: so", "split: val (a list)", "9 people", "2 joints", "abababab"
    assert all(word in note for word in (*words, "2 without a pose")) and "which leaks: much" in text
    # datasets that are not in the paper have their own block
    text = evaluation.table([scores(tmp_path / "c", kind="bench", dataset="lidarpose-bench-1.1", limit=9)])
    assert "9 people, evenly picked from 200" in text
    assert "**Evaluated here on sets that the paper does not have.**" in text and "| baseline: nobody | 300.00" in text


def test_table_has_one_row_per_weights_digest(tmp_path):
    paths = [scores(tmp_path / k, digest=k * 64, value=v) for k, v in (("a", 71.0), ("b", 72.0))]
    both = evaluation.table(paths)
    assert both.count("| mine |") == 2
    # one network on two datasets is one row
    more = evaluation.table([paths[0], scores(tmp_path / "c", kind="humanm3", digest="a" * 64, value=80.0)])
    row = next(line for line in more.splitlines() if line.startswith("| mine |"))
    assert "71.00" in row and "80.00" in row


def test_table_json_has_published_and_evaluated(tmp_path):
    content = json.loads(evaluation.table([scores(tmp_path / "a")], format="json"))
    assert content["published"] == evaluation.published()
    assert [entry["row"] for entry in content["evaluated"]] == ["mine", "mine, released arithmetic", "floor: nobody"]
    first = content["evaluated"][0]
    assert first["figures"] == {"mpjpe": 70.0, "pa_mpjpe": None, "pck3": None, "pck5": None}
    assert first["protocol"] == "clean" and first["weights"] == "ab" * 32


# ---- the command line


def run(*arguments):
    try:
        return main(list(arguments))
    except SystemExit as done:
        return done.code


@pytest.mark.long
def test_cli_evaluate_then_table(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("evaluate", "tiny", "bench", "--limit", "12", "--seed", "3") == 0
    shown = capsys.readouterr()
    assert {path.name for path in (tmp_path / "evaluation/tiny").iterdir()} == {
        "scores.json", "poses.parquet", "lidarpose-bench-1.1-errors.png", "lidarpose-bench-1.1-reliability.png",
        "lidarpose-bench-1.1-worst.png",
    }  # fmt: skip
    # the headline first, then the setting, printed once
    headline, setting, *rows = shown.out.splitlines()
    assert "clean · points, and where uncertain the center of the displaced box · no split · 12 of 2,000" in setting
    assert not any("displaced box · no split" in row for row in rows) and sum("MPJPE" in row for row in rows) > 10
    made = evaluation.read_scores(tmp_path / "evaluation/tiny")
    assert made.command == "lidarpose evaluate tiny bench --limit 12 --seed 3" and made.seed == 3
    assert headline.startswith(f"lidarpose-bench-1.1: MPJPE {made.results[0].line('mpjpe').value:.1f} mm [")
    assert ", 12 of 12 people · tiny" in headline

    assert run("table", "evaluation/tiny") == 0
    assert f"{made.results[0].line('mpjpe').value:.2f} [" in capsys.readouterr().out
    assert run("table", "evaluation/tiny", "--format", "json", "--out", "table.json") == 0
    assert json.loads((tmp_path / "table.json").read_text())["evaluated"]
    assert run("table", "evaluation/tiny", "--out", "table.csv") == 2 and not (tmp_path / "table.csv").exists()
    capsys.readouterr()

    # a folder that contains files is not overwritten
    assert run("evaluate", "tiny", "bench", "--limit", "5", "--out", "evaluation/tiny") == 2
    assert "holds other files" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("evaluate", "tiny", "nowhere"), "got nowhere: there is no such folder"),
        (("evaluate", "nix", "bench"), "known are tiny"),
        (("evaluate", "nix.safetensors", "bench"), "nix.safetensors"),
        (("evaluate", "tiny", "bench", "--skeleton", "human51"), "did you mean human15"),
        (("evaluate", "tiny", "bench", "--limit", "-1"), "at least 1 person"),
        (("evaluate", "tiny"), "expected a dataset to evaluate on"),
        (("table", "nowhere.json"), "no such file"),
        (("table", "--format", "tex"), "markdown or json, got 'tex'"),
    ],
)
def test_cli_errors_are_one_line_and_write_nothing(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and words in shown.err and shown.err.startswith("lidarpose: error: ")
    assert shown.err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_table_names_people_and_shards_that_are_left_out(tmp_path):
    skipped = {"damaged shards": {"count": 2, "first": "a"}, "people of under 10 points": {"count": 3, "first": "b"}}
    text = evaluation.table([scores(tmp_path / "a", skipped=skipped)])
    assert "3 left out; 2 damaged shards left out, with an unknown number of people" in text
