"""Parquet shards: round trips, reading with pandas, and errors for damaged files."""

import json
import os
import sys
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet
from shard_files import sample, write_shard

from lidarpose.cli import main
from lidarpose.data import shards, writer
from lidarpose.data.dataset_card import DatasetCard, read_card, write_card
from lidarpose.data.rows import TABLES, person_row
from lidarpose.data.shards import open_dataset, read_rows
from lidarpose.data.writer import check_settings, open_folder
from lidarpose.errors import InputError, MissingExtra
from lidarpose.recording.result_files import write_result
from lidarpose.sample import PersonInfo
from lidarpose.skeleton import BODY26

FACTS = PersonInfo(sensor="os1-64", kind="walk", distance=7.5, visible=0.5, height_seen=0.9, clutter=0.1, upright=True)


@pytest.fixture
def people():
    rng = np.random.default_rng(0)
    return [sample(rng, count) for count in (30, 0, 1, 500)]


@pytest.fixture
def folder(tmp_path, people):
    write_card(tmp_path, DatasetCard(settings={"what": "people"}, count=4, per_shard=3, tables=("people",)))
    rows = [person_row(p, index=k, frame=k % 2, info=FACTS if k else None) for k, p in enumerate(people)]
    write_shard(tmp_path / "people-00000.parquet", "people", rows[:3])
    write_shard(tmp_path / "people-00001.parquet", "people", rows[3:])
    return tmp_path


def refused(read, match):
    with pytest.raises(InputError, match=match) as caught:
        read()
    assert "\n" not in str(caught.value)


