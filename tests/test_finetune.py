"""Fine-tuning: reading of datasets, augmentation, sampling, and runs from raw files to scores."""

import itertools
import json
import shutil
from dataclasses import replace

import dataset_files as files
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import waymo_files
from hypothesis import given, settings, strategies as st
from training_runs import few_to_validate_on, refused, train_until_killed  # noqa: F401 - a fixture

from lidarpose import evaluation
from lidarpose.cli import main
from lidarpose.data.prepare import READERS, prepare
from lidarpose.data.shards import open_dataset, shard_path
from lidarpose.errors import InputError
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.inference.predictor import load
from lidarpose.models import weights_file
from lidarpose.models.checkpoint import load_checkpoint, read_header
from lidarpose.sample import SEEN, UNLABELED, Box, LabeledSample, Pose, center_of
from lidarpose.skeleton import BODY26, HUMAN15, skeleton
from lidarpose.synth.generator import Generator
from lidarpose.synth.shard_job import SynthesisJob, write_dataset
from lidarpose.train import loop, run_dir
from lidarpose.train.augment import (
    AUGMENTATIONS,
    BLIND,
    PELVIS_ERROR,
    Augmentation,
    augmentation,
    augmented,
    example,
    visible_joints,
)
from lidarpose.train.data_loader import MixedSource, StoredSource, SyntheticSource
from lidarpose.train.networks import PRETRAINED, expanded_network, initial_network
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.setup import make_setup
from lidarpose.train.torch_dataset import InMemoryDataset


def write_waymo(root, smpl):
    waymo_files.write_v2(root)
    waymo_files.write_v2(root, segment="10203656353524179475_7625_000_7645_000", split="validation")


WRITERS = {
    "humanm3": lambda root, smpl: files.write_humanm3(
        root, smpl, sequences=("train/a", "train/b", "train/c", "test/d")
    ),
    "lidarhuman26m": lambda root, smpl: files.write_lidarhuman26m(root, smpl, sequences=("5", "6", "7")),
    "sloper4d": files.write_sloper4d,
    "waymo": write_waymo,
}


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """Name -> prepared folder."""
    root = tmp_path_factory.mktemp("datasets")
    smpl, out = files.write_smpl(root / "SMPL_NEUTRAL.npz"), {}
    for name, write in WRITERS.items():
        write(root / f"raw-{name}", smpl)
        out[name] = root / name
        prepare(name, root / f"raw-{name}", out[name], smpl=smpl if READERS[name][2] else None, progress=False)
    return out


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic") / "people"
    write_dataset(SynthesisJob(what="people", count=6, scene="paper", seed=3), folder)
    return folder


# --- reading of datasets


@pytest.mark.parametrize("name", WRITERS)
def test_in_memory_dataset_equals_prepared_dataset(datasets, name):
    dataset, items = InMemoryDataset.load([datasets[name]]), list(open_dataset(datasets[name]))
    of = skeleton(dataset.skeleton)
    others = [k for k, joint in enumerate(BODY26.joints) if joint not in of.joints]
    assert dataset.dataset == name and not dataset.damaged
    left = dataset.without(dataset.sequences[:1])
    for some, expected in (dataset, items), (left, [item for item in items if item.sequence != dataset.sequences[0]]):
        assert len(some) == len(expected)
        for row, item in enumerate(expected):
            sample = some.sample(row)
            for field in ("points", "center", "sequence", "sensor_known"):
                np.testing.assert_array_equal(getattr(sample, field), getattr(item, field))
            np.testing.assert_allclose(sample.joints[BODY26.map_to(of)], item.joints, atol=1e-6)
            assert np.isnan(sample.joints[others]).all() and np.isnan(sample.pose.visible[others]).all()
            assert sample.centers.keys() == item.centers.keys() and (sample.box is None) == (item.box is None)
            for key, center in item.centers.items():
                np.testing.assert_array_equal(sample.centers[key], center)
            if item.box is not None:
                np.testing.assert_array_equal(sample.box.center, item.box.center)
                np.testing.assert_array_equal([*sample.box.size, sample.box.yaw], [*item.box.size, item.box.yaw])
    if name in ("humanm3", "waymo"):
        assert all(item.box is not None and item.sensor_known == (name == "waymo") for item in items)
    # only datasets that label hidden joints have visibility
    visible = np.stack([dataset.sample(row).pose.visible for row in range(len(dataset))])
    assert set(visible[~np.isnan(visible)]) == ({0.0, 1.0} if name == "waymo" else set())


