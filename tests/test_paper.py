"""`lidarpose paper`: tables and their cells, steps that run once and can be resumed, pages, figures."""

import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dataset_files import write_lidarhuman26m, write_sloper4d
from matplotlib import style
from matplotlib.text import Text
from motion_files import a_clip, write_amass
from training_runs import Killed, few_to_validate_on  # noqa: F401

from lidarpose.body.mocap.smpl_poses import load_betas
from lidarpose.cli import main
from lidarpose.cli.command_line import make_parser
from lidarpose.data.dataset_card import DatasetCard, write_card
from lidarpose.data.prepare import prepare
from lidarpose.data.shards import open_dataset
from lidarpose.errors import InputError
from lidarpose.eval import charts
from lidarpose.eval.predictions import read_poses
from lidarpose.eval.scores import read_scores
from lidarpose.eval.table import published
from lidarpose.models.checkpoint import read_header
from lidarpose.paper import figures, report, steps
from lidarpose.paper.cells import REAL, Options, _targets, cells, row_key
from lidarpose.paper.markdown import _difference_text, cost_lines, markdown
from lidarpose.paper.report import mean_pose_error, run_table, write_table
from lidarpose.paper.steps import Step, StepFailed, run_steps
from lidarpose.paper.tables import TABLES
from lidarpose.sample import center_of, facing
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24
from lidarpose.synth.bodies import PoseBank
from lidarpose.train import loop, run_dir
from lidarpose.train.recipes import RECIPES, Finetune
from lidarpose.viz.person_view import facing_of

_ROWS = ["scratch", "laser-masking"]
_TABLE = ["paper", "table4", "--people", "64", "--size", "paper-tiny", "--rows", ",".join(_ROWS), "--out"]


def _content(out, name="table4"):
    return json.loads((out / f"{name}.json").read_text())


def _chosen(content):
    """The entries of the chosen rows."""
    return [entry for entry in content["cells"] if row_key(entry["row"]) in _ROWS]


