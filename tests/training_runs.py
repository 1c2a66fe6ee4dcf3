"""Helpers for tests of training: short runs, killed runs, and errors of one line."""

from contextlib import contextmanager

import pytest

from lidarpose.errors import InputError
from lidarpose.eval import charts
from lidarpose.train import data_loader, loop, run_dir, setup

FEW = 16
# batches per chunk, half of the default
BATCHES = 4


@pytest.fixture(scope="module", autouse=True)
def few_to_validate_on():
    """Reduces validation, chunks and charts, so that a run of several chunks takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setup, "VALIDATION", FEW)
        for module in (data_loader, loop):
            patch.setattr(module, "BATCHES", BATCHES)
        for draw in ("draw_errors", "draw_worst"):
            patch.setattr(charts, draw, lambda *_: b"")
        yield


@contextmanager
def refused(message):
    """Expects an InputError with a matching message of one line."""
    with pytest.raises(InputError, match=message) as caught:
        yield
    assert "\n" not in str(caught.value)


class Killed(BaseException):
    """Stands for a kill signal: no code catches it."""


def train_until_killed(recipe, folder, name, call):
    """Trains, saving after every chunk, and raises Killed after `call` calls of the function `name`."""
    where = run_dir if hasattr(run_dir, name) else loop._Run
    original, calls = getattr(where, name), []

    def counted(*args, **kwargs):
        calls.append(name)
        if len(calls) > call:
            raise Killed
        return original(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(where, name, counted)
        patch.setattr(loop, "SAVE_EVERY", -1.0)
        with pytest.raises(Killed):
            loop.train(recipe, folder)
