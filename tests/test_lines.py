"""Every figure of a few people whose errors are known, worked out by hand, and where charts draw it."""

import numpy as np
import pytest

from lidarpose.eval import charts
from lidarpose.eval.metric_rows import metric_rows
from lidarpose.eval.predictions import stack
from lidarpose.eval.scores import Result, Setting
from lidarpose.skeleton import HUMAN15


def four():
    """Four people of one track, at 5 and 15 m, of 60 and 300 points, half hidden and whole."""
    true = np.zeros((15, 3))
    for side, y in (("left", 0.2), ("right", -0.2)):
        for joint in ("hip", "shoulder"):
            true[HUMAN15.index(f"{side}_{joint}"), 1] = y
    told = {"sequence": "s", "track": "0", "sensor": "", "condition": "", "poses": "", "plain": False, "moving": False}
    told |= {"box": np.full(7, np.nan), "confidence": np.full(15, 0.75), "spread": np.full(15, 0.06)}
    told |= {"visible": np.full(15, np.nan)}
    rows = []
    for k, (away, turned, points, distance, hidden) in enumerate(
        [(0.05, 0, 60, 5.0, 0.45), (0.05, 0, 300, 5.0, 0.0), (0.25, 0, 300, 15.0, 0.0), (0.05, 1, 300, 15.0, 0.0)]
    ):
        pred = true * [1, -1, 1] if turned else true
        rows.append(
            told
            | {"shard": 0, "row": k, "frame": k, "time": k / 10, "pred": pred + [away, 0, 0], "true": true}
            | {"labels": np.full(15, 2), "points": points, "distance": distance, "hidden": hidden}
        )
    setting = Setting(
        dataset="a", kind="synth", method="m", protocol="clean", centring="", crop="", split="none", split_source="",
        leaks="", joints=HUMAN15.joints, not_judged="", sensor="known", total=4, limit=None, clusters=False, seed=0,
    )  # fmt: skip
    return stack(HUMAN15, rows), setting


def test_lines_by_hand():
    found = {(x.figure, x.group, x.of): x for x in metric_rows(*four())}
    # steps of 0, 20 cm and -20 cm: second differences of 20 and, but for who is turned, 40 cm
    assert 200 < found["acceleration", "all", "frames in a row"].value < 450
    # one of three people of 100 points and more
    assert found["turned_round", "points", "100 and more"].value == pytest.approx(100 / 3)
    # 11 of 15 joints of the turned one are 5 cm off, as all of two others are: 41 of 60 within 10 cm
    assert found["calibration_error", "all", "all"].value == pytest.approx(100 * (0.75 - 41 / 60), abs=1e-3)
    spans = {group: {of: x.people for (f, g, of), x in found.items() if (f, g) == ("mpjpe", group)}
             for group in ("distance, m", "points", "hidden share")}  # fmt: skip
    assert spans["distance, m"] == {"0 to 10": 2, "10 to 20": 2}
    assert spans["points"] == {"50 to 100": 1, "200 to 400": 3}
    assert spans["hidden share"] == {"0 to 0.1": 3, "0.3 to 0.5": 1}


def test_charts_draw_what_the_lines_say(monkeypatch):
    judged, setting = four()
    result = Result(setting=setting, counts={}, skipped={}, notes=(), lines=tuple(metric_rows(judged, setting)))
    figures = []
    monkeypatch.setattr(charts, "_png", lambda canvas: figures.append(canvas.figure) or b"")
    charts.draw_errors(result)
    charts.draw_reliability(judged, result)
    by_group = dict(zip(("distance, m", "points", "hidden share", "joints"), figures[0].axes, strict=True))
    for group, axes in by_group.items():
        due = [line for line in result.lines if (line.figure, line.group) == ("mpjpe", group)]
        np.testing.assert_allclose([bar.get_height() for bar in axes.patches], [line.value for line in due])
        named = [label.get_text().split("\n")[0] for label in axes.get_xticklabels()]
        assert named == [line.of for line in due] and len(due) > 1
    assert by_group["distance, m"].patches[0].get_height() == pytest.approx(50)
    confidence, spread = figures[1].axes
    drawn = confidence.lines[1].get_xydata()
    np.testing.assert_allclose(drawn, [[0.75, 41 / 60]])
    np.testing.assert_allclose(spread.lines[1].get_xydata(), [[60, np.nanmean(judged.errors())]])
