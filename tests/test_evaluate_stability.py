"""The stability study: effect of perturbations on points, labels and boxes, and the resulting curves."""

import json
import zlib
from dataclasses import replace
from types import SimpleNamespace

import dataset_files as files
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from test_evaluate import Fake, standing
from test_metric_rows import PERSON

from lidarpose.data.prepare import prepare
from lidarpose.data.shards import open_dataset
from lidarpose.eval import robustness as module
from lidarpose.eval.charts import draw_stability
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.eval.predictions import stack
from lidarpose.eval.protocols import EvalSetup, eval_setup
from lidarpose.eval.robustness import PERTURBATIONS, end_errors, study, to_json
from lidarpose.eval.run import evaluate_dataset
from lidarpose.sample import Box, center_of
from lidarpose.skeleton import HUMAN15
from lidarpose.synth.generator import LEAST_POINTS
from lidarpose.synth.noise import noise_cluster, noise_clusters
from lidarpose.synth.shard_job import SynthesisJob, write_dataset

seeds = st.integers(0, 999)
often = settings(max_examples=40)


def cloud(seed, n):
    rng = np.random.default_rng(seed)
    distance, angle = rng.uniform(3, 30), rng.uniform(-np.pi, np.pi)
    middle = [distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-2, 1)]
    return rng.normal(0, [0.2, 0.2, 0.5], (n, 3)) + middle


def box_of(points):
    low, high = points.min(0), points.max(0)
    return Box(center=(low + high) / 2, size=high - low + 0.2)


def perturbed(name, points, amount, seed, box=None):
    return PERTURBATIONS[name].apply(points, box, amount, np.random.default_rng(seed))