def test_in_memory_dataset_selects_split_interval_and_sequences(datasets):
    folder = datasets["humanm3"]
    everybody = InMemoryDataset.load([folder])
    train, test = (InMemoryDataset.load([folder], split=split) for split in ("train", "test"))
    assert len(train) + len(test) == len(everybody) and test.sequences == ("test/d",)
    assert set(train.sequences) == {"train/a", "train/b", "train/c"}
    assert len(everybody.without(["train/a"])) == len(everybody) * 3 // 4
    # every person has frames 7, 8 and 9
    assert len(InMemoryDataset.load([folder], interval=4)) == len(everybody) // 3
    assert len(InMemoryDataset.load([folder, folder])) == 2 * len(everybody)
    # Waymo's frames are time stamps, two per person, in order
    waymo = datasets["waymo"]
    frames = [(item.sequence, item.track, item.frame) for item in open_dataset(waymo).items()]
    first = {whose: min(f for *w, f in frames if tuple(w) == whose) for whose in {tuple(w) for *w, _ in frames}}
    assert len(InMemoryDataset.load([waymo], interval=2)) == len(first) < len(frames)


def test_synthetic_shards_have_visibility_and_accept_noise(synthetic):
    """Joint visibility is known and noise can be added, as with people synthesized during training."""
    dataset, items = InMemoryDataset.load([synthetic]), list(open_dataset(synthetic))
    # single people belong to no sequence: the interval does not apply
    assert len(InMemoryDataset.load([synthetic], interval=5)) == len(dataset) == 6
    assert dataset.dataset == "" and dataset.skeleton == "body26"
    samples = [dataset.sample(row) for row in range(6)]
    assert any((sample.part > 0).any() for sample in samples) and all(sample.sensor_known for sample in samples)
    for sample, item in zip(samples, items, strict=True):
        np.testing.assert_array_equal(sample.pose.visible, example(item, np.random.default_rng(0)).visible)
    assert {0.0, 1.0} == set(np.ravel([sample.pose.visible for sample in samples]))
    plain, other = (make_setup(Pretrain(shards=synthetic, strays=s, noise=s)).source for s in (0.0, 1.0))
    for index in range(6):
        a, b = plain.example(index), other.example(index)
        assert len(b.points) > len(a.points) and (b.part[len(a.part) :] == 0).all()
        np.testing.assert_allclose(np.ptp(b.joints, 0)[2], np.ptp(a.joints, 0)[2], atol=1e-5)
    assert sorted(len(plain.example(k).points) for k in range(6)) == sorted(len(item.points) for item in items)


def test_dataset_without_people_of_the_split_is_named(datasets, tmp_path):
    empty = shutil.copytree(datasets["humanm3"], tmp_path / "empty")
    for shard in empty.rglob("labelled*.parquet"):
        table = pq.read_table(shard)
        split = pa.array(["test"] * len(table), table.schema.field("split").type)
        pq.write_table(table.set_column(table.schema.get_field_index("split"), "split", split), shard)
    folders = [datasets["humanm3"], empty]
    dataset = InMemoryDataset.load(folders, split="train")
    assert dataset.empty == (str(empty),) and len(dataset) == len(InMemoryDataset.load(folders[:1], split="train"))
    warning, *_ = make_setup(Finetune(data=tuple(map(str, folders)), mix=0.0)).warnings
    assert warning == f"{empty} has no labeled people for the training, see its splits"


def test_in_memory_dataset_skips_and_names_damaged_shard(datasets, tmp_path):
    folder = shutil.copytree(datasets["humanm3"], tmp_path / "copy")
    broken = shard_path(folder, "labelled", 1)
    broken.write_bytes(broken.read_bytes()[:-200])
    dataset = InMemoryDataset.load([folder])
    assert len(dataset) == len(InMemoryDataset.load([datasets["humanm3"]])) * 3 // 4
    assert len(dataset.damaged) == 1 and str(broken) in dataset.damaged[0]
    setup = make_setup(Finetune(data=(str(folder),), mix=0.0))
    warning, _ = setup.warnings
    # not that there is no validation
    assert setup.card["warnings"] == [warning]
    assert str(broken) in warning and warning.startswith("left out 1 damaged shards: ")
    # a missing shard is an error: the dataset is incomplete
    broken.unlink()
    with pytest.raises(InputError, match="is missing"):
        InMemoryDataset.load([folder])


