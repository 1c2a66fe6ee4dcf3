"""The tables of the docs: they say what the scores say, and differences come with intervals that are right."""

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def results():
    # what it imports lies beside it
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("results")


def run(variant, seed, value, people=100, **more):
    figures = {name: {"value": value} for name in ("all", "plain", "clean", "cluttered", "occluded", "turned round")}
    return {"variant": variant, "seed": seed, "people": people, "what": variant, "figures": figures} | more


def test_the_pages_say_what_the_scores_say(results):
    for path in results.PAGES:
        page = path.read_text()
        assert results.written(page) == page, f"{path.name}: run python benchmarks/results.py"
        assert "<!-- table" in page


def test_every_bundled_model_has_a_card(results):
    for name in results.BUNDLED:
        card = (BENCHMARKS.parent / "docs" / "cards" / f"{name}.md").read_text()
        for table in (f"{name} card", f"{name} by sensor", f"{name} by distance, m", f"{name} by all+condition"):
            assert f"<!-- table {table} -->" in card, table


def test_differences_are_taken_seed_by_seed(results):
    own = results.Runs([run("base", 1, 10.0), run("base", 2, 20.0), run("x", 1, 11.0), run("x", 2, 22.0)], 100)
    assert own.differences("x").tolist() == [1.0, 2.0]
    # one seed alone is compared with that seed alone
    own = results.Runs([run("base", 1, 10.0), run("base", 2, 20.0), run("x", 2, 19.0)], 100)
    assert own.differences("x").tolist() == [-1.0]
    assert np.isnan(own.deviation) and own.told("x") == "-1.0"


def test_intervals_hold_the_truth_as_often_as_they_say(results):
    """Student's intervals with a deviation pooled over variants: 95 % of them hold a difference of 3 mm."""
    rng = np.random.default_rng(0)
    held = []
    for _ in range(400):
        runs = [run("base", seed, 100.0) for seed in (1, 2)]
        names = [f"v{k}" for k in range(6)]
        runs += [run(name, seed, 103.0 + rng.normal()) for name in names for seed in (1, 2)]
        own = results.Runs(runs, 100)
        assert own.freedom == 6
        held += [abs(own.differences(name).mean() - 3.0) <= own.reach(2) for name in names]
    assert 0.93 < np.mean(held) < 0.97


def test_what_noise_hides_is_called_so(results):
    runs = [run("base", seed, 100.0) for seed in (1, 2)]
    runs += [run("large", 1, 150.0), run("large", 2, 151.0), run("small", 1, 100.5), run("small", 2, 99.6)]
    own = results.Runs(runs, 100)
    assert "unresolved" not in own.told("large") and own.told("large").startswith("+50.5 ± ")
    assert own.told("small").endswith("unresolved")


def test_a_doubling_of_people(results):
    table = results.scaling([run("base", 1, 200.0), run("base", 1, 180.0, 200), run("base", 1, 150.0, 800)])
    assert [row.split("|")[3].strip() for row in table.splitlines()[2:]] == ["", "-20.0", "-15.0"]
