"""Datasets of people as Parquet shards: a folder with dataset.json and numbered .parquet files.

Any reader of Parquet opens the shards (pandas, DuckDB, Hugging Face datasets, Ray, ...). A row of people-*.parquet is
one synthetic person in one frame:

    index, frame, track     number of the person, clip or street in the dataset; frame of it; person in a street
    points                  x, y, z of all points one after the other, m: reshape to (n, 3); the level frame at the
                            sensor, x forward, y left, z up
    part, ring              one a point: 0 = background, 1 + j = the bone of SMPL-24's joint j; the beam
    joints                  x, y, z of the joints named in dataset.json, m
    center                  origin of the person's own frame, computed from the points
    box_center, box_size, box_yaw    a detector's box: m, m, rad
    source, frame_id        as in `Sample`
    rotations, translation, background, neighbors    the same, for networks of clips; null where nobody knows them
    sensor, kind, ...       the fields of `PersonInfo`; null where it was not measured

Datasets of real people, which `lidarpose prepare` wrote, have a part of the raw files (a sequence, a file) in each
shard: labelled-*.parquet (columns as above where they mean the same; index numbers the part) with

    sequence, time, split   of the raw dataset; s since the sequence's beginning; train, val, test or null
    track                   text; the person in the sequence
    joints                  NaN where a joint is not labeled
    joint_labels            one a joint: 0 not labeled, 1 hidden or uncertain, 2 seen
    center_trans, ...       other origins that published protocols use, m; null where there is none
    distance                of the center from the sensor, m; null where the sensor's position is unknown

and skipped-*.parquet: what was left out, `reason` and `where`.

Streets have frames-*.parquet beside them: whole turns of the sensor, with the person of every point, and of everybody
in the street, seen or not, track (P,), box (P, 7: center, size, yaw) and joints (P, J, 3), flattened.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarpose._version import __version__
from lidarpose.errors import InputError, MissingExtra
from lidarpose.io.files import atomic_path, file_error, read_bytes, write_atomic
from lidarpose.sample import FARTHEST, SEEN, Box, LabeledSample, PersonInfo, Pose, Sample
from lidarpose.skeleton import BODY26, SMPL24, skeleton

SCHEMA = 1
CARD = "dataset.json"
SENSOR_FRAME = "level frame at the sensor: x forward, y left, z up"
# rows that are compressed together: what a writer and a reader must hold. A turn of 128 rings has up to 260,000 points
_ROW_GROUP = {"people": 500, "frames": 4, "labelled": 500, "skipped": 5000}
# origins that published protocols use, by name: a column center_NAME each
CENTERS = ("trans", "box", "joints_box")
# frames per second of synthetic clips and streets
_CLIP_HZ = 10
# singular of what a dataset counts
_SINGULAR = {"people": "person", "clips": "clip", "streets": "street", "parts": "part"}

# ---- columns


class Column(NamedTuple):
    """type: of Arrow; shape: of a list, flattened; None for a single value. text: both, as in the table below."""

    text: str
    type: str
    shape: tuple[str, ...] | None
    optional: bool


def _columns(text: str) -> dict[str, Column]:
    words = (re.fullmatch(r"(\w+):((\w+)(?:\[(.+)\])?(\?)?)", word) for word in text.split())
    return {
        word[1]: Column(word[2], word[3], tuple(word[4].split(",")) if word[4] else None, bool(word[5]))
        for word in words
        if word
    }


# name:type[shape], of n points, J joints, P people; "?": null for what is unknown, and missing in older shards.
# A column of the name of a field of `LabeledSample` or `PersonInfo` is that field
_BOX = "box_center:float64[3]? box_size:float64[3]? box_yaw:float64?"
_CLIP = "rotations:float32[24,3]? translation:float64[3]? background:float32[b,3]? neighbors:float32[k,3]?"
TABLES = {
    "people": _columns(f"""
        index:int64 frame:int32 track:int32
        points:float32[n,3] part:uint8[n]? ring:int32[n]? joints:float32[J,3] center:float64[3] {_BOX}
        source:string frame_id:string sensor:string? kind:string? distance:float32? visible:float32?
        height_seen:float32? clutter:float32? upright:bool? {_CLIP}"""),
    "frames": _columns("""
        index:int64 frame:int32 sensor:string points:float32[n,3] ring:int32[n] person:int16[n] part:uint8[n]
        track:int16[P] box:float64[P,7] joints:float32[P,26,3]"""),
    "labelled": _columns(f"""
        index:int64 sequence:string frame:int64 track:string time:float64 split:string?
        points:float32[n,3] part:uint8[n]? ring:int32[n]? joints:float32[J,3] joint_labels:uint8[J] center:float64[3]
        center_trans:float64[3]? center_box:float64[3]? center_joints_box:float64[3]? {_BOX} distance:float32?
        source:string frame_id:string {_CLIP}"""),
    "skipped": _columns("index:int64 reason:string where:string"),
}
_CLIP_COLUMNS = tuple(_columns(_CLIP))
_FIELDS = {info.name for info in fields(LabeledSample)}
_INFO = tuple(info.name for info in fields(PersonInfo))


# ---- samples and rows


def person_row(
    sample: Sample, *, index: int, frame: int = 0, track: int = 0, facts: PersonInfo | None = None
) -> dict[str, Any]:
    """A row of the people table. The sample needs pose (body26), part, ring and box."""
    info: dict[str, Any] = dict.fromkeys(_INFO) if facts is None else asdict(facts)
    return _sample_columns(sample, "people") | info | {"index": index, "frame": frame, "track": track}


def labeled_row(sample: LabeledSample, *, index: int) -> dict[str, Any]:
    """A row of the table of real people. index: number of the part that the person is from. Raises InputError for a
    center without a column."""
    unknown = sorted(sample.centers.keys() - set(CENTERS))
    if unknown:
        raise InputError(f"centers have the names {', '.join(CENTERS)}, got {', '.join(unknown)}")
    centers = {f"center_{name}": center for name, center in sample.centers.items()}
    distance = sample.distance if sample.sensor_known else None
    return _sample_columns(sample, "labelled") | centers | {"index": index, "distance": distance}


def _sample_columns(sample: Sample, table: str) -> dict[str, Any]:
    if sample.pose is None:
        raise InputError(f"a row of the table {table} needs a sample with a pose")
    row = {name: getattr(sample, name, None) for name in TABLES[table]} | {"joints": sample.pose.joints}
    return row | {f"box_{name}": getattr(sample.box, name, None) for name in ("center", "size", "yaw")}


def sample_of(row: dict[str, Any], skeleton_name: str = BODY26.name, what: str = "people") -> LabeledSample:
    """The sample of a row, as `read_rows` gives it. what: as in the settings of the dataset's card.

    The id of the box is the track, of real people and in streets. All joints of synthetic people count as seen.
    Raises InputError that names the column for a row that is none.
    """
    joints = skeleton(skeleton_name)
    is_real = "joint_labels" in row
    _check_row(row, "labelled" if is_real else "people", len(joints))
    values = {name: row[name] for name in row.keys() & _FIELDS} | {"track": str(row["track"])}
    if is_real:
        values["centers"] = {name: row[f"center_{name}"] for name in CENTERS if row[f"center_{name}"] is not None}
        values["sensor_known"] = row["distance"] is not None
    else:
        values["joint_labels"] = np.full(len(joints), SEEN, np.uint8)
        values["sequence"] = str(row["index"])
        values["time"] = np.nan if what == "people" else row["frame"] / _CLIP_HZ
        values["info"] = PersonInfo(**{name: row[name] for name in _INFO if row[name] is not None})
    if row["box_center"] is not None:
        track = row["track"] if is_real or what == "streets" else None
        values["box"] = Box(center=row["box_center"], size=row["box_size"], yaw=row["box_yaw"], id=track)
    for name in ("points", "rotations", "background", "neighbors"):
        values[name] = None if row[name] is None else row[name].reshape(-1, 3)
    return LabeledSample(**values, pose=Pose(joints=row["joints"].reshape(-1, 3), skeleton=joints, frame="sensor"))


def _check_row(row: dict[str, Any], table: str, joints: int) -> None:
    """Raises InputError for a null that may be none, lists of wrong lengths and values that cannot be."""
    for name, column in TABLES[table].items():
        if row[name] is None and not column.optional:
            raise InputError(f"column {name} is null, expected {column.text}")
    if len({row[name] is None for name in ("box_center", "box_size", "box_yaw")}) > 1:
        raise InputError("columns box_center, box_size, box_yaw: some are null, expected all or none")
    _check_lengths(row, table, joints)
    clip = [name for name in _CLIP_COLUMNS if row[name] is not None]
    for name in ("points", "center", *clip):
        if not np.isfinite(row[name]).all():
            raise InputError(f"column {name} has values that are no finite numbers")
    # a joint may be NaN
    for name in ("points", "center", "joints", *clip):
        if (np.abs(row[name]) > FARTHEST).any():
            raise InputError(f"column {name} has values beyond {FARTHEST:g} m")
    if row["part"] is not None and row["part"].max(initial=0) > len(SMPL24):
        raise InputError(f"column part has values above {len(SMPL24)}, expected 0 or 1 + a joint of SMPL-24")


def _check_lengths(row: dict[str, Any], table: str, joints: int = 0) -> None:
    """Raises InputError for lists whose lengths do not belong together. The first list of points or of people says how
    many there are."""
    sizes = {"J": joints}
    for name, column in TABLES[table].items():
        if column.shape is None or row[name] is None:
            continue
        first, *rest = column.shape
        each = math.prod(map(int, rest))
        count = int(first) if first.isdecimal() else sizes.setdefault(first, len(row[name]) // each)
        if len(row[name]) != count * each:
            expected = f"{count * each}: {column.text} with {first} = {count}"
            raise InputError(f"column {name} has {len(row[name])} values, expected {expected}")


# ---- rows and Arrow


def pyarrow():
    """pyarrow and pyarrow.parquet. Raises MissingExtra without them."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("reading and writing Parquet", "synth") from None
    return pyarrow, pyarrow.parquet


