"""Evaluation: inputs of each protocol, scores, damaged data, and files."""

import itertools
import json
import os
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import dataset_files as files
import numpy as np
import pandas as pd
import pytest
import waymo_files
from hypothesis import given, strategies as st
from pyarrow import parquet
from scipy.spatial import cKDTree
from shard_files import write_shard

import lidarpose
from lidarpose import evaluation, metrics
from lidarpose.cli import evaluating, main
from lidarpose.data.prepare import prepare
from lidarpose.data.shards import open_dataset, read_rows, shard_path
from lidarpose.errors import InputError
from lidarpose.eval import robustness, run as run_module
from lidarpose.eval.dataset import evenly_drawn, load_bench, open_eval_dataset
from lidarpose.eval.metric_rows import facing_flipped, metric_rows, triples
from lidarpose.eval.metrics import aggregate
from lidarpose.eval.predictions import num_nearby
from lidarpose.eval.protocols import check_protocol, crop_of, eval_setup, jittered
from lidarpose.eval.run import evaluate_dataset
from lidarpose.geometry import rotation_about
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.models import DEFAULT
from lidarpose.sample import Box, Pose, center_of
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14, Skeleton
from lidarpose.synth.shard_job import SynthesisJob, write_dataset


class Fake:
    """A model with given answers that records its inputs. answer(cloud) -> (J, 3) m or None."""

    def __init__(self, answer, skeleton=BODY26, card=None):
        self.answer, self.skeleton = answer, skeleton
        self.model = {"name": "fake", "version": "0", "backend": "none", "decode": "none"}
        self.backend, self.header = SimpleNamespace(batch=3), SimpleNamespace(card=card or {})
        self.clouds, self.origins, self.centers = [], [], []

    def predict(self, points, *, sensor_origin=None, skeleton=None, progress=False):
        assert skeleton == self.skeleton.name
        people = []
        for cloud in points:
            self.clouds.append(np.array(cloud, float))
            self.origins.append(sensor_origin)
            joints = self.answer(np.array(cloud, float))
            pose = None if joints is None else Pose(joints=joints, skeleton=self.skeleton)
            people.append(PersonPose(pose=pose, skeleton=self.skeleton, points=np.array(cloud)))
        return Poses(people=tuple(people), skeleton=self.skeleton)

    def outputs(self, clouds, centers, origin):
        assert len(clouds) <= self.backend.batch
        self.clouds += clouds
        self.centers += list(centers)
        self.origins += [origin] * len(clouds)
        joints = np.stack([self.answer(cloud) - center for cloud, center in zip(clouds, centers, strict=True)])
        return Pose(joints=joints, skeleton=self.skeleton)


def standing(cloud):
    """A pose that depends only on the points."""
    return center_of(cloud) + np.random.default_rng(0).normal(0, 0.3, (26, 3))


def shifted_truth(people, shift=(0.0, 0.0, 0.0)):
    """A model that identifies people by the median of their points and returns the true joints of human15, shifted."""
    middles = np.stack([np.median(person.points, axis=0) for person in people])
    pick = [HUMAN15.index(name) if name in HUMAN15.joints else 0 for name in BODY26.joints]

    def answer(cloud):
        person = people[int(np.argmin(np.linalg.norm(middles - np.median(cloud, axis=0), axis=1)))]
        return (np.nan_to_num(person.sample.joints) + shift)[pick]

    return Fake(answer)