def level_step(seed, length):
    """Horizontal step of `length` in the first direction that a generator of `seed` draws."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    return length * np.array([np.cos(angle), np.sin(angle), 0])


def rows(points):
    return {tuple(point) for point in points.tolist()}


@often
@given(name=st.sampled_from(sorted(PERTURBATIONS)), seed=seeds, n=st.integers(1, 300), boxed=st.booleans())
def test_perturbations_are_identity_at_zero_and_keep_input(name, seed, n, boxed):
    points = cloud(seed, n)
    before, box = points.copy(), box_of(points) if boxed else None
    np.testing.assert_allclose(perturbed(name, points, 0.0, seed, box), points)
    perturbed(name, points, PERTURBATIONS[name].amounts[-1], seed, box)
    np.testing.assert_array_equal(points, before)


@often
@given(name=st.sampled_from(["dropped", "occluder"]), seed=seeds, n=st.integers(1, 300))
def test_dropped_and_occluder_losses_are_nested(name, seed, n):
    points, amounts = cloud(seed, n), (0.0, *PERTURBATIONS[name].amounts)
    left = [rows(perturbed(name, points, amount, seed)) for amount in amounts]
    assert all(less <= more for more, less in zip(left[:-1], left[1:], strict=True))
    if name == "occluder":
        assert [n - len(some) for some in left] == [round(amount * n) for amount in amounts]


@often
@given(seed=seeds, amount=st.sampled_from([0.1, 0.4, 0.7]))
def test_occluder_edge_is_straight_seen_from_sensor(seed, amount):
    points = cloud(seed, 120)
    left = rows(perturbed("occluder", points, amount, seed))
    is_left = np.array([tuple(point) in left for point in points.tolist()])
    # a plane through the sensor separates the kept points from the hidden ones
    heading = np.arctan2(*points.mean(0)[[1, 0]])
    seen = np.stack([np.sin(heading) * -points[:, 0] + np.cos(heading) * points[:, 1], points[:, 2]], 1)
    seen /= (np.cos(heading) * points[:, 0] + np.sin(heading) * points[:, 1])[:, None]
    along = seen @ level_step(seed, 1)[:2]
    assert along[is_left].min() >= along[~is_left].max() - 1e-12


@often
@given(seed=seeds, clip=st.floats(0.001, 0.5))
def test_jitter_stays_within_clip(seed, clip):
    points = cloud(seed, 400)
    step = perturbed("jitter", points, clip, seed) - points
    assert np.abs(step).max() <= clip + 1e-9
    assert step.std() == pytest.approx(0.48 * clip, rel=0.15)


def test_dropped_removes_given_share():
    assert len(perturbed("dropped", cloud(0, 20_000), 0.75, 1)) == pytest.approx(5000, rel=0.05)


@often
@given(seed=seeds, count=st.integers(0, 200))
def test_clusters_adds_two_that_stay_in_place_as_they_grow(seed, count):
    points = cloud(seed, 150)
    more = perturbed("clusters", points, count, seed)
    np.testing.assert_array_equal(more[:150], points)
    assert len(more) == 150 + 2 * count
    for added in (more[150 : 150 + count], more[150 + count :]):
        assert (np.abs(added - center_of(points)) <= np.array([0.4, 0.4, 0.8]) + 0.3).all()
        # each cluster fits into a ball of radius 30 cm
        assert not count or np.ptp(added, axis=0).max() <= 0.6
    few, many = (perturbed("clusters", points, count, 5)[150:] for count in (40, 150))
    for first, second in ((few[:40], many[:150]), (few[40:], many[150:])):
        assert np.linalg.norm(first.mean(0) - second.mean(0)) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_noise_clusters_match_single_clusters(seed):
    rng, twin = np.random.default_rng(seed), np.random.default_rng(seed)
    counts = range(twin.integers(1, 3))
    slow = [noise_cluster(np.zeros(3), count=int(twin.integers(0, 61)), rng=twin) for _ in counts]
    np.testing.assert_array_equal(noise_clusters(np.zeros(3), most=60, rng=rng), np.concatenate(slow))


@often
@given(seed=seeds, amount=st.floats(0, 0.5))
def test_crop_drops_points_outside_displaced_box(seed, amount):
    points = cloud(seed, 200)
    box = box_of(points)
    inside = (np.abs(points - box.center - level_step(seed, amount)) <= box.size / 2).all(1)
    np.testing.assert_array_equal(perturbed("crop", points, amount, seed, box), points[inside])


# ---- the study


def people_of(error):
    """Predictions of human15 with errors (n, 15) in m along x; NaN: unlabeled."""
    people = []
    for k, own in enumerate(error):
        labels = np.where(np.isnan(own), 0, 2)
        true = np.where(labels[:, None], 0, np.full((15, 3), np.nan))
        pred = np.nan_to_num(own)[:, None] * [1, 0, 0]
        people.append(PERSON | {"row": k, "pred": pred, "true": true, "labels": labels})
    return stack(HUMAN15, people)


def test_end_errors_use_worst_people():
    error = np.full((10, 15), 0.01)
    error[:3] = 0.2
    error[0, HUMAN15.index("left_wrist")] = 0.6
    error[1, HUMAN15.index("right_wrist")] = np.nan
    ends = {end.group: end for end in end_errors(people_of(error))}
    assert set(ends) == {"head", "wrists", "ankles"}
    # the worst 30 % of ten people are the three with errors of 20 cm
    assert all(end.worst == 3 and end.people == 3 for end in ends.values())
    assert (ends["head"].mean, ends["head"].deviation) == pytest.approx((200, 0), abs=1e-3)
    assert ends["wrists"].mean == pytest.approx((600 + 4 * 200) / 5, abs=1e-3)
    assert ends["wrists"].quartiles == pytest.approx((200, 200, 200), abs=1e-3)
    # at most 600 people
    error = np.random.default_rng(0).uniform(0, 1, (2500, 1)) + np.zeros((2500, 15))
    head = next(end for end in end_errors(people_of(error)) if end.group == "head")
    assert head.worst == head.people == 600
    assert head.mean == pytest.approx(1e3 * np.sort(error[:, 0])[-600:].mean(), rel=1e-5)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth") / "people"
    write_dataset(SynthesisJob(what="people", count=12, hard=0.0, sensors=("os1-128",)), folder)
    return folder


@pytest.fixture(scope="module")
def humanm3(tmp_path_factory):
    root = tmp_path_factory.mktemp("real")
    files.write_humanm3(root / "raw", files.write_smpl(root / "smpl.npz"), sequences=("test/b",), frames=2)
    prepare("humanm3", root / "raw", root / "humanm3")
    return root / "humanm3"


def set_up(folder, answer=standing, **options):
    return eval_setup(Fake(answer), open_eval_dataset(folder), **options)


def studied(setup, **options):
    return study(setup, evaluate_dataset(setup).predictions, **options)


def test_evaluate_dataset_reports_plain_synthetic_people(synthetic):
    wanted = [
        row["upright"] and row["visible"] > 0.8 and row["clutter"] < 0.05 and len(row["points"]) >= 300
        for row in open_dataset(synthetic).rows()
    ]
    setup = set_up(synthetic)
    assert [person.plain for person in setup.dataset] == wanted and 0 < sum(wanted) < len(wanted)
    row = evaluate_dataset(setup).result.line("mpjpe", "plain", "upright, whole, uncluttered, 100 points")
    assert row.people == sum(wanted)


@pytest.mark.long
def test_study_curves_match_perturbations(synthetic, monkeypatch):
    monkeypatch.setattr(module, "CAST", 2)
    monkeypatch.setattr(module, "SENSORS", ("vlp-16", "os1-128"))
    # no pose for fewer than 60 points; other poses depend on the points
    setup = set_up(synthetic, lambda points: None if len(points) < 60 else standing(points))
    base = evaluate_dataset(setup).predictions
    done = []
    result = study(setup, base, progress=lambda count, total: done.append(count))
    curves = {curve.name: curve.points for curve in result.curves}
    assert list(curves) == [*PERTURBATIONS, "sensors"]
    assert "12 people of people" in result.who and not result.notes
    assert done[-1] == 12 * sum(len(own.amounts) for own in PERTURBATIONS.values()) + 4
    for name, perturbation in PERTURBATIONS.items():
        first, *others = curves[name]
        assert (first.amount, first.increase) == (0.0, 0.0) and first.mpjpe == pytest.approx(np.nanmean(base.errors()))
        assert [point.amount for point in others] == list(perturbation.amounts)
    assert curves["dropped"][-1].points < curves["dropped"][0].points * 0.1 and curves["dropped"][-1].no_pose > 0
    added = [point.points - curves["clusters"][0].points for point in curves["clusters"]]
    assert added == [0, 20, 50, 100, 200, 400]
    assert [point.label for point in curves["sensors"]] == ["vlp-16", "os1-128"]
    assert curves["sensors"][0].points < curves["sensors"][1].points
    # a repeated study gives the same numbers; results can be written and drawn
    assert study(setup, base) == result
    written = json.loads(to_json([result], head={"command": "x"}))
    assert written["schema"] == "lidarpose.stability/1" and len(written["studies"][0]["curves"]) == len(result.curves)
    assert draw_stability(result)[:4] == b"\x89PNG"


def test_tilt_rotates_points_labels_and_boxes(synthetic, monkeypatch):
    monkeypatch.setattr(module, "PERTURBATIONS", {"tilt": PERTURBATIONS["tilt"]})
    monkeypatch.setattr(module, "SENSORS", ())
    # errors of rotation-invariant predictions are the same in any frame; those that assume z up are not
    careless = studied(set_up(synthetic, lambda points: np.repeat(points.mean(0)[None], 26, 0))).curves[0].points
    assert [point.label for point in careless] == ["0", "5", "10", "15", "20", "30"]
    assert [point.mpjpe for point in careless] == pytest.approx([careless[0].mpjpe] * 6, abs=0.01)
    upright = set_up(synthetic)
    assert max(abs(point.increase) for point in studied(upright).curves[0].points) > 1
    person = module.people_to_perturb(upright)[0]
    turned, before = module._perturbed(upright, person, "tilt", np.radians(20)), person.shown
    u, _, vt = np.linalg.svd((turned.points - turned.points.mean(0)).T @ (before.points - before.points.mean(0)))
    R = u @ vt
    assert np.degrees(np.arccos((np.trace(R) - 1) / 2)) == pytest.approx(20, abs=0.1)
    np.testing.assert_allclose(turned.sample.joints, before.sample.joints @ R.T, atol=1e-3)
    for moved, still in ((turned.sample.box, before.sample.box), (turned.crop_box, before.crop_box)):
        np.testing.assert_allclose(moved.center, R @ still.center, atol=1e-3)


def test_study_without_poses_or_numba_can_be_drawn(synthetic, monkeypatch):
    def missing(*_):
        raise ModuleNotFoundError("numba", name="numba")

    monkeypatch.setattr(module, "_sensor_curve", missing)
    nobody = studied(set_up(synthetic, lambda points: None))
    assert '".[synth]"' in nobody.notes[0] and "sensors" not in [curve.name for curve in nobody.curves]
    assert all(point.mpjpe is None for curve in nobody.curves for point in curve.points) and not nobody.ends
    sensors = replace(nobody.curves[0], name="sensors")
    assert draw_stability(replace(nobody, curves=(*nobody.curves, sensors)))[:4] == b"\x89PNG"


def test_displaced_crop_includes_surrounding_points(humanm3):
    setup, gained = set_up(humanm3), 0
    for person in module.people_to_perturb(setup):
        whole, box = person.whole.points, person.shown.crop_box
        np.testing.assert_array_equal(person.shown.points, whole[box.contains(whole)])
        # a box smaller than the person
        small = replace(box, size=box.size * 0.6)
        shown = replace(person.shown, points=whole[small.contains(whole)], crop_box=small)
        perturbed = module._perturbed(setup, replace(person, shown=shown), "crop", 0.2)
        points = perturbed.points
        # the same random draws as in the perturbation
        step = level_step([0, zlib.crc32(b"crop"), shown.shard, shown.row], 0.2)
        inside = replace(small, center=small.center + step).contains(whole)
        # the network gets the displaced box
        np.testing.assert_allclose(perturbed.crop_box.center, small.center + step)
        assert rows(points) == rows(whole[inside].astype(float))
        gained += (inside & ~small.contains(whole)).sum()
    assert gained > 0


def test_frame_out_of_level_turns_surroundings_of_clips(humanm3):
    setup = set_up(humanm3)
    person = module.people_to_perturb(setup)[0]
    around = {name: person.shown.points[:20].astype(np.float32) for name in ("background", "neighbors")}
    shown = replace(person.shown, sample=replace(person.shown.sample, **around))
    name = next(name for name, one in PERTURBATIONS.items() if one.rigid)
    turned = module._perturbed(setup, replace(person, shown=shown), name, PERTURBATIONS[name].amounts[-1])
    for cloud in (turned.sample.background, turned.sample.neighbors):
        np.testing.assert_allclose(cloud, turned.points[:20], atol=1e-3)
    assert np.abs(turned.points[:20] - shown.points[:20]).max() > 0.05


@pytest.mark.parametrize("protocol", ["clean", "dapt"])
def test_crop_displaced_by_zero_is_unchanged(humanm3, protocol):
    """Also in the protocol dapt, which uses another box."""
    setup = set_up(humanm3, protocol=protocol)
    for person in module.people_to_perturb(setup):
        points = module._perturbed(setup, person, "crop", 0.0).points
        np.testing.assert_array_equal(points, person.shown.points.astype(float))


def test_curve_point_excludes_missing_poses_and_uses_seed():
    def point(base, errors, clusters=None, seed=0):
        errors = np.array(errors, float)[:, None]
        posed = ~np.isnan(errors[:, 0])
        answers = SimpleNamespace(errors=lambda: errors, posed=posed, points=[5, 6, 7], sequence=clusters)
        setting = SimpleNamespace(seed=seed, clusters=clusters is not None)
        return module._point(answers, np.array(base)[:, None], 1.0, "1", setting)

    found = point([100.0, 200.0, 300.0], [110.0, np.nan, 330.0])
    assert (found.mpjpe, found.increase, found.no_pose, found.people, found.points) == (220.0, 20.0, 1, 3, 6.0)
    # people without a pose on the unperturbed points are counted, too
    assert point([100.0, np.nan, 300.0], [110.0, np.nan, np.nan]).no_pose == 2
    assert point([100.0, np.nan, 300.0], [100.0, np.nan, 300.0]).no_pose == 1
    alone = point([100.0, 200.0, 300.0], [110.0, np.nan, 330.0], np.array(["a", "a", "a"]))
    assert alone.low is None and alone.increase_high is None
    errors = np.random.default_rng(0).uniform(0, 1, 50)
    first, again, other = (point(errors, errors, seed=seed) for seed in (0, 0, 1))
    assert first == again and first.mpjpe == other.mpjpe and first.low != other.low


def test_sensor_curve_casts_same_people_at_same_places(synthetic, monkeypatch):
    """Sensors with few beams keep the distance; people with too few points have no pose and are counted."""
    monkeypatch.setattr(module, "CAST", 12)
    monkeypatch.setattr(module, "SENSORS", ("vlp-16", "livox-mid360", "os1-128"))
    asked, predict = [], EvalSetup.predict
    monkeypatch.setattr(EvalSetup, "predict", lambda self, people: asked.append(people) or predict(self, people))
    curve = module._sensor_curve(set_up(synthetic), lambda count: None)
    for people in asked[1:]:
        for person, first in zip(people, asked[0], strict=True):
            assert person.sample.distance == pytest.approx(first.sample.distance, abs=1.0)
            np.testing.assert_allclose(person.sample.joints[:, :2], first.sample.joints[:, :2], atol=1e-3)
    # the protocol clean passes the boxes' centers
    assert all(person.crop_box is person.sample.box is not None for people in asked for person in people)
    assert min(len(person.points) for person in asked[1]) < LEAST_POINTS
    assert [point.people for point in curve.points] == [12, 12, 12]


def test_sensor_curve_respects_limit(synthetic, monkeypatch):
    monkeypatch.setattr(module, "SENSORS", ("os1-128",))
    setup = set_up(synthetic)
    curve = module._sensor_curve(replace(setup, setting=replace(setup.setting, limit=3)), lambda count: None)
    assert [point.people for point in curve.points] == [3] and curve.says.startswith("3 people")