def _arrow_type(pa, column: Column):
    value = pa.bool_() if column.type == "bool" else getattr(pa, column.type)()
    return value if column.shape is None else pa.list_(value)


def to_arrow(pa, table: str, rows: list[dict[str, Any]]):
    """Rows as an Arrow table."""
    schema = pa.schema([(name, _arrow_type(pa, column)) for name, column in TABLES[table].items()])
    arrays = []
    for name, column in TABLES[table].items():
        values = [row[name] for row in rows]
        if column.type == "string":
            # names from a disk or from JSON may hold what is no character
            values = [v if v is None else v.encode("utf-8", "backslashreplace").decode() for v in values]
        elif column.shape is not None:
            values = [v if v is None else np.asarray(v, column.type).ravel() for v in values]
        arrays.append(pa.array(values, schema.field(name).type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _rows_of(pa, batch, table: str) -> Iterator[dict[str, Any]]:
    """The rows of a record batch, lists as numpy arrays; None where a value is null or its column is missing. Raises
    InputError that names the column for one of another type."""
    columns: dict[str, Any] = {}
    for name, column in TABLES[table].items():
        if name not in batch.schema.names:
            columns[name] = [None] * batch.num_rows
            continue
        values = batch.column(name)
        # of tables of people `sample_of` names the row
        if table in ("frames", "skipped") and values.null_count and not column.optional:
            raise InputError(f"column {name} has nulls, expected {column.text}")
        try:
            values = values.cast(_arrow_type(pa, column))
        except pa.ArrowException:
            raise InputError(f"column {name} is {values.type}, expected {column.text}") from None
        if column.shape is None:
            columns[name] = values.to_pylist()
            continue
        if values.flatten().null_count:
            raise InputError(f"column {name} has nulls in its lists, expected {column.text}")
        columns[name] = [cell.values.to_numpy() if cell.is_valid else None for cell in values]
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        if table == "frames":
            _check_lengths(row, table)
        yield row


# ---- the card


def counted(count: int, what: str) -> str:
    """ "1 street", "1,200 people"."""
    return f"{count:,} {_SINGULAR.get(what, what) if count == 1 else what}"


@dataclass(frozen=True, kw_only=True)
class DatasetCard:
    """What dataset.json says: settings, all that decides the content; count of persons, clips, streets or parts;
    per_shard; tables; skeleton's name; version of the package that wrote it; frame of points and joints; about: of a
    real dataset, its license, quirks and parts; summary: what a finished one holds."""

    settings: dict[str, Any]
    count: int
    per_shard: int
    tables: tuple[str, ...]
    skeleton: str = BODY26.name
    version: str = __version__
    frame: str = SENSOR_FRAME
    about: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] | None = None

    @property
    def people(self) -> str:
        """The table of people: "people" of synthetic ones, "labelled" of real ones."""
        return "labelled" if "labelled" in self.tables else "people"

    @property
    def writer(self) -> str:
        """The command that writes such a dataset."""
        return "lidarpose prepare" if self.people == "labelled" else "lidarpose synth"

    @property
    def shards(self) -> int:
        """How many shards a table has."""
        return -(-self.count // self.per_shard)

    def size(self, shard: int) -> int:
        """How many persons, clips or streets a shard holds."""
        return min(self.per_shard, self.count - shard * self.per_shard)

    def to_json(self) -> str:
        content = {
            **{"schema": SCHEMA, "version": self.version, "count": self.count, "per_shard": self.per_shard},
            **{"tables": self.tables, "unit": "m", "frame": self.frame, "skeleton": self.skeleton},
            **{"joints": skeleton(self.skeleton).joints, "settings": self.settings},
            **({"about": self.about} if self.about else {}),
            **({} if self.summary is None else {"summary": self.summary}),
        }
        return json.dumps(content, indent=2) + "\n"


_CARD_TYPES: dict[str, Callable[[Any], Any]] = {
    **{"settings": dict, "count": int, "per_shard": int, "tables": lambda names: tuple(map(str, names))},
    **{"skeleton": str, "version": str, "frame": str, "about": dict, "summary": dict},
}
_OPTIONAL = ("frame", "about", "summary")


def read_card(folder: str | Path) -> DatasetCard:
    """The card of a dataset's folder. Raises InputError where it is missing, damaged or of another schema."""
    path = Path(folder) / CARD
    if not path.is_file():
        raise file_error(folder, f"is no dataset: {CARD} is missing; write one with lidarpose synth or prepare")
    try:
        content = json.loads(read_bytes(path, expected="a dataset's card"))
        if content["schema"] != SCHEMA:
            version = content.get("version", "of the version that wrote it")
            problem = f"is of schema {content['schema']!r}, this lidarpose reads {SCHEMA}: install lidarpose {version}"
            raise file_error(path, problem)
        names = [name for name in _CARD_TYPES if name in content or name not in _OPTIONAL]
        card = DatasetCard(**{name: _CARD_TYPES[name](content[name]) for name in names})
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise file_error(path, f"is not a dataset's card ({problem})") from None
    if card.count < 1 or card.per_shard < 1 or not set(card.tables) <= set(TABLES):
        raise file_error(path, "is not a dataset's card: count, per_shard or tables make no sense")
    skeleton(card.skeleton)
    return card


def write_card(folder: str | Path, card: DatasetCard) -> None:
    """Writes dataset.json, whole or not at all."""
    write_atomic(Path(folder) / CARD, card.to_json())


# ---- files


def shard_path(folder: str | Path, table: str, shard: int) -> Path:
    return Path(folder) / f"{table}-{shard:05d}.parquet"


@contextmanager
def shard_writer(path: str | Path, table: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Writes the rows of a table ("people", "frames", ...), whole or not at all; the same rows give the same bytes.

    Yields what adds a row, and holds a row group of them at a time. Raises InputError where the folder cannot be
    written, MissingExtra without pyarrow.
    """
    pa, parquet = pyarrow()
    waiting: list[dict[str, Any]] = []

    def flush() -> None:
        writer.write_table(to_arrow(pa, table, waiting), row_group_size=_ROW_GROUP[table])
        waiting.clear()

    def add(row: dict[str, Any]) -> None:
        waiting.append(row)
        if len(waiting) == _ROW_GROUP[table]:
            flush()

    # a flipped bit in points would pass unnoticed
    options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
    schema = to_arrow(pa, table, []).schema
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema, **options) as writer:
        yield add
        if waiting:
            flush()


@contextmanager
def open_parquet(path: str | Path, remedy: str, **options: Any) -> Iterator[Any]:
    """An open Parquet file. Whatever goes wrong with it in the block is an InputError of one line that names it."""
    pa, parquet = pyarrow()
    try:
        with parquet.ParquetFile(path, **options) as file:
            yield file
    except InputError as error:
        raise file_error(path, error) from None
    except FileNotFoundError:
        raise file_error(path, "is missing") from None
    except (pa.ArrowException, OSError, ValueError, TypeError, AttributeError, KeyError, MemoryError) as error:
        raise file_error(path, f"cannot be read as Parquet ({error}); {remedy}") from None


def rows_of_shard(path: str | Path) -> int | None:
    """How many rows a shard says it holds; None where it is missing or damaged."""
    with suppress(InputError), open_parquet(path, "") as file:
        return file.metadata.num_rows
    return None


def read_rows(path: str | Path, table: str, columns: tuple[str, ...] | None = None) -> Iterator[dict[str, Any]]:
    """The rows of a shard, list columns as numpy arrays; of `columns` alone where they are named, the others None.

    Raises InputError for a damaged file, and for a column that is missing or of another type.
    """
    pa, _ = pyarrow()
    with open_parquet(path, "delete it and make it again", page_checksum_verification=True) as file:
        names = file.schema_arrow.names
        missing = [name for name, column in TABLES[table].items() if name not in names and not column.optional]
        if missing:
            raise InputError(f"is no shard of {table}: the columns {', '.join(missing)} are missing")
        wanted = [name for name in TABLES[table] if name in names and (columns is None or name in columns)]
        for batch in file.iter_batches(batch_size=_ROW_GROUP[table], columns=wanted):
            yield from _rows_of(pa, batch, table)


@dataclass(frozen=True, kw_only=True)
class DatasetReader:
    """A folder of shards, read as it is iterated: its samples in order. card: what dataset.json says."""

    folder: Path
    card: DatasetCard

    def path(self, shard: int, table: str | None = None) -> Path:
        """A shard of a table, by default that of people."""
        return shard_path(self.folder, table or self.card.people, shard)

    def written(self, table: str | None = None) -> list[int]:
        """Numbers of the shards of a table, by default that of people, that are there: no count in dataset.json makes
        this long."""
        name = re.compile(rf"{table or self.card.people}-(\d{{5,9}})\.parquet")
        numbers = (name.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(k for k in (int(number[1]) for number in numbers if number) if k < self.card.shards)

    def rows(self, table: str | None = None, shards: Iterable[int] | None = None) -> Iterator[dict[str, Any]]:
        """The rows of a table, of some shards or of all; see `TABLES`. By default those of people."""
        for shard in range(self.card.shards) if shards is None else shards:
            path = self.path(shard, table)
            if not path.is_file():
                raise self._unfinished(path)
            yield from read_rows(path, table or self.card.people)

    def rows_of(self, table: str, shard: int) -> int:
        """How many rows a shard has. Raises InputError where it is missing or damaged."""
        path = self.path(shard, table)
        rows = rows_of_shard(path)
        if rows is None:
            raise self._unfinished(path)
        return rows

    def _unfinished(self, path: Path) -> InputError:
        problem = "is damaged" if path.exists() else "is missing: the dataset is not finished"
        return file_error(path, f"{problem}; run the same {self.card.writer} again")

    def __iter__(self) -> Iterator[LabeledSample]:
        return (self.sample(row) for row in self.rows())

    def samples(self, split: str | None = None) -> Iterator[LabeledSample]:
        """Everybody with what is labeled, or of a dataset of real people those of a split ("train", "val", "test").

        Raises InputError for a split of synthetic people, and for one that nobody is in.
        """
        if split is not None and self.card.people != "labelled":
            raise file_error(self.folder, f"holds synthetic people, which have no split {split!r}: leave it out")
        is_empty = True
        for row in self.rows():
            if split is None or row["split"] == split:
                is_empty = False
                yield self.sample(row)
        if is_empty and split is not None:
            raise file_error(self.folder, f"has nobody in the split {split!r}; prepare says which splits it has")

    # the name until 0.2
    items = samples

    def sample(self, row: dict[str, Any]) -> LabeledSample:
        """The sample of a row of people. Raises InputError that names its shard and column for a row that is none."""
        try:
            return sample_of(row, self.card.skeleton, self.card.settings.get("what", "people"))
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            number = row.get("index")
            place = self.folder if number is None else self.path(number // self.card.per_shard)
            raise file_error(place, f"row of index {number} is no sample: {error}; write it again") from None


def open_dataset(folder: str | Path) -> DatasetReader:
    """A dataset that `lidarpose synth` or `prepare` wrote. Raises InputError for none, MissingExtra without pyarrow."""
    pyarrow()
    return DatasetReader(folder=Path(folder), card=read_card(folder))
