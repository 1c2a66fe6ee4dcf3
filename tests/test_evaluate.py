"""Evaluation: what each protocol shows the network, what counts, and that poses.parquet holds every figure."""

import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import dataset_files as files
import numpy as np
import pytest
import waymo_files
from hypothesis import given
from hypothesis import strategies as st
from shard_files import write_shard

import lidarpose
from lidarpose import evaluation, metrics
from lidarpose.cli import evaluating, main
from lidarpose.data.prepare import prepare
from lidarpose.data.shards import open_dataset, read_rows, shard_path
from lidarpose.errors import InputError
from lidarpose.eval import robustness
from lidarpose.eval import run as run_module
from lidarpose.eval.bench import load_bench
from lidarpose.eval.dataset import open_eval_dataset, spread
from lidarpose.eval.metric_rows import facing_flipped, metric_rows, triples
from lidarpose.eval.metrics import bootstrap
from lidarpose.eval.protocols import cropped, eval_setup, jittered
from lidarpose.eval.run import evaluate_dataset
from lidarpose.geometry import rotation_about
from lidarpose.inference.backend import Estimates
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.models import DEFAULT
from lidarpose.sample import Box, Pose, center_of
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14, Skeleton
from lidarpose.synth.shard_job import Job, write_dataset


class Fake:
    """A model of known answers, which remembers what it was shown. answer(cloud) -> (J, 3) m or None."""

    def __init__(self, answer, skeleton=BODY26, confidence=None):
        self.answer, self.skeleton, self.confidence = answer, skeleton, confidence
        self.model = {"name": "fake", "version": "0", "backend": "none", "decode": "none"}
        self.backend = SimpleNamespace(batch=3)
        self.clouds, self.origins, self.centers = [], [], []

    def predict(self, points, *, sensor_origin=None, skeleton=None, progress=False):
        assert skeleton == self.skeleton.name
        people = []
        for cloud in points:
            self.clouds.append(np.array(cloud, float))
            self.origins.append(sensor_origin)
            joints = self.answer(np.array(cloud, float))
            pose = (
                None if joints is None else Pose(joints=joints, skeleton=self.skeleton, confidence=self._told(joints))
            )
            people.append(PersonPose(pose=pose, skeleton=self.skeleton, points=np.array(cloud)))
        return Poses(people=tuple(people), skeleton=self.skeleton)

    def outputs(self, clouds, centers, origin):
        assert len(clouds) <= self.backend.batch
        self.clouds += clouds
        self.centers += list(centers)
        self.origins += [origin] * len(clouds)
        joints = np.stack([self.answer(cloud) - center for cloud, center in zip(clouds, centers, strict=True)])
        nothing = dict.fromkeys(("spread", "visible", "in_range"))
        return Estimates(joints=joints, confidence=None, **nothing)

    def _told(self, joints):
        return None if self.confidence is None else np.full(len(joints), self.confidence)


def standing(cloud):
    """A pose that depends on the points alone."""
    rng = np.random.default_rng(0)
    return center_of(cloud) + rng.normal(0, 0.3, (26, 3))


def knowing(people, shift=(0.0, 0.0, 0.0)):
    """A model that finds a cloud's owner by its middle and answers with the truth, moved."""
    middles = np.stack([np.median(one.points, axis=0) for one in people])

    def answer(cloud):
        one = people[int(np.argmin(np.linalg.norm(middles - np.median(cloud, axis=0), axis=1)))]
        return np.nan_to_num(one.sample.joints) + shift

    return answer


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


def judged(sets, name, model, **options):
    split, limit = options.pop("split", None), options.pop("limit", None)
    return evaluate_dataset(eval_setup(model, open_eval_dataset(sets / name, split=split, limit=limit), **options))


# ---- what the network is shown


def test_clean_shows_what_lies_in_a_displaced_box(sets):
    model = Fake(standing)
    found = judged(sets, "humanm3", model, seed=3)
    people = list(open_eval_dataset(sets / "humanm3"))
    assert len(model.clouds) == len(people) == 16
    for cloud, one in zip(model.clouds, people, strict=True):
        box = jittered(one.sample.box, np.random.default_rng([3, one.shard, one.row]))
        np.testing.assert_array_equal(cloud, one.points[box.contains(one.points)])
    # some points are lost, some come in, and nobody's place is told
    assert any(
        len(cloud) != one.sample.box.contains(one.points).sum() for cloud, one in zip(model.clouds, people, strict=True)
    )
    assert model.origins == [None] * 16 and found.result.setting.sensor == "unknown"
    told = found.result.setting
    assert (told.protocol, told.centring, told.split) == ("clean", "points alone", "test")
    assert "detector" in told.crop