class Own:
    """A user's model with only the required attributes."""

    skeleton = "smpl24"

    def __init__(self, answers):
        self.answers = answers

    def predict(self, clouds, *, sensor_origin, skeleton):
        return self.answers(clouds)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Prepared folders by name."""
    root = tmp_path_factory.mktemp("sets")
    smpl = files.write_smpl(root / "SMPL_NEUTRAL.npz")
    files.write_humanm3(root / "a", smpl, sequences=("train/a", "test/b", "test/c"), frames=4)
    prepare("humanm3", root / "a", root / "humanm3")
    files.write_sloper4d(root / "b", smpl, frames=5)
    prepare("sloper4d", root / "b", root / "sloper4d", smpl=smpl)
    prepare("sloper4d", root / "b", root / "leaking", smpl=smpl, split_by="dapt")
    files.write_lidarhuman26m(root / "c", smpl, frames=3)
    prepare("lidarhuman26m", root / "c", root / "lidarhuman26m", smpl=smpl)
    prepare("lidarhuman26m", root / "c", root / "askew", smpl=smpl, level=False)
    waymo_files.write_v2(root / "d", split="validation")
    prepare("waymo", root / "d", root / "waymo")
    return root


def evaluated(sets, name, model=None, *, split=None, limit=None, **options):
    dataset = open_eval_dataset(sets / name, split=split, limit=limit)
    return evaluate_dataset(eval_setup(model or Fake(standing), dataset, **options))


def test_undecodable_folder_name_is_escaped(sets, tmp_path):
    folder = shutil.copytree(sets / "lidarhuman26m", tmp_path / os.fsdecode(b"\xff"))
    assert open_eval_dataset(folder).name == "\\udcff"


@pytest.mark.parametrize(
    "settings, protocol",
    [
        ({"split_by": "a\nb\ud800"}, "dapt"),
        ({"dataset": "a\nb\ud800"}, "dapt"),
        ({"dataset": "a\nb\ud800", "split_by": "dapt"}, "clean"),
    ],
)
def test_check_protocol_reports_edited_settings_in_one_line(sets, settings, protocol):
    dataset = open_eval_dataset(sets / "lidarhuman26m")
    edited = replace(dataset, settings=dataset.settings | settings, kind=settings.get("dataset", dataset.kind))
    with pytest.raises(InputError, match=r"a b\\ud800") as raised:
        check_protocol(protocol, edited)
    assert "\n" not in str(raised.value)


# ---- inputs of the network


def test_clean_protocol_crops_by_jittered_box(sets):
    model = Fake(standing)
    setting = evaluated(sets, "humanm3", model, seed=3).result.setting
    people = list(open_eval_dataset(sets / "humanm3"))
    assert len(model.clouds) == len(people) == 16
    for cloud, person in zip(model.clouds, people, strict=True):
        box = jittered(person.sample.box, np.random.default_rng([3, person.shard, person.row]))
        np.testing.assert_array_equal(cloud, person.points[box.contains(person.points)])
    # some points are lost, some are added, and the sensor's position is unknown
    undisplaced = [person.sample.box.contains(person.points).sum() for person in people]
    assert [len(cloud) for cloud in model.clouds] != undisplaced
    assert model.origins == [None] * 16 and setting.sensor == "unknown" and "detector" in setting.crop
    assert (setting.protocol, setting.centring, setting.split) == ("clean", "points alone", "test")


class Asked(Fake):
    def predict_in(self, points, origin, skeleton=None, progress=False, *, box_centers, **options):
        self.centers += [] if box_centers is None else list(box_centers)
        return self.predict(points, sensor_origin=origin, skeleton=skeleton)


@pytest.mark.parametrize("name", ["humanm3", "waymo"])
def test_clean_protocol_gives_center_of_jittered_box(sets, name):
    """Networks choose between two people by it; the center of the labeled box would reveal the true joints."""
    model = Asked(standing)
    evaluated(sets, name, model, seed=3)
    people = [person for person in open_eval_dataset(sets / name) if person.sample.box is not None]
    assert len(model.centers) == len(people) > 1
    for center, person in zip(model.centers, people, strict=True):
        box = jittered(person.sample.box, np.random.default_rng([3, person.shard, person.row]))
        np.testing.assert_array_equal(center, box.center)


def test_clean_protocol_mixes_people_with_and_without_box(sets):
    setup = eval_setup(Asked(standing), open_eval_dataset(sets / "humanm3"), protocol="clean")
    people = [setup.crop_sample(person)[0] for person in open_eval_dataset(sets / "humanm3")]
    boxless = [replace(person, crop_box=None) if k % 2 else person for k, person in enumerate(people)]
    poses = setup.predict(boxless).pred
    np.testing.assert_array_equal(setup.model.centers, [person.crop_box.center for person in people[::2]])
    np.testing.assert_array_equal(poses, setup.predict(people).pred)


def test_clean_protocol_uses_no_label_of_segmented_people(sets):
    model = Fake(standing)
    setting = evaluated(sets, "lidarhuman26m", model).result.setting
    people = list(open_eval_dataset(sets / "lidarhuman26m"))
    for cloud, origin, person in zip(model.clouds, model.origins, people, strict=True):
        np.testing.assert_array_equal(cloud, person.points)
        assert (origin == 0).all()
    assert "none could be displaced" in setting.crop
    evaluated(sets, "lidarhuman26m", model, sensor_unknown=True)
    assert model.origins[len(people) :] == [None] * len(people)


def test_jittered_box_is_independent_of_other_people(sets):
    everybody, some, other = Fake(standing), Fake(standing), Fake(standing)
    evaluated(sets, "humanm3", everybody, split="all")
    evaluated(sets, "humanm3", some, split="all", limit=5)
    for cloud, k in zip(some.clouds, evenly_drawn(len(everybody.clouds), 5), strict=True):
        np.testing.assert_array_equal(cloud, everybody.clouds[k])
    evaluated(sets, "humanm3", other, split="all", seed=1)
    assert any(len(a) != len(b) for a, b in zip(other.clouds, everybody.clouds, strict=True))


def test_jittered_errors_match_documentation():
    box = Box(center=[1, 2, 3], size=[0.6, 0.8, 1.8], yaw=0.3)
    boxes = [jittered(box, np.random.default_rng(k)) for k in range(4000)]
    center = np.stack([own.center for own in boxes]) - box.center
    size = np.log(np.stack([own.size for own in boxes]) / box.size)
    yaw = np.array([own.yaw for own in boxes]) - box.yaw
    # a normal distribution clipped at two standard deviations has 0.96 of the deviation
    for values, sigma in ((center[:, :2], 0.1), (center[:, 2], 0.05), (size, 0.05), (yaw, 0.1)):
        assert np.abs(values).max() <= 2 * sigma + 1e-12 and abs(values.mean()) < 0.1 * sigma
        assert values.std() == pytest.approx(0.96 * sigma, rel=0.06)


def test_dapt_protocol_crops_and_centers_as_released(sets):
    shown, results = {}, {}
    for name in ("humanm3", "waymo", "leaking"):
        model = Fake(standing)
        results[name] = evaluated(sets, name, model, protocol="dapt").result
        shown[name] = list(zip(model.clouds, model.centers, open_eval_dataset(sets / name), strict=True))
    for cloud, center, person in shown["humanm3"]:
        low, high = person.sample.joints.min(0).astype(float), person.sample.joints.max(0).astype(float)
        inside = (np.abs(person.points - (low + high) / 2) <= 1.25 * (high - low) / 2).all(1)
        np.testing.assert_allclose(cloud, person.points[inside])
        np.testing.assert_allclose(center, (low + high) / 2, atol=1e-6)
    # the mean excludes the pelvis
    setting = results["humanm3"].setting
    assert setting.joints == HUMAN15.joints[1:] and "pelvis" in setting.not_judged

    for cloud, center, person in shown["waymo"]:
        np.testing.assert_array_equal(cloud, person.points[person.sample.box.contains(person.points)])
        np.testing.assert_array_equal(center, person.sample.box.center)
    box = replace(person.sample.box, size=person.sample.box.size * 0.6)
    setup = eval_setup(model, open_eval_dataset(sets / "waymo"), protocol="dapt")
    rows, _ = crop_of(replace(person, sample=replace(person.sample, box=box)), setup.setting)
    points = person.points[rows]
    assert 0 < len(points) < len(person.points) and box.contains(points).all()

    for _, center, person in shown["leaking"]:
        np.testing.assert_array_equal(center, person.sample.centers["trans"])
    assert "neighbouring frames" in results["leaking"].setting.leaks
    rows = results["leaking"].lines
    assert all(row.split == "test" and row.protocol == "dapt" and "SMPL" in row.centring for row in rows)


def test_dapt_protocol_notes_leveled_frames(sets):
    for name, protocol, noted in (("lidarhuman26m", "dapt", 1), ("lidarhuman26m", "clean", 0), ("askew", "dapt", 0)):
        notes = evaluated(sets, name, protocol=protocol).result.notes
        assert sum("prepare with --no-level" in note for note in notes) == noted, (name, protocol)


@pytest.mark.parametrize(
    "name, options, words",
    [
        ("sloper4d", {"protocol": "dapt"}, "--split-by dapt into another folder"),
        ("leaking", {}, "use protocol dapt"),
        ("humanm3", {"split": "val"}, "no people in the split 'val'; there are test, train"),
        ("humanm3", {"skeleton": "smpl24"}, "has no spine1"),
        ("humanm3", {"protocol": "clear"}, "did you mean clean"),
        ("humanm3", {"limit": 0}, "at least 1 person"),
        ("humanm3", {"limit": "4"}, "limit must be a whole number of at least 1 person, got '4'"),
        ("humanm3", {"limit": 4.0}, "limit must be a whole number"),
        ("humanm3", {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ("humanm3", {"tta": 4}, "are for weights by name or path: give them to load instead"),
        ("lidarhuman26m", {}, "two datasets are called lidarhuman26m"),
        ("nowhere", {}, "or bench or bench-2, got .*nowhere: there is no such folder"),
        ("a", {}, "is not a dataset"),
    ],
)
def test_run_rejects_invalid_options_before_predicting(sets, name, options, words):
    model = Fake(standing)
    with pytest.raises(InputError, match=words) as raised:
        evaluation.run(model, [sets / "lidarhuman26m", sets / name], **options)
    assert not model.clouds and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "model, dataset, options, words",
    [
        (Fake(standing), "bench", {"protocol": "dapt"}, "is synthetic"),
        (Fake(standing), "bench", {"split": "test"}, "without splits"),
        (3, "bench", {}, "expected a network to evaluate"),
        (SimpleNamespace(predict=5), "bench", {}, "expected a network to evaluate"),
        (SimpleNamespace(predict=list), "bench", {}, "SimpleNamespace.skeleton: expected a Skeleton or its name, got"),
        (Own(lambda clouds: [None] * len(clouds)), "bench", {"limit": 3}, "^Own.predict: expected an answer for each"),
        (Own(lambda clouds: []), "bench", {"limit": 3}, "^Own.predict: expected an answer for each of 3 clouds"),
        ("tiny", None, {}, "expected a dataset to evaluate on"),
    ],
)
def test_evaluate_rejects_invalid_arguments(model, dataset, options, words):
    with pytest.raises(InputError, match=words):
        evaluation.evaluate(model, dataset, **options)


def test_evaluate_accepts_minimal_user_model(sets):
    def answers(clouds):
        poses = [Pose(joints=np.repeat(np.median(cloud, 0)[None], 24, 0), skeleton=SMPL24) for cloud in clouds]
        return [SimpleNamespace(pose=pose) for pose in poses]

    result = evaluation.evaluate(Own(answers), "bench", limit=5)
    assert result.setting.method == "Own" and 100 < result.line("mpjpe").value < 2000
    # a pose of NaN is none
    nowhere = SimpleNamespace(pose=Pose(joints=np.full((24, 3), np.nan), skeleton=SMPL24))
    result = evaluation.evaluate(Own(lambda clouds: answers(clouds)[1:] + [nowhere]), "bench", limit=5)
    assert result.counts["without a pose"] == 1
    with pytest.raises(InputError, match="^the protocol dapt needs a model with `outputs` and `backend`"):
        evaluation.evaluate(Own(answers), sets / "humanm3", protocol="dapt")


@pytest.mark.parametrize(
    "pose, words",
    [
        (
            Pose(joints=np.zeros((15, 3)), skeleton=HUMAN15),
            "expected a lidarpose.Pose with the 24 joints of smpl24, got 15",
        ),
        (np.zeros((24, 3)), "got ndarray: return poses of the model's skeleton"),
        (
            Pose(joints=np.zeros((24, 3)), skeleton=SMPL24, confidence=np.full(24, 95.0)),
            "expected confidence from 0 to 1, got 95.0 to 95.0",
        ),
        (Pose(joints=np.zeros((24, 3)), skeleton=SMPL24, person=-0.5), "expected person from 0 to 1"),
        (
            Pose(joints=np.full((24, 3), [[np.nan]] + [[0.0]] * 23), skeleton=SMPL24),
            "finite joints for the person in shard 0, row [0-9]+, got 1 of 15 scored ones .*: return None",
        ),
    ],
)
def test_evaluate_rejects_unsuitable_poses_of_user_models(pose, words):
    model = Own(lambda clouds: [SimpleNamespace(pose=pose)] * len(clouds))
    with pytest.raises(InputError, match=f"^Own.predict: .*{words}"):
        evaluation.evaluate(model, "bench", limit=3)


def test_open_eval_dataset_default_splits(sets, tmp_path):
    assert [open_eval_dataset(sets / name).split for name in ("waymo", "humanm3")] == ["val", "test"]
    everybody = open_eval_dataset(sets / "humanm3", split="all")
    assert everybody.split == "all" and everybody.count == 24
    assert open_eval_dataset("bench").split == "none"
    prepare("humanm3", sets / "a", tmp_path / "x", split="train")
    with pytest.raises(InputError, match="only in train: give split"):
        open_eval_dataset(tmp_path / "x")
    assert open_eval_dataset(tmp_path / "x", split="train").count == 8


@given(total=st.integers(1, 400), limit=st.none() | st.integers(1, 500))
def test_evenly_drawn_takes_one_row_of_each_share(total, limit):
    rows = evenly_drawn(total, limit)
    assert len(rows) == min(total, limit or total)
    edges = np.arange(len(rows) + 1) * total // len(rows)
    assert (edges[:-1] <= rows).all() and (rows < edges[1:]).all()
    np.testing.assert_array_equal(rows, evenly_drawn(total, limit))


def test_bench_limit_mixes_sensors():
    people = list(open_eval_dataset("bench", limit=40))
    of_sensor = Counter(person.info.sensor for person in people)
    assert len(of_sensor) == 8 and max(of_sensor.values()) <= 10


# ---- scores


def test_scores_of_true_and_shifted_joints(sets):
    people = list(open_eval_dataset(sets / "humanm3"))
    for shift, error in (((0, 0, 0), 0), ((0.06, 0, 0.08), 100)):
        result = evaluated(sets, "humanm3", shifted_truth(people, shift)).result
        values = {(row.figure, row.of): row.value for row in result.lines if row.of in ("all", "wrists")}
        assert values["mpjpe", "all"] == pytest.approx(error, abs=1e-2) == values["mpjpe", "wrists"]
        assert values["pa_mpjpe", "all"] == pytest.approx(0, abs=1e-2) and values["pck3", "all"] == 100
        assert result.line("turned_round", "points", "100 and more").value == 0
        # a constant shift does not change the acceleration
        assert result.line("acceleration", "all", "frames in a row").value == pytest.approx(0, abs=1e-2)
        assert result.line("mpjpe").people == 16 and result.counts["people"] == 16
    # poses of the protocol dapt are in the dataset's frame
    result = evaluated(sets, "humanm3", shifted_truth(people, shift), protocol="dapt").result
    assert result.line("mpjpe").value == pytest.approx(100, abs=1e-2)


def test_scores_use_hidden_labels_and_skip_missing_ones(sets):
    scored = evaluated(sets, "waymo")
    people = [person.sample for person in open_eval_dataset(sets / "waymo")]
    labels, size = np.stack([own.joint_labels for own in people]), np.stack([own.box.size for own in people])
    assert (labels == 0).any() and (labels == 1).any()
    pred, true, line = scored.predictions.pred, scored.predictions.true, scored.result.line
    assert line("mpjpe").joints == (labels > 0).sum()
    for name, metric in (("mpjpe", metrics.mpjpe), ("pa_mpjpe", metrics.pa_mpjpe), ("pck3", metrics.pck)):
        assert line(name).value == pytest.approx(metric(pred, true, labels > 0))
    assert line("pck_box@0.2").value == pytest.approx(metrics.pck_box(pred, true, size, labels > 0, threshold=0.2))
    assert line("oks_ap").value == pytest.approx(metrics.oks_ap(pred, true, size, labels > 0))
    frames = [[k for k, own in enumerate(people) if own.frame == f] for f in sorted({own.frame for own in people})]
    boxes = np.stack([[*own.box.center, *own.box.size, own.box.yaw] for own in people])
    wanted = metrics.pem(*([values[rows] for rows in frames] for values in (pred, true, boxes, labels == 2)))
    assert line("pem").value == pytest.approx(wanted.pem)


def test_people_without_pose_count_only_in_pem(sets):
    turns = itertools.cycle([True, False])
    some = evaluated(sets, "waymo", Fake(lambda cloud: standing(cloud) if next(turns) else None)).result
    words = "without a pose, and in no metric except PEM"
    assert some.counts["without a pose"] and any(words in line for line in evaluating._lines(some))
    # each labeled keypoint is missed
    nobody = evaluated(sets, "waymo", Fake(lambda cloud: None)).result
    assert nobody.line("pem").value == 250
    assert nobody.line("mpjpe").value is None and nobody.line("mpjpe").low is None
    some = evaluated(sets, "humanm3", Fake(lambda cloud: None if len(cloud) % 2 else standing(cloud)))
    missing, row = some.result.counts["without a pose"], some.result.line("mpjpe")
    assert 0 < missing < 16 and row.people == 16 - missing and row.no_pose == missing and row.skipped == 0
    assert some.result.line("mpjpe", "joints", "knees").no_pose == missing
    assert row.value == pytest.approx(np.nanmean(some.predictions.errors()))


@pytest.mark.parametrize(
    "trained, words",
    [("train", "validated on this split"), ("val", "trained on split val"), ("all", "trained on split all")],
)
def test_notes_report_training_on_evaluated_people(sets, trained, words):
    """The people of the Waymo set are in the split val."""

    def noted(card, words):
        return sum(words in note for note in evaluated(sets, "waymo", Fake(standing, card=card)).result.notes)

    card = {"data": ["waymo"], "recipe": {"split": trained}, "validation_mm": 60.0}
    other = {"data": ["another"], "recipe": {"split": trained}}
    assert noted(card, words) == 1 and noted(other, words) == 0
    # validated on another split, by `finetune --validation-split`
    elsewhere = card | {"recipe": {"split": "train", "validation_split": "test"}}
    assert noted(elsewhere, "validated on this split") == 0
    # people of an earlier run count as well; pre-training on shards uses all splits
    assert noted(other | {"init_card": card}, words) == 1
    assert noted({"recipe": {"shards": ["waymo"], "seed": 0, "scene": "wild"}}, "trained on split all") == 1


def test_notes_report_weights_chosen_on_the_test_split(sets):
    recipe = {"split": "train", "validation_split": "test"}
    card = {"data": ["humanm3"], "recipe": recipe, "validation_mm": 60.0}
    for changes, count in (({}, 1), ({"recipe": {"split": "train"}}, 0)):
        notes = evaluated(sets, "humanm3", Fake(standing, card=card | changes)).result.notes
        assert sum("selected on these people" in note for note in notes) == count


def test_notes_report_training_about_labels(sets):
    model = Fake(standing, card={})
    model.header.config = SimpleNamespace(trans_center=True)
    for protocol, count in (("clean", 1), ("dapt", 0)):
        notes = evaluated(sets, "lidarhuman26m", model, protocol=protocol).result.notes
        assert sum("trained about the labels' trans" in note for note in notes) == count


def test_scored_joints_are_common_to_network_and_dataset(sets):
    result = evaluated(sets, "humanm3", Fake(lambda cloud: standing(cloud)[:14], WAYMO14)).result
    both = tuple(name for name in HUMAN15.joints if name in WAYMO14.joints)
    assert result.setting.joints == both and len(both) == 12
    assert "the network has no pelvis, neck, head" in result.setting.not_judged
    assert any("the network has no" in note for note in result.notes)
    with pytest.raises(InputError, match="none in common"):
        nose = Skeleton(name="nose", joints=("nose",), parents=(-1,))
        evaluated(sets, "humanm3", Fake(lambda cloud: standing(cloud)[:1], nose))
    # a given skeleton restricts the joints
    setting = evaluated(sets, "lidarhuman26m", skeleton="human15").result.setting
    assert set(setting.joints) == set(HUMAN15.joints)


def test_interval_needs_several_sequences_and_draws_them_whole(sets, monkeypatch):
    for name, words in (("lidarhuman26m", "only one sequence"), ("humanm3", "only 2 sequences")):
        result = evaluated(sets, name).result
        assert result.line("mpjpe").low is None and any(note.startswith(words) for note in result.notes)
    monkeypatch.setattr(aggregate, "LEAST_UNITS", 2)
    scored = evaluated(sets, "humanm3")
    row, table = scored.result.line("mpjpe"), scored.predictions.errors()
    means = [np.nanmean(table[scored.predictions.sequence == name]) for name in ("test/b", "test/c")]
    # with two sequences, the extreme draws are one of them twice
    assert (row.low, row.high) == pytest.approx((min(means), max(means)))


def test_triples_are_consecutive_and_evenly_spaced(sets):
    base = evaluated(sets, "lidarhuman26m").predictions

    def triples_of(frames, **more):
        """Triples of one person's frames, 0.1 s apart."""
        frames = np.array(frames)
        predictions = replace(base.select(np.zeros(len(frames), int)), frame=frames, time=frames * 0.1)
        return frames[triples(replace(predictions, **more))].tolist()

    # the step of the sequence is one frame, not two
    assert sorted(triples_of([3, 1, 2, 5, 6, 7, 9, 11, 13])) == [[1, 2, 3], [5, 6, 7]]
    assert not triples_of([1, 2]) and not triples_of([1, 2, 3], time=np.full(3, np.nan))
    # every second frame is none of successive ones, if another track of the sequence has those between
    frames, two_tracks = [0, 2, 4, 6, 8, 9, 10], np.array(["a"] * 5 + ["b"] * 2)
    assert not triples_of(frames, track=two_tracks)
    assert len(triples_of(frames, track=two_tracks, sequence=two_tracks)) == 3
    # one short step of the clock costs the two triples that are uneven by it; frame numbers may have any step
    times = 0.1 * np.arange(8) - 0.03 * (np.arange(8) > 3)
    assert triples_of(range(0, 40, 5), time=times) == [[k, k + 5, k + 10] for k in (0, 5, 20, 25)]
    # a skipped frame ends a run even if the clock does not show it
    assert triples_of([1, 2, 3, 5, 6], time=0.1 * np.arange(5)) == [[1, 2, 3]]


