"""`prepare`: real datasets as shards, restarts, several processes, splits, summary, bad input."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import dataset_files as files
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, settings, strategies as st
from pyarrow import parquet
from shard_files import write_shard

from lidarpose.data import writer
from lidarpose.data.prepare import READERS, PartWriter, prepare, summary_lines
from lidarpose.data.readers.humanm3 import HumanM3
from lidarpose.data.rows import labeled_row, sample_of
from lidarpose.data.shards import open_dataset, read_rows
from lidarpose.data.splits import _published, split_rule
from lidarpose.errors import InputError
from lidarpose.sample import SEEN, UNLABELED, Box, LabeledSample, Pose, center_of
from lidarpose.skeleton import HUMAN15, WAYMO14


@pytest.fixture(scope="module")
def raw(tmp_path_factory, smpl):
    """Raw files of HumanM3 and the true joints."""
    root = tmp_path_factory.mktemp("humanm3")
    truth = files.write_humanm3(root, smpl, sequences=("train/a", "train/b/seg0", "test/c"))
    return root, truth


@pytest.fixture(scope="module")
def prepared(raw, tmp_path_factory):
    out = tmp_path_factory.mktemp("prepared") / "humanm3"
    return out, prepare("humanm3", raw[0], out)


def refused(message, *arguments, **options):
    with pytest.raises(InputError, match=message) as caught:
        prepare(*arguments, **options)
    assert "\n" not in str(caught.value)


def content(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


# --- output


def test_prepare_humanm3_round_trip(raw, prepared):
    out, summary = prepared
    dataset = open_dataset(out)
    items = list(dataset.items())
    assert summary["people"] == len(items) == len(raw[1])
    assert [(part["people"], part["skipped"]) for part in summary["parts"]] == [(6, 0)] * 3
    for item in items:
        joints = raw[1][item.sequence, item.frame, item.track]
        assert np.abs(item.joints - joints).max() < 1e-3
        assert item.skeleton is HUMAN15 and item.box.id == item.track
        np.testing.assert_allclose(item.centers["joints_box"], item.box.center)
        np.testing.assert_array_equal(item.center, center_of(item.points))
        assert item.joint_labels.dtype == np.uint8 and (item.joint_labels == SEEN).all()
    for sample, item in zip(dataset, items, strict=True):
        np.testing.assert_array_equal(sample.points, item.points)
    tests = list(dataset.items("test"))
    assert {item.sequence for item in tests} == {"test/c"} and len(tests) == 6
    with pytest.raises(InputError, match="no people in the split 'val'"):
        list(dataset.items("val"))


def test_prepared_shards_are_readable_by_pandas(prepared):
    out, _ = prepared
    table = pd.concat([pd.read_parquet(path) for path in sorted(out.glob("labelled-*.parquet"))])
    assert len(table) == 18 and set(table["split"]) == {"train", "test"}
    assert table["center_trans"].isna().all() and table["distance"].isna().all() and table["part"].isna().all()
    assert table["joints"].iloc[0].reshape(-1, 3).shape == (15, 3)
    assert (table["index"].to_numpy() == np.repeat([0, 1, 2], 6)).all()
    card = json.loads((out / "dataset.json").read_text())
    assert card["about"]["sensor_known"] is False and card["about"]["parts"] == ["test/c", "train/a", "train/b/seg0"]
    assert card["frame"].startswith("world") and card["joints"] == list(HUMAN15.joints)
    assert card["summary"]["people"] == 18 and "non-commercial" in card["about"]["licence"]


def test_prepare_sloper4d_has_trans_and_distances(tmp_path, smpl):
    root = tmp_path / "raw"
    truth = files.write_sloper4d(root, smpl)
    summary = prepare("sloper4d", root, tmp_path / "out", smpl=smpl, progress=False)
    rows = list(open_dataset(tmp_path / "out").rows())
    assert len(rows) == len(truth) == summary["people"]
    for row in rows:
        assert row["distance"] == pytest.approx(np.linalg.norm(row["center"]), rel=1e-6)
        assert row["center_trans"] is not None and row["center_box"] is None and row["box_center"] is None
    assert summary["splits"] == {"test": 3, "train": 3} and summary["frames"] == 6
    assert summary["sources"] == {"sloper4d/opt_pose, male by the given body": 6}
    assert summary["skipped"] == {"labels without a cloud": 2}
    assert summary["trunk"][2] > 0.7 and summary["joints"] == {"seen": 144, "hidden": 0, "unlabelled": 0}
    # the split has sequences that these files do not contain
    assert any(
        line.startswith("missing: seq003_street_002, ") and line.endswith("of train by lidar-hmr")
        for line in summary["warnings"]
    )
    lines = summary_lines(summary)
    assert lines[0] == "6 people in 6 frames (test 3, train 3)" and lines[1].startswith("skipped 2: labels without")
    shutil.copy(smpl, tmp_path / "SMPL_MALE.npz")
    shutil.copy(smpl, tmp_path / "SMPL_NEUTRAL.npz")
    refused("other settings: smpl ", "sloper4d", root, tmp_path / "out", smpl=tmp_path)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 30), st.booleans(), st.booleans())
def test_labeled_row_round_trip(tmp_path_factory, seed, count, boxed, rings):
    rng = np.random.default_rng(seed)
    joints = rng.normal(0, 1, (14, 3)).astype(np.float32)
    labels = rng.integers(0, 3, 14).astype(np.uint8)
    joints[labels == UNLABELED] = np.nan
    box = Box(center=rng.normal(0, 1, 3), size=rng.uniform(0.1, 2, 3), yaw=0.25, id="ab") if boxed else None
    sample = LabeledSample(
        points=rng.normal(0, 1, (count, 3)).astype(np.float32),
        center=rng.normal(0, 1, 3),
        ring=rng.integers(0, 64, count).astype(np.int32) if rings else None,
        pose=Pose(joints=joints, skeleton=WAYMO14, frame="sensor"),
        box=box,
        source="waymo",
        frame_id="f",
        joint_labels=labels,
        sequence="s",
        frame=1_550_083_467_346_370,
        track="ab",
        time=1.5,
        centers={"box": box.center} if boxed else {},
        split="val",
    )
    path = tmp_path_factory.mktemp("sample") / "a.parquet"
    other = replace(sample, time=float("nan"), centers={"trans": np.ones(3)}, split=None, sensor_known=False)
    write_shard(path, "labelled", [labeled_row(one, index=0) for one in (sample, other)])
    found, second = (sample_of(row, "waymo14", "parts") for row in read_rows(path, "labelled"))
    for name in ("points", "joints", "joint_labels", "center", "ring", "part"):
        np.testing.assert_array_equal(getattr(found, name), getattr(sample, name))
        assert np.asarray(getattr(found, name)).dtype == np.asarray(getattr(sample, name)).dtype
    for name in ("sequence", "frame", "track", "time", "split", "sensor_known", "distance", "source", "frame_id"):
        assert getattr(found, name) == getattr(sample, name)
    assert found.centers.keys() == sample.centers.keys() and (found.box is None) == (not boxed) and found.info is None
    if boxed:
        np.testing.assert_array_equal(found.box.size, sample.box.size)
        assert found.box.yaw == 0.25 and found.box.id == "ab"
    assert np.isnan(second.time) and second.split is None and second.centers.keys() == {"trans"}
    assert not second.sensor_known and np.isnan(second.distance)


def test_labeled_row_rejects_unknown_centers(raw):
    item = next(HumanM3().read(raw[0], "train/a"))
    with pytest.raises(InputError, match="names of centers must be trans, box, joints_box, got mean"):
        labeled_row(replace(item, centers={"mean": np.zeros(3)}), index=0)


# --- stopped, killed, in several processes


def test_prepare_with_workers_writes_same_bytes(raw, prepared, tmp_path):
    summary = prepare("humanm3", raw[0], tmp_path / "out", workers=2)
    assert content(tmp_path / "out") == content(prepared[0]) and summary == prepared[1]


def test_prepare_reads_only_missing_or_damaged_parts_again(raw, prepared, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(prepared[0], out)
    (out / "labelled-00001.parquet").unlink()
    (out / "skipped-00002.parquet").write_bytes(b"PAR1")
    (out / f".{_gone()}-3-labelled-00001.parquet").write_bytes(b"half")
    read = []
    whole = PartWriter.__call__
    monkeypatch.setattr(PartWriter, "__call__", lambda self, number: read.append(number) or whole(self, number))
    summary = prepare("humanm3", raw[0], out)
    assert read == [1, 2] and content(out) == content(prepared[0]) and summary == prepared[1]
    prepare("humanm3", raw[0], out)
    assert read == [1, 2]
    # a shard with the right number of rows, but damaged content
    table = parquet.read_table(out / "labelled-00001.parquet")
    column = pa.nulls(len(table), table.schema.field("joints").type)
    place = table.schema.get_field_index("joints")
    parquet.write_table(table.set_column(place, "joints", column), out / "labelled-00001.parquet")
    refused("labelled-00001.parquet: has a row that is not a sample; delete it", "humanm3", raw[0], out)


def _gone():
    """The id of a process that has ended."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_prepare_resumes_and_has_no_summary_until_finished(raw, prepared, tmp_path, monkeypatch):
    out, whole = tmp_path / "out", PartWriter.__call__

    def stop(self, number):
        if number == 1:
            raise KeyboardInterrupt
        return whole(self, number)

    def stopped():
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(PartWriter, "__call__", stop)
            prepare("humanm3", raw[0], out)
        assert open_dataset(out).card.summary is None

    stopped()
    assert list(content(out)) == ["dataset.json", "labelled-00000.parquet", "skipped-00000.parquet"]
    with pytest.raises(InputError, match="not finished; run the same lidarpose prepare again"):
        list(open_dataset(out))
    prepare("humanm3", raw[0], out)
    assert content(out) == content(prepared[0])
    # a dataset that is no longer complete has no summary either
    (out / "labelled-00001.parquet").unlink()
    stopped()


