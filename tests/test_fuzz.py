"""Readers accept a file or reject it in one line: damaged files, and hostile files made of parts of valid ones.

`make fuzz` runs this for about ten minutes, with new examples each time.
"""

import os
import struct

import numpy as np
import pyarrow as pa
import pytest
import safetensors.numpy
from hostile_files import BOX_FILES, CALIBRATION, PICKLE_PIECES, PICKLES, POINT_FILES, damaged
from hypothesis import HealthCheck, given, settings, strategies as st
from pyarrow import parquet
from shard_files import sample, write_shard

from lidarpose.data.dataset_card import DatasetCard, write_card
from lidarpose.data.rows import TABLES, person_row
from lidarpose.errors import InputError
from lidarpose.io.boxes import read_boxes
from lidarpose.io.pickles import load_pickle
from lidarpose.io.point_cloud import read_points
from lidarpose.models import bundled_path
from lidarpose.models.checkpoint import ENTRY, SafetensorsFile, read_header
from lidarpose.train.torch_dataset import InMemoryDataset

fuzz = settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", 100)),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def read_or_refuse(read, path, content):
    """Result of `read`, or None if it raises an error of one line that names the file."""
    path.write_bytes(content)
    try:
        return read(path)
    except InputError as error:
        assert str(error).isprintable() and len(str(error)) < 1000 and str(path) in str(error)
        return None


@pytest.mark.parametrize("read, files", [(read_points, POINT_FILES), (load_pickle, PICKLES)])
def test_readers_accept_undamaged_files(folder, read, files):
    for name, content in files.items():
        assert read_or_refuse(read, folder / name, content) is not None


@fuzz
@given(file=damaged(POINT_FILES))
def test_read_points_accepts_or_rejects_damaged_files(folder, file):
    cloud = read_or_refuse(read_points, folder / file[0], file[1])
    if cloud is not None:
        assert cloud.points.ndim == 2 and cloud.points.shape[1] == 3 and np.isfinite(cloud.points).all()


@fuzz
@given(file=damaged(BOX_FILES), calibration=damaged({"calib.txt": CALIBRATION}), is_damaged=st.booleans())
def test_read_boxes_accepts_or_rejects_damaged_files(folder, file, calibration, is_damaged):
    calib = folder / "calib.txt"
    calib.write_bytes(calibration[1] if is_damaged else CALIBRATION)
    for path in (folder / file[0], calib):
        path.touch()
    try:
        boxes = read_or_refuse(lambda path: read_boxes(path, calib=calib), folder / file[0], file[1])
    except AssertionError:
        # the error is about the calibration file
        with pytest.raises(InputError, match="calib.txt: "):
            read_boxes(folder / file[0], calib=calib)
        boxes = None
    for box in boxes or ():
        assert np.isfinite([*box.center, *box.size, box.yaw]).all() and (box.size > 0).all()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda part: (
        st.lists(part, max_size=8)
        | st.dictionaries(
            st.sampled_from(["people", "center", "size", "yaw", "id", "track"]) | st.text(max_size=3), part
        )
    ),
    max_leaves=30,
)


@fuzz
@given(content=JSON)
def test_read_boxes_accepts_or_rejects_any_json(content):
    if isinstance(content, list | dict):
        boxes = []
        try:
            boxes = read_boxes(content)
        except InputError as error:
            assert str(error).isprintable()
        for box in boxes:
            assert np.isfinite([*box.center, *box.size, box.yaw]).all() and (box.size > 0).all()


@fuzz
@given(
    content=damaged(PICKLES).map(lambda file: file[1])
    | st.binary(max_size=80).map(lambda data: b"\x80\x02" + data + b".")
    | st.lists(st.sampled_from(PICKLE_PIECES), max_size=40).map(lambda pieces: b"".join(pieces) + b".")
)
def test_load_pickle_accepts_or_rejects_damaged_files(folder, content):
    """Also opcodes in any order with small arguments, which reach code that random bytes hardly reach."""
    read_or_refuse(load_pickle, folder / "f.pkl", content)


_HEADER = SafetensorsFile.open(bundled_path()).metadata[ENTRY]
WEIGHTS = {"w.safetensors": safetensors.numpy.save({"a": np.zeros(3, np.float32)}, metadata={ENTRY: _HEADER})}


@fuzz
@given(file=damaged(WEIGHTS), is_fitted=st.booleans())
def test_read_header_accepts_or_rejects_damaged_weights(folder, file, is_fitted):
    name, content = file
    if is_fitted:
        # with the length of the damaged header, so that its content is parsed
        content = struct.pack("<Q", max(len(content) - 8 - 12, 0)) + content[8:]
    read_or_refuse(read_header, folder / name, content)
    read_or_refuse(lambda path: SafetensorsFile.open(path).check_digest(), folder / name, content)


SCALARS = st.none() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.booleans() | st.text(max_size=9)


LISTS = st.none() | st.lists(st.none() | st.floats() | st.integers(-9, 300), max_size=12)


@pytest.mark.long
@fuzz
@given(
    column=st.sampled_from(sorted(TABLES["people"])),
    values=st.tuples(SCALARS, SCALARS) | st.tuples(LISTS, LISTS),
    is_typed=st.booleans(),
)
def test_dataset_accepts_or_rejects_damaged_columns(folder, column, values, is_typed):
    """Random values in one column, with the column's type if the values allow it."""
    path = folder / "people-00000.parquet"
    write_card(folder, DatasetCard(settings={"what": "people"}, count=2, per_shard=2, tables=("people",)))
    rng = np.random.default_rng(0)
    write_shard(path, "people", [person_row(sample(rng, count), index=k) for k, count in enumerate((3, 4))])
    table = parquet.read_table(path)
    place = table.schema.get_field_index(column)
    try:
        array = pa.array(values, table.schema.field(column).type if is_typed else None)
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        return
    parquet.write_table(table.set_column(place, column, array), path)
    try:
        data = InMemoryDataset.load([folder])
        assert all(np.isfinite(data.sample(row).points).all() for row in range(len(data)))
    except InputError as error:
        assert str(error).isprintable() and len(str(error)) < 1000 and str(folder) in str(error)