def test_facing_flipped_beyond_right_angle(sets):
    base = evaluated(sets, "lidarhuman26m").predictions
    # an upright body, so that a rotation about z changes its facing
    true = np.zeros_like(base.true)
    for joint, y in (("hip", 0.1), ("shoulder", 0.2)):
        true[:, SMPL24.index(f"left_{joint}"), 1], true[:, SMPL24.index(f"right_{joint}"), 1] = y, -y
    for angle, wanted in ((0.0, 0), (1.4, 0), (-1.5, 0), (1.7, 100), (np.pi, 100)):
        pred = (true @ rotation_about("z", angle).T).astype(np.float32)
        assert (facing_flipped(replace(base, pred=pred, true=true)) == wanted).all()
    assert np.isnan(facing_flipped(replace(base, pred=np.full_like(true, np.nan)))).all()


def test_worst_people_are_sorted_by_error(sets):
    scored = evaluated(sets, "humanm3", split="all")
    error = scored.predictions.errors().mean(1)
    assert len(error) == 24 and [k for _, k in scored.worst] == np.argsort(-error, kind="stable").tolist()


# ---- damaged data


@pytest.fixture
def copy(sets, tmp_path):
    return shutil.copytree(sets / "humanm3", tmp_path / "humanm3")


def test_damaged_shard_is_skipped_and_reported(copy):
    shards = [shard_path(copy, "labelled", k) for k in range(open_dataset(copy).card.count)]
    split = [next(iter(read_rows(path, "labelled")))["split"] for path in shards]
    first, second = (path for path, name in zip(shards, split, strict=True) if name == "test")
    first.write_bytes(first.read_bytes()[:-20])
    result = evaluated(copy.parent, "humanm3").result
    assert result.counts["people"] == 8
    assert result.skipped["damaged shards"]["count"] == 1 and first.name in result.skipped["damaged shards"]["first"]
    for paths, words in (([second], "perhaps those of the split test"), (shards, "none of the 3 shards")):
        for path in paths:
            path.write_bytes(b"PAR1")
        with pytest.raises(InputError, match=words):
            open_eval_dataset(copy)
    shards[0].unlink()
    with pytest.raises(InputError, match="not finished"):
        open_eval_dataset(copy)


