"""People of datasets in memory, in one frame each, joints by the names of body26.

Legend: N people, M points of all of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import HIDDEN, SEEN
from lidarpose.data.schema import CENTERS
from lidarpose.data.shards import Dataset, open_dataset, shard_path
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, listed
from lidarpose.sample import Box
from lidarpose.skeleton import BODY26, skeleton
from lidarpose.train.example import UNKNOWN_PART, seen


@dataclass(frozen=True, kw_only=True)
class StoredPerson:
    """One stored person, sensor's frame. points (n, 3) m; part (n,) int16, -1 unknown; joints (26, 3) m, NaN without
    a label; visible (26,) 1, 0 or NaN; center (3,) m from the points; centers: others by name, as in `Item`; box or
    None; sensor_known: whether the frame's origin is the sensor."""

    points: np.ndarray
    part: np.ndarray
    joints: np.ndarray
    visible: np.ndarray
    center: np.ndarray
    centers: dict[str, np.ndarray]
    box: Box | None
    sensor_known: bool


@dataclass(frozen=True, kw_only=True)
class Crowd:
    """Everybody. start, end (N,): where a person's points begin and end; visible (N, 26): as in `StoredPerson`;
    centers: (N, 3) m by name, NaN for none; box (N, 7), NaN for none; sequence (N,): numbers of `sequences`; dataset:
    name of the first one, "" if synthetic; damaged: what could not be read; the rest as in `StoredPerson`."""

    points: np.ndarray
    part: np.ndarray
    start: np.ndarray
    end: np.ndarray
    joints: np.ndarray
    visible: np.ndarray
    center: np.ndarray
    centers: dict[str, np.ndarray]
    box: np.ndarray
    sensor_known: np.ndarray
    sequence: np.ndarray
    sequences: tuple[str, ...]
    skeleton: str
    dataset: str
    damaged: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.center)

    def person(self, row: int) -> StoredPerson:
        own = slice(self.start[row], self.end[row])
        box = self.box[row]
        return StoredPerson(
            points=self.points[own],
            part=self.part[own],
            joints=self.joints[row],
            visible=self.visible[row],
            center=self.center[row],
            centers={name: at[row] for name, at in self.centers.items() if not np.isnan(at[row]).any()},
            box=None if np.isnan(box).any() else Box(center=box[:3], size=box[3:6], yaw=float(box[6])),
            sensor_known=bool(self.sensor_known[row]),
        )

    def without(self, sequences: Sequence[str]) -> "Crowd":
        """Everybody but those of some sequences; the points are shared."""
        left = [name for name in self.sequences if name not in sequences]
        number = np.array([left.index(name) if name in left else -1 for name in self.sequences], int)
        rows = np.flatnonzero(number[self.sequence] >= 0)
        each = ("start", "end", "joints", "visible", "center", "box", "sensor_known")
        return replace(
            self,
            sequence=number[self.sequence[rows]],
            sequences=tuple(left),
            centers={name: at[rows] for name, at in self.centers.items()},
            **{name: getattr(self, name)[rows] for name in each},
        )


