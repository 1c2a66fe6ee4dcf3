"""The stability study: what a disturbance does to points, and that curves say what was done."""

import json
import zlib
from dataclasses import replace
from types import SimpleNamespace

import dataset_files as files
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_evaluate import Fake, standing

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
from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.generator import LEAST_POINTS
from lidarpose.synth.noise import noise_cluster, noise_clusters
from lidarpose.synth.shard_job import Job, write_dataset


def cloud(seed, n):
    rng = np.random.default_rng(seed)
    away = rng.uniform(3, 30)
    turn = rng.uniform(-np.pi, np.pi)
    return rng.normal(0, [0.2, 0.2, 0.5], (n, 3)) + [away * np.cos(turn), away * np.sin(turn), rng.uniform(-2, 1)]


def box_of(points):
    low, high = points.min(0), points.max(0)
    return Box(center=(low + high) / 2, size=high - low + 0.2)


def disturbed(name, points, amount, seed, box=None):
    return PERTURBATIONS[name].apply(points, box, amount, np.random.default_rng(seed))


def rows(points):
    return {tuple(point) for point in points.tolist()}


@settings(max_examples=40)
@given(name=st.sampled_from(sorted(PERTURBATIONS)), seed=st.integers(0, 99), n=st.integers(1, 300), boxed=st.booleans())
def test_nothing_changes_at_0_and_nothing_given_is_changed(name, seed, n, boxed):
    points = cloud(seed, n)
    before = points.copy()
    box = box_of(points) if boxed else None
    np.testing.assert_allclose(disturbed(name, points, 0.0, seed, box), points)
    disturbed(name, points, PERTURBATIONS[name].amounts[-1], seed, box)
    np.testing.assert_array_equal(points, before)


@settings(max_examples=40)
@given(name=st.sampled_from(["dropped", "occluder"]), seed=st.integers(0, 99), n=st.integers(1, 300))
def test_what_is_lost_at_one_share_is_lost_at_each_larger_one(name, seed, n):
    points = cloud(seed, n)
    kept = [rows(disturbed(name, points, amount, seed)) for amount in (0.0, *PERTURBATIONS[name].amounts)]
    for more, less in zip(kept[:-1], kept[1:], strict=True):
        assert less <= more
    if name == "occluder":
        assert [n - len(one) for one in kept] == [round(a * n) for a in (0.0, *PERTURBATIONS[name].amounts)]


def test_dropped_are_as_many_as_said():
    assert len(disturbed("dropped", cloud(0, 20_000), 0.75, 1)) == pytest.approx(5000, rel=0.05)


@settings(max_examples=40)
@given(seed=st.integers(0, 999), amount=st.sampled_from([0.1, 0.4, 0.7]))
def test_an_occluder_s_edge_is_straight_as_the_sensor_sees_it(seed, amount):
    points = cloud(seed, 120)
    kept = rows(disturbed("occluder", points, amount, seed))
    is_kept = np.array([tuple(point) in kept for point in points.tolist()])
    # a plane through the sensor parts the two: the edge and the sensor span it
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    middle = points.mean(0)
    heading = np.arctan2(middle[1], middle[0])
    seen = np.stack([np.sin(heading) * -points[:, 0] + np.cos(heading) * points[:, 1], points[:, 2]], 1)
    seen /= (np.cos(heading) * points[:, 0] + np.sin(heading) * points[:, 1])[:, None]
    along = seen @ [np.cos(turn), np.sin(turn)]
    assert along[is_kept].min() >= along[~is_kept].max() - 1e-12


@settings(max_examples=40)
@given(seed=st.integers(0, 99), clip=st.floats(0.001, 0.5))
def test_jitter_stays_within_its_clip(seed, clip):
    points = cloud(seed, 400)
    step = disturbed("jitter", points, clip, seed) - points
    assert np.abs(step).max() <= clip + 1e-9
    assert step.std() == pytest.approx(0.48 * clip, rel=0.15)


@settings(max_examples=40)
@given(seed=st.integers(0, 99), count=st.integers(0, 200))
def test_two_clusters_of_so_many_points_are_added(seed, count):
    points = cloud(seed, 150)
    found = disturbed("clusters", points, count, seed)
    np.testing.assert_array_equal(found[:150], points)
    assert len(found) == 150 + 2 * count
    center = center_of(points)
    for added in (found[150 : 150 + count], found[150 + count :]):
        assert (np.abs(added - center) <= np.array([0.4, 0.4, 0.8]) + 0.3).all()
        # a ball of 30 cm holds them
        assert not count or np.ptp(added, axis=0).max() <= 0.6