def test_samples_survive_round_trip(folder, people):
    dataset = open_dataset(folder)
    samples, rows = list(dataset), list(dataset.rows())
    assert len(samples) == 4 and dataset.card.shards == 2
    for a, b in zip(samples, people, strict=True):
        for name in ("points", "part", "ring", "center"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
            assert getattr(a, name).dtype == getattr(b, name).dtype
        np.testing.assert_array_equal(a.pose.joints, b.pose.joints)
        np.testing.assert_array_equal(a.box.center, b.box.center)
        np.testing.assert_array_equal(a.box.size, b.box.size)
        assert (a.box.yaw, a.source, a.frame_id) == (b.box.yaw, b.source, b.frame_id)
    assert [row["index"] for row in rows] == [0, 1, 2, 3] and rows[0]["distance"] is None
    assert (samples[2].info.kind, samples[2].distance, samples[2].info.upright) == ("walk", 7.5, True)
    refused(lambda: list(dataset.samples("test")), "has synthetic people, which have no split 'test'")


@pytest.mark.parametrize("name", ["run:1", os.fsdecode(b"\xff")])
def test_folder_name_may_hold_a_colon_or_undecodable_bytes(folder, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = Path(name, "a.parquet")
    write_shard(path, "people", open_dataset(folder).rows())
    assert shards.rows_of_shard(path) == len(list(read_rows(path, "people"))) == 4
    refused(lambda: next(read_rows(Path(name, "b.parquet"), "people")), "b.parquet: is missing")
    write_result(Path(name, "c.parquet"), [])
    assert shards.rows_of_shard(Path(name, "c.parquet")) == 0


def test_pandas_reads_shards(folder, people):
    table = pd.concat([pd.read_parquet(path) for path in sorted(folder.glob("*.parquet"))])
    assert list(table.columns) == list(TABLES["people"])
    np.testing.assert_array_equal(table["points"].iloc[3].reshape(-1, 3), people[3].points)
    assert table["sensor"].tolist()[1:] == ["os1-64"] * 3
    card = json.loads((folder / "dataset.json").read_text())
    assert card["joints"] == list(BODY26.joints) and card["unit"] == "m" and card["schema"] == 1


def test_frames_survive_round_trip(tmp_path):
    rng = np.random.default_rng(1)
    row = {
        "index": 5, "frame": 2, "sensor": "av2", "points": rng.normal(size=30).astype(np.float32),
        "ring": np.arange(10, dtype=np.int32), "person": np.full(10, -1, np.int16), "part": np.zeros(10, np.uint8),
        "track": [0, 1], "box": rng.normal(size=(2, 7)), "joints": rng.normal(size=(2, 26, 3)).astype(np.float32),
    }  # fmt: skip
    path = tmp_path / "f.parquet"
    write_shard(path, "frames", [row, row])
    _, stored = read_rows(path, "frames")
    assert stored["index"] == 5 and stored["person"].dtype == np.int16
    for name in ("points", "box", "joints"):
        np.testing.assert_array_equal(stored[name].reshape(row[name].shape), row[name])
    refused(lambda: list(read_rows(path, "people")), "not a shard of people: the columns center")
    for name, value, problem in (
        ("person", None, "column person has nulls"),
        ("ring", [1], "column ring has 1 values, expected 10: int32.n. with n = 10"),
        ("points", [1.0], "column points has 1 values, expected 0"),
        ("box", [1.0] * 8, "column box has 8 values, expected 14: float64.P,7. with P = 2"),
    ):
        write_shard(path, "frames", [row | {name: value}])
        refused(lambda: list(read_rows(path, "frames")), f"f.parquet: {problem}")


def test_damaged_or_missing_shard_error_names_file(folder):
    path = folder / "people-00001.parquet"
    whole = path.read_bytes()
    assert shards.rows_of_shard(path) == 1
    flipped = bytearray(whole)
    # a bit within the points
    flipped[len(whole) // 3] ^= 4
    for broken in (b"", b"PAR1", whole[: len(whole) // 2], b"\0" * len(whole), flipped):
        path.write_bytes(broken)
        assert (shards.rows_of_shard(path) is None) == (broken is not flipped)
        refused(lambda: list(open_dataset(folder)), "people-00001.*cannot be read as Parquet")
    path.unlink()
    refused(lambda: list(open_dataset(folder)), "people-00001.* is missing: the dataset is not finished")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, "dataset.json is missing"),
        ("{", "dataset.json: is not JSON"),
        ("[]", "not a dataset's card"),
        ({"schema": 2}, "has schema 2, this lidarpose reads 1: install lidarpose [0-9]"),
        ({"count": 0}, "are invalid"),
        ({"tables": ["cars"]}, "are invalid"),
        ({"tables": [["people"]]}, "are invalid"),
        ({"count": float("inf")}, "not a dataset's card"),
        ({"skeleton": "cat"}, "unknown skeleton"),
    ],
)
def test_open_dataset_rejects_invalid_card(folder, change, message):
    path = folder / "dataset.json"
    content = json.dumps(json.loads(path.read_text()) | change) if isinstance(change, dict) else change
    path.unlink() if content is None else path.write_text(content)
    refused(lambda: open_dataset(folder), message)


def test_open_folder_looks_again_when_it_is_locked(folder, tmp_path, monkeypatch):
    out, card = tmp_path / "out", read_card(folder)

    @contextmanager
    def locked_after_another_job(path, *_, **__):
        path.mkdir()
        write_card(path, card)
        yield

    monkeypatch.setattr(writer, "locked", locked_after_another_job)
    with pytest.raises(InputError, match="has a dataset with other settings: count"):
        with open_folder(out, replace(card, count=card.count + 1)):
            pass


def test_check_settings_names_differences(folder):
    card = read_card(folder)
    check_settings(folder, card, card)
    other = replace(card, count=9, settings=card.settings | {"seed": 3})
    problem = "count is 4, requested is 9; seed is null, requested is 3"
    refused(lambda: check_settings(folder, card, other), problem)


def test_write_shard_streams_rows_in_groups(tmp_path, people, monkeypatch):
    monkeypatch.setattr(shards, "_ROW_GROUP", {"people": 2, "frames": 2})
    path = tmp_path / "people-00000.parquet"
    written = []

    def rows():
        for k in range(7):
            written.append(sum(p.stat().st_size for p in tmp_path.iterdir() if p != path))
            yield person_row(people[3], index=k)

    write_shard(path, "people", rows())
    # rows are on the disk before the last one is produced: memory does not grow with the shard
    assert written[5] > written[3] > written[1] and list(tmp_path.iterdir()) == [path]
    with parquet.ParquetFile(path) as file:
        assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [2, 2, 2, 1]
    assert [row["index"] for row in read_rows(path, "people")] == list(range(7))
    # the same rows give the same bytes
    write_shard(tmp_path / "again", "people", rows())
    assert (tmp_path / "again").read_bytes() == path.read_bytes()


def test_shard_writer_leaves_no_file_after_error(tmp_path, people):
    with pytest.raises(KeyError), shards.shard_writer(tmp_path / "a.parquet", "people") as add:
        add(person_row(people[0], index=0))
        raise KeyError("no more")
    assert not list(tmp_path.iterdir())


def test_person_info_fields_are_optional_columns(tmp_path, people):
    path = tmp_path / "a.parquet"
    write_shard(path, "people", [person_row(people[0], index=0, info=FACTS)])
    row = next(read_rows(path, "people"))
    names = [fact.name for fact in fields(PersonInfo)]
    assert [name for name in TABLES["people"] if name in names] == names
    for name in names:
        assert row[name] == pytest.approx(getattr(FACTS, name))
    parquet.write_table(parquet.read_table(path).drop_columns(["kind"]), path)
    row = next(read_rows(path, "people"))
    assert row["kind"] is None and row["sensor"] == "os1-64"


def with_column(path, column, values):
    table = parquet.read_table(path)
    place = table.schema.get_field_index(column)
    parquet.write_table(table.set_column(place, column, [values]), path)


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("points", [["a text"]] * 3, "column points is list<.*string>, expected float32\\[n,3\\]"),
        ("part", [["a text"]] * 3, "column part is list<.*string>, expected uint8"),
        ("points", ["a text"] * 3, "column points is string, expected float32\\[n,3\\]"),
        ("box_yaw", ["a text"] * 3, "column box_yaw is string, expected float64"),
        ("part", [[None] * 30, [], [None]], "column part has nulls in its lists, expected uint8"),
    ],
)
def test_column_of_wrong_type_raises(folder, column, values, message):
    with_column(folder / "people-00000.parquet", column, values)
    refused(lambda: list(open_dataset(folder)), f"people-00000.parquet: {message}")


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("points", None, "column points is null, expected float32"),
        ("index", None, "column index is null, expected int64"),
        ("source", None, "column source is null, expected string"),
        ("points", [1.0], "column points has 1 values, expected 0: float32"),
        ("joints", [1.0, 2.0, 3.0], "column joints has 3 values, expected 78"),
        ("center", [1.0], "column center has 1 values, expected 3"),
        ("part", [1], "column part has 1 values, expected 30"),
        ("part", [25] * 30, "column part has values above 24"),
        ("points", [float("nan")] * 90, "column points has values that are not finite numbers"),
        ("points", [1e30] * 90, r"column points has values beyond 1e\+09 m"),
        ("joints", [1e30] * 78, r"column joints has values beyond 1e\+09 m"),
        ("box_size", [1.0, 2.0], "column box_size has 2 values, expected 3"),
        ("box_yaw", None, "columns box_center, box_size, box_yaw: some are null"),
    ],
)
def test_null_or_invalid_list_raises(folder, column, value, message):
    path = folder / "people-00000.parquet"
    table = parquet.read_table(path)
    with_column(path, column, pa.array([value, *table[column].to_pylist()[1:]], table[column].type))
    place = folder if column == "index" else path
    refused(
        lambda: list(open_dataset(folder)), f"{place}: row with index .* is not a sample: {message}.*; write it again"
    )


def test_commands_report_damaged_column_in_one_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    with_column(folder / "people-00000.parquet", "points", [None] * 3)
    for words in (["view", "."], ["view", ".", "--html"], ["pretrain", "--shards", "."]):
        assert main(words) == 2
        captured = capsys.readouterr()
        assert "people-00000.parquet: row with index 0 is not a sample: column points is null" in captured.err
        assert captured.err.count("\n") == 1


def test_written_does_not_enumerate_missing_shards(folder):
    card = read_card(folder)
    write_card(folder, replace(card, count=10**9, per_shard=1))
    (folder / "people-99999999999999999999.parquet").write_bytes(b"")
    # looking for all shards would not finish
    assert open_dataset(folder).written() == [0, 1]


def test_missing_pyarrow_error_names_extra(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match="^reading and writing Parquet needs an optional dependency: .*synth"):
        open_dataset(folder)
