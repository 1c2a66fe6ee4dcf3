"""Predictions for a dataset's people beside the ground truth, as arrays and as poses.parquet, from which every metric
can be recomputed.

A row is one person in one frame; columns:

    dataset             name, as in scores.json
    shard, row          position in the dataset
    sequence, frame, track, time        s, NaN where unknown
    sensor, condition, poses, family, plain     known for synthetic sets; "" where unknown
    moving              a frame of a clip that counts for the acceleration error only
    points              number of points that the network was given
    distance            m from the sensor, NaN where unknown
    hidden              share of the body that is hidden, for synthetic people; else NaN, but labels may record it
    box                 center (3), size (3), yaw of the box before any jitter: m, rad; null without a box
    pred, true          x, y, z of the joints that the file's metadata names, m, in the dataset's frame; pred is null
                        without a pose, true NaN without a label
    labels              one per joint: 0 not labeled, 1 hidden or uncertain, 2 seen
    nearby              one per joint: number of points that the network was given within 15 cm of the true joint, NaN
                        without a label; null in files written before 0.3
    confidence, spread, visible         one per joint, null if the network does not predict it; spread in m
    person, second_person               probability that the cloud shows a person, and a second person; NaN if the
                        network does not predict it
    error_mm            one per joint, NaN where there is nothing to score
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.shards import pyarrow
from lidarpose.eval.metrics.joint_errors import joint_errors
from lidarpose.io.files import file_error, read_bytes
from lidarpose.sample import UNLABELED
from lidarpose.skeleton import Skeleton

# key of the joints' names in the file's metadata
METADATA = "lidarpose.poses"
# radius about a true joint in which points are near it, m
NEARBY = 0.15


def _column(kind: type, *shape: int, null: bool = False) -> Any:
    """A column: type; shape of one person's values, -1 for J; whether a value that is all NaN is null in the file."""
    return field(metadata={"kind": kind, "shape": shape, "null": null})


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """N people with the J joints of `skeleton`. Columns as in poses.parquet: pred, true (N, J, 3) float32 m, pred NaN
    without a pose; labels (N, J) uint8; nearby (N, J) float32, NaN if not known; confidence, spread, visible (N, J)
    float32, NaN if not predicted; box (N, 7), NaN without a box; the others (N,)."""

    skeleton: Skeleton
    shard: np.ndarray = _column(np.int32)
    row: np.ndarray = _column(np.int64)
    sequence: np.ndarray = _column(str)
    frame: np.ndarray = _column(np.int64)
    track: np.ndarray = _column(str)
    time: np.ndarray = _column(np.float64)
    sensor: np.ndarray = _column(str)
    condition: np.ndarray = _column(str)
    poses: np.ndarray = _column(str)
    family: np.ndarray = _column(str)
    plain: np.ndarray = _column(bool)
    moving: np.ndarray = _column(bool)
    points: np.ndarray = _column(np.int32)
    distance: np.ndarray = _column(np.float32)
    hidden: np.ndarray = _column(np.float32)
    box: np.ndarray = _column(np.float64, 7, null=True)
    pred: np.ndarray = _column(np.float32, -1, 3, null=True)
    true: np.ndarray = _column(np.float32, -1, 3)
    labels: np.ndarray = _column(np.uint8, -1)
    nearby: np.ndarray = _column(np.float32, -1, null=True)
    confidence: np.ndarray = _column(np.float32, -1, null=True)
    spread: np.ndarray = _column(np.float32, -1, null=True)
    visible: np.ndarray = _column(np.float32, -1, null=True)
    person: np.ndarray = _column(np.float32, null=True)
    second_person: np.ndarray = _column(np.float32, null=True)

    def __len__(self) -> int:
        return len(self.pred)

    @property
    def posed(self) -> np.ndarray:
        """(N,) bool: people with a pose."""
        return np.isfinite(self.pred).all((1, 2))

    @property
    def boxed(self) -> np.ndarray:
        """(N,) bool: people with a box."""
        return np.isfinite(self.box).all(1)

    @property
    def labeled(self) -> np.ndarray:
        """(N, J) bool: joints to score, labeled as hidden or seen, of people with a pose."""
        return (self.labels != UNLABELED) & self.posed[:, None]

    # the name until 0.2
    labelled = labeled

    @property
    def filled(self) -> np.ndarray:
        """(N, J, 3): pred, with 0 for people without a pose, none of whose joints count as labeled."""
        return np.where(self.posed[:, None, None], self.pred, 0)

    def errors(self) -> np.ndarray:
        """(N, J) mm; NaN without a label or a pose."""
        return joint_errors(self.filled, self.true, self.labeled)

    def select(self, rows: np.ndarray) -> "Predictions":
        """The people in `rows`."""
        return replace(self, **{column.name: getattr(self, column.name)[rows] for column in _COLUMNS})

    # the name until 0.2
    of = select