# --- augmentation


def someone(seed=0, count=80):
    rng = np.random.default_rng(seed)
    joints = rng.normal(0, 0.4, (26, 3)) + [6.0, 2.0, 0.0]
    joints[rng.random(26) < 0.2] = np.nan
    points = (rng.normal(0, [0.2, 0.2, 0.5], (count, 3)) + [6.0, 2.0, 0.0]).astype(np.float32)
    labels = np.where(np.isnan(joints).any(-1), UNLABELED, SEEN).astype(np.uint8)
    return LabeledSample(
        points=points,
        part=rng.integers(-1, 25, count).astype(np.int16),
        pose=body26(joints, np.where(labels, 1.0, np.nan)),
        joint_labels=labels,
        center=points.mean(0).astype(float),
        centers={"box": np.array([6.1, 2.0, 0.1])},
        box=Box(center=(6.0, 2.0, 0.0), size=(1.0, 1.0, 2.0), yaw=0.3),
    )


def body26(joints, visible):
    return Pose(joints=joints.astype(np.float32), visible=visible.astype(np.float32), skeleton=BODY26)


RIGID = Augmentation(turn=1.0, flip=0.5)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 100))
def test_augmented_moves_points_joints_and_view_together(seed, number):
    person = someone(number)
    shown = augmented(person, RIGID, np.random.default_rng(seed))
    before = np.linalg.norm(person.points[:, None] - person.joints, axis=-1)
    after = np.linalg.norm(shown.points[:, None] - shown.joints, axis=-1)
    flip = list(BODY26.flip)
    mirrored = np.allclose(np.nan_to_num(after), np.nan_to_num(before[:, flip]), atol=1e-4)
    assert mirrored or np.allclose(np.nan_to_num(after), np.nan_to_num(before), atol=1e-4)
    # left and right are swapped only if the points are mirrored
    R = np.linalg.lstsq(person.points - person.points.mean(0), shown.points - shown.points.mean(0))[0]
    assert (np.linalg.det(R) < 0) == mirrored
    unlabelled = np.isnan(person.joints).any(-1)
    np.testing.assert_array_equal(np.isnan(shown.joints).any(-1), unlabelled[flip] if mirrored else unlabelled)
    if shown.view[4]:
        # distances between sensor and points stay the same
        sensor = shown.view[:3] * np.exp(shown.view[3])
        np.testing.assert_allclose(
            np.linalg.norm(shown.points - sensor, axis=1), np.linalg.norm(person.points, axis=1), atol=1e-3
        )


def test_augmented_scales_points_and_joints_alike():
    person, scales = someone(), []
    before = np.linalg.norm(person.points[:, None] - person.joints, axis=-1)
    for seed in range(40):
        shown = augmented(person, Augmentation(scale=0.1), np.random.default_rng(seed))
        ratio = np.linalg.norm(shown.points[:, None] - shown.joints, axis=-1) / before
        scales.append(np.nanmean(ratio))
        np.testing.assert_allclose(ratio[~np.isnan(ratio)], scales[-1], atol=1e-3)
    assert 0.9 <= min(scales) < 0.93 and 1.07 < max(scales) <= 1.1


def test_augmented_flip_swaps_visibility_and_parts():
    sample, mirrored = someone(), 0
    visible = np.where(np.isnan(sample.pose.visible), np.nan, np.arange(26) % 2).astype(np.float32)
    sample = replace(sample, pose=body26(sample.joints, visible))
    left, right = 1 + BODY26.index("left_ankle"), 1 + BODY26.index("right_ankle")
    for seed in range(40):
        shown = augmented(sample, RIGID, np.random.default_rng(seed))
        exchanged = (shown.part != sample.part).any()
        mirrored += exchanged
        np.testing.assert_array_equal(shown.visible, visible[list(BODY26.flip)] if exchanged else visible)
        assert (np.isnan(shown.joints) != np.isnan(sample.joints)).any() == exchanged
        np.testing.assert_array_equal(shown.part == left, sample.part == (right if exchanged else left))
        for kept in (-1, 0):
            np.testing.assert_array_equal(shown.part == kept, sample.part == kept)
    assert 10 < mirrored < 30


