"""Shards of given rows, and random samples."""

import numpy as np

from lidarpose.data.shards import shard_writer
from lidarpose.sample import Box, Pose, Sample
from lidarpose.skeleton import BODY26


def write_shard(path, table, rows):
    with shard_writer(path, table) as add:
        for row in rows:
            add(row)


def sample(rng, count):
    return Sample(
        points=rng.normal(0, 1, (count, 3)).astype(np.float32),
        center=rng.normal(0, 1, 3),
        part=rng.integers(0, 25, count).astype(np.uint8),
        ring=rng.integers(0, 64, count).astype(np.int32),
        pose=Pose(joints=rng.normal(0, 1, (26, 3)).astype(np.float32), skeleton=BODY26, frame="sensor"),
        box=Box(center=rng.normal(0, 1, 3), size=rng.uniform(0.4, 2, 3), yaw=float(rng.normal())),
        source="synth/wild/os1-64",
        frame_id="3/1",
    )