def test_clean_uses_no_label_of_who_was_segmented(sets):
    model = Fake(standing)
    found = judged(sets, "lidarhuman26m", model)
    people = list(open_eval_dataset(sets / "lidarhuman26m"))
    for cloud, origin, one in zip(model.clouds, model.origins, people, strict=True):
        np.testing.assert_array_equal(cloud, one.points)
        assert (origin == 0).all()
    assert "none could be displaced" in found.result.setting.crop
    judged(sets, "lidarhuman26m", model, sensor_unknown=True)
    assert model.origins[len(people) :] == [None] * len(people)


def test_a_person_s_box_does_not_depend_on_the_others(sets):
    everybody, some = Fake(standing), Fake(standing)
    judged(sets, "humanm3", everybody, split="all")
    judged(sets, "humanm3", some, split="all", limit=5)
    chosen = spread(len(everybody.clouds), 5)
    assert len(some.clouds) == 5
    for cloud, k in zip(some.clouds, chosen, strict=True):
        np.testing.assert_array_equal(cloud, everybody.clouds[k])
    other = Fake(standing)
    judged(sets, "humanm3", other, split="all", seed=1)
    assert any(len(a) != len(b) for a, b in zip(other.clouds, everybody.clouds, strict=True))


def test_a_detector_s_errors_are_as_told():
    box = Box(center=[1, 2, 3], size=[0.6, 0.8, 1.8], yaw=0.3)
    drawn = [jittered(box, np.random.default_rng(k)) for k in range(4000)]
    center = np.stack([one.center for one in drawn]) - box.center
    size = np.log(np.stack([one.size for one in drawn]) / box.size)
    yaw = np.array([one.yaw for one in drawn]) - box.yaw
    # a normal cut at twice its deviation has .96 of it
    for values, sigma in ((center[:, :2], 0.1), (center[:, 2], 0.05), (size, 0.05), (yaw, 0.1)):
        assert np.abs(values).max() <= 2 * sigma + 1e-12 and abs(values.mean()) < 0.1 * sigma
        assert values.std() == pytest.approx(0.96 * sigma, rel=0.06)


def test_dapt_crops_and_centers_as_released(sets):
    model = Fake(standing)
    found = judged(sets, "humanm3", model, protocol="dapt")
    people = list(open_eval_dataset(sets / "humanm3"))
    for cloud, center, one in zip(model.clouds, model.centers, people, strict=True):
        low, high = one.sample.joints.min(0).astype(float), one.sample.joints.max(0).astype(float)
        half = 1.25 * (high - low) / 2
        inside = (np.abs(one.points - (low + high) / 2) <= half).all(1)
        np.testing.assert_allclose(cloud, one.points[inside])
        np.testing.assert_allclose(center, (low + high) / 2, atol=1e-6)
    # its mean leaves the pelvis out
    assert found.result.setting.joints == HUMAN15.joints[1:] and "pelvis" in found.result.setting.not_judged

    model = Fake(standing)
    judged(sets, "waymo", model, protocol="dapt")
    people = list(open_eval_dataset(sets / "waymo"))
    for cloud, center, one in zip(model.clouds, model.centers, people, strict=True):
        np.testing.assert_array_equal(cloud, one.points[one.sample.box.contains(one.points)])
        np.testing.assert_array_equal(center, one.sample.box.center)
    box = people[0].sample.box
    small = replace(people[0], sample=replace(people[0].sample, box=replace(box, size=box.size * 0.6)))
    kept = cropped("dapt", "waymo", small, 0).points
    assert 0 < len(kept) < len(small.points) and small.sample.box.contains(kept).all()

    model = Fake(standing)
    found = judged(sets, "leaking", model, protocol="dapt")
    for center, one in zip(model.centers, open_eval_dataset(sets / "leaking"), strict=True):
        np.testing.assert_array_equal(center, one.sample.centers["trans"])
    assert "neighbouring frames" in found.result.setting.leaks
    assert all(
        line.split == "test" and line.protocol == "dapt" and "SMPL" in line.centring for line in found.result.lines
    )


def test_a_frame_that_was_turned_is_told_where_it_is_compared_with_the_released_code(sets):
    for name, protocol, told in (("lidarhuman26m", "dapt", 1), ("lidarhuman26m", "clean", 0), ("askew", "dapt", 0)):
        notes = judged(sets, name, Fake(standing), protocol=protocol).result.notes
        assert sum("prepare with --no-level" in note for note in notes) == told, (name, protocol)


