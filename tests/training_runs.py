"""What tests of training share: short runs, runs that are killed, and refusals in one line."""

from contextlib import contextmanager

import pytest

from lidarpose.errors import InputError
from lidarpose.eval import charts
from lidarpose.train import data_loader, loop, run_dir, setup

FEW = 16
# batches a chunk, half of what they are
BATCHES = 4


@pytest.fixture(scope="module", autouse=True)
def few_to_validate_on():
    """So that a run of several chunks takes a second, and is not all validation, nor its evaluation all pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setup, "VALIDATION", FEW)
        for module in (data_loader, loop):
            patch.setattr(module, "BATCHES", BATCHES)
        for draw in ("draw_errors", "draw_worst"):
            patch.setattr(charts, draw, lambda *_: b"")
        yield


@contextmanager
def refused(message):
    """An InputError that matches, in one line."""
    with pytest.raises(InputError, match=message) as caught:
        yield
    assert "\n" not in str(caught.value)


class Killed(BaseException):
    """As a signal would: nothing catches it."""


def train_until_killed(recipe, folder, name, call):
    """Lets the named function of the loop be called `call` times, then kills the run; saves after every chunk."""
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