def test_clusters_stay_where_they_are_while_they_grow():
    points = cloud(3, 50)
    few, many = (disturbed("clusters", points, count, 5)[50:] for count in (40, 150))
    for first, second in ((few[:40], many[:150]), (few[40:], many[150:])):
        assert np.linalg.norm(first.mean(0) - second.mean(0)) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_cluster_alone_is_one_of_those_of_training(seed):
    # the draws of noise_clusters are as they were before clusters could be had alone
    rng, twin = np.random.default_rng(seed), np.random.default_rng(seed)
    found = noise_clusters(np.zeros(3), most=60, rng=rng)
    slow = []
    for _ in range(twin.integers(1, 3)):
        slow.append(noise_cluster(np.zeros(3), count=int(twin.integers(0, 61)), rng=twin))
    np.testing.assert_array_equal(found, np.concatenate(slow))


@settings(max_examples=40)
@given(seed=st.integers(0, 99), amount=st.floats(0, 0.5))
def test_a_displaced_box_loses_one_side(seed, amount):
    points = cloud(seed, 200)
    box = box_of(points)
    kept = disturbed("crop", points, amount, seed, box)
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    shift = amount * np.array([np.cos(turn), np.sin(turn), 0])
    inside = (np.abs(points - box.center - shift) <= box.size / 2).all(1)
    np.testing.assert_array_equal(kept, points[inside])


# ---- the study


def people_of(error):
    """Judged people, human15, of errors (n, 15) m along x; NaN has no label."""
    n = len(error)
    nothing = np.full(15, np.nan)
    told = {"sequence": "s", "frame": 0, "track": "0", "time": 0.0, "sensor": "", "condition": "", "poses": ""}
    told |= {"plain": False, "moving": False, "points": 100, "distance": 5.0, "hidden": np.nan, "shard": 0}
    told |= {"box": np.full(7, np.nan), "confidence": nothing, "spread": nothing, "visible": nothing}
    out = []
    for k in range(n):
        pred = np.zeros((15, 3))
        pred[:, 0] = np.nan_to_num(error[k])
        true = np.where(np.isnan(error[k])[:, None], np.nan, np.zeros((15, 3)))
        out.append(told | {"row": k, "pred": pred, "true": true, "labels": np.where(np.isnan(error[k]), 0, 2)})
    return stack(HUMAN15, out)


def test_end_joints_are_of_the_worst_people():
    error = np.full((10, 15), 0.01)
    error[:3] = 0.2
    error[0, HUMAN15.index("left_wrist")] = 0.6
    error[1, HUMAN15.index("right_wrist")] = np.nan
    found = {end.group: end for end in end_errors(people_of(error))}
    assert set(found) == {"head", "wrists", "ankles"}
    # 30 % of ten people are the three with 20 cm
    assert all(end.worst == 3 and end.people == 3 for end in found.values())
    assert found["head"].mean == pytest.approx(200, abs=1e-3) and found["head"].deviation == pytest.approx(0, abs=1e-3)
    assert found["wrists"].mean == pytest.approx((600 + 4 * 200) / 5, abs=1e-3)
    assert found["wrists"].quartiles == pytest.approx((200, 200, 200), abs=1e-3)


def test_at_most_600_are_the_worst():
    rng = np.random.default_rng(0)
    error = rng.uniform(0, 1, (2500, 1)) + np.zeros((2500, 15))
    head = next(end for end in end_errors(people_of(error)) if end.group == "head")
    assert head.worst == head.people == 600
    assert head.mean == pytest.approx(1e3 * np.sort(error[:, 0])[-600:].mean(), rel=1e-5)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth") / "people"
    write_dataset(Job(what="people", count=12, hard=0.0, sensors=("os1-128",)), folder)
    return folder


def test_plain_people_of_a_synthesized_folder_have_a_line(synthetic):
    wanted = [
        row["upright"] and row["visible"] > 0.8 and row["clutter"] < 0.05 and len(row["points"]) >= 300
        for row in open_dataset(synthetic).rows()
    ]
    people = open_eval_dataset(synthetic)
    assert [one.plain for one in people] == wanted and 0 < sum(wanted) < len(wanted)
    judged = evaluate_dataset(eval_setup(Fake(standing), people))
    assert judged.result.line("mpjpe", "plain", "upright, whole, uncluttered, 100 points").people == sum(wanted)


