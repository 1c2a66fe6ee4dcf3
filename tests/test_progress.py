"""Progress of long tasks: a bar on a terminal, lines elsewhere, nothing if quiet."""

import re
import sys
import time

import pytest

from lidarpose import progress
from lidarpose.progress import Progress


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(progress, "LINE_EVERY", 0.02)
    monkeypatch.setattr(progress, "BAR_EVERY", 0.02)
    # commands of other tests may have set it
    monkeypatch.setattr(progress, "_quiet", False)


def test_progress_prints_lines_without_terminal(quick, capsys):
    with Progress(1200, unit="people", label="bench") as shown:
        # the first 1000 were done before this run and do not count for the speed
        time.sleep(0.4)
        shown.update(1000)
        time.sleep(0.1)
        shown.update(1100, "loss 1.5")
        time.sleep(0.2)
        # nor does the time before the first update, in which code is compiled
        assert 100 / 0.5 < float(re.search(r"([\d.,]+)/s", shown.line())[1].replace(",", ""))
    lines = capsys.readouterr().err.splitlines()
    # lines are not repeated
    assert len(lines) == len(set(lines)) >= 2
    pattern = r"lidarpose: bench: 1,100 of 1,200 people, [\d,.]+/s, 0:00:\d\d left, loss 1\.5"
    assert re.fullmatch(pattern, lines[-1])


def test_progress_redraws_bar_without_updates(quick, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Progress(10, unit="parts") as shown:
        shown.update(3)
        time.sleep(0.2)
        drawn = capsys.readouterr().err.count("\r")
    assert drawn >= 4


@pytest.mark.parametrize("quiet, shown", [(True, True), (False, False)])
def test_progress_prints_nothing_if_quiet_or_not_shown(quick, capsys, monkeypatch, quiet, shown):
    monkeypatch.setattr(progress, "_quiet", quiet)
    with Progress(10, unit="parts", shown=shown) as bar:
        bar.update(3)
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
    assert bar.line().startswith("3 of 10 parts")


def test_progress_thread_ends_after_error(quick):
    with pytest.raises(ValueError), Progress(None, unit="parts") as bar:
        raise ValueError
    bar._thread.join(1)
    assert not bar._thread.is_alive()
