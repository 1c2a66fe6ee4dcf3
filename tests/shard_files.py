"""Shards of rows that are at hand, for tests."""

from lidarpose.data.shards import shard_writer


def write_shard(path, table, rows):
    with shard_writer(path, table) as add:
        for row in rows:
            add(row)
