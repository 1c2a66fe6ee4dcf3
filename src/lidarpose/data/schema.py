"""Tables of a dataset's shards: their columns, and how a sample becomes a row and a row a sample.

Any reader of Parquet opens the shards (pandas, DuckDB, Hugging Face datasets, Ray, ...). A row of people-*.parquet is
one synthetic person in one frame:

    index, frame, track     number of the person, clip or street in the dataset; frame of it; person in a street
    points                  x, y, z of all points one after the other, m: reshape to (n, 3); the level frame at the
                            sensor, x forward, y left, z up
    part, ring              one a point: 0 = not body, 1 + j = the bone of SMPL-24's joint j; the beam
    joints                  x, y, z of the joints named in dataset.json, m
    center                  origin of the person's own frame, found from the points
    box_center, box_size, box_yaw    a detector's box: m, m, rad
    source, frame_id        as in `Sample`
    sensor, kind, ...       the fields of `PersonInfo`; null where it was not measured

Datasets of real people, which `lidarpose prepare` wrote, have a part of the raw files (a sequence, a file) in each
shard: labelled-*.parquet (columns as above where they mean the same; index numbers the part) with

    sequence, time, split   of the raw dataset; s since the sequence's beginning; train, val, test or null
    track                   text; the person in the sequence
    joints                  NaN where a joint is not labelled
    joint_labels            one a joint: 0 not labelled, 1 hidden or uncertain, 2 seen
    center_trans, ...       other origins that published protocols use, m; null where there is none
    distance                of the center from the sensor, m; null where nobody knows the sensor's place

and skipped-*.parquet: what was left out, `reason` and `where`.

Streets have frames-*.parquet beside them: whole turns of the sensor, with the person of every point, and of everybody
in the street, seen or not, track (P,), box (P, 7: center, size, yaw) and joints (P, J, 3), flattened.
"""

from collections.abc import Iterator
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from lidarpose.errors import InputError, MissingExtra
from lidarpose.sample import FARTHEST, SEEN, Box, LabeledSample, PersonInfo, Pose, Sample
from lidarpose.skeleton import BODY26, SMPL24, skeleton


def _columns(text: str) -> dict[str, str]:
    return dict(column.split(":") for column in text.split())


# a field more is a column more, which older shards have not
_INFO_TYPES: dict[Any, str] = {str: "string?", float: "float32?", bool: "bool?"}
INFO = {info.name: _INFO_TYPES[info.type] for info in fields(PersonInfo)}
# origins that published protocols use, by name: a column center_NAME each
CENTERS = ("trans", "box", "joints_box")
_SAMPLE = _columns("points:float32[] part:uint8[]? ring:int32[]? joints:float32[]")
_BOX = _columns("box_center:float64[]? box_size:float64[]? box_yaw:float64?")
_SOURCE = _columns("source:string frame_id:string")

# table -> column -> its type; "[]" marks a list, flattened arrays are lists, and "?" what may be null
TABLES: dict[str, dict[str, str]] = {
    "people": {
        **_columns("index:int64 frame:int32 track:int32"),
        **_SAMPLE,
        "center": "float64[]",
        **_BOX,
        **_SOURCE,
        **INFO,
    },
    "frames": {
        **_columns("index:int64 frame:int32 sensor:string points:float32[] ring:int32[] person:int16[] part:uint8[]"),
        **_columns("track:int16[] box:float64[] joints:float32[]"),
    },
    "labelled": {
        **_columns("index:int64 sequence:string frame:int64 track:string time:float64 split:string?"),
        **_SAMPLE,
        **_columns("joint_labels:uint8[] center:float64[]"),
        **{f"center_{name}": "float64[]?" for name in CENTERS},
        **_BOX,
        "distance": "float32?",
        **_SOURCE,
    },
    "skipped": _columns("index:int64 reason:string where:string"),
}
# whose rows are samples
_PEOPLE = ("people", "labelled")
# frames per second of synthetic clips and streets
_CLIP_HZ = 10


# ---- samples and rows


