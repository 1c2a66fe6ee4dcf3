"""ITOP: reading of its HDF5 files, removal of the room, and the share of joints within 10 cm."""

import re
import sys

import dataset_files as files
import h5py
import motion_files
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from test_evaluate import Fake

from lidarpose.cli import main
from lidarpose.data.prepare import prepare, reader
from lidarpose.data.readers import itop
from lidarpose.data.readers.base import Skipped
from lidarpose.data.shards import open_dataset
from lidarpose.errors import InputError, MissingExtra
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.eval.protocols import eval_setup
from lidarpose.eval.run import evaluate_dataset
from lidarpose.sample import HIDDEN, SEEN, LabeledSample
from lidarpose.skeleton import BODY26, ITOP14

LABELS, CLOUDS = "ITOP_side_test_labels.h5", "ITOP_side_test_point_cloud.h5"


@pytest.fixture(scope="module")
def raw(tmp_path_factory, smpl):
    """Files of both views, whose second frames are invalid, and the true joints."""
    root = tmp_path_factory.mktemp("itop")
    return root, files.write_itop(root, smpl, parts=itop.PARTS, frames=3, invalid=(1,))


@pytest.fixture(scope="module")
def prepared(raw, tmp_path_factory):
    out = tmp_path_factory.mktemp("prepared") / "itop"
    return out, prepare("itop", raw[0], out)


def everything(root):
    source = reader("itop")
    records = [record for part in source.parts(root) for record in source.read(root, part)]
    return [record for record in records if isinstance(record, LabeledSample)], records


def test_itop_reads_known_poses_and_skips_invalid_frames(raw):
    root, truth = raw
    people, records = everything(root)
    assert {(person.sequence, person.frame, person.track) for person in people} == truth.keys()
    assert len(people) == len(truth) == 8
    for person in people:
        joints = truth[person.sequence, person.frame, person.track]
        assert np.abs(person.joints - joints).max() < 1e-4
        at = {name: person.joints[ITOP14.index(name)] for name in ITOP14.joints}
        assert at["head_center"][2] > at["neck"][2] > max(at["left_hip"][2], at["right_hip"][2])
        labels = {name: label for name, label in zip(ITOP14.joints, person.joint_labels, strict=True)}
        assert labels.pop("left_hand") == HIDDEN and set(labels.values()) == {SEEN}
        assert person.sensor_known and person.source == f"itop/{person.sequence[:-3]}"
    skipped = [record for record in records if isinstance(record, Skipped)]
    assert [record.reason for record in skipped] == ["labels not checked by a human"] * 4
    assert skipped[0].where == "side/test/00_00008"


def test_itop_side_view_removes_room_without_labels(raw):
    people, _ = everything(raw[0])
    for person in people:
        if person.sequence.startswith("side"):
            distance = np.linalg.norm(person.points[:, None] - person.joints, axis=-1).min(1)
            # the floor is removed with the soles; half of the skin is within 15 cm of a joint
            assert distance.max() < 0.4 and np.median(distance) < 0.15 and 2400 < len(person.points) < 3100
            assert person.box is None and not person.centers
        else:
            assert person.box.contains(person.points, 0.3001).all() and len(person.points) >= 3000
            np.testing.assert_array_equal(person.centers["joints_box"], person.box.center)


def test_person_of_room_keeps_arms_and_detached_feet():
    rng = np.random.default_rng(0)

    def blob(count, *place):
        return rng.uniform(-0.05, 0.05, (count, 3)) + place

    # x right, y up, z away; fewer points below, so that there is no floor
    body = np.stack([rng.uniform(-0.2, 0.2, 4000), 1.4 * rng.random(4000) ** 0.5 - 1, rng.uniform(2.8, 3, 4000)], 1)
    arms = np.concatenate([blob(50, 0.1, 0.2, 2.1), blob(50, 0.0, 0.7, 2.9)])
    feet = blob(50, 0.1, -1.3, 2.9)
    others = np.concatenate([blob(50, 0.0, 0.0, 3.4), blob(50, 0.6, 0.0, 2.9), blob(9, 0.0, 0.2, 2.4)])
    # below, but beside or behind
    others = np.concatenate([others, blob(50, 0.3, -1.3, 2.9), blob(50, 0.1, -1.3, 3.4)])
    person = np.concatenate([arms, feet, body])
    np.testing.assert_array_equal(itop.person_of_room(np.concatenate([others, person])), person)