@pytest.mark.parametrize(
    "name, options, words",
    [
        ("sloper4d", {"protocol": "dapt"}, "--split-by dapt into another folder"),
        ("leaking", {}, "use --protocol dapt"),
        ("humanm3", {"split": "val"}, "nobody in the split 'val'; there are test, train"),
        ("humanm3", {"skeleton": "smpl24"}, "has no spine1"),
        ("humanm3", {"protocol": "clear"}, "did you mean clean"),
        ("humanm3", {"limit": 0}, "at least 1 person"),
        ("humanm3", {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ("nowhere", {}, "is no dataset"),
        ("a", {}, "is no dataset"),
    ],
)
def test_what_does_not_fit_is_told_before_anybody_is_judged(sets, name, options, words):
    model = Fake(standing)
    with pytest.raises(InputError, match=words) as raised:
        evaluation.run(model, [sets / "lidarhuman26m", sets / name], **options)
    assert not model.clouds and "\n" not in str(raised.value)


def test_synthetic_sets_have_neither_splits_nor_oracles(sets):
    for options, words in (({"protocol": "dapt"}, "is synthetic"), ({"split": "test"}, "without splits")):
        with pytest.raises(InputError, match=words):
            evaluation.run(Fake(standing), ["bench"], **options)


def test_splits_that_are_judged_by_default(sets):
    assert open_eval_dataset(sets / "waymo").split == "val"
    assert open_eval_dataset(sets / "humanm3").split == "test"
    everybody = open_eval_dataset(sets / "humanm3", split="all")
    assert everybody.split == "all" and everybody.count == 24
    assert open_eval_dataset("bench").split == "none"


def test_train_alone_asks_for_a_split(sets, tmp_path):
    prepare("humanm3", sets / "a", tmp_path / "x", split="train")
    with pytest.raises(InputError, match="only in train: say --split"):
        open_eval_dataset(tmp_path / "x")
    assert open_eval_dataset(tmp_path / "x", split="train").count == 8


@given(total=st.integers(1, 400), limit=st.none() | st.integers(1, 500))
def test_a_limit_is_spread_evenly(total, limit):
    rows = spread(total, limit)
    assert len(rows) == min(total, limit or total) and len(set(rows.tolist())) == len(rows)
    assert rows.min() >= 0 and rows.max() < total
    gaps = np.diff(rows)
    assert not len(gaps) or gaps.max() - gaps.min() <= 1


# ---- what counts


def test_the_truth_has_no_error_and_a_step_its_length(sets):
    people = list(open_eval_dataset(sets / "humanm3"))
    pick = [HUMAN15.index(name) if name in HUMAN15.joints else 0 for name in BODY26.joints]
    for shift, error in (((0, 0, 0), 0), ((0.06, 0, 0.08), 100)):
        known = knowing(people, shift)
        result = judged(sets, "humanm3", Fake(lambda cloud, known=known: known(cloud)[pick])).result
        assert result.line("mpjpe").value == pytest.approx(error, abs=1e-2)
        assert result.line("pa_mpjpe").value == pytest.approx(0, abs=1e-2)
        assert result.line("pck3").value == 100
        assert result.line("mpjpe", "joints", "wrists").value == pytest.approx(error, abs=1e-2)
        assert result.line("turned_round", "points", "100 and more").value == 0
        # who moves with the truth has its acceleration
        assert result.line("acceleration", "all", "frames in a row").value == pytest.approx(0, abs=1e-2)
        assert result.line("mpjpe").people == 16 and result.counts["people"] == 16


def test_hidden_labels_count_and_missing_ones_do_not(sets):
    found = judged(sets, "waymo", Fake(standing))
    people = list(open_eval_dataset(sets / "waymo"))
    labels = np.stack([one.sample.joint_labels for one in people])
    assert (labels == 0).any() and (labels == 1).any()
    assert found.result.line("mpjpe").joints == (labels > 0).sum()
    pred = found.predictions.pred
    for name, of in (("mpjpe", metrics.mpjpe), ("pa_mpjpe", metrics.pa_mpjpe), ("pck3", metrics.pck)):
        assert found.result.line(name).value == pytest.approx(of(pred, found.predictions.true, labels > 0))
    size = np.stack([one.sample.box.size for one in people])
    box = metrics.pck_box(pred, found.predictions.true, size, labels > 0, threshold=0.2)
    assert found.result.line("pck_box@0.2").value == pytest.approx(box)
    hit = metrics.oks_ap(pred, found.predictions.true, size, labels > 0)
    assert found.result.line("oks_ap").value == pytest.approx(hit)
    frames = [
        [k for k, one in enumerate(people) if one.sample.frame == f]
        for f in sorted({one.sample.frame for one in people})
    ]
    boxes = np.stack([[*one.sample.box.center, *one.sample.box.size, one.sample.box.yaw] for one in people])
    wanted = metrics.pem(
        *([value[rows] for rows in frames] for value in (pred, found.predictions.true, boxes, labels == 2))
    )
    assert found.result.line("pem").value == pytest.approx(wanted.pem)


def test_people_without_a_pose_count_in_pem_alone(sets):
    turns = itertools.cycle([True, False])
    shy = judged(sets, "waymo", Fake(lambda cloud: standing(cloud) if next(turns) else None)).result
    told = "without a pose, and in no figure but PEM"
    assert shy.counts["without a pose"] and any(told in line for line in evaluating._lines(shy))
    # each labelled keypoint is missed, be it everybody's
    nobody = judged(sets, "waymo", Fake(lambda cloud: None)).result
    assert nobody.line("pem").value == 250 and nobody.line("mpjpe").value is None


@pytest.mark.parametrize(
    "learned, told",
    [("train", "validated on this split"), ("val", "learned from split val"), ("all", "learned from split all")],
)
def test_a_network_that_knows_the_people_is_told(sets, learned, told):
    """Waymo's people are of the split val."""
    model = Fake(standing)
    model.header = SimpleNamespace(card={"data": ["waymo"], "recipe": {"split": learned}, "validation_mm": 60.0})
    notes = judged(sets, "waymo", model).result.notes
    assert any(told in note for note in notes)
    # an earlier run's people are known as well
    model.header.card = {"data": ["another"], "recipe": {"split": learned}, "init_card": model.header.card}
    assert sum(told in note for note in judged(sets, "waymo", model).result.notes) == 1
    del model.header.card["init_card"]
    assert not any(told in note for note in judged(sets, "waymo", model).result.notes)
    # pre-training on shards takes everybody
    model.header.card = {"recipe": {"shards": ["waymo"], "seed": 0, "scene": "wild"}}
    assert any("learned from split all" in note for note in judged(sets, "waymo", model).result.notes)


def test_who_gets_no_pose_is_counted_and_in_no_figure(sets):
    def shy(cloud):
        return None if len(cloud) % 2 else standing(cloud)

    found = judged(sets, "humanm3", Fake(shy))
    missing = found.result.counts["without a pose"]
    line = found.result.line("mpjpe")
    assert 0 < missing < 16 and line.people == 16 - missing and line.no_pose == missing and line.skipped == 0
    assert found.result.line("mpjpe", "joints", "knees").no_pose == missing
    assert line.value == pytest.approx(np.nanmean(found.predictions.errors()))
    nobody = judged(sets, "humanm3", Fake(lambda cloud: None)).result
    assert nobody.line("mpjpe").value is None and nobody.line("mpjpe").low is None


def test_joints_that_both_have_are_judged_and_named(sets):
    result = judged(sets, "humanm3", Fake(lambda cloud: standing(cloud)[:14], WAYMO14)).result
    both = tuple(name for name in HUMAN15.joints if name in WAYMO14.joints)
    assert result.setting.joints == both and len(both) == 12
    assert "the network has no pelvis, neck, head" in result.setting.not_judged
    assert any("the network has no" in note for note in result.notes)
    with pytest.raises(InputError, match="none in common"):
        stranger = Skeleton(name="nose", joints=("nose",), parents=(-1,))
        judged(sets, "humanm3", Fake(lambda cloud: standing(cloud)[:1], stranger))
    # asked for fewer: those alone
    asked = judged(sets, "lidarhuman26m", Fake(standing), skeleton="human15").result.setting
    assert set(asked.joints) == set(HUMAN15.joints)


def test_few_sequences_have_no_interval(sets):
    for name, told in (("lidarhuman26m", "one sequence alone"), ("humanm3", "2 sequences alone")):
        found = judged(sets, name, Fake(standing)).result
        assert found.line("mpjpe").low is None and any(note.startswith(told) for note in found.notes)


def test_sequences_are_drawn_whole(sets, monkeypatch):
    monkeypatch.setattr(bootstrap, "LEAST_UNITS", 2)
    found = judged(sets, "humanm3", Fake(standing))
    line, table = found.result.line("mpjpe"), found.predictions.errors()
    means = [np.nanmean(table[found.predictions.sequence == name]) for name in ("test/b", "test/c")]
    # of two sequences the extreme draws are one of them twice
    assert (line.low, line.high) == pytest.approx((min(means), max(means)))


def _moving(sets, frames):
    """People of one track at frames, every 0.1 s."""
    base = judged(sets, "lidarhuman26m", Fake(standing)).predictions
    rows = np.zeros(len(frames), int)
    frames = np.array(frames)
    return replace(base.select(rows), frame=frames, time=frames * 0.1)


def test_triples_follow_each_other_evenly(sets):
    found = triples(_moving(sets, [3, 1, 2, 5, 6, 7, 9, 11, 13]))
    frames = np.array([3, 1, 2, 5, 6, 7, 9, 11, 13])[found]
    # every second frame is not the sequence's own step
    assert sorted(map(tuple, frames.tolist())) == [(1, 2, 3), (5, 6, 7)]
    assert not len(triples(_moving(sets, [1, 2])))
    # another track's frames nearby take nothing away
    several = _moving(sets, [0, 2, 4, 6, 8, 9, 10])
    several = replace(several, track=np.array(["a"] * 5 + ["b"] * 2))
    assert len(triples(several)) == 3
    unknown = replace(_moving(sets, [1, 2, 3]), time=np.full(3, np.nan))
    assert not len(triples(unknown))


def test_turned_round_is_over_a_right_angle(sets):
    base = judged(sets, "lidarhuman26m", Fake(standing)).predictions
    true = base.true - base.true.mean(1, keepdims=True)
    # upright bodies, so that a turn about z turns their facing
    true = np.tile(SMPL_STANDING.astype(np.float32), (len(true), 1, 1))
    for angle, wanted in ((0.0, 0), (1.4, 0), (-1.5, 0), (1.7, 100), (np.pi, 100)):
        pred = (true @ rotation_about("z", angle).T).astype(np.float32)
        assert (facing_flipped(replace(base, pred=pred, true=true)) == wanted).all()
    assert np.isnan(facing_flipped(replace(base, pred=np.full_like(true, np.nan)))).all()


SMPL_STANDING = np.zeros((24, 3))
for _name, _y in (("hip", 0.1), ("shoulder", 0.2)):
    SMPL_STANDING[SMPL24.index(f"left_{_name}"), 1] = _y
    SMPL_STANDING[SMPL24.index(f"right_{_name}"), 1] = -_y


# ---- damage


@pytest.fixture
def copy(sets, tmp_path):
    return shutil.copytree(sets / "humanm3", tmp_path / "humanm3")


def test_a_damaged_shard_is_skipped_counted_and_named(copy):
    shards = [shard_path(copy, "labelled", k) for k in range(open_dataset(copy).card.count)]
    split = [next(iter(read_rows(path, "labelled")))["split"] for path in shards]
    first, second = (path for path, name in zip(shards, split, strict=True) if name == "test")
    first.write_bytes(first.read_bytes()[:-20])
    model = Fake(standing)
    result = judged(copy.parent, "humanm3", model).result
    assert result.counts["people"] == len(model.clouds) == 8
    assert result.skipped["damaged shards"]["count"] == 1 and first.name in result.skipped["damaged shards"]["first"]
    second.write_bytes(b"PAR1")
    with pytest.raises(InputError, match="nobody in test or val"):
        judged(copy.parent, "humanm3", model)
    for path in shards:
        path.write_bytes(b"PAR1")
    with pytest.raises(InputError, match="none of the 3 shards"):
        judged(copy.parent, "humanm3", model)


def test_a_shard_that_breaks_half_way_is_left_out_whole(copy):
    path = shard_path(copy, "labelled", 1)
    data = bytearray(path.read_bytes())
    # within the points: the split column can still be read
    at = len(data) // 3
    data[at : at + 64] = bytes(64)
    path.write_bytes(bytes(data))
    result = judged(copy.parent, "humanm3", Fake(standing), split="all").result
    assert result.counts["people"] == 16
    assert result.skipped["people of damaged shards"]["count"] == 8
    assert path.name in result.skipped["damaged shards"]["first"]
    # a second reading counts no more
    task = eval_setup(Fake(standing), open_eval_dataset(copy, split="all"))
    assert (
        evaluate_dataset(task).result == evaluate_dataset(task).result
        and evaluate_dataset(task).result.skipped == result.skipped
    )


def test_a_missing_shard_is_an_unfinished_dataset(copy):
    shard_path(copy, "labelled", 0).unlink()
    with pytest.raises(InputError, match="not finished"):
        open_eval_dataset(copy)


def test_who_the_released_code_leaves_out_is_counted(sets, tmp_path):
    copied = shutil.copytree(sets / "leaking", tmp_path / "leaking")
    path = shard_path(copied, "labelled", 0)
    rows = list(read_rows(path, "labelled"))
    tests = [k for k, row in enumerate(rows) if row["split"] == "test"]
    rows[tests[0]]["points"] = rows[tests[0]]["points"][:15]
    rows[tests[1]]["center_trans"] = None
    write_shard(path, "labelled", rows)
    before = judged(sets, "leaking", Fake(standing), protocol="dapt").result
    after = judged(tmp_path, "leaking", Fake(standing), protocol="dapt").result
    assert after.counts["people"] == before.counts["people"] - 2
    assert after.skipped["people of under 10 points, as the released code skips them"]["count"] == 1
    assert after.skipped["people without the center 'trans'"]["count"] == 1
    # nor are they disturbed
    task = eval_setup(Fake(standing), open_eval_dataset(tmp_path / "leaking"), protocol="dapt")
    assert len(robustness.people_to_perturb(task)) == after.counts["people"]


def test_the_released_protocol_is_one_look(sets):
    model = Fake(standing)
    model.model["tta"] = 4
    assert judged(sets, "humanm3", model)
    with pytest.raises(InputError, match="dapt is one look at each person"):
        judged(sets, "humanm3", model, protocol="dapt")


# ---- files


@pytest.fixture(scope="module")
def written(sets, tmp_path_factory):
    """What the bundled weights make of a real and of the synthetic set."""
    run = evaluation.run("tiny", [sets / "waymo", sets / "humanm3", "bench"], limit=16, legacy=True, command="as typed")
    folder = tmp_path_factory.mktemp("out") / "new"
    return run, folder, evaluation.write(run, folder)


def test_what_cannot_be_written_or_disturbed_is_known_before_anybody_is_judged(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run_module, "evaluate_dataset", None)
    (tmp_path / "file").write_text("")
    for out in ("file", "file/deep"):
        assert main(["evaluate", "tiny", "bench", "--limit", "2", "--out", str(tmp_path / out)]) == 2
        assert "file" in capsys.readouterr().err
    # of a single person of the bench nobody is clean
    assert main(["evaluate", "tiny", "bench", "--limit", "1", "--stability", "--out", str(tmp_path / "new")]) == 2
    assert "judge more people, or no --stability" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "model, dataset, options, words",
    [
        (3, "bench", {}, "expected a network to judge"),
        ("tiny", None, {}, "expected a dataset to judge"),
        ("tiny", "bench", {"limit": "4"}, "limit must be a whole number of at least 1 person, got '4'"),
        ("tiny", "bench", {"limit": 4.0}, "limit must be a whole number"),
        (Fake(None), "bench", {"tta": 4}, "of weights by name or path: give them to load instead"),
    ],
)
def test_arguments_of_the_wrong_kind_are_told(model, dataset, options, words):
    with pytest.raises(InputError, match=words):
        evaluation.evaluate(model, dataset, **options)


def test_numpy_s_numbers_and_one_dataset_alone_are_judged_and_written(tmp_path):
    run = evaluation.run("tiny", "bench", limit=np.int64(3), seed=np.int32(2))
    evaluation.write(run, tmp_path / "new")
    assert evaluation.read_scores(tmp_path / "new").results == run.scores.results
    assert evaluation.table(tmp_path / "new") == evaluation.table([tmp_path / "new"])


def test_every_figure_can_be_computed_from_the_poses(written):
    run, folder, _ = written
    scores, people = evaluation.read_scores(folder), evaluation.read_poses(folder / "poses.parquet")
    assert list(people) == ["waymo", "humanm3", "lidarpose-bench-1"]
    for result in scores.results:
        again = metric_rows(people[result.setting.dataset], result.setting, dapt_compat=True)
        own = tuple(line for line in result.lines if line.method == result.setting.method)
        assert again == own and len(own) > 30
    # and by anybody else, from the table alone
    import pandas

    table = pandas.read_parquet(folder / "poses.parquet")
    for name, rows in table.groupby("dataset"):
        each = rows["error_mm"].map(np.nanmean)
        wanted = next(r for r in scores.results if r.setting.dataset == name).line("mpjpe")
        assert each.mean() == pytest.approx(wanted.value, abs=1e-3)


def test_scores_come_back_as_they_were(written):
    run, folder, paths = written
    assert evaluation.read_scores(folder) == evaluation.read_scores(folder / "scores.json") == run.scores
    found = json.loads((folder / "scores.json").read_text())
    assert found["schema"] == "lidarpose.scores/1" and found["command"] == "as typed"
    assert len(found["weights"]["digest"]) == 64 and found["weights"]["file"] == "tiny.safetensors"
    for result in found["results"]:
        for line in result["lines"]:
            assert {line[key] for key in ("protocol", "centring")} == {"clean", "points alone"}
            assert line["split"] == result["setting"]["split"]
    assert {path.name for path in paths} == {path.name for path in folder.iterdir()}
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in paths if path.suffix == ".png")
    assert sum(path.suffix == ".png" for path in paths) == 9