def test_partly_damaged_shard_is_skipped_as_a_whole(copy):
    path = shard_path(copy, "labelled", 1)
    data = bytearray(path.read_bytes())
    # damage within the points, so that the split column can still be read
    at = len(data) // 3
    data[at : at + 64] = bytes(64)
    path.write_bytes(bytes(data))
    setup = eval_setup(Fake(standing), open_eval_dataset(copy, split="all"))
    result = evaluate_dataset(setup).result
    assert result.counts["people"] == 16 and result.skipped["people of damaged shards"]["count"] == 8
    assert path.name in result.skipped["damaged shards"]["first"]
    # a second evaluation does not count them again
    assert evaluate_dataset(setup).result == result


def test_dapt_protocol_counts_people_that_released_code_skips(sets, tmp_path):
    path = shard_path(shutil.copytree(sets / "leaking", tmp_path / "leaking"), "labelled", 0)
    rows = list(read_rows(path, "labelled"))
    tests = [k for k, row in enumerate(rows) if row["split"] == "test"]
    rows[tests[0]]["points"] = rows[tests[0]]["points"][:15]
    rows[tests[1]]["center_trans"] = None
    write_shard(path, "labelled", rows)
    before, after = (evaluated(root, "leaking", protocol="dapt").result for root in (sets, tmp_path))
    assert after.counts["people"] == before.counts["people"] - 2
    assert after.skipped["people of under 10 points, as the released code skips them"]["count"] == 1
    assert after.skipped["people without the center 'trans'"]["count"] == 1
    # these people are not perturbed either
    setup = eval_setup(Fake(standing), open_eval_dataset(tmp_path / "leaking"), protocol="dapt")
    assert len(robustness.people_to_perturb(setup)) == after.counts["people"]


