"""The frozen benchmark: nothing may ever change it, and what it says of itself is so."""

import hashlib
from functools import cache

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.eval import dataset as module
from lidarpose.eval.dataset import BENCH_SHA256, bench_path, facing, load_bench, mean_poses, open_eval_dataset
from lidarpose.geometry import rotation_about
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26, HUMAN15


@cache
def bench():
    return load_bench()


def test_the_file_is_the_frozen_one_and_a_damaged_one_is_named(monkeypatch, tmp_path):
    data = bench_path().read_bytes()
    assert hashlib.sha256(data).hexdigest() == BENCH_SHA256
    assert BENCH_SHA256.startswith("8abcafc6628c") and len(data) < 12e6
    damaged = tmp_path / "b.parquet"
    damaged.write_bytes(data[:-1])
    monkeypatch.setattr(module, "bench_path", lambda: damaged)
    with pytest.raises(InputError, match="is not lidarpose-bench-1 as it was frozen"):
        load_bench()


def test_parts_are_equal():
    people, columns = bench().people, bench().columns
    assert len(people) == 2000 and [len(rows) for rows in bench().clips] == [16] * 60
    for name, values in (("condition", 5), ("poses", 2), ("sensor", 8)):
        found, counts = np.unique(columns[name][people], return_counts=True)
        assert len(found) == values and (counts == 2000 // values).all()
        assert set(columns[name][np.concatenate(bench().clips)]) == set(found)
    assert columns["num_points"][people].min() >= 20
    assert columns["distance"][people].min() >= 1.9 and columns["distance"][people].max() <= 40.1
    for rows in bench().clips:
        assert (columns["frame"][rows] == np.arange(16)).all() and len(set(columns["sensor"][rows])) == 1


def test_points_lie_in_their_box_and_bodies_about_their_joints():
    for row in bench().people[::37]:
        points, joints, box = bench().points[row], bench().joints[row], bench().columns["box"][row]
        box = Box(center=box[:3], size=box[3:6], yaw=box[6])
        assert box.contains(points, margin=0.002).mean() > 0.8
        nearest = np.linalg.norm(points[:, None] - joints, axis=-1).min(1)
        assert np.median(nearest) < 0.5


def test_baselines_know_no_points():
    baselines = mean_poses(bench())
    people, pick = bench().people, BODY26.map_to(HUMAN15)
    true, alike = (baselines[name] - bench().joints for name in ("mean pose, true facing", "mean pose"))
    true, alike = (np.linalg.norm(away[people][:, pick], axis=-1).mean() for away in (true, alike))
    assert 0.2 < true < alike < 0.45
    turn = {name: np.cos(facing(joints) - facing(bench().joints))[people] for name, joints in baselines.items()}
    assert (turn["mean pose, true facing"] > 0.99).all()
    assert 0.4 < (turn["mean pose"] < 0).mean() < 0.6


def test_facing_turns_with_the_person():
    joints = bench().joints[bench().people[:50]]
    turn = facing(joints @ rotation_about("z", 0.7).T) - facing(joints)
    np.testing.assert_allclose(np.cos(turn), np.cos(0.7), atol=1e-5)
    mirrored = joints[:, list(BODY26.flip)]
    np.testing.assert_allclose(np.cos(facing(mirrored) - facing(joints)), -1, atol=1e-5)


def test_plain_people_are_whole_and_of_many_points():
    rows = np.array([one.row for one in open_eval_dataset("bench") if one.plain and not one.moving])
    columns = bench().columns
    assert len(rows) == 706 and columns["num_points"][rows].min() >= 100
    assert columns["visible"][rows].min() > 0.8 and columns["clutter"][rows].max() < 0.05
    assert columns["upright"][rows].all()