# --- a table from command to page


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Table 4's first and last row on 64 people each, killed while the second row's fine-tuning saves, then resumed."""
    out = tmp_path_factory.mktemp("paper") / "paper"
    with pytest.MonkeyPatch.context() as patch:
        save, saved = run_dir.save_state, []

        def save_twice(*arguments):
            saved.append(arguments)
            if len(saved) > 2:
                raise Killed
            return save(*arguments)

        patch.setattr(loop.run_dir, "save_state", save_twice)
        with pytest.raises(Killed):
            main([*_TABLE, str(out)])
    killed = _content(out)
    before = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")}
    assert main([*_TABLE, str(out)]) == 0
    return out, killed, before


def test_paper_resumes_killed_table(finished):
    out, killed, before = finished
    assert [cell["state"] for cell in _chosen(killed)] == ["done", "not run"]
    done = _chosen(_content(out))
    assert [cell["state"] for cell in done] == ["done", "done"]
    # the first row, the finished parts of both targets and the pre-training are not repeated
    assert len(before) >= 4 and all(path.stat().st_mtime_ns == at for path, at in before.items())
    assert done[0].items() >= _chosen(killed)[0].items()
    (tuned,) = [log for log in (out / "runs").glob("finetune-*/log.jsonl") if "--resume" in _command(log.parent)]
    assert json.loads(tuned.read_text().splitlines()[-1])["people"] == 64


def _command(run):
    return read_header(run / "model.safetensors").card["command"]


def test_paper_cell_has_cost_and_mean_pose(finished):
    out, _, _ = finished
    scratch, masked = _chosen(_content(out))
    assert (scratch["people_seen"], masked["people_seen"]) == (64, 128)
    assert scratch["parameters"] == masked["parameters"] > 4e5 and scratch["size"] == "paper-tiny"
    assert scratch["people_scored"] == 16 and scratch["undertrained"] and scratch["mean_pose"] == masked["mean_pose"]
    assert [command.split()[1] for command in masked["commands"]] == [
        "synth",
        "pretrain",
        "finetune",
        "synth",
        "evaluate",
    ]
    assert scratch["mpjpe"] == read_scores(scratch["scores"]).results[0].line("mpjpe").value
    page = (out / "table4.md").read_text()
    assert page.split("## Cells")[0].count(", *undertrained* |") == 3
    assert all(command in page for command in masked["commands"])


def test_paper_rows_are_compared_person_by_person(finished):
    out, _, _ = finished
    scratch, reference = _chosen(_content(out))
    assert "difference" not in reference
    first, second = (
        read_poses(Path(cell["scores"]).with_name("poses.parquet")).popitem()[1].errors().mean(1)
        for cell in (scratch, reference)
    )
    assert scratch["difference"] == pytest.approx((first - second).mean(), abs=1e-3)
    assert scratch["difference_low"] < scratch["difference"] < scratch["difference_high"]
    # errors of both rows are correlated
    assert scratch["difference_high"] - scratch["difference_low"] < scratch["high"] - scratch["low"]
    cells_page = (out / "table4.md").read_text().split("## Cells")[1].split("## Commands")[0]
    heads, line = (
        next(line for line in cells_page.splitlines() if word in line) for word in ("| row |", "| scratch |")
    )
    assert heads.split(" | ")[4] == "against + laser masking"
    assert line.split(" | ")[4].startswith(f"{scratch['difference']:+.1f} [")


def test_differences_of_few_sequences_have_no_interval(finished, monkeypatch):
    out, _, _ = finished
    scratch, _ = cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS)
    reference = report._reference(
        TABLES["table4"], scratch, cells(TABLES["table4"], Options(people=64, size="paper-tiny"))
    )
    whole = report._difference(scratch, reference, out)
    monkeypatch.setattr(report.aggregate, "LEAST_UNITS", 1000)
    few = report._difference(scratch, reference, out)
    assert few == {"difference": whole["difference"], "difference_low": None, "difference_high": None}
    assert _difference_text(few) == f"{whole['difference']:+.1f}"


def test_unreadable_scores_fail_their_cell_only(finished, tmp_path):
    out, _, _ = finished
    copy = tmp_path / "copy"
    shutil.copytree(out, copy)
    options = Options(people=64, size="paper-tiny")
    scratch, masked = cells(TABLES["table4"], options, _ROWS)
    (masked.evaluation.product(copy) / "scores.json").write_text("{")
    report._path(masked.evaluation, copy).unlink()
    entries = _chosen(write_table(TABLES["table4"], options, copy))
    assert [entry["state"] for entry in entries] == ["done", "failed"] and "scores.json" in entries[1]["reason"]


def test_mean_pose_is_relative_to_center_of_points(finished):
    out, _, _ = finished
    wanted = _content(out)["cells"][0]["mean_pose"]
    learned, scored = [], []
    for path in sorted((out / "runs").glob("synth-*/dataset.json")):
        people = list(open_dataset(path.parent).items())
        own = [p.joints[BODY26.map_to(HUMAN15)] - center_of(p.points) for p in people]
        (learned if len(own) == 64 else scored).extend(own)
    assert len(learned) == 64 and len(scored) == 16
    error = np.linalg.norm(np.array(scored) - np.mean(learned, 0), axis=-1).mean()
    assert wanted == pytest.approx(1e3 * error, abs=0.1)


def test_paper_table_only_lists_finished_cells(finished, capsys):
    out, _, _ = finished
    assert main([*_TABLE, str(out), "--table-only", "--seeds", "2"]) == 0
    assert [cell["state"] for cell in _chosen(_content(out))] == ["done", "not run"] * 2
    assert "1 of 2 seeds" in (out / "table4.md").read_text()
    assert main([*_TABLE, str(out), "--table-only"]) == 0
    # with other options none of them is a cell of the table: its page is not replaced by an empty one
    page = (out / "table4.md").read_text()
    assert main(["paper", "table4", "--out", str(out), "--table-only"]) == 2
    error = capsys.readouterr().err
    assert "table4.json has 3 finished cells, none of them run with these options" in error and error.count("\n") == 1
    assert (out / "table4.md").read_text() == page


def test_fig5_draws_hardest_people_of_all_methods(finished, monkeypatch):
    out, _, _ = finished
    selected = cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS)
    (path,) = figures.draw("fig5", selected, out)
    assert path.name == "fig5.png" and path.read_bytes().startswith(b"\x89PNG")
    drawn = []
    monkeypatch.setattr(figures, "draw_people", lambda panels, **_: drawn.extend(panels) or b"x")
    figures.draw("fig5", selected, out)
    assert len(drawn) == 2 * figures.HARDEST
    # all methods of a person are drawn from the same side, given by the true pose
    for one, other in zip(drawn[::2], drawn[1::2], strict=True):
        np.testing.assert_array_equal(facing_of(one), facing_of(other))
        np.testing.assert_array_equal(facing_of(one), facing(one.truth))
    # the points are those that the networks had
    with monkeypatch.context() as patch:
        patch.setattr(figures, "crop_of", lambda person, setting: (np.arange(7 + setting.seed), None))
        drawn.clear()
        figures.draw("fig5", selected, out)
    assert {len(panel.points) for panel in drawn} == {7}
    # a missing pose is no error of 0 mm, and does not make a person easier
    read = figures.read_poses

    def read_without_poses(path):
        predictions = read(path)
        if path.parent == selected[0].evaluation.product(out):
            for p in predictions.values():
                p.pred[:] = np.nan
        return predictions

    with monkeypatch.context() as patch:
        patch.setattr(figures, "read_poses", read_without_poses)
        drawn.clear()
        figures.draw("fig5", selected, out)
    assert {panel.label for panel in drawn[::2]} == {f"{selected[0].row}: no pose"}
    errors = [int(panel.label.rpartition(": ")[2].removesuffix(" mm")) for panel in drawn[1::2]]
    assert errors == sorted(errors, reverse=True) and errors[-1] > 0
    assert figures.draw("fig5", cells(TABLES["fig5"], Options(people=96)), out) == []
    # one picture per column
    clips = [replace(cell, column="clips") for cell in selected]
    assert [path.name for path in figures.draw("fig5", [*selected, *clips], out)] == [
        "fig5-people.png",
        "fig5-clips.png",
    ]


# --- tables and cells


@pytest.mark.parametrize("name", TABLES)
def test_cells_have_unique_keys_and_command_or_reason(name):
    for options in (Options(), Options(motion=("a.npz", "b.npz"), subjects="1", held_out="2", seeds=2, hours=2.0)):
        table = cells(TABLES[name], options)
        keys = [(row_key(cell.row), cell.column, cell.seed) for cell in table]
        assert len(set(keys)) == len(keys)
        for cell in table:
            assert (cell.evaluation is None) == bool(cell.why)
            assert sum(step.hours or 0 for step in cell.training) == pytest.approx(options.hours or 0) or cell.why


@pytest.fixture
def data(tmp_path):
    """Name -> folder of a real dataset or corpus, with as much content as options check."""
    folders = {name: tmp_path / name for name in (*REAL, "lipd", "freemotion", "noisemotion")}
    for name, folder in folders.items():
        folder.mkdir()
        card = DatasetCard(settings={"dataset": name}, count=1, per_shard=1, tables=("labelled",))
        write_card(folder, card)
    raw = tmp_path / "raw"
    (raw / "labels" / "3d" / "pose" / "5").mkdir(parents=True)
    poses = {name: str(raw) for name in ("freemotion-poses", "lidarhuman26m-poses")}
    return {name: str(folder) for name, folder in folders.items()} | poses


def test_options_reject_data_of_another_dataset(data):
    with pytest.raises(InputError, match=r"--data waymo=.*: expected waymo as prepared, got humanm3"):
        Options(data=data | {"waymo": data["humanm3"]})


def test_table1_cells_have_published_figures(data):
    printed = {method["method"]: method["figures"] for method in published()["methods"]}
    for cell in cells(TABLES["table1"], Options(data=data)):
        wanted = printed.get(next((name for name in printed if name.startswith(cell.row)), ""), {}).get(cell.column)
        assert cell.published == (wanted and wanted["mpjpe"])


def test_cell_names_people_that_were_not_scored_and_warnings_of_training(finished, monkeypatch):
    out, _, _ = finished
    cell = next(c for c in cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS) if c.row == "scratch")
    result = report.read_scores(cell.evaluation.product(out) / report.FILE).results[0]
    skipped = {"damaged shards": {"count": 1, "first": "labelled-00002.parquet"}}
    network, header = report.load_checkpoint(cell.training[-1].product(out))
    card = header.card | {"warnings": ["left out 1 damaged shards: a"], "init_card": {"warnings": ["no L_seg"]}}
    changed = SimpleNamespace(results=[replace(result, skipped=skipped)])
    monkeypatch.setattr(report, "read_scores", lambda path: changed)
    monkeypatch.setattr(report, "load_checkpoint", lambda path: (network, SimpleNamespace(card=card)))
    notes = report._figures(cell, cell.evaluation, out)["notes"]
    expected = ["not scored: 1 damaged shards; labelled-00002.parquet", "training: left out 1 damaged shards: a"]
    assert notes[-3:] == [*expected, "training: no L_seg"]


def test_tables_share_common_steps():
    def runs(name, row):
        (cell,) = cells(TABLES[name], Options(), [row])[:1]
        return [step.name for step in cell.evaluation.all()]

    assert runs("table4", "laser-masking") == runs("table4", "r-keep-0.6") == runs("table1", "dapt")
    assert runs("fig7", "dapt")[:-1] == runs("table1", "dapt")[:-1]
    assert runs("fig7", "dapt") == runs("fig8", "dapt")
    assert runs("table4", "scratch") == runs("table2", "w-o") != runs("table4", "r-keep-0.5")


@pytest.mark.parametrize("name", TABLES)
def test_step_commands_are_accepted_by_parser(name, tmp_path, data):
    for options in (Options(motion=("a.npz",)), Options(data=data, size="paper")):
        steps_of = [list(cell.evaluation.all()) for cell in cells(TABLES[name], options) if cell.evaluation]
        assert steps_of
        for step in {step.name: step for steps_ in steps_of for step in steps_}.values():
            # raises SystemExit for a wrong command
            make_parser().parse_args(step.command(tmp_path))


def test_table_commands_follow_paper_protocol(data):
    options = Options(data=data, size="paper")
    lines = {}
    for cell in cells(TABLES["table1"], options):
        own = cell.evaluation.all() if cell.evaluation else ()
        lines[cell.row, cell.column] = [" ".join(step.command(Path("o"))) for step in own]
    assert not lines["NE", "waymo"] and lines["NE", "sloper4d"] and lines["LiDARCap", "lidarhuman26m"]
    for (row, column), (*_, tuned, scored) in ((key, own) for key, own in lines.items() if own):
        # clips have all frames
        thinned = column in ("humanm3", "lidarhuman26m") and row not in ("LiDARCap", "NE")
        assert ("--interval 5" in tuned) == thinned
        assert "--protocol dapt" in scored and ("--decode dark" in scored) == (row == "DAPT")
        assert "--rate" not in tuned and "--epochs" not in tuned
        # training uses the crops and centers of the evaluation
        wanted = "--options trans_center=true" if row in ("LiDARCap", "NE") else "--augment paper"
        assert ("--recipe paper" in tuned) == (row in ("PRN", "DAPT"))
        assert wanted in tuned or "--recipe paper" in tuned
    assert (
        "--recipe paper --size paper" in lines["DAPT", "waymo"][0]
        and f"--motion {data['lidarhuman26m-poses']}" in lines["DAPT", "waymo"][0]
        and "--set ground_window=1,clothes=0" in lines["DAPT", "waymo"][0]
    )
    recorded = cells(TABLES["table4"], options, ["pre-training"])[0].training[0]
    assert "--set ground_window=1,clothes=0,recorded=1,keep=1" in " ".join(recorded.command(Path("o")))
    assert all(cell.evaluation for cell in cells(TABLES["table2"], options))
    # people with a corpus's poses have the body of the user's SMPL file if given, others the shipped body
    assert "--body" not in lines["DAPT", "waymo"][0]
    with_smpl = Options(data=data | {"smpl": "SMPL.npz"}, size="paper")
    bodies = {
        cell.row: "--body SMPL.npz" in " ".join(cell.training[0].command(Path("o")))
        for cell in cells(TABLES["table2"], with_smpl)
    }
    assert {row for row, has_body in bodies.items() if has_body} == {"FreeMotion†", "LiDARH26M†"}
    (dapt,) = cells(TABLES["table3"], with_smpl, ["anchors-mde-heatmaps"])
    assert "--body SMPL.npz" in " ".join(dapt.training[0].command(Path("o")))
    some = Options(data={name: data[name] for name in ("waymo", "lipd")})
    reasons = {cell.row: cell.why for cell in cells(TABLES["table2"], some)}
    assert reasons["LIPD"] == "" and "--data freemotion=DIR" in reasons["FreeMotion"]


def test_the_papers_network_learns_faster_from_few_synthesized_people_at_any_width():
    for size, rate in (("paper", "--rate 1e-3 --batch 32"), ("paper-tiny", "--rate 2e-3")):
        selected = cells(TABLES["table3"], Options(size=size), ["anchors", "anchors-mde-heatmaps"])
        for cell in selected:
            pretrained, tuned = (" ".join(step.command(Path("o"))) for step in cell.training)
            assert f"--recipe paper {rate} " in pretrained and f"--recipe paper {rate} " in tuned
            assert ("--heatmap-rate 10" in tuned) == (cell.row != "anchors") and "--heatmap-rate" not in pretrained


def test_tables_do_not_train_on_lidarhuman26m_test_poses(tmp_path, data, smpl):
    raw = tmp_path / "lidarhuman26m-raw"
    # 9 is in no split
    write_lidarhuman26m(raw, smpl, sequences=("5", "7", "24", "8", "9"))
    options = Options(data=data | {"lidarhuman26m-poses": str(raw)}, size="paper")
    rows = ("table1", "dapt"), ("table1", "ours"), ("table2", "lidarh26m-poses"), ("table4", "pre-training")
    for table, row in rows:
        first = cells(TABLES[table], options, [row])[0].training[0]
        words = first.command(tmp_path)
        subjects = words[words.index("--subjects") + 1].split(",")
        assert set(PoseBank.from_clips(raw, tuple(subjects)).clips.names) == {"labels/3d/pose/5", "labels/3d/pose/8"}
    for wrong in (raw / "labels", raw / "labels" / "3d" / "pose"):
        with pytest.raises(InputError, match="expected the root of the raw dataset"):
            cells(TABLES["table1"], replace(options, data=options.data | {"lidarhuman26m-poses": str(wrong)}))
    shapes = [load_betas(raw, subjects), load_betas(raw / "labels" / "3d" / "pose", ["5", "8"])]
    assert len(shapes[0]) and np.array_equal(*shapes) and len(load_betas(raw)) > len(shapes[0])


def test_pages_of_real_sets_name_poses_of_pretraining(data, tmp_path):
    without = {"waymo": data["waymo"]}
    for options, told in (
        (Options(data=data), ""),
        (Options(data=without), "poses of pre-training: the procedural prior, not LiDARHuman26M as in the paper"),
        (Options(data=without, motion=("b/a.npz",)), "poses of pre-training: a.npz"),
    ):
        content = write_table(TABLES["table1"], options, tmp_path)
        assert content["target"].startswith("real sets") and told in content["target"]
        assert ("pre-training" in content["target"]) == bool(told)
    reasons = [cell.why for cell in cells(TABLES["table4"], Options(data=without)) if cell.why]
    assert len(reasons) == 1 and "--data lidarhuman26m-poses=DIR" in reasons[0]


def test_mean_pose_is_relative_to_center_of_protocol(tmp_path, smpl):
    write_sloper4d(tmp_path / "raw", smpl, frames=40)
    prepare("sloper4d", tmp_path / "raw", tmp_path / "set", smpl=smpl, split_by="dapt")
    (target,) = _targets(TABLES["fig5"], Options(data={"sloper4d": str(tmp_path / "set")}))
    setting = SimpleNamespace(dataset="set", kind="sloper4d", joints=HUMAN15.joints, protocol="dapt", total=9)
    people = {split: list(open_dataset(tmp_path / "set").samples(split)) for split in ("train", "test")}
    own = {
        split: np.array([p.joints[SMPL24.map_to(HUMAN15)] - p.centers["trans"] for p in some])
        for split, some in people.items()
    }
    wanted = 1e3 * np.linalg.norm(own["test"] - own["train"].mean(0), axis=-1).mean()
    found = mean_pose_error(target, SimpleNamespace(setting=setting), tmp_path)
    assert found == pytest.approx(wanted, abs=0.1)
    # of other people, as after a shard was damaged or repaired, it is computed again
    (path,) = (tmp_path / "cells").glob("mean-pose-*.json")
    path.write_text('{"mpjpe": 1.0}')
    assert mean_pose_error(target, SimpleNamespace(setting=setting), tmp_path) == 1.0
    setting.total = 5
    assert mean_pose_error(target, SimpleNamespace(setting=setting), tmp_path) == found


def test_mean_pose_uses_training_set_and_skips_few_points(tmp_path, monkeypatch):
    def person(height, points):
        joints = np.full((15, 3), (0.0, 0.0, height))
        sample = SimpleNamespace(skeleton=HUMAN15, joint_labels=np.ones(15), joints=joints)
        return SimpleNamespace(sample=sample, points=np.zeros((points, 3)))

    first, second, test = (Step(("synth", name)) for name in ("first", "second", "test"))
    people = {first: [person(0, 9)], second: [person(1, 9)], test: [person(0, 5), person(9, 4)]}
    datasets = {str(step.product(tmp_path)): own for step, own in people.items()}
    monkeypatch.setattr(report, "open_eval_dataset", lambda folder, **_: datasets[folder])
    setting = SimpleNamespace(dataset="test", kind="synth", joints=HUMAN15.joints, protocol="clean")
    target = replace(cells(TABLES["table1"], Options())[0].target, test=test)
    for train, error in ((first, 0.0), (second, 1000.0)):
        assert mean_pose_error(replace(target, train=train), SimpleNamespace(setting=setting), tmp_path) == error


def test_run_table_rejects_unknown_subjects_before_training(tmp_path):
    motion = write_amass(tmp_path / "001_poses.npz", *a_clip())
    for subjects, held_out in (("001,9", "001"), ("001", "9")):
        options = Options(people=64, motion=(str(motion),), subjects=subjects, held_out=held_out)
        with pytest.raises(InputError, match="no clip starts with '9'"):
            run_table(TABLES["table4"], options, tmp_path / "out", [], lambda words: pytest.fail(str(words)), print)


def test_run_table_rejects_unsuitable_dataset_before_training(tmp_path, smpl, monkeypatch, capsys):
    write_sloper4d(tmp_path / "raw", smpl)
    prepare("sloper4d", tmp_path / "raw", tmp_path / "set", smpl=smpl)
    options = Options(data={"sloper4d": str(tmp_path / "set")}, people=64)
    with pytest.raises(InputError, match="run lidarpose prepare sloper4d RAW OUT --split-by dapt into another folder"):
        run_table(TABLES["table1"], options, tmp_path / "out", [], lambda words: pytest.fail(str(words)), print)
    # table 3 has no column of this dataset
    with pytest.raises(InputError, match="table3 is scored on waymo: give one by --data"):
        run_table(TABLES["table3"], options, tmp_path / "out", [], pytest.fail, print)
    monkeypatch.chdir(tmp_path)
    words = ["--data", f"sloper4d={options.data['sloper4d']}"]
    assert main(["paper", "table1", "--dry-run", *words]) == 2 and "--split-by dapt" in capsys.readouterr().err


@pytest.mark.parametrize("level", [True, False])
def test_paper_warns_of_leveled_frames_before_training(tmp_path, smpl, capsys, level):
    write_lidarhuman26m(tmp_path / "raw", smpl)
    prepare("lidarhuman26m", tmp_path / "raw", tmp_path / "set", smpl=smpl, level=level)
    words = ["--data", f"lidarhuman26m={tmp_path / 'set'}", "--out", str(tmp_path / "out")]
    assert main(["paper", "table1", "--dry-run", *words]) == 0
    assert ("prepare with --no-level" in capsys.readouterr().err) == level


@pytest.mark.parametrize(
    "size, suffix", [("paper", ""), ("paper-small", "-small"), ("paper-tiny", "-tiny"), ("paper-deep", "-tiny")]
)
def test_table1_rows_have_requested_size(size, suffix):
    sizes = {cell.row: cell.size for cell in cells(TABLES["table1"], Options(size=size)) if cell.evaluation}
    assert sizes == {
        "LiDARCap": f"lidarcap{suffix}", "NE": f"ne{suffix}", "LPFormer": f"lpformer{suffix}",
        "PRN as published": f"prn{suffix}", "PRN": size, "DAPT": size, "ours": "tiny" if suffix == "-tiny" else "small",
    }  # fmt: skip


def test_step_name_does_not_depend_on_workers():
    one, two = (cells(TABLES["table1"], Options(workers=n), ["dapt"])[0].evaluation.name for n in (1, 2))
    assert one == two != cells(TABLES["table1"], Options(hours=1.0), ["dapt"])[0].evaluation.name


def test_rows_are_named_as_in_the_table_or_by_their_keys():
    by_key = cells(TABLES["table2"], Options(), ["w-o"])
    assert by_key and by_key == cells(TABLES["table2"], Options(), ["w/o"])
    assert cells(TABLES["table1"], Options(), ["lidarcap", "PRN as published"]) == cells(
        TABLES["table1"], Options(), ["LiDARCap", "prn-as-published"]
    )


def test_paper_dry_run_runs_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["paper", "table4", "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert "lidarpose pretrain paper/runs/" in text and "--keep 0.5" in text and "as above" in text
    assert "need captured motion" in text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words, told",
    [
        (["table9"], "unknown table or figure 'table9'"),
        (["table1", "--rows", "hers"], "unknown row of table1 'hers'"),
        (["table1", "--people", "0"], "at least 1"),
        (["table1", "--hours", "0"], "above 0"),
        (["table1", "--size", "huge"], "unknown size of the paper's network"),
        (["table1", "--data", "waymo"], "NAME=DIR"),
        (["table1", "--data", "wymo=x"], "unknown dataset 'wymo'"),
        (["table1", "--data", "waymo=nowhere"], "is not a prepared dataset"),
        (["table1", "--data", "freemotion-poses=x"], "needs a dataset to score on"),
        (["fig6", "--rows", "dapt"], "omit --rows, --data, --held-out and --table-only"),
        (["fig6", "--data", "waymo=x"], "omit --rows, --data, --held-out and --table-only"),
        (["table1", "--held-out", "2"], "--motion"),
        (["table1", "--out", "file"], "give another by --out"),
    ],
)
def test_cli_paper_errors_are_one_line(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    assert main(["paper", *words]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.long
@pytest.mark.parametrize("words", [["fig6"], ["table1", "--table-only"]])
def test_paper_accepts_its_own_output_folder(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lidarpose.paper.figures.draw_people", lambda panels, **_: b"x")
    for _ in range(2):
        assert main(["paper", *words]) == 0
    assert main(["paper", "table4", "--dry-run"]) == 0


# --- steps


def test_run_table_marks_failed_cells_and_continues(tmp_path):
    asked = []

    def execute(words):
        asked.append(words[0])
        if words[0] == "finetune":
            print("lidarpose: error: unrecognized arguments: --model prn", file=sys.stderr)
            raise SystemExit(2)
        return 0

    told = []
    chosen = ["scratch", "laser-masking"]
    content = run_table(TABLES["table4"], Options(people=64), tmp_path / "out", chosen, execute, told.append)
    # the page has all rows, also those that were not chosen
    assert len(content["cells"]) == 9 and {cell["state"] for cell in content["cells"]} == {
        "failed",
        "not run",
        "not possible",
    }
    assert [cell["state"] for cell in _chosen(content)] == ["failed", "failed"]
    assert {cell["reason"] for cell in _chosen(content)} == {"unrecognized arguments: --model prn"}
    # the target is made once
    assert asked == ["synth", "finetune", "pretrain", "finetune"]
    assert "failed: unrecognized arguments" in (tmp_path / "out" / "table4.md").read_text()
    # the reason stays until the cell is run again, unless the table is damaged
    again = write_table(TABLES["table4"], Options(people=64), tmp_path / "out", chosen=chosen)
    assert _chosen(again) == _chosen(content)
    (tmp_path / "out" / "table4.json").write_text("{")
    again = write_table(TABLES["table4"], Options(people=64), tmp_path / "out", chosen=chosen)
    assert {cell["state"] for cell in _chosen(again)} == {"not run"}


def test_paper_command_fails_if_a_cell_failed(tmp_path, monkeypatch, capsys):
    content = {"cells": [_entry(), _entry(state="failed", reason="x")]}
    monkeypatch.setattr(report, "run_table", lambda *_: content)
    assert main(["paper", "table4", "--out", str(tmp_path / "p")]) == 2
    assert "1 cell failed, the others are done" in capsys.readouterr().err


@pytest.mark.parametrize("dry", [["--dry-run"], []])
def test_paper_checks_files_before_it_trains(tmp_path, monkeypatch, capsys, dry):
    monkeypatch.setattr(report, "run_steps", lambda *_: pytest.fail("runs a step"))
    monkeypatch.chdir(tmp_path)
    assert main(["paper", "table4", "--motion", "nowhere.npz", *dry]) == 2
    assert "nowhere.npz: no such file or folder, for --motion" in capsys.readouterr().err
    # of the chosen rows alone
    write_amass(tmp_path / "first_poses.npz", *a_clip())
    words = ["paper", "table2", "--motion", "first_poses.npz,nowhere.npz", "--dry-run", "--rows"]
    assert main([*words, "poses-of-first_poses"]) == 0 and main([*words, "poses-of-nowhere"]) == 2


def test_options_need_poses_for_a_body(data):
    with pytest.raises(InputError, match="smpl=FILE is the body of people with given poses: give freemotion-poses"):
        Options(data={"waymo": data["waymo"], "smpl": "SMPL.npz"})


def test_paper_needs_people_to_train_on(tmp_path, smpl):
    raw, folder = tmp_path / "raw", tmp_path / "test"
    write_lidarhuman26m(raw, smpl, sequences=("5", "7"), frames=2)
    prepare("lidarhuman26m", raw, folder, smpl=smpl, split="test", progress=False)
    selected = cells(TABLES["table1"], Options(data={"lidarhuman26m": str(folder)}), ["lidarcap"])
    with pytest.raises(InputError, match="has no people in the split 'train'; there are test"):
        report.check_targets(selected)


def test_copied_cells_are_done_for_tables_but_not_for_figures(tmp_path):
    asked = []
    for name in ("table1", "fig5"):
        cell = cells(TABLES[name], Options(people=64), ["dapt"])[0]
        path = report._path(cell.evaluation, tmp_path)
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(_entry(row=cell.row, column=cell.column)))
        chosen = replace(TABLES[name], columns=("waymo",))
        run_table(chosen, Options(people=64), tmp_path, ["dapt"], lambda words: asked.append(words[0]) or 0, print)
        assert asked == ([] if name == "table1" else ["synth", "pretrain", "finetune", "synth", "evaluate"])


def test_run_steps_raises_if_step_is_stopped_or_fails(tmp_path):
    step = Step(("synth", "-n", "3"))
    with pytest.raises(KeyboardInterrupt, match="^the same lidarpose paper command goes on here$"):
        run_steps(step, tmp_path, lambda words: 143, print)
    with pytest.raises(StepFailed, match="status 1"):
        run_steps(step, tmp_path, lambda words: 1, print)
    asked = []
    for _ in range(2):
        run_steps(step, tmp_path, lambda words: asked.append(words) or 0, print)
    assert asked == [["synth", "-n", "3", "--out", str(step.folder(tmp_path))]]


def test_damaged_files_of_steps_are_named(tmp_path):
    cell = cells(TABLES["table1"], Options(people=64), ["dapt"])[0]
    state, results = tmp_path / "runs" / f"{cell.evaluation.name}.json", report._path(cell.evaluation, tmp_path)
    curves = cell.evaluation.product(tmp_path) / "stability.json"

    def curves_of_done_cell():
        steps._note(cell.evaluation, tmp_path, done=True)
        return figures._picture("fig7", {"ours": cell}, tmp_path)

    for path, read in (
        (state, lambda: steps.is_done(cell.evaluation, tmp_path)),
        (results, lambda: report._entry(cell, tmp_path, "", [])),
        (curves, curves_of_done_cell),
        (tmp_path / run_dir.CONFIG, lambda: steps._people(tmp_path)),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('{"done": tr')
        with pytest.raises(InputError, match=f"^{re.escape(str(path))}: is not JSON"):
            read()
        path.unlink()


def test_run_steps_waits_for_step_of_another_process(tmp_path):
    step, began, go_on = Step(("synth", "-n", "3")), threading.Event(), threading.Event()
    asked, told = [], []

    def execute(words):
        asked.append(words)
        began.set()
        return 0 if go_on.wait(60) else 1

    def tell(line):
        told.append(line)
        if "another process" in line:
            go_on.set()

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(run_steps, step, tmp_path, execute, tell)
        assert began.wait(60)
        # waits until the step is done
        pool.submit(run_steps, step, tmp_path, execute, tell).result(60)
        first.result(60)
    assert len(asked) == 1 and told[1] == f"{step.name}: another process is running it, waiting for its end"


def test_run_steps_repeats_killed_evaluation(tmp_path):
    step, asked = Step(("evaluate", "weights", "set")), []
    folder = step.folder(tmp_path)
    folder.mkdir(parents=True)
    for name in ("set-errors.png", ".0123456789abcdef-scores.json"):
        (folder / name).write_text("")

    def execute(words):
        assert not folder.exists()
        asked.append(words)
        return 0

    run_steps(step, tmp_path, execute, print)
    assert len(asked) == 1
    # all files exist, but the process was killed before it recorded that
    (tmp_path / "runs" / f"{step.name}.json").unlink()
    folder.mkdir()
    (folder / "poses.parquet").write_text("")
    run_steps(step, tmp_path, execute, print)
    assert len(asked) == 1 and steps.is_done(step, tmp_path)


@pytest.mark.parametrize(
    ("lines", "fit"),
    [
        # 100 s for the first line, 8 people a second after it
        ([(64, 100.0), (224, 120.0)], 224 + 8 * 880),
        # a first line that took a third of the hours is all that can be waited for
        ([(64, 400.0)], 160),
        # fits
        ([(64, 1.0), (9_000, 130.0)], None),
    ],
)
def test_the_first_line_of_a_log_does_not_count_for_a_trainings_speed(tmp_path, monkeypatch, lines, fit):
    signals = []
    monkeypatch.setattr(steps, "_POLL", 0.001)
    monkeypatch.setattr(steps, "_people", lambda folder: 20_000)
    monkeypatch.setattr(steps.os, "kill", lambda process, number: signals.append(number))
    log = [json.dumps({"people": people, "seconds": seconds}) for people, seconds in lines]
    (tmp_path / "log.jsonl").write_text("\n".join(log) + "\n")
    with loop.StopRequest(), steps._Watch(tmp_path, 1000 / 3600, print) as watch:
        watch._thread.join(timeout=10)
    assert watch.fit == pytest.approx(fit) if fit else watch.fit is None
    assert signals == [signal.SIGINT] * bool(fit)


@pytest.mark.parametrize("first", ["user", "watch"])
def test_a_users_stop_is_not_lost_to_the_watch(tmp_path, monkeypatch, capsys, first):
    """Neither before the watch, whose signal would abort the saving, nor after it, while the training saves."""
    monkeypatch.setattr(steps, "_POLL", 0.001)
    monkeypatch.setattr(steps, "_people", lambda folder: 20_000)
    step, asked, saved = Step(("pretrain", "--people", "20000"), hours=1000 / 3600), [], []

    def execute(words):
        asked.append(words)
        try:
            with loop.StopRequest() as stop:
                if first == "user":
                    os.kill(os.getpid(), signal.SIGINT)
                step.folder(tmp_path).mkdir(parents=True)
                log = "".join(json.dumps({"people": 64 * k, "seconds": 100.0 * k}) + "\n" for k in (1, 2))
                (step.folder(tmp_path) / "log.jsonl").write_text(log)
                until = time.monotonic() + (0.1 if first == "user" else 10)
                while time.monotonic() < until and not (first == "watch" and stop.number):
                    time.sleep(0.01)
                if first == "watch":
                    os.kill(os.getpid(), signal.SIGINT)
                    time.sleep(10)
                saved.append(True)
                raise loop.Interrupted("stopped after 128 samples, saved: go on", stop.number)
        except KeyboardInterrupt as interrupt:
            print(f"lidarpose: {interrupt or 'stopped'}", file=sys.stderr)
            return 130

    with pytest.raises(KeyboardInterrupt):
        run_steps(step, tmp_path, execute, print)
    assert len(asked) == 1 and bool(saved) == (first == "user") and "length" not in steps._state(step, tmp_path)


def test_watch_tells_why_it_cannot_watch(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(steps, "_POLL", 0.001)
    (tmp_path / "log.jsonl").write_text('{"people": 64}\n')
    with steps._Watch(tmp_path, 1.0, told.append) as watch:
        watch._thread.join(timeout=10)
    assert told == [f"warning: --hours has no effect on {tmp_path.name} (KeyError: 'seconds')"]


def test_resumed_training_has_its_workers_and_no_less_than_it_has_seen(tmp_path, monkeypatch):
    words = ("finetune", "--data", "x", "--workers", "4")
    step, asked = Step(words), []
    folder = step.folder(tmp_path)
    run_dir.begin(folder, Finetune(data=("x",), epochs=12.344), "")
    run_steps(step, tmp_path, lambda words: asked.append(words) or 0, print)
    assert asked == [["finetune", "--out", str(folder), "--resume", "--workers", "4"]]
    (folder / "log.jsonl").write_text('{"people": 12344}\n')
    monkeypatch.setattr(steps, "_people", lambda folder: 12_344)
    assert steps._shortened(step, folder, 12_344.0) == ["--epochs", "12.344"]


@pytest.mark.long
def test_run_steps_shortens_training_to_its_hours(tmp_path):
    words = ("pretrain", "--size", "tiny", "--people", "200000", "--batch", "4", "--workers", "0", "--pictures", "0")
    step = Step(words, hours=0.0005)
    run_steps(step, tmp_path, main, print)
    (option, people) = json.loads((tmp_path / "runs" / f"{step.name}.json").read_text())["length"]
    assert option == "--people" and 8 <= int(people) < 20_000
    seen = steps.last_entry(step.folder(tmp_path))["people"]
    assert seen == -(-int(people) // 4) * 4
    # includes batches that end between reading the log and stopping
    assert int(steps._shortened(step, step.folder(tmp_path), fit=1.0)[1]) >= seen


# --- pages


def _entry(**changes):
    entry = {"row": "a", "column": "x", "seed": 0, "published": None, "commands": ["lidarpose x"], "state": "done"}
    entry |= {"mpjpe": 100.0, "low": 95.0, "high": 105.0, "pa_mpjpe": 60.0, "pck3": 90.0, "pck5": None}
    entry |= {
        "mean_pose": 200.0,
        "people_seen": 1000,
        "hours": 0.5,
        "people_per_second": None,
        "parameters": 1234,
        "size": "tiny",
    }
    return entry | {"undertrained": False} | changes


def test_markdown_has_columns_of_root_and_difference_where_cells_have_them():
    compared = {"difference": -1.25, "difference_low": None, "difference_high": None}
    entries = [_entry(), _entry(row="b", root_mpjpe=70.04, **compared)]
    content = {"cells": entries, "reference": "a"}
    head, _, first, second = cost_lines(content)
    assert " | MPJPE | against a | relative to the root | PA | " in head
    assert " | 100.0 | - | - | 60.0 | " in first and " | 100.0 | -1.2 | 70.0 | 60.0 | " in second
    assert "relative" not in cost_lines(content | {"cells": entries[:1]})[0]


def test_markdown_has_clips_in_the_metric_of_their_printed_values():
    entries = [_entry(row="NE", published=72.2, root_mpjpe=70.04), _entry(published=51.6, root_mpjpe=70.04)]
    page = markdown({"title": "T", "target": "real sets", "people": 2000, "hours": None, "cells": entries})
    assert "| NE | 100.0 [95.0, 105.0]; 70.0 relative to the root (paper 72.2) |" in page
    assert "| a | 100.0 [95.0, 105.0] (paper 51.6) |" in page


def test_markdown_of_cells():
    entries = [
        _entry(published=51.6),
        _entry(row="b"), _entry(row="b", seed=1, mpjpe=120.0, undertrained=True),
        _entry(row="c", state="failed", reason="no such flag"),
        _entry(row="d", state="not run", reason="its command was not run", published=60.0),
        _entry(row="e", low=None, high=None, notes=["the split leaks: by time"]),
        _entry(row="f", seed=1, notes=["the split leaks: by time"]),
    ]  # fmt: skip
    page = markdown({"title": "T", "target": "stand-in", "people": 2000, "hours": 1.5, "cells": entries})
    assert "Budget: 2,000 people a stage of training, 1.5 hours a row." in page
    real = markdown({"title": "T", "target": "real sets", "people": 2000, "hours": None, "cells": entries})
    assert "Budget: 2,000 people of pre-training." in real
    for line in (
        "| a | 100.0 [95.0, 105.0] (paper 51.6) |",
        "| b | 110.0 [100.0, 120.0], 2 of 2 seeds, *undertrained* |",
        "| c | failed: no such flag |",
        "| d | not run (paper 60.0) |",
        "| e | 100.0 |",
        "- x: the split leaks: by time",
        "| b | x | 1 | 120.0 | 60.0 | 90.0 | - | 200.0 | 1,000 | 0.50 | - | tiny | 1,234 | undertrained |",
        "| d | x | 0 | - | - | - | - | - | - | - | - | - | - | not run |",
    ):
        assert line in page.splitlines()


@pytest.mark.parametrize(("mean_pose", "is_noted"), [(200.4, False), (202.3, True)])
def test_markdown_notes_columns_of_different_people(mean_pose, is_noted):
    """The mean pose of other training people differs a little on the same people."""
    entries = [_entry(), _entry(row="b", mean_pose=mean_pose), _entry(row="c", state="failed", reason="r", mean_pose=1)]
    page = markdown({"title": "T", "target": "real sets", "people": 2000, "hours": None, "cells": entries})
    assert (
        "- x: mean poses of 200.0 to 202.3 mm: the rows may score different people" in page.splitlines()
    ) is is_noted


def test_table_leaves_out_seeds_that_were_neither_chosen_nor_run(tmp_path):
    options = Options(seeds=2)
    ours = next(c for c in cells(TABLES["table1"], options, ["ours"]) if c.seed == 1 and c.evaluation)
    path = report._path(ours.evaluation, tmp_path)
    path.parent.mkdir()
    path.write_text(json.dumps({k: v for k, v in _entry().items() if k not in ("row", "column", "seed", "commands")}))
    seeds = {}
    for entry in write_table(TABLES["table1"], options, tmp_path, chosen=["prn", "lidarcap"])["cells"]:
        seeds.setdefault((entry["row"], entry["column"]), []).append(entry["seed"])
    assert seeds["PRN", "people"] == seeds["LiDARCap", "clips"] == [0, 1] and seeds["DAPT", "people"] == [0]
    assert seeds["ours", ours.column] == [0, 1]
    assert all(entry["seed"] < 2 for entry in write_table(TABLES["table1"], options, tmp_path)["cells"])


# --- figures


def _study(scale):
    points = [{"label": str(k), "mpjpe": scale * (100 + 10 * k)} for k in range(4)]
    points.append({"label": "9", "mpjpe": None})
    curves = [{"name": name, "title": name, "points": points} for name in ("jitter", "clusters")]
    ends = [{"group": g, "mean": 90.0 * scale, "quartiles": [50, 80, 120], "worst": 600} for g in ("head", "wrists")]
    setting = {"dataset": "synth-9-abc", "protocol": "clean"}
    return {"curves": curves, "ends": ends, "who": "9 people of synth-9-abc", "setting": setting}


@pytest.mark.parametrize("name", ["fig7", "fig8"])
def test_fig7_and_fig8_draw_several_networks(tmp_path, name, monkeypatch):
    drawn, png_of = [], charts.png_of
    monkeypatch.setattr(charts, "png_of", lambda figure: drawn.append(figure) or png_of(figure))
    selected = cells(TABLES[name], Options(), ["dapt", "ours"])
    for scale, cell in enumerate(selected, 1):
        folder = cell.evaluation.product(tmp_path)
        folder.mkdir(parents=True)
        (folder / "stability.json").write_text(json.dumps({"studies": [_study(scale)]}))
        steps._note(cell.evaluation, tmp_path, done=True)
    (path,) = figures.draw(name, selected, tmp_path)
    assert path == tmp_path / f"{name}.png" and path.read_bytes().startswith(b"\x89PNG")
    # the dataset's description, not the name of its folder
    words = " ".join(text.get_text() for text in drawn[0].findobj(Text))
    assert "the stand-in" in words and "synth-9-abc" not in words
    assert path.read_bytes() != _drawn_alone(name, selected[:1], tmp_path)


def test_fig7_is_drawn_from_copied_cells(tmp_path):
    """Without the evaluations' folders; a cell without curves is run again."""
    (cell,) = cells(TABLES["fig7"], Options(), ["ours"])
    results = report._path(cell.evaluation, tmp_path)
    results.parent.mkdir(parents=True)
    results.write_text(json.dumps({"state": "done"}))
    assert not report._is_there(TABLES["fig7"], cell.evaluation, tmp_path)
    assert figures.draw("fig7", [cell], tmp_path) == []
    results.write_text(json.dumps({"state": "done", "stability": _study(1)}))
    assert report._is_there(TABLES["fig7"], cell.evaluation, tmp_path)
    (path,) = figures.draw("fig7", [cell], tmp_path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert "stability" not in report._entry(cell, tmp_path, "", [])


def test_figures_have_all_finished_rows_whatever_the_chosen_ones(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "compare_stability", lambda studies: drawn.append(list(studies)) or b"")
    selected = cells(TABLES["fig7"], Options(), ["dapt", "ours"])
    (tmp_path / "cells").mkdir()
    for cell in selected:
        results = _entry(stability=_study(1))
        report._path(cell.evaluation, tmp_path).write_text(
            json.dumps({name: results[name] for name in results if name not in ("row", "column", "seed")})
        )
    assert main(["paper", "fig7", "--rows", "ours", "--table-only", "--out", str(tmp_path)]) == 0
    assert drawn == [[cell.row for cell in selected]]


def test_compare_stability_aligns_amounts_without_poses(monkeypatch):
    monkeypatch.setattr(charts, "png_of", lambda figure: figure)
    whole, gap = _study(1), _study(2)
    for curve in gap["curves"]:
        curve["points"][1]["mpjpe"] = None
    figure = charts.compare_stability({"whole": whole, "gap": gap})
    for axes in figure.axes:
        (one, other), labels = axes.lines, [label.get_text() for label in axes.get_xticklabels()]
        assert labels == ["0", "1", "2", "3", "9"]
        np.testing.assert_array_equal(one.get_xdata(), other.get_xdata())
        np.testing.assert_array_equal(other.get_ydata(), [200, np.nan, 240, 260, np.nan])
        # the legend is below the axes and hides no line
        assert axes.get_legend() is None
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["whole", "gap"]


def test_compare_stability_is_independent_of_settings_of_user():
    png = charts.compare_stability({"ours": _study(1)})
    with style.context("dark_background"):
        assert charts.compare_stability({"ours": _study(1)}) == png


def _drawn_alone(name, selected, out):
    return figures.draw(name, selected, out)[0].read_bytes()


def test_fig6_draws_one_body_at_all_distances(tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(figures, "draw_people", lambda panels, **_: drawn.extend(panels) or b"PNG")
    assert main(["paper", "fig6", "--out", str(tmp_path / "out")]) == 0
    bodies = np.array([panel.truth.joints - panel.truth.joints[0] for panel in drawn])
    # the same body and rotation: masks and distances change only the points
    np.testing.assert_allclose(bodies, np.broadcast_to(bodies[0], bodies.shape), atol=1e-4)
    assert main(["paper", "fig6", "--held-out", "006", "--out", str(tmp_path / "out")]) == 2
    assert "fig6 shows a synthesized body and has no rows: omit" in capsys.readouterr().err
    assert main(["paper", "table1", "--data", "waymo=a,waymo=b", "--out", str(tmp_path / "out")]) == 2
    assert "expected each name of --data once, got waymo twice" in capsys.readouterr().err
    counts = np.array([len(panel.points) for panel in drawn]).reshape(len(figures._DISTANCES), -1)
    assert (np.diff(counts[:, 0]) < 0).all() and (counts[:, -1] < counts[:, 0]).all()


def test_check_out_rejects_folder_with_other_files(tmp_path):
    (tmp_path / "x").write_text("")
    with pytest.raises(InputError, match="expected a new or empty folder"):
        steps.check_out(tmp_path)
    assert report.SCHEMA == "lidarpose.paper/1"


@pytest.mark.long
def test_paper_table1_from_raw_lidarhuman26m(tmp_path, smpl, monkeypatch):
    """All commands as typed by a user; accuracy is not checked with so few frames."""
    monkeypatch.setitem(RECIPES[Finetune]["lidarcap"], "epochs", 8.0)
    raw, prepared, out = tmp_path / "raw", tmp_path / "set", tmp_path / "paper"
    write_lidarhuman26m(raw, smpl, sequences=("5", "7"), frames=16)
    assert main(["prepare", "lidarhuman26m", str(raw), str(prepared), "--smpl", str(smpl)]) == 0
    words = ["--data", f"lidarhuman26m={prepared}", "--size", "paper-tiny", "--rows", "lidarcap", "--out", str(out)]
    assert main(["paper", "table1", *words]) == 0
    (cell,) = [entry for entry in _content(out, "table1")["cells"] if entry["row"] == "LiDARCap"]
    assert (cell["row"], cell["column"], cell["state"]) == ("LiDARCap", "lidarhuman26m", "done")
    assert cell["people_seen"] == 8 * 16 and cell["people_scored"] == 16 and cell["undertrained"]
    assert len(cell["joints"]) == 24 and cell["mpjpe"] > 0 and cell["mean_pose"] > 0
    assert "| LiDARCap | " in (out / "table1.md").read_text()


def test_table_in_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch, capsys):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert main(["paper", "table4", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    problem = f"cannot write into the folder {tmp_path / 'out'} (Read-only file system)"
    assert f"{problem}; the disk is read-only: write to another folder" in error
    assert error.count("\n") == 1


def test_stand_in_is_scored_on_other_people_than_it_trains_on():
    for target in _targets(TABLES["table1"], Options(people=100)):
        (train, test), epochs = (step.words for step in (target.train, target.test)), float(target.learn[-1])
        seeds, counts = ([int(words[words.index(name) + 1]) for words in (train, test)] for name in ("--seed", "-n"))
        assert seeds[0] != seeds[1]
        frames = 16 if target.clips else 1
        assert counts == [-(-100 // frames), -(-25 // frames)]
        assert epochs * counts[0] * frames == pytest.approx(100, rel=1e-5)


def test_poses_of_held_out_subjects_are_not_pretrained_on():
    options = Options(motion=("a.npz", "b.npz"), subjects="1", held_out="2")
    rows = [("table2", "poses-of-a"), ("table2", "poses-of-b"), ("table1", "dapt"), ("table4", "pre-training")]
    pretrained = [" ".join(cells(TABLES[t], options, [row])[0].training[0].command(Path("o"))) for t, row in rows]
    assert ["--subjects 1 " in words for words in pretrained] == [True, False, True, True]


def test_ours_sees_as_many_people_of_real_sets_as_other_rows(data):
    tuned = [
        cells(TABLES["table1"], options, ["ours"])[0].training[1].words for options in (Options(data=data), Options())
    ]
    assert ["--hold-out" in words for words in tuned] == [True, False]
    assert " ".join(map(str, tuned[0])).count("--mix 0 --hold-out 0") == 1


def test_cell_is_undertrained_unless_a_fifth_better_than_the_mean_pose(finished, monkeypatch):
    out, _, _ = finished
    cell = next(c for c in cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS) if c.row == "scratch")
    found = []
    for share in (0.79, 0.81):
        error = report.read_scores(cell.evaluation.product(out) / report.FILE).results[0].line("mpjpe").value / share
        monkeypatch.setattr(report, "mean_pose_error", lambda *_, error=error: error)
        found.append(report._figures(cell, cell.evaluation, out)["undertrained"])
    assert found == [False, True]


def test_hours_of_a_cell_include_pretraining(finished, monkeypatch):
    out, _, _ = finished
    cell = next(c for c in cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS) if c.row == "scratch")
    network, header = report.load_checkpoint(cell.training[-1].product(out))
    card = header.card | {"hours": 1.5, "init_card": {"hours": 2.25, "people_seen": 9}}
    monkeypatch.setattr(report, "load_checkpoint", lambda path: (network, SimpleNamespace(card=card)))
    figures = report._figures(cell, cell.evaluation, out)
    assert (figures["hours"], figures["people_seen"]) == (3.75, 73)


def test_rows_of_other_people_are_not_compared(finished, monkeypatch):
    out, _, _ = finished
    cell, reference = cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS)
    read, others = report.read_poses, iter((0.0, 1.0))

    def moved(path):
        return {name: replace(p, true=p.true + next(others)) for name, p in read(path).items()}

    assert report._difference(cell, reference, out)
    monkeypatch.setattr(report, "read_poses", moved)
    assert report._difference(cell, reference, out) == {}


def test_differences_of_clips_are_drawn_by_sequence(finished, monkeypatch):
    out, _, _ = finished
    cell, reference = cells(TABLES["table4"], Options(people=64, size="paper-tiny"), _ROWS)
    result, drawn = report.read_scores(cell.evaluation.product(out) / report.FILE).results[0], []
    interval = report.aggregate.paired_interval
    monkeypatch.setattr(
        report.aggregate, "paired_interval", lambda *of, clusters: drawn.append(clusters) or interval(*of)
    )
    for clusters in (False, True):
        scores = SimpleNamespace(results=[replace(result, setting=replace(result.setting, clusters=clusters))])
        monkeypatch.setattr(report, "read_scores", lambda path, scores=scores: scores)
        report._difference(cell, reference, out)
    assert drawn[0] is None and len(drawn[1]) == 16