def test_dapt_protocol_rejects_test_time_augmentation(sets):
    model = Fake(standing)
    model.model["tta"] = 4
    assert evaluated(sets, "humanm3", model)
    with pytest.raises(InputError, match="dapt predicts each person once"):
        evaluated(sets, "humanm3", model, protocol="dapt")


# ---- files


@pytest.fixture(scope="module")
def written(sets, tmp_path_factory):
    """An evaluation of bundled weights on prepared sets and the bench, and its files."""
    run = evaluation.run("tiny", [sets / "waymo", sets / "humanm3", "bench"], limit=16, legacy=True, command="as typed")
    folder = tmp_path_factory.mktemp("out") / "new"
    return run, folder, evaluation.write(run, folder)


def test_evaluate_command_fails_before_predicting(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run_module, "evaluate_dataset", None)
    (tmp_path / "file").write_text("")
    for out, words in (("file", "is a file; give a new or empty"), ("file/deep", "file")):
        assert main(["evaluate", "tiny", "bench", "--limit", "2", "--out", str(tmp_path / out)]) == 2
        assert words in capsys.readouterr().err
    # the stability study needs clean people, and the single person is not
    assert main(["evaluate", "tiny", "bench", "--limit", "1", "--stability", "--out", str(tmp_path / "new")]) == 2
    assert "score more people, or leave stability out" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.long
