"""Metric rows of a few people with known errors, computed by hand, and the charts of these rows."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.eval import charts, metric_rows
from lidarpose.eval.metric_rows import METRICS, Metric
from lidarpose.eval.predictions import stack
from lidarpose.eval.scores import Result, Setting
from lidarpose.skeleton import HUMAN15

# a row of `stack` without poses; most fields are unknown
PERSON = {"sequence": "s", "frame": 0, "track": "0", "time": 0.0, "sensor": "", "condition": "", "poses": ""}
PERSON |= {"plain": False, "moving": False, "points": 100, "distance": 5.0, "hidden": np.nan, "shard": 0, "row": 0}


def four():
    """Four people of one track, at 5 and 15 m, with 60 and 300 points, half hidden and fully visible."""
    true = np.zeros((15, 3))
    for joint in ("hip", "shoulder"):
        true[HUMAN15.index(f"left_{joint}"), 1], true[HUMAN15.index(f"right_{joint}"), 1] = 0.2, -0.2
    stated = {"confidence": np.full(15, 0.75), "spread": np.full(15, 0.06), "labels": np.full(15, 2), "true": true}
    rows = []
    for k, (shift, flipped, points, distance, hidden) in enumerate(
        [(0.05, 0, 60, 5.0, 0.45), (0.05, 0, 300, 5.0, 0.0), (0.25, 0, 300, 15.0, 0.0), (0.05, 1, 300, 15.0, 0.0)]
    ):
        pred = (true * [1, -1, 1] if flipped else true) + [shift, 0, 0]
        own = {"row": k, "frame": k, "time": k / 10, "pred": pred}
        rows.append(PERSON | stated | own | {"points": points, "distance": distance, "hidden": hidden})
    setting = Setting(
        dataset="a", kind="synth", method="m", protocol="clean", centring="", crop="", split="none", split_source="",
        leaks="", joints=HUMAN15.joints, not_judged="", sensor="known", total=4, limit=None, clusters=False, seed=0,
    )  # fmt: skip
    return stack(HUMAN15, rows), setting


def test_metric_rows_match_values_by_hand():
    rows = {(x.figure, x.group, x.of): x for x in metric_rows.metric_rows(*four())}
    # steps of 0, 20 and -20 cm: second differences of 20 and 40 cm; four flipped joints also move 40 cm sideways
    expected = (200 + (11 * 400 + 4 * np.hypot(400, 400)) / 15) / 2
    assert rows["acceleration", "all", "frames in a row"].value == pytest.approx(expected, rel=1e-4)
    # one of three people with 100 points or more
    assert rows["turned_round", "points", "100 and more"].value == pytest.approx(100 / 3)
    assert rows["turned_round", "points", "20 to 100"].value == 0
    # of 50, 50, 250 mm and the flipped person's error: interpolated between the third and the fourth
    people = np.sort(four()[0].errors().mean(1))
    worst = rows["mpjpe_p95", "all", "all"]
    assert worst.value == pytest.approx(people[2] + 0.85 * (people[3] - people[2])) and worst.people == 4
    # 11 of 15 joints of the flipped person and all of two others are 5 cm off: 41 of 60 within 10 cm
    assert rows["calibration_error", "all", "all"].value == pytest.approx(100 * (0.75 - 41 / 60), abs=1e-3)
    spans = {group: {of: x.people for (f, g, of), x in rows.items() if (f, g) == ("mpjpe", group)}
             for group in ("distance, m", "points", "hidden share")}  # fmt: skip
    assert spans["distance, m"] == {"0 to 10": 2, "10 to 20": 2}
    assert spans["points"] == {"50 to 100": 1, "200 to 400": 3}
    assert spans["hidden share"] == {"0 to 0.1": 3, "0.3 to 0.5": 1}


def test_rows_of_joints_by_points_near_them_count_each_joint_once():
    people, setting = four()
    assert not any(row.group == "points near the joint" for row in metric_rows.metric_rows(people, setting))
    nearby = np.full((4, 15), 30.0)
    # the third person is 25 cm off, the others' pelvises 5 cm
    nearby[2], nearby[:2, 0], nearby[3] = 0, 4, np.nan
    found = {
        row.of: (row.value, row.people, row.joints, row.skipped)
        for row in metric_rows.metric_rows(replace(people, nearby=nearby), setting)
        if row.group == "points near the joint"
    }
    assert found == {
        "0 to 1": (pytest.approx(250, abs=1e-3), 1, 15, 0),
        "1 to 5": (pytest.approx(50, abs=1e-3), 2, 2, 0),
        "20 and more": (pytest.approx(50, abs=1e-3), 2, 28, 0),
    }
    nearby[0, 1] = 0
    rows = {(row.group, row.of): row.value for row in metric_rows.metric_rows(replace(people, nearby=nearby), setting)}
    # 15 joints at 250 mm and one at 50, not the mean of two people
    assert rows["points near the joint", "0 to 1"] == pytest.approx((15 * 250 + 50) / 16, abs=1e-3)


def test_metrics_entry_adds_rows_and_changes_no_others(monkeypatch):
    def largest_error(predictions):
        return predictions.errors().max(1)

    before = metric_rows.metric_rows(*four())
    monkeypatch.setitem(METRICS, "largest_error", Metric(largest_error, "mm", ("all", "spans")))
    after = metric_rows.metric_rows(*four())
    added = {(row.group, row.of): row for row in after if row.figure == "largest_error"}
    assert [row for row in after if row.figure != "largest_error"] == list(before)
    # hips and shoulders of the flipped person are also 40 cm off along y
    wanted = [50, 50, 250, 1e3 * np.hypot(0.4, 0.05)]
    assert added["all", "all"].value == pytest.approx(np.mean(wanted), abs=1e-3)
    assert added["distance, m", "0 to 10"].value == pytest.approx(50, abs=1e-3) and len(added) == 7


def test_charts_draw_metric_rows(monkeypatch):
    predictions, setting = four()
    nearby = np.arange(predictions.labels.size).reshape(predictions.labels.shape) % 30
    predictions = replace(predictions, nearby=nearby.astype(float))
    rows = metric_rows.metric_rows(predictions, setting)
    result = Result(setting=setting, counts={}, skipped={}, notes=(), lines=rows)
    figures = []
    monkeypatch.setattr(charts, "png_of", lambda figure: figures.append(figure) or b"")
    charts.draw_errors(result)
    charts.draw_reliability(predictions, result)
    groups = ("distance, m", "points", "hidden share", "joints", "points near the joint")
    by_group = dict(zip(groups, figures[0].axes, strict=True))
    for group, axes in by_group.items():
        due = [row for row in rows if (row.figure, row.group) == ("mpjpe", group)]
        np.testing.assert_allclose([bar.get_height() for bar in axes.patches], [row.value for row in due])
        named = [label.get_text().split("\n")[0] for label in axes.get_xticklabels()]
        assert named == [row.of for row in due] and len(due) > 1
    assert by_group["distance, m"].patches[0].get_height() == pytest.approx(50)
    confidence, spread = figures[1].axes
    np.testing.assert_allclose(confidence.lines[1].get_xydata(), [[0.75, 41 / 60]])
    np.testing.assert_allclose(spread.lines[1].get_xydata(), [[60, np.nanmean(predictions.errors())]])