def crowd_of(folders: Sequence[str | Path], *, split: str | None = None, interval: int = 1) -> Crowd:
    """Everybody with points and a label in datasets that `lidarpose prepare` or `synth` wrote.

    split: of real datasets, None for all; interval: only every so many of a person's frames in a sequence, as published
    recipes thin out. A shard that is damaged is left out and named in `damaged`.
    Raises InputError where nobody is left, for a folder that is no dataset, and for datasets of different skeletons.
    """
    folders = [Path(folder) for folder in listed(folders)]
    rows: list[dict] = []
    damaged: list[str] = []
    skeletons = {}
    for folder in folders:
        dataset = open_dataset(folder)
        skeletons[dataset.card.skeleton] = folder
        if split is not None and dataset.card.people != "labelled":
            raise file_error(folder, f"holds synthetic people, which have no split {split!r}: say --split all")
        frames: dict[tuple, int] = {}
        first = len(rows)
        for row in _rows(dataset, damaged):
            if split is not None and row["split"] != split:
                continue
            # frames are numbered by anything, time stamps too; a synthetic clip has a number instead of a sequence
            whose = row.get("sequence", row["index"]), row["track"]
            frames[whose] = frames.get(whose, -1) + 1
            if frames[whose] % interval == 0 and len(row["points"]):
                rows.append(_kept(row, dataset))
        if not any((row["visible"] == 0).any() for row in rows[first:]):
            # a dataset that never says hidden tells nothing of what is seen
            for row in rows[first:]:
                row["visible"] = np.full_like(row["visible"], np.nan)
    if len(skeletons) > 1:
        raise InputError(f"datasets that are learned together need one skeleton, got {', '.join(sorted(skeletons))}")
    rows = [row for row in rows if not np.isnan(row["joints"]).all()]
    if not rows:
        where = ", ".join(map(str, folders))
        told = f" ({len(damaged)} shards cannot be read: {damaged[0]})" if damaged else ""
        what = "labelled people" if split is None else f"labelled people in the split {split!r}"
        raise InputError(f"{where}: expected {what}, found none{told}; lidarpose prepare says what is there")
    names = sorted({row["sequence"] for row in rows})
    number = {name: k for k, name in enumerate(names)}
    counts = np.array([len(row["points"]) for row in rows])
    ends = counts.cumsum()
    stacked = ("joints", "visible", "center", "box", "sensor_known")
    return Crowd(
        points=np.concatenate([row["points"] for row in rows]),
        part=np.concatenate([row["part"] for row in rows]),
        start=ends - counts,
        end=ends,
        sequence=np.array([number[row["sequence"]] for row in rows]),
        sequences=tuple(names),
        skeleton=next(iter(skeletons)),
        dataset=str(open_dataset(folders[0]).card.settings.get("dataset", "")),
        damaged=tuple(damaged),
        centers={name: np.stack([row["centers"][name] for row in rows]) for name in CENTERS},
        **{name: np.stack([row[name] for row in rows]) for name in stacked},
    )


def _rows(dataset: Dataset, damaged: list[str]) -> Iterator[dict]:
    """The rows of people, shard by shard, but for shards that are damaged. Raises InputError where one is missing: the
    dataset is not finished."""
    for shard in range(dataset.card.shards):
        there = shard_path(dataset.folder, dataset.card.people, shard).is_file()
        try:
            rows = list(dataset.rows(shards=range(shard, shard + 1)))
        except InputError as error:
            if not there:
                raise
            damaged.append(str(error))
        else:
            yield from rows


def _kept(row: dict, dataset: Dataset) -> dict:
    of = skeleton(dataset.card.skeleton)
    place = [BODY26.index(joint) for joint in of.joints]
    joints = np.full((len(BODY26), 3), np.nan, np.float32)
    visible = np.full(len(BODY26), np.nan, np.float32)
    real = "joint_labels" in row
    try:
        joints[place] = row["joints"].reshape(-1, 3)
        if real:
            visible[place] = np.select([row["joint_labels"] == SEEN, row["joint_labels"] == HIDDEN], [1.0, 0.0], np.nan)
    except (ValueError, AttributeError) as error:
        problem = f"row {row['index']} has not the {len(of)} joints of its card ({error}); write it again"
        raise file_error(dataset.folder, problem) from None
    points = row["points"].reshape(-1, 3)
    part = np.full(len(points), UNKNOWN_PART, np.int16) if row["part"] is None else row["part"].astype(np.int16)
    if not real and row["part"] is not None:
        # parts tell it, as of people made meanwhile
        visible[place] = seen(joints[place], points[part > 0])
    nowhere = np.full(3, np.nan)
    centers = {name: row.get(f"center_{name}") for name in CENTERS}
    box = np.full(7, np.nan)
    if row["box_center"] is not None:
        box = np.array([*row["box_center"], *row["box_size"], row["box_yaw"]])
    return {
        "points": points,
        "part": part,
        "joints": joints,
        "visible": visible,
        "center": np.asarray(row["center"], float),
        "centers": {name: nowhere if at is None else np.asarray(at, float) for name, at in centers.items()},
        "box": box,
        "sensor_known": not real or row["distance"] is not None,
        "sequence": f"{row['sequence']}" if real else "",
    }