def person_row(
    sample: Sample, *, index: int, frame: int = 0, track: int = 0, facts: PersonInfo | None = None
) -> dict[str, Any]:
    """A row of the people table. The sample needs pose (body26), part, ring and box."""
    if sample.pose is None:
        raise InputError("a row of the people table needs a sample with a pose")
    info = dict.fromkeys(INFO) if facts is None else asdict(facts)
    return {"index": index, "frame": frame, "track": track, **_sample_columns(sample, sample.pose), **info}


def labeled_row(sample: LabeledSample, *, index: int) -> dict[str, Any]:
    """A row of the table of real people. index: number of the part that the person is from. Raises InputError for a
    center without a column."""
    unknown = sorted(sample.centers.keys() - set(CENTERS))
    if unknown:
        raise InputError(f"centers have the names {', '.join(CENTERS)}, got {', '.join(unknown)}")
    return {
        "index": index,
        **{name: getattr(sample, name) for name in ("sequence", "frame", "track", "time", "split", "joint_labels")},
        **_sample_columns(sample, sample.pose),
        **{f"center_{name}": sample.centers.get(name) for name in CENTERS},
        "distance": sample.distance if sample.sensor_known else None,
    }


def _sample_columns(sample: Sample, pose: Pose) -> dict[str, Any]:
    box = sample.box
    return {
        "points": sample.points.ravel(),
        "part": sample.part,
        "ring": sample.ring,
        "joints": np.asarray(pose.joints, np.float32).ravel(),
        "center": sample.center,
        "box_center": box and box.center,
        "box_size": box and box.size,
        "box_yaw": box and float(box.yaw),
        "source": sample.source,
        "frame_id": sample.frame_id,
    }


def sample_of(row: dict[str, Any], skeleton_name: str = BODY26.name, what: str = "people") -> LabeledSample:
    """The sample of a row, as `rows_of` gives it. what: as in the settings of the dataset's card.

    The id of the box is the track, of real people and in streets. All joints of synthetic people count as seen.
    Raises InputError that names the column for a row that is none.
    """
    joints = skeleton(skeleton_name)
    real = "joint_labels" in row
    _check_row(row, "labelled" if real else "people", len(joints))
    labels: dict[str, Any]
    if real:
        labels = {
            **{name: row[name] for name in ("joint_labels", "sequence", "time", "split")},
            "centers": {name: row[f"center_{name}"] for name in CENTERS if row[f"center_{name}"] is not None},
            "sensor_known": row["distance"] is not None,
        }
    else:
        labels = {
            "joint_labels": np.full(len(joints), SEEN, np.uint8),
            "sequence": str(row["index"]),
            "time": np.nan if what == "people" else row["frame"] / _CLIP_HZ,
            "info": PersonInfo(**{name: row[name] for name in INFO if row[name] is not None}),
        }
    box = None
    if row["box_center"] is not None:
        box_id = row["track"] if real or what == "streets" else None
        box = Box(center=row["box_center"], size=row["box_size"], yaw=row["box_yaw"], id=box_id)
    return LabeledSample(
        points=row["points"].reshape(-1, 3),
        pose=Pose(joints=row["joints"].reshape(-1, 3), skeleton=joints, frame="sensor"),
        box=box,
        track=str(row["track"]),
        **{name: row[name] for name in ("center", "part", "ring", "source", "frame_id", "frame")},
        **labels,
    )