class Slow:
    """Makes shards that never end, and writes its process id to a file."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, shard):
        (self.folder / f"begun-{shard}").write_text(str(os.getpid()))
        while True:
            time.sleep(0.05)
            yield 1


@pytest.mark.long
def test_make_shards_workers_end_when_closed(tmp_path):
    made = writer.make_shards(Slow(tmp_path), [0, 1], workers=2)
    for _, people in made:
        if people and len(list(tmp_path.iterdir())) == 2:
            break
    made.close()
    for path in tmp_path.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


# --- splits


def test_prepare_prefers_user_lists_and_ignores_blank_lines(tmp_path, smpl):
    root, out = tmp_path / "raw", tmp_path / "own"
    files.write_lidarhuman26m(root, smpl, sequences=("5", "7", "9"), frames=1)
    assert split_rule("lidarhuman26m", root).of_part("7") == "test"
    (root / "train.txt").write_text("7\n9\n\n")
    refused("has train.txt and no test.txt", "lidarhuman26m", root, out, smpl=smpl)
    (root / "test.txt").write_text("5\n")
    assert prepare("lidarhuman26m", root, out, smpl=smpl)["splits"] == {"test": 1, "train": 2}
    assert {item.sequence for item in open_dataset(out).items("test")} == {"5"}
    # unless the published split is requested by name
    summary = prepare("lidarhuman26m", root, tmp_path / "named", smpl=smpl, split_by="official")
    assert summary["splits"] == {"none": 1, "test": 1, "train": 1}
    (root / "train.txt").write_text("7\n")
    refused("other settings: lists ", "lidarhuman26m", root, out, smpl=smpl)


@pytest.fixture
def copied(raw, tmp_path):
    """A function that writes a user's lists into a copy of HumanM3."""
    root = tmp_path / "raw"
    shutil.copytree(raw[0], root)

    def write(train, test):
        for name, content in (("train", train), ("test", test)):
            (root / f"{name}.txt").write_bytes(content if isinstance(content, bytes) else content.encode())
        return root

    return write


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-8"])
def test_split_rule_user_lists_may_omit_first_folder(copied, encoding):
    root = copied("c\r\nb/seg0\r\n".encode(encoding), "train/a\nelsewhere\n".encode(encoding))
    rule = split_rule("humanm3", root, parts=["test/c", "train/a", "train/b/seg0"])
    assert rule.sets == {"train": ("test/c", "train/b/seg0"), "test": ("train/a", "elsewhere")}
    # a name that fits the end of two sequences matches neither
    rule = split_rule("humanm3", root, parts=["test/c", "train/c", "train/a"])
    assert rule.of_part("test/c") is None and rule.of_part("train/a") == "test"


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ("basketball1\n", "plaza\n", "expected names such as 'test/c', got 'basketball1'"),
        ("train/a\n".encode("utf-16"), "plaza\n", "train.txt: expected text in UTF-8, got UTF-16"),
        ("train/a\n".encode("utf-16-le"), "plaza\n", "train.txt: expected text, got zero bytes"),
        ("stra\xdfe\n".encode("latin-1"), "plaza\n", "train.txt: expected text in UTF-8, got an invalid byte at 4"),
        ("c\nb/seg0\n", "test/c\n", "test.txt: names test/c, which is also in train.txt"),
        ("train/a\n", "\n", "test.txt: names no sequence"),
    ],
)
def test_prepare_rejects_bad_user_lists(copied, tmp_path, train, test, message):
    refused(message, "humanm3", copied(train, test), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_prepare_single_split(raw, tmp_path):
    summary = prepare("humanm3", raw[0], tmp_path / "out", split="test")
    assert summary["splits"] == {"test": 6} and [part["part"] for part in summary["parts"]] == ["test/c"]
    refused(
        "other settings: the number of the release's parts is 1, requested is 2",
        "humanm3",
        raw[0],
        tmp_path / "out",
        split="train",
    )


def test_prepare_warns_that_split_in_chunks_leaks(tmp_path, smpl):
    root = tmp_path / "raw"
    files.write_sloper4d(root, smpl, sequences=("seq009_running_002",), frames=101, without=(3,))
    summary = prepare("sloper4d", root, tmp_path / "out", smpl=smpl, split_by="dapt")
    # 100 frames with clouds are 7 chunks, the last of 4
    assert summary["splits"]["train"] + summary["splits"]["test"] == 100 and summary["splits"]["train"] in (64, 52)
    assert any("dapt leaks" in line for line in summary["warnings"])
    splits = [row["split"] for row in open_dataset(tmp_path / "out").rows()]
    assert all(len(set(splits[k : k + 16])) == 1 for k in range(0, 100, 16))
    tests = prepare("sloper4d", root, tmp_path / "test", smpl=smpl, split_by="dapt", split="test")
    assert tests["people"] == splits.count("test") and tests["skipped"] == summary["skipped"]


def test_published_splits_are_disjoint_and_have_source(tmp_path):
    for name in READERS:
        rules = list(_published(name))
        assert (
            sum(rule.usual for rule in rules)
            == bool(rules)
            == (name in ("humanm3", "lidarhuman26m", "sloper4d", "waymo", "itop"))
        )
        rule = split_rule(name, tmp_path)
        assert (rule is None) == (not rules)
        if rule is not None:
            # Waymo does not publish the labels of its test folder
            held_out = rule.sets["val" if name == "waymo" else "test"]
            assert rule.source and rule.sets["train"] and held_out
            assert not set(rule.sets["train"]) & set(held_out)
    assert split_rule("sloper4d", tmp_path).name == "lidar-hmr" and split_rule("sloper4d", tmp_path, "dapt").leaks
    assert len(split_rule("lidarhuman26m", tmp_path).sets["train"]) == 19


# --- bad input


@pytest.mark.parametrize("name", ["sloper4d", "lidarhuman26m"])
def test_prepare_rejects_bad_smpl_file_before_writing(tmp_path, smpl, name):
    getattr(files, f"write_{name}")(tmp_path / "raw", smpl)
    wrong = tmp_path / "SMPL_NEUTRAL.npz"
    wrong.write_bytes(b"PK no model")
    for asked in (wrong, tmp_path):
        refused("SMPL_NEUTRAL.npz", name, tmp_path / "raw", tmp_path / "out", smpl=asked)
    assert not (tmp_path / "out").exists()


def test_prepare_errors_are_one_line_and_write_nothing(raw, tmp_path, smpl):
    out, mine = tmp_path / "out", tmp_path / "mine.txt"
    mine.write_text("x")
    for arguments, options, message in (
        (("humanm3", tmp_path / "none", out), {}, "none: is not a folder; expected the raw files of humanm3"),
        (("humanm3", raw[0], out), {"workers": 0}, "workers must be a whole number of at least 1, got 0"),
        (("human3m", raw[0], out), {}, "unknown dataset 'human3m': did you mean humanm3"),
        (("lidarhuman26m", raw[0], out), {"smpl": smpl}, "is not the root of LiDARHuman26M"),
        (("lidarhuman26m", raw[0], out), {}, "register at smpl.is.tue.mpg.de"),
        (("lipd", raw[0], out), {"split": "test"}, "is not the root of lipd"),
        (("humanm3", raw[0], out), {"split": "tset"}, "unknown split of humanm3 by official 'tset': did you mean test"),
        (("humanm3", raw[0], out), {"split_by": "dapt"}, "unknown split of humanm3 'dapt'"),
        (("humanm3", raw[0], tmp_path), {}, "holds other files and no dataset.json"),
        (("humanm3", raw[0], mine), {}, "is a file"),
    ):
        refused(message, *arguments, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_prepare_counts_damaged_part_and_continues(tmp_path, smpl):
    root = tmp_path / "raw"
    files.write_sloper4d(root, smpl)
    path = root / "seq002_football_001/seq002_football_001_labels.pkl"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    summary = prepare("sloper4d", root, tmp_path / "out", smpl=smpl)
    assert summary["people"] == 3 and summary["skipped"]["the rest of a part cannot be read"] == 1
    assert "seq002_football_001_labels.pkl" in summary["skipped_first"]["the rest of a part cannot be read"]
    assert any(line == "no people in seq002_football_001" for line in summary["warnings"])
    assert any("skipped 1: the rest of a part" in line for line in summary_lines(summary))
    # the repaired part is read again if its shards are deleted
    path.write_bytes(whole)
    for shard in (tmp_path / "out").glob("*-00000.parquet"):
        shard.unlink()
    assert prepare("sloper4d", root, tmp_path / "out", smpl=smpl)["people"] == 6


@pytest.mark.skipif(sys.platform != "linux", reason="names on other systems are text")
def test_prepare_escapes_undecodable_names(tmp_path, smpl):
    root = tmp_path / "raw"
    files.write_humanm3(root, smpl, sequences=("train/a",), frames=1)
    path = root / "train/a/pose_calib/0007.json"
    path.write_text(path.read_text().replace('"2"', '"\\ud800"'))
    os.rename(bytes(root / "train/a"), bytes(root / "train") + b"/stra\xdfe")
    assert prepare("humanm3", root, tmp_path / "out")["people"] == 2
    people = list(open_dataset(tmp_path / "out").items())
    assert {item.sequence for item in people} == {"train/stra\\udcdfe"}
    assert {item.track for item in people} == {"\\ud800", "10"}


def test_prepare_counts_unexpected_errors_by_type(raw, tmp_path, monkeypatch):
    whole = HumanM3.read

    def read(self, root, part):
        yield from list(whole(self, root, part))[:2]
        if part == "train/a":
            raise KeyError("joints")

    monkeypatch.setattr(HumanM3, "read", read)
    summary = prepare("humanm3", raw[0], tmp_path / "out")
    reason = "the rest of a part cannot be read (KeyError)"
    assert summary["people"] == 6 and summary["skipped"] == {reason: 1}
    assert summary["skipped_first"] == {reason: "train/a: KeyError: 'joints'"}


def test_prepare_warns_of_wrong_up_axis_and_mismatched_labels(tmp_path, smpl):
    root = tmp_path / "raw"
    files.write_lidarhuman26m(root, smpl, sequences=("5",))
    for path in (root / "labels/3d/pose/5").iterdir():
        found = json.loads(path.read_text())
        found["trans"] = [found["trans"][0] + 4, *found["trans"][1:]]
        found["pose"][:3] = [0, 0, 0]  # SMPL's own up, y
        path.write_text(json.dumps(found))
    warnings = prepare("lidarhuman26m", root, tmp_path / "out", smpl=smpl)["warnings"]
    assert any("people stand along" in line for line in warnings)
    assert any("labels and clouds from different releases" in line for line in warnings)


def test_prepare_warns_of_dataset_without_people(tmp_path, smpl):
    root = tmp_path / "raw"
    files.write_humanm3(root, smpl, sequences=("train/a",), frames=2)
    for path in root.glob("**/*.pcd"):
        path.unlink()
    summary = prepare("humanm3", root, tmp_path / "out")
    assert summary["people"] == 0 and summary["skipped"] == {"labels without a cloud": 4}
    assert any("it has no people" in line for line in summary["warnings"])
    assert list(open_dataset(tmp_path / "out")) == []