def test_run_accepts_numpy_numbers_and_options_of_load(tmp_path):
    run = evaluation.run("tiny", "bench", limit=np.int64(3), seed=np.int32(2), tta=2, sensor_unknown=True)
    evaluation.write(run, tmp_path / "new")
    assert evaluation.read_scores(tmp_path / "new").results == run.scores.results
    assert evaluation.table(tmp_path / "new") == evaluation.table([tmp_path / "new"])
    assert run.scores.weights["tta"] == 2 and run.scores.results[0].setting.sensor == "unknown"


def test_metrics_can_be_computed_from_poses_parquet(written):
    _, folder, _ = written
    scores, people = evaluation.read_scores(folder), evaluation.read_poses(folder / "poses.parquet")
    assert list(people) == ["waymo", "humanm3", "lidarpose-bench-1.1"]
    # also from the table alone, without this package
    table = pd.read_parquet(folder / "poses.parquet")
    for result in scores.results:
        again = metric_rows(people[result.setting.dataset], result.setting, dapt_compat=True)
        own = tuple(row for row in result.lines if row.method == result.setting.method)
        assert again == own and len(own) > 30
        each = table[table["dataset"] == result.setting.dataset]["error_mm"].map(np.nanmean)
        assert each.mean() == pytest.approx(result.line("mpjpe").value, abs=1e-3)