def _check_row(row: dict[str, Any], table: str, joints: int) -> None:
    """Raises InputError for a null that may be none and for a list of a length that cannot be."""
    for name, kind in TABLES[table].items():
        if row[name] is None and not kind.endswith("?"):
            raise InputError(f"column {name} is null, expected {kind}")
    if any((row[name] is None) != (row["box_yaw"] is None) for name in _BOX):
        raise InputError("columns box_center, box_size, box_yaw: some are null, expected all or none")
    if len(row["points"]) % 3:
        raise InputError(f"column points has {len(row['points'])} values, expected three for each point")
    for name in ("points", "center"):
        if not np.isfinite(row[name]).all():
            raise InputError(f"column {name} has values that are no finite numbers")
    # a joint may be NaN
    for name in ("points", "center", "joints"):
        if (np.abs(row[name]) > FARTHEST).any():
            raise InputError(f"column {name} has values beyond {FARTHEST:g} m")
    if row["part"] is not None and row["part"].max(initial=0) > len(SMPL24):
        raise InputError(f"column part has values above {len(SMPL24)}, expected 0 or 1 + a joint of SMPL-24")
    lengths = {name: 3 for name in row if name.partition("_")[0] == "center"}
    lengths |= {"box_center": 3, "box_size": 3, "joints": 3 * joints, "joint_labels": joints}
    lengths |= dict.fromkeys(("part", "ring"), len(row["points"]) // 3)
    for name, length in lengths.items():
        if row.get(name) is not None and len(row[name]) != length:
            raise InputError(f"column {name} has {len(row[name])} values, expected {length}")


# ---- rows and Arrow


def pyarrow():
    """pyarrow and pyarrow.parquet. Raises MissingExtra without them."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("reading and writing Parquet", "synth") from None
    return pyarrow, pyarrow.parquet


def schema_of(pa, table: str):
    """The Arrow schema of a table."""
    return pa.schema([(name, _type(pa, kind)) for name, kind in TABLES[table].items()])


def arrays_of(pa, table: str, rows: list[dict[str, Any]]) -> list:
    """A table's columns of some rows, as Arrow arrays."""
    return [_column(pa, [row[name] for row in rows], kind.removesuffix("?")) for name, kind in TABLES[table].items()]


def rows_of(pa, batch, table: str) -> Iterator[dict[str, Any]]:
    """The rows of a record batch, lists as numpy arrays; None where a value is null or its column is missing. Raises
    InputError that names the column for one of another type."""
    columns: dict[str, Any] = {}
    for name, kind in TABLES[table].items():
        if name not in batch.schema.names:
            columns[name] = [None] * batch.num_rows
            continue
        column = batch.column(name)
        # of the others `sample_of` names the row
        if table not in _PEOPLE and column.null_count and not kind.endswith("?"):
            raise InputError(f"column {name} has nulls, expected {kind}")
        try:
            column = column.cast(_type(pa, kind))
        except pa.ArrowException:
            raise InputError(f"column {name} is {column.type}, expected {kind}") from None
        if "[]" not in kind:
            columns[name] = column.to_pylist()
            continue
        if column.flatten().null_count:
            raise InputError(f"column {name} has nulls in its lists, expected {kind}")
        columns[name] = [cell.values.to_numpy() if cell.is_valid else None for cell in column]
    for k in range(batch.num_rows):
        row = {name: values[k] for name, values in columns.items()}
        if table == "frames":
            _check_frame(row)
        yield row


def _check_frame(row: dict[str, Any]) -> None:
    """Raises InputError for lists that do not belong together, of a row of "frames" or of some of its columns."""
    for names, each in ((("points", "ring", "person", "part"), (3, 1, 1, 1)), (("track", "box", "joints"), (1, 7, 78))):
        counts = [len(row[name]) / per for name, per in zip(names, each, strict=True) if row[name] is not None]
        if len(set(counts)) > 1 or any(count % 1 for count in counts):
            raise InputError(f"columns {', '.join(names)} hold different numbers of points or people, or parts of one")


def _column(pa, values: list, kind: str):
    if kind == "string":
        # names from a disk or from JSON may hold what is no character
        values = [value if value is None else value.encode("utf-8", "backslashreplace").decode() for value in values]
    if kind.endswith("[]"):
        values = [v if v is None else np.asarray(v, kind.removesuffix("[]")).ravel() for v in values]
    return pa.array(values, _type(pa, kind))


def _type(pa, kind: str):
    kind = kind.removesuffix("?")
    if kind.endswith("[]"):
        return pa.list_(_type(pa, kind.removesuffix("[]")))
    return pa.bool_() if kind == "bool" else getattr(pa, kind)()