def test_limits_and_floors_are_told_in_the_lines(written):
    result = written[0].scores.results[2]
    assert result.setting.limit == 16 and result.setting.total == 2000
    assert all(line.limit == 16 for line in result.lines)
    floor = result.line("mpjpe", method="floor: mean pose, true facing")
    assert result.line("mpjpe").value < floor.value < result.line("mpjpe", method="floor: mean pose").value
    # four waymo people are all there are
    assert written[0].scores.results[0].setting.limit is None


def test_released_arithmetic_stands_beside(written):
    result = written[0].scores.results[0]
    people = evaluation.read_poses(written[1] / "poses.parquet")["waymo"]
    known = people.labels > 0
    wanted = metrics.by_group(metrics.joint_errors(people.pred, people.true, known), "waymo14", empty=0.0)["head"]
    assert result.line("mpjpe", "joints", "head", arithmetic="released").value == pytest.approx(wanted)
    # labels are missing there, so the released alignment has nothing to align
    with pytest.raises(InputError, match="no line"):
        result.line("pa_mpjpe", arithmetic="released")
    assert written[0].scores.results[1].line("pa_mpjpe", arithmetic="released").value > 0


def test_all_files_or_none(written, tmp_path, monkeypatch):
    run, folder, _ = written
    run = replace(run, evaluations=run.evaluations[:1])
    with pytest.raises(InputError, match="holds other files"):
        evaluation.write(run, folder)
    with pytest.raises(InputError, match="is a file; give a new or empty folder"):
        evaluation.write(run, folder / "scores.json")

    def broken(path, judged):
        path.write_bytes(b"half")
        raise InputError("no more")

    monkeypatch.setattr(run_module, "write_poses", broken)
    with pytest.raises(InputError, match="no more"):
        evaluation.write(run, tmp_path / "deep" / "new")
    assert not (tmp_path / "deep").exists()