def test_itop_detects_mirrored_files(tmp_path, smpl, monkeypatch):
    joints = files.itop_joints(motion_files.joints_of(motion_files.a_clip(300)[0]))
    joints = np.delete(joints, files.ITOP_JOINTS.index("torso"), 1)
    assert not itop.is_mirrored(joints) and itop.is_mirrored(joints * [1, -1, 1])
    # too few frames, and unlabeled joints, are not enough
    assert not itop.is_mirrored(joints[:99] * [1, -1, 1])
    joints[99:, 3] = np.nan
    assert not itop.is_mirrored(joints * [1, -1, 1])
    monkeypatch.setattr(itop, "_LEAST_FRAMES", 6)
    truth = files.write_itop(tmp_path, smpl, parts=("side/test", "top/test"), frames=6, mirrored=True)
    people, _ = everything(tmp_path)
    for person in people:
        assert np.abs(person.joints - truth[person.sequence, person.frame, person.track]).max() < 1e-4
        assert person.source.endswith(", x left")


def test_prepare_itop_does_not_mix_views(raw, prepared, tmp_path):
    out, summary = prepared
    assert summary["splits"] == {"none": 4, "test": 2, "train": 2}
    assert {sample.sequence for sample in open_dataset(out).samples("test")} == {"side/00"}
    summary = prepare("itop", raw[0], tmp_path / "top", split_by="top", split="test")
    assert summary["splits"] == {"test": 2} and summary["sources"] == {"itop/top": 2}


def test_prepare_itop_ignores_missing_other_split(tmp_path, smpl):
    files.write_itop(tmp_path / "raw", smpl, parts=("side/test",), frames=1)
    warnings = {
        split: prepare("itop", tmp_path / "raw", tmp_path / f"{split}", split=split)["warnings"]
        for split in ("test", None)
    }
    assert warnings == {"test": [], None: ["missing: side/train of train by side"]}


def test_prepare_itop_ignores_damaged_other_split(tmp_path, smpl):
    raw = tmp_path / "raw"
    files.write_itop(raw, smpl, parts=("side/test", "side/train"), frames=1)
    cut_off(raw / LABELS.replace("test", "train"))
    assert prepare("itop", raw, tmp_path / "test", split="test")["people"] == 1
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        prepare("itop", raw, tmp_path / "all")


def scored(out, shift=0.0, joints=ITOP14.joints):
    """The result of predictions that equal the truth, except that `joints` are off by `shift` m."""
    dataset = open_eval_dataset(out)
    people = {tuple(person.points[0]): person for person in dataset}
    moved = shift * np.isin(ITOP14.joints, joints)[:, None] * [0.6, 0.0, 0.8]

    def answer(cloud):
        pose = np.zeros((len(BODY26), 3))
        pose[BODY26.map_to(ITOP14)] = people[tuple(cloud[0].astype(np.float32))].sample.joints + moved
        return pose

    return evaluate_dataset(eval_setup(Fake(answer), dataset)).result


def test_pck_10cm_by_body_half_and_joint(prepared):
    for shift, value in ((0.0, 100.0), (0.09, 100.0), (0.11, 0.0)):
        rows = [row for row in scored(prepared[0], shift).lines if row.figure == "pck_10cm"]
        assert len(rows) == 1 + 2 + 14 and {row.value for row in rows} == {value}
    result = scored(prepared[0], 0.11, ("left_hand", "left_foot"))
    assert result.line("pck_10cm").value == pytest.approx(100 * 12 / 14)
    assert result.line("pck_10cm", "body", "upper").value == pytest.approx(100 * 7 / 8)
    assert result.line("pck_10cm", "body", "lower").value == pytest.approx(100 * 5 / 6)
    assert result.line("pck_10cm", "joint", "left_hand").value == 0
    assert result.line("pck_10cm", "joint", "right_hand").value == 100
    assert "cut out without labels" in result.setting.crop and result.setting.centring == "points alone"