_COLUMNS = [column for column in fields(Predictions) if column.metadata]


def num_nearby(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """points (n, 3) m, joints (J, 3) m -> (J,): points within `NEARBY` of each joint; NaN for a joint that is NaN."""
    count = np.array([(np.linalg.norm(points[:, :3] - joint, axis=1) < NEARBY).sum() for joint in joints], float)
    return np.where(np.isfinite(joints).all(-1), count, np.nan)


def stack(skeleton: Skeleton, rows: Sequence[dict[str, Any]]) -> Predictions:
    """Predictions from one dict per person, with the columns' names as keys. A value that is None or missing is null;
    numbers get the precision of the file."""
    columns: dict[str, np.ndarray] = {}
    for column in _COLUMNS:
        name, kind = column.name, column.metadata["kind"]
        shape = [len(skeleton) if size == -1 else size for size in column.metadata["shape"]]
        if column.metadata["null"]:
            values = [np.full(shape, np.nan) if row.get(name) is None else np.reshape(row[name], shape) for row in rows]
        else:
            # files written before 0.3 have no families
            values = [row.get(name, "") if name == "family" else row[name] for row in rows]
        columns[name] = np.array(values, kind).reshape(len(rows), *shape)
    return Predictions(skeleton=skeleton, **columns)


def concatenate(parts: Sequence[Predictions]) -> Predictions:
    """Joins one or more predictions of the same joints."""
    columns: dict[str, Any] = {
        column.name: np.concatenate([getattr(part, column.name) for part in parts]) for column in _COLUMNS
    }
    return replace(parts[0], **columns)


# ---- poses.parquet


def poses_parquet(predictions: dict[str, Predictions]) -> bytes:
    """The bytes of poses.parquet. predictions: name of a dataset -> its people."""
    pa, parquet = pyarrow()
    types = [("dataset", pa.string())]
    for column in _COLUMNS:
        kind, shape = column.metadata["kind"], column.metadata["shape"]
        value = pa.string() if kind is str else pa.from_numpy_dtype(kind)
        types.append((column.name, pa.list_(value) if shape else value))
    skeletons = {name: people.skeleton for name, people in predictions.items()}
    dataset_entries = {
        k: {"skeleton": skeleton.name, "joints": skeleton.joints, "parents": skeleton.parents}
        for k, skeleton in skeletons.items()
    }
    schema = pa.schema(
        [*types, ("error_mm", pa.list_(pa.float32()))],
        metadata={METADATA: json.dumps({"unit": "m", "datasets": dataset_entries})},
    )
    buffer = BytesIO()
    with parquet.ParquetWriter(buffer, schema, compression="zstd", write_page_checksum=True) as writer:
        for name, people in predictions.items():
            values: dict[str, Any] = {
                "dataset": [name] * len(people),
                "error_mm": list(people.errors().astype(np.float32)),
            }
            for column in _COLUMNS:
                array = getattr(people, column.name)
                if column.metadata["shape"]:
                    flat = array.reshape(len(people), -1)
                    null_mask = np.isnan(flat).all(1) & column.metadata["null"]
                    array = [None if is_null else row for is_null, row in zip(null_mask, flat, strict=True)]
                values[column.name] = array
            writer.write_table(pa.Table.from_pydict(values, schema=schema))
    return buffer.getvalue()


def read_poses(path: str | Path) -> dict[str, Predictions]:
    """The people of poses.parquet by dataset. Raises InputError for another file, MissingExtra without pyarrow."""
    pa, parquet = pyarrow()
    data = read_bytes(path, expected="poses.parquet of an evaluation")
    try:
        table = parquet.read_table(pa.BufferReader(data), page_checksum_verification=True)
        dataset_entries = json.loads(table.schema.metadata[METADATA.encode()])["datasets"]
        predictions = {}
        for name, entry in dataset_entries.items():
            joints, parents = tuple(entry["joints"]), tuple(entry["parents"])
            records = table.filter(pa.compute.equal(table["dataset"], name)).to_pylist()
            rows = [{key: value for key, value in row.items() if value is not None} for row in records]
            predictions[name] = stack(Skeleton(name=entry["skeleton"], joints=joints, parents=parents), rows)
        return predictions
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        remedy = "lidarpose.read_poses reads .poses.json" if data.startswith(b"{") else "evaluate again"
        raise file_error(path, f"is not the poses.parquet of an evaluation ({error}); {remedy}") from None