def test_scores_round_trip(written):
    run, folder, paths = written
    assert evaluation.read_scores(folder) == evaluation.read_scores(folder / "scores.json") == run.scores
    content = json.loads((folder / "scores.json").read_text())
    assert content["schema"] == "lidarpose.scores/1" and content["command"] == "as typed"
    assert len(content["weights"]["digest"]) == 64 and content["weights"]["file"] == "tiny.safetensors"
    for result in content["results"]:
        for row in result["lines"]:
            assert (row["protocol"], row["centring"]) == (
                "clean",
                "points, and where uncertain the center of the displaced box",
            )
            assert row["split"] == result["setting"]["split"]
    assert {path.name for path in paths} == {path.name for path in folder.iterdir()}
    assert [path.read_bytes()[:4] for path in paths if path.suffix == ".png"] == [b"\x89PNG"] * 9
    # names until 0.2
    first = run.evaluations[0]
    assert evaluation.Judged is type(first.predictions) and evaluation.Line is type(first.result.lines[0])
    assert lidarpose.evaluation.evaluate is evaluation.evaluate and "evaluation" in dir(lidarpose)


def test_rows_contain_limit_baselines_and_released_arithmetic(written):
    waymo, humanm3, result = written[0].scores.results
    assert result.setting.limit == 16 and result.setting.total == 2000
    assert all(row.limit == 16 for row in result.lines)
    baseline = result.line("mpjpe", method="floor: mean pose, true facing")
    assert result.line("mpjpe").value < baseline.value < result.line("mpjpe", method="floor: mean pose").value
    assert any("MPJPE" in line and "baseline mean pose:" in line for line in evaluating._lines(result))
    # the Waymo set contains only four people
    assert waymo.setting.limit is None
    people = evaluation.read_poses(written[1] / "poses.parquet")["waymo"]
    table = metrics.joint_errors(people.pred, people.true, people.labels > 0)
    wanted = metrics.by_group(table, "waymo14", empty=0.0)["head"]
    assert waymo.line("mpjpe", "joints", "head", arithmetic="released").value == pytest.approx(wanted)
    # the released alignment is undefined with missing labels
    with pytest.raises(InputError, match="no row"):
        waymo.line("pa_mpjpe", arithmetic="released")
    assert humanm3.line("pa_mpjpe", arithmetic="released").value > 0


def test_write_creates_all_files_or_none(written, tmp_path, monkeypatch):
    run = replace(written[0], evaluations=written[0].evaluations[:1])
    with pytest.raises(InputError, match="holds other files"):
        evaluation.write(run, written[1])

    # the last file cannot be written, because its content is not bytes
    monkeypatch.setattr(run_module, "poses_parquet", lambda predictions: "half")
    with pytest.raises(TypeError):
        evaluation.write(run, tmp_path / "deep" / "new")
    assert not (tmp_path / "deep").exists()