@pytest.mark.parametrize("labeled", [True, False])
def test_augmented_refined_centers_on_noisy_pelvis(labeled):
    joints = np.nan_to_num(someone().joints, nan=6.0)
    hips = [BODY26.index(f"{side}_hip") for side in ("left", "right")]
    if not labeled:
        joints[BODY26.index("pelvis")] = np.nan
    labels = np.where(np.isnan(joints).any(1), UNLABELED, SEEN)
    person = replace(someone(), pose=body26(joints, np.ones(26)), joint_labels=labels)
    rows = [BODY26.index("pelvis")] if labeled else hips

    def pelvis(person):
        return person.joints[rows].mean(0)

    draw = [pelvis(augmented(person, Augmentation(pelvis_centered=1.0), np.random.default_rng(k))) for k in range(300)]
    np.testing.assert_allclose(np.std(draw, 0), PELVIS_ERROR, rtol=0.2)
    np.testing.assert_allclose(np.mean(draw, 0), 0, atol=0.02)
    still = [pelvis(augmented(person, Augmentation(pelvis_centered=0.0), np.random.default_rng(k))) for k in range(3)]
    np.testing.assert_allclose(still, [pelvis(person) - center_of(person.points)] * 3, atol=1e-5)


@pytest.mark.parametrize("how", [Augmentation(cut=1.0), Augmentation(box=1.0)], ids=["cut", "box"])
def test_augmented_cut_and_box_update_visibility(how):
    person, hidden = someone(count=60), 0
    body = person.part != 0
    # labels that are correct before the augmentation
    visible = np.where(np.isnan(person.pose.visible), np.nan, visible_joints(person.joints, person.points[body]))
    person = replace(person, pose=body26(person.joints, visible))
    for index in range(40):
        shown = augmented(person, how, np.random.default_rng(index))
        wanted = np.where(np.isnan(visible), np.nan, visible_joints(shown.joints, shown.points[shown.part != 0]))
        np.testing.assert_array_equal(shown.visible, wanted)
        hidden += np.nansum(visible) - np.nansum(wanted)
    assert hidden > 4


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_augmented_is_deterministic_and_keeps_input(name):
    person, kept = someone(), someone()
    a, b = (augmented(person, augmentation(name), np.random.default_rng(4)) for _ in range(2))
    for field in ("points", "part", "joints", "visible", "view", "seed"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    for field in ("points", "part", "joints", "center"):
        np.testing.assert_array_equal(getattr(person, field), getattr(kept, field))
    np.testing.assert_array_equal(person.pose.visible, kept.pose.visible)
    assert a.points.dtype == a.joints.dtype == a.view.dtype == np.float32 and len(a.points) == len(a.part)
    # few points
    for seed, count in itertools.product(range(20), (1, 2, 6)):
        few = augmented(someone(count=count), augmentation(name), np.random.default_rng(seed))
        assert np.isfinite(few.points).all()


def test_paper_augmentation_uses_available_center():
    person, still = someone(), replace(augmentation("paper"), turn=0.0, scale=0.0, flip=0.0, jitter=0.0, drop=0.0)
    shown = augmented(person, still, np.random.default_rng(0))
    inside = person.box.contains(person.points)
    np.testing.assert_allclose(shown.points, person.points[inside] - person.centers["box"], atol=1e-5)
    trans = replace(person, centers={"trans": np.array([5.0, 2.0, 0.0])})
    shown = augmented(trans, still, np.random.default_rng(0))
    np.testing.assert_allclose(shown.points, person.points - [5.0, 2.0, 0.0], atol=1e-5)
    joints = replace(person, centers={"joints_box": np.array([6.0, 2.0, 0.0])})
    shown = augmented(joints, still, np.random.default_rng(0))
    low, high = np.nanmin(person.joints, 0), np.nanmax(person.joints, 0)
    kept = (np.abs(person.points - (low + high) / 2) <= 0.625 * (high - low)).all(1)
    np.testing.assert_allclose(shown.points, person.points[kept] - [6.0, 2.0, 0.0], atol=1e-5)


# --- sampling of people


def stored(datasets, name="humanm3", **more):
    return StoredSource(
        dataset=InMemoryDataset.load([datasets[name]]), seed=1, augmentation=AUGMENTATIONS["none"], **more
    )


def test_stored_source_epochs_are_different_permutations(datasets):
    source = stored(datasets)
    count = len(source.dataset)
    # the vector between two joints identifies a person
    everybody = {tuple(p.joints[0] - p.joints[1]) for p in map(source.dataset.sample, range(count))}
    epochs = [
        [tuple((e.joints[0] - e.joints[1]).round(4)) for e in map(source.example, range(n * count, (n + 1) * count))]
        for n in range(3)
    ]
    for epoch in epochs:
        assert len(set(epoch)) == len(everybody) == count
    assert epochs[0] != epochs[1] != epochs[2]
    # independent of earlier requests
    again = stored(datasets)
    np.testing.assert_array_equal(again.example(2 * count + 1).points, source.example(2 * count + 1).points)


def test_changes_of_scene_reach_people_that_are_mixed_in(datasets):
    changed, plain = (
        make_setup(Finetune(data=(str(datasets["humanm3"]),), hold_out=0.34, set=changes)).source.other
        for changes in (("keep=0.3", "mask=1"), ())
    )
    assert changed.set == ("keep=0.3", "mask=1") and plain.set == ()
    counts = [sum(len(source.example(k).points) for k in range(12)) for source in (changed, plain)]
    assert counts[0] < 0.8 * counts[1]
    # not the people that pre-training with the same seed began with
    first, earlier = (source.example(0) for source in (plain, SyntheticSource(scene=plain.scene, seed=plain.seed)))
    assert not np.array_equal(first.points, earlier.points)
    # the configuration of a run from before this setting
    old = {key: value for key, value in Finetune(data=("a",)).to_dict().items() if key != "set"}
    assert Finetune(**old) == Finetune(data=("a",))


def test_mixed_source_mixes_by_share(datasets):
    main, other = stored(datasets), SyntheticSource(scene="paper", seed=1)
    mixed = MixedSource(main=main, other=other, share=0.3)
    shown = [mixed.example(k) for k in range(120)]
    synthesized = np.array([not np.isnan(one.joints).any() for one in shown])
    assert synthesized.sum() == 36 and all(synthesized[k : k + 10].sum() == 3 for k in range(0, 120, 10))
    # neither source skips a person
    for source, people in ((main, np.flatnonzero(~synthesized)), (other, np.flatnonzero(synthesized))):
        for place, k in enumerate(people[:20]):
            np.testing.assert_array_equal(shown[k].points, source.example(place).points)
    alone = MixedSource(main=main, other=other, share=0.0)
    np.testing.assert_array_equal(alone.example(3).points, main.example(3).points)


@pytest.mark.parametrize(
    "name, settings, held_out, watched",
    [
        ("humanm3", {}, ["train/c"], 6),
        # Waymo has a validation split; training on it leaves no validation people
        ("waymo", {}, [], 4),
        ("waymo", {"split": "val"}, [], 0),
        # a single training sequence is not held out
        ("sloper4d", {}, [], 0),
    ],
)
def test_finetune_holds_out_sequences_without_val_split(datasets, name, settings, held_out, watched):
    setup = make_setup(Finetune(data=(str(datasets[name]),), mix=0.0, **settings))
    assert setup.card["held_out_sequences"] == held_out and not {*held_out} & {*setup.source.dataset.sequences}
    assert len(setup.validation()) == watched
    reason = "there is no split val, and there are too few sequences to hold one out"
    reason = "none are held out from training (--hold-out)" if settings.get("hold_out") == 0 else reason
    assert setup.warnings == (() if watched else (f"no validation people: {reason}",))


def test_scene_of_mixed_people_needs_mixed_people(datasets):
    for changes in ({"scene": "paper"}, {"scene": "nonsense"}, {"set": ("keep=0.5",)}):
        with pytest.raises(InputError, match="--scene, --set and --keep change the people that are mixed in"):
            Finetune(data=(str(datasets["humanm3"]),), mix=0.0, **changes)


def test_setups_of_trained_weights_can_be_used_twice(datasets):
    """Training changes the network in place: each run of a setup starts from the same weights."""
    setup = make_setup(Finetune(data=(str(datasets["humanm3"]),), init="tiny", mix=0.0))
    first, second = setup.network(), setup.network()
    assert first is not second
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert a is not b and torch.equal(a, b)


@pytest.mark.parametrize("name, hold_out, watched", [("humanm3", 0.0, 6), ("waymo", 0.1, 4)])
def test_finetune_validates_on_the_named_split(datasets, name, hold_out, watched):
    """As methods whose weights were chosen by test error; no sequence of training is held out then."""
    changes = {"data": (str(datasets[name]),), "mix": 0.0, "hold_out": hold_out}
    split = "test" if name == "humanm3" else "val"
    setup = make_setup(Finetune(**changes, validation_split=split))
    assert not setup.warnings and not setup.card["held_out_sequences"]
    shown = setup.validation()
    dataset = InMemoryDataset.load(changes["data"], split=split)
    assert len(shown) == len(dataset) == watched
    with pytest.raises(InputError, match="validation_split 'train' is trained on: give another --split"):
        make_setup(Finetune(**changes, validation_split="train"))
    with pytest.raises(InputError, match="labeled people in the split 'nothing', got none"):
        make_setup(Finetune(**changes, validation_split="nothing"))


def test_finetune_people_follow_epochs_and_mix(datasets):
    for mix, people in ((0.0, 72), (0.25, 96)):
        setup = make_setup(Finetune(data=(str(datasets["humanm3"]),), epochs=6, mix=mix, hold_out=0.34))
        assert len((setup.source.main if mix else setup.source).dataset) == 12 and setup.people == people


def test_finetune_card_names_dataset_as_in_evaluation(datasets, tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to(datasets["humanm3"])
    monkeypatch.chdir(datasets["humanm3"])
    for folder in (".", tmp_path / "link"):
        card = make_setup(Finetune(data=(folder,), init="tiny")).card
        assert card["data"] == [open_eval_dataset(folder).name] == ["humanm3"]


def test_pretrain_rejects_test_people(datasets, tmp_path):
    with pytest.raises(InputError, match="contains test people, by the split official.*--split train") as error:
        make_setup(Pretrain(shards=(datasets["humanm3"],)))
    assert "\n" not in str(error.value)
    raw = datasets["humanm3"].parent / "raw-humanm3"
    prepare("humanm3", raw, tmp_path / "train", split="train", progress=False)
    dataset = make_setup(Pretrain(shards=(tmp_path / "train",))).source.dataset
    assert dataset.sequences == ("train/a", "train/b", "train/c")
    # LIPD has no split
    files.write_lipd(tmp_path / "raw", files.write_smpl(tmp_path / "SMPL_NEUTRAL.npz"))
    prepare("lipd", tmp_path / "raw", tmp_path / "corpus", progress=False)
    assert len(make_setup(Pretrain(shards=(tmp_path / "corpus",))).source.dataset)


# --- runs

SHORT = {"workers": 0, "pictures": 0, "validate": 1000}


@pytest.mark.long
def test_pretrain_records_shards_in_card(synthetic, tmp_path):
    recipe = Pretrain(shards=(str(synthetic),), people=32, batch=4, scene="paper", **SHORT)
    loop.train(recipe, tmp_path / "run")
    assert read_header(tmp_path / "run" / run_dir.MODEL).card["recipe"]["shards"] == ["people"]


@pytest.mark.long
@pytest.mark.parametrize("name, epochs", [("humanm3", 6), ("lidarhuman26m", 20), ("sloper4d", 30), ("waymo", 20)])
def test_finetune_from_raw_files_to_scores(datasets, name, epochs, tmp_path, capsys, monkeypatch):
    """Prepare, train a few steps, evaluate: labels are unchanged and the error decreases."""
    monkeypatch.chdir(tmp_path)
    words = ["finetune", str(datasets[name]), "--out", "run", "--workers", "0", "--batch", "8", "--mix", "0"]
    assert not main([*words, "--init", "tiny", "--epochs", str(epochs), "--pictures", "2"])
    network, header = load_checkpoint("run/model.safetensors")
    # same skeleton for all datasets, so the configuration is that of the bundled weights
    assert header.config == load("tiny").header.config and header.card["data"] == [name]
    assert not main(["evaluate", "run/model.safetensors", str(datasets[name]), "--out", "scores"])
    assert "MPJPE" in capsys.readouterr().out
    scores = json.loads((tmp_path / "scores" / "scores.json").read_text())
    tuned = evaluation.read_scores(tmp_path / "scores").results[0]
    untrained = evaluation.evaluate("tiny", datasets[name])
    assert tuned.line("mpjpe").people == untrained.line("mpjpe").people > 0 and scores
    assert tuned.line("mpjpe").value < 0.9 * untrained.line("mpjpe").value
    (judged,) = evaluation.read_poses(tmp_path / "scores" / "poses.parquet").values()
    truth = {(i.sequence, i.frame, i.track): i.joints for i in open_dataset(datasets[name]).items()}
    for row in range(len(judged.true)):
        known = truth[judged.sequence[row], judged.frame[row], judged.track[row]]
        np.testing.assert_allclose(judged.true[row], known, atol=1e-3)


PAPER = ["--recipe", "paper", "--batch", "4", "--workers", "0", "--pictures", "0", "--validate", "1000"]


def two_stages(people, neck, *words):
    """Trains both stages of the paper's network on the command line and evaluates it."""
    assert not main(["pretrain", "first", "--size", "paper-tiny", "--neck", neck, "--people", "16", *PAPER])
    tuned = ["finetune", str(people), "--out", "second", "--init", "first/model.safetensors", "--epochs", "1"]
    assert not main([*tuned, *words, *PAPER])
    assert not main(["evaluate", "second/model.safetensors", str(people), "--protocol", "dapt"])


@pytest.mark.long
def test_cli_trains_paper_network_in_two_stages(datasets, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    two_stages(datasets["humanm3"], "mde", "--keep-anchors", "true")
    assert "MPJPE" in capsys.readouterr().out
    (pretrained, first), (_, second) = (load_checkpoint(f"{name}/model.safetensors") for name in ("first", "second"))
    assert first.config.coordinates and not first.config.bins and first.config.parts == 25
    assert second.config.bins == (140, 140, 220) and not (second.config.coordinates or second.config.parts)
    assert second.config.joints == HUMAN15.joints and not second.config.stale_convolution
    recipe, anchors = run_dir.read_config(tmp_path / "second", Finetune)[0], "backbone.keypoint_embedding"
    assert recipe.keep_anchors
    for keep in (True, False):
        begun = make_setup(replace(recipe, keep_anchors=keep)).network().state_dict()
        assert torch.equal(begun[anchors], pretrained.state_dict()[anchors]) == keep


@pytest.mark.long
@pytest.mark.parametrize("neck", ["finest", "prn"])
def test_cli_trains_necks_with_coordinate_head(datasets, tmp_path, capsys, monkeypatch, neck):
    monkeypatch.chdir(tmp_path)
    two_stages(datasets["humanm3"], neck, "--head", "coordinates")
    assert "MPJPE" in capsys.readouterr().out
    trained, header = load_checkpoint("second/model.safetensors")
    assert header.config.neck == neck and header.config.coordinates and not header.config.bins
    log = [json.loads(line) for line in (tmp_path / "second" / run_dir.LOG).read_text().splitlines()]
    assert "regression" in log[-1] and ("vote" in log[-1]) == (neck == "prn")
    # training from random weights uses the given neck and head
    scratch = {"init": "random", "size": "paper-tiny", "neck": neck, "head": "coordinates", "augment": "paper"}
    setup = make_setup(Finetune(data=(str(datasets["humanm3"]),), mix=0.0, **scratch))
    assert setup.network().state_dict().keys() == trained.state_dict().keys()


@pytest.mark.long
def test_finetune_resumes_killed_run(datasets, tmp_path):
    data = (str(datasets["lidarhuman26m"]),)
    recipe = Finetune(data=data, init="tiny", epochs=3, batch=2, scene="paper", **SHORT)
    loop.train(recipe, tmp_path / "whole")
    train_until_killed(recipe, tmp_path / "run", "_chunk", 2)
    # the dataset may have been moved
    moved = shutil.copytree(datasets["lidarhuman26m"], tmp_path / "lidarhuman26m")
    loop.train(replace(recipe, data=(str(moved),)), tmp_path / "run", resume=True)
    with pytest.raises(InputError, match="a run keeps its recipe"):
        loop.train(replace(recipe, data=(str(datasets["sloper4d"]),)), tmp_path / "run", resume=True)
    whole, broken = (run_dir.read_log(tmp_path / name) for name in ("whole", "run"))
    assert len(whole) == len(broken) == 3
    for a, b in zip(whole, broken, strict=True):
        a.pop("seconds"), b.pop("seconds")
        assert b == pytest.approx(a, abs=2e-4)


@pytest.mark.parametrize(
    "words, told",
    [
        (["nowhere"], "is not a dataset"),
        (["{humanm3}", "--split", "morning"], "expected labeled people in the split 'morning'"),
        (["{humanm3}", "--init", "huge"], "unknown bundled weights 'huge'"),
        (["{humanm3}", "--init", "none.safetensors"], "does not exist"),
        (["{humanm3}", "{waymo}"], "need the same skeleton"),
        (["{synthetic}"], "have no split 'train': give --split all"),
        (["{humanm3}", "--augment", "much"], "unknown augmentation 'much'"),
        (["{humanm3}", "--keep-anchors", "perhaps"], "keep_anchors must be true or false, got 'perhaps'"),
        (["{humanm3}", "--hold-out", "0.99"], "leaves no people for training"),
        (["{humanm3}", "--epochs", "0"], "epochs must be above 0"),
        (["{humanm3}", "--epochs", "inf"], "epochs must be a finite number"),
        (["{humanm3}", "--recipe", "paper"], "give it by --init"),
        (["{humanm3}", "--keep-anchors", "false"], "keep_anchors=false is for the paper's network"),
        (["{humanm3}", "--mix", "1"], "mix must be a share, below 1"),
        ([], "fine-tuning needs a dataset"),
    ],
)
def test_cli_finetune_errors_are_one_line_and_leave_no_folder(
    datasets, synthetic, tmp_path, monkeypatch, capsys, words, told
):
    monkeypatch.chdir(tmp_path)
    words = [word.format(**datasets, synthetic=synthetic) for word in words]
    assert main(["finetune", *words, "--workers", "0"]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_augmented_hides_sensor_at_rate_or_if_unknown():
    person = someone()
    known = [augmented(person, Augmentation(), np.random.default_rng(k)).view[4] for k in range(400)]
    assert np.mean(known) == pytest.approx(1 - BLIND, abs=0.07)
    fused = replace(person, sensor_known=False)
    assert not any(augmented(fused, Augmentation(), np.random.default_rng(k)).view.any() for k in range(40))
    sample = Generator(scene="paper", measure=False).person(1, 0).sample
    known = [example(sample, np.random.default_rng(k)).view[4] for k in range(400)]
    assert np.mean(known) == pytest.approx(1 - BLIND, abs=0.07)


def test_augmented_jitters_drops_and_adds_points():
    plain, jittered, clutter, lost = (
        augmented(someone(count=500), Augmentation(pelvis_centered=0.0, **more), np.random.default_rng(3))
        for more in ({}, {"jitter": 0.005}, {"strays": 1.0}, {"drop": 1.0})
    )
    assert (jittered.points - plain.points).std() == pytest.approx(0.005, rel=0.1)
    assert len(clutter.points) > 500 and len(clutter.points) == len(clutter.part) and not clutter.part[500:].any()
    # about 400 of 500 are kept
    assert len(lost.points) == len(lost.part) and 370 < len(lost.points) < 430


def test_init_rejects_networks_without_poses():
    for name in ("verifier", "detector"):
        with pytest.raises(InputError, match=f"contains the network {name}, which predicts no poses"):
            initial_network(Finetune(data=("any",), init=str(weights_file(f"{name}.safetensors"))))
        with pytest.raises(InputError, match=f"contains the network {name}: --init needs one of the package's own"):
            expanded_network(str(weights_file(f"{name}.safetensors")), PRETRAINED["tiny"][0])