def test_curves_say_what_was_done(synthetic, monkeypatch):
    monkeypatch.setattr(module, "CAST", 2)
    monkeypatch.setattr(module, "SENSORS", ("vlp-16", "os1-128"))

    def shy(points):
        # no answer for thinned people, and one that notices noise
        return None if len(points) < 60 else standing(points)

    model = Fake(shy)
    task = eval_setup(model, open_eval_dataset(synthetic))
    base = evaluate_dataset(task).predictions
    done = []
    found = study(task, base, progress=done.append)
    assert [curve.name for curve in found.curves] == [*PERTURBATIONS, "sensors"]
    assert "12 people of people" in found.who and not found.notes
    assert sum(done) == 12 * sum(len(one.amounts) for one in PERTURBATIONS.values()) + 4
    for curve in found.curves[:-1]:
        first = curve.points[0]
        assert (first.amount, first.increase) == (0.0, 0.0) and first.mpjpe == pytest.approx(np.nanmean(base.errors()))
        assert [point.amount for point in curve.points[1:]] == list(PERTURBATIONS[curve.name].amounts)
    dropped = next(curve for curve in found.curves if curve.name == "dropped").points
    assert dropped[-1].points < dropped[0].points * 0.1 and dropped[-1].no_pose > 0
    clusters = next(curve for curve in found.curves if curve.name == "clusters").points
    assert [point.points - clusters[0].points for point in clusters] == [0, 20, 50, 100, 200, 400]
    assert [point.label for point in found.curves[-1].points] == ["vlp-16", "os1-128"]
    assert found.curves[-1].points[0].points < found.curves[-1].points[1].points
    # the same numbers whoever asks again, and they can be written and drawn
    assert study(task, base) == found
    written = json.loads(to_json([found], head={"command": "x"}))
    assert written["schema"] == "lidarpose.stability/1" and len(written["studies"][0]["curves"]) == len(found.curves)
    assert draw_stability(found)[:4] == b"\x89PNG"


def test_a_frame_out_of_level_moves_points_and_labels_alike(synthetic, monkeypatch):
    monkeypatch.setattr(module, "PERTURBATIONS", {"tilt": PERTURBATIONS["tilt"]})
    # who knows no up errs as much in any frame; who takes z for up does not
    careless = eval_setup(Fake(lambda points: np.repeat(points.mean(0)[None], 26, 0)), open_eval_dataset(synthetic))
    (curve,) = study(careless, evaluate_dataset(careless).predictions, sensors=False).curves
    assert [point.label for point in curve.points] == ["0", "5", "10", "15", "20", "30"]
    assert [point.mpjpe for point in curve.points] == pytest.approx([curve.points[0].mpjpe] * 6, abs=0.01)
    upright = eval_setup(Fake(standing), open_eval_dataset(synthetic))
    (curve,) = study(upright, evaluate_dataset(upright).predictions, sensors=False).curves
    assert max(abs(point.increase) for point in curve.points) > 1
    shown = module.people_to_perturb(upright)[0]
    turned, before = module._perturbed(upright, shown, "tilt", np.radians(20)), shown.shown
    u, _, vt = np.linalg.svd((turned.points - turned.points.mean(0)).T @ (before.points - before.points.mean(0)))
    R = u @ vt
    assert np.degrees(np.arccos((np.trace(R) - 1) / 2)) == pytest.approx(20, abs=0.1)
    np.testing.assert_allclose(turned.sample.joints, before.sample.joints @ R.T, atol=1e-3)
    np.testing.assert_allclose(turned.sample.box.center, R @ before.sample.box.center, atol=1e-3)


def setup_of_seed(seed):
    return SimpleNamespace(setting=SimpleNamespace(seed=seed))


def test_intervals_are_of_the_seed_and_nobody_posed_is_drawn(synthetic):
    error = np.random.default_rng(0).uniform(0, 1, (50, 1)) + np.zeros((50, 15))
    args = people_of(error), 1e3 * error, 0.0, "0"
    first, again, other = (module._point(*args, setup_of_seed(seed)) for seed in (0, 0, 1))
    assert first == again and first.mpjpe == other.mpjpe and first.low != other.low
    nobody = eval_setup(Fake(lambda points: None), open_eval_dataset(synthetic))
    found = study(nobody, evaluate_dataset(nobody).predictions, sensors=False)
    assert all(point.mpjpe is None for curve in found.curves for point in curve.points) and not found.ends
    sensors = replace(found.curves[0], name="sensors")
    assert draw_stability(replace(found, curves=(*found.curves, sensors)))[:4] == b"\x89PNG"