def test_other_files_are_no_scores(tmp_path):
    for content, words in (
        ("{}", "'schema' is missing"),
        ("[1]", "no scores.json"),
        ('{"schema": "x/9"}', "x/9"),
        ("a", "no s"),
    ):
        (tmp_path / "scores.json").write_text(content)
        with pytest.raises(InputError, match=words):
            evaluation.read_scores(tmp_path)
    (tmp_path / "poses.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match="is no poses.parquet"):
        evaluation.read_poses(tmp_path / "poses.parquet")


def test_scores_whose_words_are_none_are_no_scores(written, tmp_path):
    good = json.loads((written[1] / "scores.json").read_text())
    for change in ({"digest": -1}, {"digest": float("nan")}):
        (tmp_path / "a.json").write_text(json.dumps(good | {"weights": good["weights"] | change}))
        with pytest.raises(InputError, match="no scores.json .*digest"):
            evaluation.table([tmp_path / "a.json"])
    good["results"][0]["setting"]["dataset"] = []
    (tmp_path / "a.json").write_text(json.dumps(good))
    with pytest.raises(InputError, match="no scores.json .*dataset is no text"):
        evaluation.table([tmp_path / "a.json"])


def test_a_table_never_replaces_its_scores(written, capsys):
    path = written[1] / "scores.json"
    before = path.read_bytes()
    for named in (written[1], path):
        assert main(["table", str(named), "--out", str(path)]) == 2
        assert "is itself what is read" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_folders_are_numbered(tmp_path):
    assert evaluation.new_folder("tiny", tmp_path) == tmp_path / "tiny"
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny-2").mkdir()
    assert evaluation.new_folder("tiny", tmp_path) == tmp_path / "tiny-3"
    assert evaluation.new_folder("x/best.safetensors", tmp_path) == tmp_path / "best"


def test_two_of_one_name_are_refused(sets):
    with pytest.raises(InputError, match="two datasets are called"):
        evaluation.run("tiny", ["bench", "bench"])


def test_the_public_name_is_there():
    assert lidarpose.evaluation.evaluate is evaluation.evaluate and "evaluation" in dir(lidarpose)


@pytest.mark.slow
def test_the_figures_of_the_docs_are_those_of_the_bundled_weights_on_the_bench():
    root = Path(__file__).parents[1]
    result = evaluation.evaluate(DEFAULT, "bench")
    stored = evaluation.read_scores(root / "docs" / "scores" / f"{DEFAULT}.json").results[0]
    for line in stored.lines:
        if line.method != stored.setting.method:
            continue
        now = result.line(line.figure, line.group, line.of)
        assert now.value == pytest.approx(line.value, abs=0.051), (line.figure, line.group, line.of)
    assert f"**{result.line('mpjpe').value:.1f}**" in (root / "README.md").read_text("utf-8")
    assert result.line("mpjpe", method="floor: mean pose, true facing").value == pytest.approx(267.1, abs=0.05)
    assert result.counts == {"people": 2000, "frames of clips": 960, "without a pose": 0}
    assert len(load_bench().people) == 2000


def test_evaluate_looks_as_often_as_asked_for():
    assert evaluation.run("tiny", "bench", limit=2, tta=2).scores.weights["tta"] == 2


def test_evaluate_hides_the_sensor():
    assert evaluation.evaluate("tiny", "bench", limit=2, sensor_unknown=True).setting.sensor == "unknown"


def test_dapt_s_poses_are_in_the_dataset_s_frame(sets):
    people = list(open_eval_dataset(sets / "humanm3"))
    pick = [HUMAN15.index(name) if name in HUMAN15.joints else 0 for name in BODY26.joints]
    known = knowing(people, (0.06, 0, 0.08))
    task = eval_setup(Fake(lambda cloud: known(cloud)[pick]), open_eval_dataset(sets / "humanm3"), protocol="dapt")
    assert evaluate_dataset(task).result.line("mpjpe").value == pytest.approx(100, abs=1e-2)


def test_the_worst_are_the_worst(sets):
    found = evaluate_dataset(eval_setup(Fake(standing), open_eval_dataset(sets / "humanm3", split="all")))
    error = found.predictions.errors().mean(1)
    assert len(error) == 24 and [k for _, k in found.worst] == np.argsort(-error, kind="stable").tolist()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Synthesized people of seed 0."""
    folder = tmp_path_factory.mktemp("made") / "people"
    write_dataset(Job(what="people", count=3, hard=0.0, sensors=("os1-128",)), folder)
    return folder


@pytest.mark.parametrize(
    "recipe, knows",
    [
        ({"seed": 0, "scene": "wild", "shards": []}, True),
        ({"seed": 0, "scene": "wild", "split": "train", "mix": 0.25}, True),
        ({"seed": 0, "scene": "wild", "split": "train", "mix": 0.0}, False),
        ({"seed": 0, "scene": "wild", "shards": ["others"]}, False),
        ({"seed": 1, "scene": "wild", "shards": []}, False),
        ({"seed": 0, "scene": "paper", "shards": []}, False),
    ],
)
def test_people_of_the_seed_that_a_network_learned_from_are_no_strangers(made, recipe, knows):
    """Person i of a seed has the same body, pose and place at any difficulty."""
    model = Fake(standing)
    model.header = SimpleNamespace(card={"recipe": {"seed": 5, "scene": "wild"}, "init_card": {"recipe": recipe}})
    notes = evaluate_dataset(eval_setup(model, open_eval_dataset(made))).result.notes
    assert any("of seed 0, as these are" in note for note in notes) == knows


def test_what_is_hidden_is_not_visible(made):
    for one, row in zip(open_eval_dataset(made), open_dataset(made).rows(), strict=True):
        assert 1 - one.info.visible == pytest.approx(1 - row["visible"], abs=1e-6)
    visible = load_bench().columns["visible"]
    for one in open_eval_dataset("bench", limit=9):
        assert 1 - one.info.visible == pytest.approx(1 - visible[one.row], abs=1e-6)