# ---- damaged files


def cut_off(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def without(path, name):
    with h5py.File(path, "a") as file:
        del file[name]


def replaced(path, name, values):
    without(path, name)
    with h5py.File(path, "a") as file:
        file[name] = values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root: cut_off(root / LABELS), f"{LABELS}: cannot be read as HDF5"),
        (lambda root: cut_off(root / CLOUDS), f"{CLOUDS}: cannot be read as HDF5"),
        (lambda root: (root / CLOUDS).write_bytes(b"\x1f\x8b"), f"{CLOUDS}: cannot be read as HDF5"),
        (lambda root: (root / CLOUDS).unlink(), f"{CLOUDS}: is missing: get it .* unpack it with gunzip"),
        (lambda root: without(root / LABELS, "is_valid"), r"expected is_valid of shape \(1,\), got None"),
        (lambda root: replaced(root / CLOUDS, "data", np.zeros((1, 9, 3))), r"expected data of shape \(1, 76800, 3\)"),
        (lambda root: replaced(root / CLOUDS, "id", np.array(["00_00009"], "S8")), "has other frames than"),
        (lambda root: replaced(root / LABELS, "id", 5), "cannot be read as HDF5"),
        (lambda root: (root / LABELS).unlink() or (root / CLOUDS).unlink(), "is not the root of ITOP"),
    ],
)
def test_prepare_itop_reports_damaged_file_and_writes_nothing(tmp_path, smpl, capsys, change, message):
    files.write_itop(tmp_path / "raw", smpl, parts=("side/test",), frames=1)
    change(tmp_path / "raw")
    assert main(["prepare", "itop", str(tmp_path / "raw"), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error and re.search(message, error)
    assert not (tmp_path / "out").exists()


def test_itop_skips_unusable_frames_with_reasons(tmp_path, smpl):
    files.write_itop(tmp_path, smpl, parts=("side/test", "top/test"), frames=4)
    names = np.array(["00_00007", "nobody", "00_00009", "00_00010"], "S8")
    for path in sorted(tmp_path.iterdir()):
        replaced(path, "id", names)
        with h5py.File(path, "a") as file:
            if "data" in file:
                file["data"][0] = np.zeros((76800, 3))
            else:
                file["real_world_coordinates"][2] = np.inf
    people, records = everything(tmp_path)
    assert [person.frame for person in people] == [10, 10]
    assert [record.reason for record in records if isinstance(record, Skipped)] == [
        "no person stands out from the room", "id in another format", "no joint is labeled",
        "no points in the box", "id in another format", "no joint is labeled",
    ]  # fmt: skip


def test_itop_names_missing_extra(raw, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingExtra, match=r'"\.\[itop\]"'):
        reader("itop").check(raw[0], "side/test")


def clusters_reference(points):
    """`itop._clusters` by a flood fill from point to point."""
    cells = np.floor((points - points.min(0)) / 0.075).astype(int)
    cluster = np.full(len(points), -1)
    for k in range(len(points)):
        queue = [k] if cluster[k] < 0 else []
        while queue:
            j = queue.pop()
            cluster[j] = k
            queue += np.flatnonzero((np.abs(cells - cells[j]) <= 1).all(1) & (cluster < 0)).tolist()
    return cluster


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 120), st.sampled_from([0.2, 0.6, 1.5]))
def test_itop_clusters_match_reference(seed, count, wide):
    points = np.random.default_rng(seed).uniform(0, wide, (count, 3))
    ours, theirs = itop._clusters(points), clusters_reference(points)
    np.testing.assert_array_equal(ours[:, None] == ours, theirs[:, None] == theirs)


def test_itop_joints_after_the_torso_have_their_own_visibility(tmp_path, smpl):
    files.write_itop(tmp_path, smpl, parts=("top/test",), frames=1)
    with h5py.File(tmp_path / "ITOP_top_test_labels.h5", "r+") as file:
        file["visible_joints"][:] = np.array(files.ITOP_JOINTS) != "left_knee"
    (item,) = reader("itop").read(tmp_path, "top/test")
    assert [ITOP14.joints[k] for k in np.flatnonzero(item.joint_labels == HIDDEN)] == ["left_knee"]