def test_a_displaced_box_lets_in_what_lies_around(tmp_path):
    files.write_humanm3(tmp_path / "raw", files.write_smpl(tmp_path / "smpl.npz"), sequences=("test/b",), frames=2)
    prepare("humanm3", tmp_path / "raw", tmp_path / "humanm3")
    task = eval_setup(Fake(standing), open_eval_dataset(tmp_path / "humanm3"))
    gained = 0
    for shown in module.people_to_perturb(task):
        np.testing.assert_array_equal(shown.shown.points, shown.whole.points[shown.box.contains(shown.whole.points)])
        # a box so small that the person reaches beyond it
        small = replace(shown.box, size=shown.box.size * 0.6)
        person = replace(shown.shown, points=shown.whole.points[small.contains(shown.whole.points)])
        shown = replace(shown, box=small, shown=person)
        found = rows(module._perturbed(task, shown, "crop", 0.2).points)
        # the same draws as of the disturbance
        seed = [0, zlib.crc32(b"crop"), person.shard, person.row]
        turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        moved = replace(shown.box, center=shown.box.center + 0.2 * np.array([np.cos(turn), np.sin(turn), 0]))
        inside = moved.contains(shown.whole.points)
        assert found == rows(shown.whole.points[inside].astype(float))
        gained += (inside & ~small.contains(shown.whole.points)).sum()
    assert gained > 0


def test_without_the_extra_other_sensor_curve_are_left_out(synthetic, monkeypatch):
    def missing(*_):
        raise ModuleNotFoundError("numba", name="numba")

    monkeypatch.setattr(module, "_sensor_curve", missing)
    monkeypatch.setattr(module, "PERTURBATIONS", {})
    task = eval_setup(Fake(standing), open_eval_dataset(synthetic))
    found = study(task, evaluate_dataset(task).predictions)
    assert not found.curves and "'.[synth]'" in found.notes[0]


def test_no_pose_stays_out_of_the_increase():
    base, setup = np.array([[100.0], [200.0], [300.0]]), setup_of_seed(0)

    def answers(*errors):
        errors = np.array(errors)[:, None]
        return SimpleNamespace(errors=lambda: errors, posed=~np.isnan(errors[:, 0]), points=[5, 6, 7])

    found = answers(110.0, np.nan, 330.0)
    point = module._point(found, base, 1.0, "1", setup)
    assert (point.mpjpe, point.increase, point.no_pose, point.people, point.points) == (220.0, 20.0, 1, 3, 6.0)
    # whoever had none undisturbed has none here either
    base = np.array([[100.0], [np.nan], [300.0]])
    assert module._point(answers(110.0, np.nan, np.nan), base, 1.0, "1", setup).no_pose == 2
    assert module._point(answers(100.0, np.nan, 300.0), base, 0.0, "0", setup).no_pose == 1
    alone = module._point(found, base, 1.0, "1", setup, np.array(["a", "a", "a"]))
    assert alone.low is None and alone.increase_high is None


def test_the_fake_answers_as_a_predictor_does(synthetic):
    model = Fake(standing)
    assert model.skeleton is BODY26 and isinstance(model.backend, SimpleNamespace)
    found = evaluate_dataset(replace(eval_setup(model, open_eval_dataset(synthetic)), sensor_unknown=True))
    assert model.origins == [None] * 12 and len(found.judged) == 12


def test_other_sensors_see_the_same_people_at_the_same_places(synthetic, monkeypatch):
    """Few beams do not bring them nearer: who is hardly seen then has no pose, and is counted."""
    monkeypatch.setattr(module, "CAST", 12)
    monkeypatch.setattr(module, "SENSORS", ("vlp-16", "livox-mid360", "os1-128"))
    asked = []

    def answered(self, people):
        asked.append(people)
        return real(self, people)

    real = EvalSetup.predict
    monkeypatch.setattr(EvalSetup, "predict", answered)
    curve = module._sensor_curve(eval_setup(Fake(standing), open_eval_dataset(synthetic)), lambda count: None)
    for people in asked[1:]:
        for one, first in zip(people, asked[0], strict=True):
            assert one.sample.distance == pytest.approx(first.sample.distance, abs=1.0)
            np.testing.assert_allclose(one.sample.joints[:, :2], first.sample.joints[:, :2], atol=1e-3)
    assert min(len(one.points) for one in asked[1]) < LEAST_POINTS
    assert [point.people for point in curve.points] == [12, 12, 12]


def test_a_crop_moved_by_nothing_is_the_crop(tmp_path):
    """In the protocol dapt too, whose box is another one."""
    files.write_humanm3(tmp_path / "raw", files.write_smpl(tmp_path / "smpl.npz"), sequences=("test/b",), frames=2)
    prepare("humanm3", tmp_path / "raw", tmp_path / "humanm3")
    for protocol in ("clean", "dapt"):
        task = eval_setup(Fake(standing), open_eval_dataset(tmp_path / "humanm3"), protocol=protocol)
        for shown in module.people_to_perturb(task):
            found = module._perturbed(task, shown, "crop", 0.0).points
            np.testing.assert_array_equal(found, shown.shown.points.astype(float))
