"""What was predicted of a dataset's people, beside the truth, as arrays; and as poses.parquet, from which every metric
can be computed again.

A row is one person in one frame; columns:

    dataset             name, as in scores.json
    shard, row          where in the dataset
    sequence, frame, track, time        s, NaN where unknown
    sensor, condition, poses, plain     what synthetic sets tell; "" where nothing is known
    moving              a frame of a clip that counts for acceleration alone
    points              how many points the network was given
    distance            m from the sensor, NaN where unknown
    hidden              share of the body that is hidden, of synthetic people; else NaN, labels may tell
    box                 center (3), size (3), yaw of the box before any jitter: m, rad; null where there is none
    pred, true          x, y, z of the joints that the file's metadata names, m, in the dataset's frame; pred null
                        without a pose, true NaN without a label
    labels              one a joint: 0 not labelled, 1 hidden or uncertain, 2 seen
    confidence, spread, visible         one a joint, null where the network does not tell; spread in m
    error_mm            one a joint, NaN where there is nothing to judge
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
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
# columns of one value a person
_VALUES = {
    **{"shard": np.int32, "row": np.int64, "sequence": str, "frame": np.int64, "track": str, "time": np.float64},
    **{"sensor": str, "condition": str, "poses": str, "plain": bool, "moving": bool},
    **{"points": np.int32, "distance": np.float32, "hidden": np.float32},
}
# columns of a list a person: type, shape of one person's with J joints as -1
_LISTS: dict[str, tuple[type, tuple[int, ...]]] = {
    "box": (np.float64, (7,)),
    "pred": (np.float32, (-1, 3)),
    "true": (np.float32, (-1, 3)),
    "labels": (np.uint8, (-1,)),
    **dict.fromkeys(("confidence", "spread", "visible"), (np.float32, (-1,))),
}
# of these NaN all over is null in the file: there is none
_NULLABLE = ("box", "pred", "confidence", "spread", "visible")


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """N people in J joints, of `skeleton`. Columns as in poses.parquet: pred, true (N, J, 3) float32 m, pred NaN
    without a pose; labels (N, J) uint8; confidence, spread, visible (N, J) float32, NaN where not stated; box (N, 7),
    NaN where there is none; the others (N,)."""

    skeleton: Skeleton
    pred: np.ndarray
    true: np.ndarray
    labels: np.ndarray
    confidence: np.ndarray
    spread: np.ndarray
    visible: np.ndarray
    box: np.ndarray
    shard: np.ndarray
    row: np.ndarray
    sequence: np.ndarray
    frame: np.ndarray
    track: np.ndarray
    time: np.ndarray
    sensor: np.ndarray
    condition: np.ndarray
    poses: np.ndarray
    plain: np.ndarray
    moving: np.ndarray
    points: np.ndarray
    distance: np.ndarray
    hidden: np.ndarray

    def __len__(self) -> int:
        return len(self.pred)

    @property
    def posed(self) -> np.ndarray:
        """(N,) bool: has a pose."""
        return np.isfinite(self.pred).all((1, 2))

    @property
    def boxed(self) -> np.ndarray:
        """(N,) bool: has a box."""
        return np.isfinite(self.box).all(1)

    @property
    def labeled(self) -> np.ndarray:
        """(N, J) bool: a joint that counts, hidden or seen, of a person with a pose."""
        return (self.labels != UNLABELED) & self.posed[:, None]

    # names until 0.2
    labelled = labeled

    @property
    def filled(self) -> np.ndarray:
        """(N, J, 3): pred, 0 without a pose; such people have no labeled joints."""
        return np.where(self.posed[:, None, None], self.pred, 0)

    def errors(self) -> np.ndarray:
        """(N, J) mm; NaN without a label or a pose."""
        return joint_errors(self.filled, self.true, self.labeled)

    def select(self, rows: np.ndarray) -> "Predictions":
        """Some of the people."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "skeleton"})

    of = select