def test_read_scores_rejects_other_files(written, tmp_path):
    good = json.loads((written[1] / "scores.json").read_text())
    nameless = json.loads(json.dumps(good))
    nameless["results"][0]["setting"]["dataset"] = []
    cases = [
        ({}, "'schema' is missing"),
        ([1], "not a scores.json"),
        ({"schema": "x/9"}, "x/9"),
        (good | {"weights": good["weights"] | {"digest": -1}}, "not a scores.json .*digest"),
        (good | {"weights": good["weights"] | {"digest": float("nan")}}, "not a scores.json .*digest"),
        (nameless, "not a scores.json .*dataset is not text"),
        (good | {"seed": float("inf")}, "not a scores.json .*cannot convert float infinity"),
    ]
    for change, words in [
        (lambda result: result["lines"][0].update(value="x"), "value is not a number"),
        (lambda result: result["lines"][0].update(method=["a"]), "method is not text"),
        (lambda result: result["setting"].update(limit="5"), "limit is not a whole number"),
        (lambda result: result["skipped"].update({"people of": {"count": "3"}}), "count of people of is not a whole"),
        (lambda result: result["skipped"].update({"people of": 3}), "not a scores.json"),
    ]:
        changed = json.loads(json.dumps(good))
        change(changed["results"][0])
        cases.append((changed, f"not a scores.json .*{words}" if words != "not a scores.json" else words))
    for content, words in [*((json.dumps(content), words) for content, words in cases), ("a", "is not JSON")]:
        (tmp_path / "scores.json").write_text(content)
        for read in (evaluation.read_scores, evaluation.table):
            with pytest.raises(InputError, match=words):
                read(tmp_path)
    path = tmp_path / "poses.parquet"
    path.write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match="is not the poses.parquet"):
        evaluation.read_poses(path)
    table = parquet.read_table(written[1] / "poses.parquet")
    place = table.schema.get_field_index("points")
    parquet.write_table(table.set_column(place, "points", [[2**40] * len(table)]), path)
    with pytest.raises(InputError, match="is not the poses.parquet .*out of bounds"):
        evaluation.read_poses(path)


def test_table_command_never_overwrites_scores(written, capsys):
    path = written[1] / "scores.json"
    before = path.read_bytes()
    for named in (written[1], path):
        assert main(["table", str(named), "--out", str(path)]) == 2
        assert "is also an input file" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_new_folder_numbers_folders(tmp_path):
    assert evaluation.new_folder("tiny", tmp_path) == tmp_path / "tiny"
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny-2").mkdir()
    assert evaluation.new_folder("tiny", tmp_path) == tmp_path / "tiny-3"
    assert evaluation.new_folder("runs/x/best.safetensors", tmp_path) == tmp_path / "x-best"
    assert evaluation.new_folder("runs/x/model.safetensors", tmp_path) == tmp_path / "x"


@pytest.mark.slow
def test_figures_in_docs_match_bundled_weights_on_bench():
    root = Path(__file__).parents[1]
    result = evaluation.evaluate(DEFAULT, "bench")
    stored = evaluation.read_scores(root / "docs" / "scores" / f"{DEFAULT}.json").results[0]
    for line in stored.lines:
        if line.method == stored.setting.method:
            now = result.line(line.figure, line.group, line.of)
            assert now.value == pytest.approx(line.value, abs=0.051), (line.figure, line.group, line.of)
    assert f"**{result.line('mpjpe').value:.1f}**" in (root / "README.md").read_text("utf-8")
    assert result.line("mpjpe", method="floor: mean pose, true facing").value == pytest.approx(267.1, abs=0.05)
    assert result.counts == {"people": 2000, "frames of clips": 960, "without a pose": 0}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Synthesized people of seed 0."""
    folder = tmp_path_factory.mktemp("made") / "people"
    write_dataset(SynthesisJob(what="people", count=3, hard=0.0, sensors=("os1-128",)), folder)
    return folder


@pytest.mark.parametrize(
    "recipe, noted",
    [
        ({"seed": 0, "scene": "wild", "shards": []}, True),
        ({"seed": 0, "scene": "wild", "split": "train", "mix": 0.25}, True),
        ({"seed": 0, "scene": "wild", "split": "train", "mix": 0.0}, False),
        ({"seed": 0, "scene": "wild", "shards": ["others"]}, False),
        ({"seed": 1, "scene": "wild", "shards": []}, False),
        ({"seed": 0, "scene": "paper", "shards": []}, False),
    ],
)
def test_notes_report_training_on_same_seed(made, recipe, noted):
    """Person i of a seed has the same body, pose and place at any difficulty."""
    card = {"recipe": {"seed": 5, "scene": "wild"}, "init_card": {"recipe": recipe}}
    notes = evaluated(made.parent, made.name, Fake(standing, card=card)).result.notes
    assert any("of seed 0, like these" in note for note in notes) == noted


def test_nearby_points_are_those_of_the_crop_within_15_cm_of_the_true_joint(made):
    setup = eval_setup(Fake(standing), open_eval_dataset(made))
    people = [person for person in map(setup.crop_sample, setup.dataset) if person[0] is not None]
    predictions = setup.predict([person for person, _ in people])
    for (person, _), true, nearby in zip(people, predictions.true, predictions.nearby, strict=True):
        tree = cKDTree(person.points)
        np.testing.assert_array_equal(nearby, [len(found) for found in tree.query_ball_point(true, 0.15)])
    assert (predictions.nearby == 0).any() and (predictions.nearby > 20).any()
    joints = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 0.2]])
    np.testing.assert_array_equal(num_nearby(np.array([[0, 0, 0.1, 7], [0, 0, 0.14, 7]]), joints), [2, np.nan, 2])


def test_predictions_hidden_is_complement_of_visible(made):
    hidden = evaluated(made.parent, made.name).predictions.hidden
    np.testing.assert_allclose(hidden, [1 - row["visible"] for row in open_dataset(made).rows()], atol=1e-6)
    predictions = evaluate_dataset(eval_setup(Fake(standing), open_eval_dataset("bench", limit=9))).predictions
    np.testing.assert_allclose(predictions.hidden, 1 - load_bench().columns["visible"][predictions.row], atol=1e-6)
