"""What was predicted of a dataset's people, beside the truth, as arrays; and as poses.parquet, from which every figure
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

import numpy as np

from lidarpose.data.schema import pyarrow
from lidarpose.eval.metrics.joint_errors import joint_errors
from lidarpose.io.files import file_error, read_bytes
from lidarpose.sample import UNLABELED
from lidarpose.skeleton import Skeleton

# key of the joints' names in the file's metadata
METADATA = "lidarpose.poses"
_VALUES = {
    "shard": np.int32,
    "row": np.int64,
    "sequence": str,
    "frame": np.int64,
    "track": str,
    "time": np.float64,
    "sensor": str,
    "condition": str,
    "poses": str,
    "plain": bool,
    "moving": bool,
    "points": np.int32,
    "distance": np.float32,
    "hidden": np.float32,
}
_OF_JOINTS = ("confidence", "spread", "visible")
# box: center, size, yaw
_BOX = 7


@dataclass(frozen=True, kw_only=True)
class Judged:
    """N people in J joints, of `skeleton`. Columns as in poses.parquet: pred, true (N, J, 3) float32 m, pred NaN
    without a pose; labels (N, J) uint8; confidence, spread, visible (N, J) float32, NaN where not told; box (N, 7), NaN
    where there is none; the others (N,)."""

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
    def labelled(self) -> np.ndarray:
        """(N, J) bool: a joint that counts, hidden or seen, of a person with a pose."""
        return (self.labels != UNLABELED) & self.posed[:, None]

    @property
    def filled(self) -> np.ndarray:
        """(N, J, 3): pred, 0 without a pose; such people have no labelled joints."""
        return np.where(self.posed[:, None, None], self.pred, 0)

    def errors(self) -> np.ndarray:
        """(N, J) mm; NaN without a label or a pose."""
        return joint_errors(self.filled, self.true, self.labelled)

    def of(self, rows: np.ndarray) -> "Judged":
        """Some of the people."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "skeleton"}
        return replace(self, **{name: values[rows] for name, values in own.items()})


def gathered(skeleton: Skeleton, rows: Sequence[dict]) -> Judged:
    """Judged people from one dict each, whose keys are the columns' names; numbers become as wide as in the file."""
    count = len(skeleton)
    stacked = {
        name: np.array([row[name] for row in rows], kind) if rows else np.empty(0, kind)
        for name, kind in _VALUES.items()
    }
    for name in ("pred", "true"):
        stacked[name] = np.array([row[name] for row in rows], np.float32).reshape(-1, count, 3)
    for name in _OF_JOINTS:
        stacked[name] = np.array([row[name] for row in rows], np.float32).reshape(-1, count)
    stacked["labels"] = np.array([row["labels"] for row in rows], np.uint8).reshape(-1, count)
    stacked["box"] = np.array([row["box"] for row in rows], float).reshape(-1, _BOX)
    return Judged(skeleton=skeleton, **stacked)


def subset(of: Skeleton, joints: Sequence[str]) -> Skeleton:
    """A skeleton of some joints of another, in its order; each hangs on the nearest of its ancestors that is left, or
    on the first."""
    if tuple(joints) == of.joints:
        return of
    parents = []
    for name in joints:
        at = of.parents[of.index(name)]
        while at >= 0 and of.joints[at] not in joints:
            at = of.parents[at]
        parents.append(joints.index(of.joints[at]) if at >= 0 else min(len(parents), 1) - 1)
    return Skeleton(name=f"{len(joints)} joints of {of.name}", joints=tuple(joints), parents=tuple(parents))


# ---- poses.parquet


def write_poses(path: str | Path, judged: dict[str, Judged]) -> None:
    """Writes poses.parquet, people of all datasets by their names, into a file that nothing else writes."""
    pa, parquet = pyarrow()
    meta = {
        name: {"skeleton": one.skeleton.name, "joints": one.skeleton.joints, "parents": one.skeleton.parents}
        for name, one in judged.items()
    }
    types = {str: pa.string(), bool: pa.bool_()}
    of_joints = pa.list_(pa.float32())
    schema = [("dataset", pa.string())]
    schema += [(name, types[kind] if kind in types else pa.from_numpy_dtype(kind)) for name, kind in _VALUES.items()]
    schema += [("box", pa.list_(pa.float64())), ("pred", of_joints), ("true", of_joints)]
    schema += [("labels", pa.list_(pa.uint8())), *((name, of_joints) for name in _OF_JOINTS), ("error_mm", of_joints)]
    schema = pa.schema(schema, metadata={METADATA: json.dumps({"unit": "m", "datasets": meta})})
    with parquet.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
        for name, one in judged.items():
            columns = {"dataset": [name] * len(one)} | {key: getattr(one, key) for key in _VALUES}
            lists = {key: getattr(one, key) for key in ("box", "pred", "true", "labels", *_OF_JOINTS)}
            lists["error_mm"] = one.errors().astype(np.float32)
            for key, values in lists.items():
                flat = values.reshape(len(one), -1)
                # NaN all over means that there is none; in the truth and the errors it is said joint by joint
                null = np.isnan(flat).all(1) if key not in ("true", "labels", "error_mm") else np.zeros(len(one), bool)
                columns[key] = [None if none else row for none, row in zip(null, flat, strict=True)]
            writer.write_table(pa.Table.from_pydict(columns, schema=schema))


def read_poses(path: str | Path) -> dict[str, Judged]:
    """The people of poses.parquet by dataset. Raises InputError where it is none, MissingExtra without pyarrow."""
    pa, parquet = pyarrow()
    data = read_bytes(path, expected="poses.parquet of an evaluation")
    try:
        table = parquet.read_table(pa.BufferReader(data), page_checksum_verification=True)
        meta = json.loads(table.schema.metadata[METADATA.encode()])["datasets"]
        out = {}
        for name, told in meta.items():
            skeleton = Skeleton(name=told["skeleton"], joints=tuple(told["joints"]), parents=tuple(told["parents"]))
            count = len(skeleton)
            empty = {"pred": np.full((count, 3), np.nan), "box": np.full(_BOX, np.nan)}
            empty |= {key: np.full(count, np.nan) for key in _OF_JOINTS}
            own = table.filter(pa.compute.equal(table["dataset"], name)).to_pylist()
            rows = [
                {
                    key: empty[key] if value is None else value
                    for key, value in row.items()
                    if key in empty or value is not None
                }
                for row in own
            ]
            for row in rows:
                row["pred"], row["true"] = (np.reshape(row[key], (count, 3)) for key in ("pred", "true"))
            out[name] = gathered(skeleton, rows)
        return out
    except (pa.ArrowException, KeyError, TypeError, ValueError, AttributeError) as error:
        raise file_error(path, f"is no poses.parquet of an evaluation ({error}); evaluate again") from None