def stack(skeleton: Skeleton, rows: Sequence[dict[str, Any]]) -> Predictions:
    """Predictions from a dict a person, whose keys are the columns' names; None or nothing where the file
    would have null; numbers become as wide as in the file."""
    columns: dict[str, np.ndarray] = {
        name: np.array([row[name] for row in rows], kind) for name, kind in _VALUES.items()
    }
    for name, (kind, shape) in _LISTS.items():
        shape = (len(rows), *(len(skeleton) if size == -1 else size for size in shape))
        columns[name] = np.full(shape, 0 if kind is np.uint8 else np.nan, kind)
        for k, row in enumerate(rows):
            if (value := row.get(name) if name in _NULLABLE else row[name]) is not None:
                columns[name][k] = np.reshape(value, shape[1:])
    return Predictions(skeleton=skeleton, **columns)


def subset(of: Skeleton, joints: Sequence[str]) -> Skeleton:
    """A skeleton of some joints of another, in its order; each hangs on the nearest of its ancestors that is left, or
    on the first."""
    if tuple(joints) == of.joints:
        return of
    parents: list[int] = []
    for name in joints:
        parent = of.parents[of.index(name)]
        while parent >= 0 and of.joints[parent] not in joints:
            parent = of.parents[parent]
        parents.append(joints.index(of.joints[parent]) if parent >= 0 else min(len(parents), 1) - 1)
    return Skeleton(name=f"{len(joints)} joints of {of.name}", joints=tuple(joints), parents=tuple(parents))


# ---- poses.parquet


def write_poses(path: str | Path, predictions: dict[str, Predictions]) -> None:
    """Writes poses.parquet, people of all datasets by their names, into a file that nothing else writes."""
    pa, parquet = pyarrow()
    types = {str: pa.string(), bool: pa.bool_()}
    columns = [("dataset", pa.string())]
    columns += [(name, types[kind] if kind in types else pa.from_numpy_dtype(kind)) for name, kind in _VALUES.items()]
    columns += [(name, pa.list_(pa.from_numpy_dtype(kind))) for name, (kind, _) in _LISTS.items()]
    skeletons = {name: own.skeleton for name, own in predictions.items()}
    about = {k: {"skeleton": of.name, "joints": of.joints, "parents": of.parents} for k, of in skeletons.items()}
    schema = pa.schema(
        [*columns, ("error_mm", pa.list_(pa.float32()))],
        metadata={METADATA: json.dumps({"unit": "m", "datasets": about})},
    )
    with parquet.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
        for name, own in predictions.items():
            values: dict[str, Any] = {"dataset": [name] * len(own)} | {key: getattr(own, key) for key in _VALUES}
            values["error_mm"] = list(own.errors().astype(np.float32))
            for key in _LISTS:
                flat = getattr(own, key).reshape(len(own), -1)
                null = np.isnan(flat).all(1) & (key in _NULLABLE)
                values[key] = [None if is_null else row for is_null, row in zip(null, flat, strict=True)]
            writer.write_table(pa.Table.from_pydict(values, schema=schema))


def read_poses(path: str | Path) -> dict[str, Predictions]:
    """The people of poses.parquet by dataset. Raises InputError where it is none, MissingExtra without pyarrow."""
    pa, parquet = pyarrow()
    data = read_bytes(path, expected="poses.parquet of an evaluation")
    try:
        table = parquet.read_table(pa.BufferReader(data), page_checksum_verification=True)
        about = json.loads(table.schema.metadata[METADATA.encode()])["datasets"]
        predictions = {}
        for name, entry in about.items():
            joints, parents = tuple(entry["joints"]), tuple(entry["parents"])
            own = table.filter(pa.compute.equal(table["dataset"], name)).to_pylist()
            rows = [{key: value for key, value in row.items() if value is not None} for row in own]
            predictions[name] = stack(Skeleton(name=entry["skeleton"], joints=joints, parents=parents), rows)
        return predictions
    except (pa.ArrowException, KeyError, TypeError, ValueError, AttributeError) as error:
        raise file_error(path, f"is no poses.parquet of an evaluation ({error}); evaluate again") from None
