"""Datasets to evaluate on: folders written by `lidarpose prepare` or `synth`, and lidarpose-bench.

lidarpose-bench 1 and 2 are frozen sets of synthetic people for scoring weights; set 1 also has clips of them. Each is
one Parquet file that ships with the package. `tools/make_bench.py` made them once, and later versions of the generator
do not change them. A row is one person in one frame:

    clip, frame         number of the clip and frame in it; clip -1: a single frame
    person              set 2: False for 500 crops without a person: joints NaN, condition object, family the object
    others              set 2: number of points on a second person
    condition           clean, occluded, cluttered, crop (a poor detector's box) or company (a second person); in set 2
                        also the `conditions` of a sample
    poses               prior (procedural) or captured (subjects excluded from all training); in set 2 prior, cmu,
                        hdm05 or idle
    family              set 2: the activity, one word that is the same across all sources
    sensor, kind, distance, visible, clutter, upright      as in `sample.PersonInfo`
    origin              (3,) m in the level frame at the sensor
    points_mm           x, y, z of all points relative to origin, millimeters
    part                one per point: 0 = background, 1 + j = the bone of SMPL-24's joint j
    joints              x, y, z of body26's joints, m, in the level frame with the sensor at its origin
    box                 center (3), size (3), yaw of the detector's box: m, rad
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lidarpose.data.shards import DatasetReader, open_dataset, pyarrow, read_rows
from lidarpose.errors import InputError, check_int
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error, one_line, read_bytes
from lidarpose.sample import SEEN, Box, LabeledSample, PersonInfo, Pose, center_of, is_plain
from lidarpose.skeleton import BODY26, HUMAN15, Skeleton, skeleton


class BenchFile(NamedTuple):
    """A set that ships with the package: its name, and the SHA-256 hash of its file."""

    name: str
    sha256: str


# keys are the names that users give; the first one is also the `kind` of both sets
BENCH = "bench"
BENCHES = {
    BENCH: BenchFile("lidarpose-bench-1.1", "d4b999797b03f13c14cefabe594660033d7562fa4f644887fdf3a84dcc581bcc"),
    "bench-2": BenchFile("lidarpose-bench-2.1", "19ceed16dec362c56115ae589f7d8c66c4bb5131c57edb50dff0031fe51eb8ec"),
}
# the split name that selects all people
EVERYBODY = "all"
# splits scored by default: the first of these that the dataset has. Waymo's papers report on its validation folder
_DEFAULT_SPLITS = ("test", "val")
# joints scored by default on synthetic people
_SYNTHETIC = HUMAN15
# plain people have at least this many points
PLAIN_POINTS = 100

# reason -> how many people or shards were skipped for it, and the first of them
Skipped = dict[str, dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class EvalSample:
    """A sample and its place in the dataset.

    points: (n, 3) m, the network's input; when read, all points that the dataset holds, at their stored precision;
    point_times: (n,) s, as in `Sample`, of these points, None if unknown or not to be used; crop_box: the box that
    `points` were cropped with, or the dataset's own box if nothing was cropped, None if there is neither; shard, row:
    position in the dataset; condition, poses, family: as in lidarpose-bench, "" elsewhere; moving: a frame of a clip
    that is scored for acceleration only.
    """

    sample: LabeledSample
    points: np.ndarray
    shard: int
    row: int
    condition: str = ""
    poses: str = ""
    family: str = ""
    moving: bool = False
    crop_box: Box | None = None
    point_times: np.ndarray | None = None

    @property
    def info(self) -> PersonInfo:
        """Attributes of a synthetic person; empty for real people."""
        return self.sample.info or PersonInfo()

    @property
    def plain(self) -> bool:
        """Upright, whole and uncluttered, with at least 100 points."""
        info = self.info
        has_enough_points = len(self.sample.points) >= PLAIN_POINTS
        return has_enough_points and bool(is_plain(bool(info.upright), info.visible, info.clutter))


@dataclass(frozen=True, kw_only=True)
class EvalDataset:
    """An open dataset.

    name; kind: the raw dataset's name, "synth" or "bench"; skeleton of the joints; scored: the joints that are scored
    by default; split: name or "none"; split_source: origin of the split, "" without one; leaks: how the split leaks, in
    words; settings: of the dataset's card; count: number of people to score, out of `total`; limit: as given, None if
    it excludes no person; clusters: people of one `sequence` are not independent; skipped: people and shards skipped in
    the last iteration.
    """

    name: str
    kind: str
    skeleton: Skeleton
    scored: Skeleton
    read: Callable[[Skipped], Iterator[EvalSample]]
    count: int
    total: int
    limit: int | None
    clusters: bool
    split: str = "none"
    split_source: str = ""
    leaks: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    bench: "Bench | None" = None
    skipped: Skipped = field(default_factory=dict)

    def __iter__(self) -> Iterator[EvalSample]:
        self.skipped.clear()
        return self.read(self.skipped)


def open_eval_dataset(dataset: str | PathLike, *, split: str | None = None, limit: int | None = None) -> EvalDataset:
    """Opens a dataset's people for evaluation.

    Args:
        dataset: "bench", "bench-2" or the path of a folder.
        split: the split to score, "all" for all people. None: test, else val, else all people if there are no splits.
        limit: score only this many people, evenly spread.

    Raises:
        InputError: not a dataset, a split without people, a missing shard, or all shards damaged.
        MissingExtra: without pyarrow.
    """
    if limit is not None:
        limit = check_int("limit", limit, least=1, hint=" person")
    if not isinstance(dataset, str | PathLike):
        raise InputError(f"expected a dataset to evaluate on, {BENCH} or the path of a folder, got {dataset!r}")
    if str(dataset) in BENCHES:
        return _open_bench(str(dataset), split, limit)
    if not Path(dataset).exists():
        expected = f"expected the folder of a dataset, or {' or '.join(BENCHES)}, got {dataset}"
        raise InputError(f"{expected}: there is no such folder; write one with lidarpose synth or prepare")
    return _open_folder(Path(dataset), split, limit)


def count_skipped(skipped: Skipped, reason: str, where: object, count: int = 1) -> None:
    """Counts `count` skipped people or shards under a reason; `where` is stored for the first one."""
    skipped.setdefault(reason, {"count": 0, "first": str(where)})["count"] += count


def evenly_drawn(total: int, limit: int | None) -> np.ndarray:
    """Indices of `limit` of `total` people, one drawn from each of `limit` equal parts; all indices without a limit.

    The seed is fixed. Equal steps could match a period in the order of a dataset, such as the sensors of a bench.
    """
    count = total if limit is None else min(limit, total)
    edges = np.arange(count + 1) * total // max(count, 1)
    return np.random.default_rng(0).integers(edges[:-1], edges[1:])


# ---- folders


def _open_folder(folder: Path, split: str | None, limit: int | None) -> EvalDataset:
    dataset, damaged_shards = open_dataset(folder), Skipped()
    card = dataset.card
    is_synthetic = card.people != "labelled"
    if is_synthetic and split not in (None, EVERYBODY):
        raise file_error(folder, f"holds synthetic people, which have no splits, got {split!r}: leave split out")
    rows = _stored_rows(dataset, damaged_shards)
    splits = sorted(rows["split"].dropna().unique())
    if split is None:
        split = next((name for name in _DEFAULT_SPLITS if name in splits), EVERYBODY)
        if splits and split != _DEFAULT_SPLITS[0] and damaged_shards:
            (entry,) = damaged_shards.values()
            problem = f"{entry['count']} of its {card.shards} shards cannot be read, perhaps those of the split test"
            raise file_error(folder, f"{problem}; the first: {entry['first']}; or give split NAME")
        if split == EVERYBODY and splits:
            raise file_error(
                folder,
                f"has no people in test or val, only in {', '.join(splits)}: give split NAME, or prepare all splits",
            )
    people = rows if split == EVERYBODY else rows[rows["split"] == split]
    total = len(people)
    if not total:
        split_names = ", ".join(splits) or "no splits"
        raise file_error(folder, f"has no people in the split {split!r}; there are {split_names}: give one as split")
    people = people.iloc[evenly_drawn(total, limit)]
    source, _, leaks = str(card.about.get("split", "")).partition("; LEAKS: ")
    dataset_skeleton = skeleton(card.skeleton)
    return EvalDataset(
        name=one_line(folder.resolve().name),
        kind="synth" if is_synthetic else str(card.settings.get("dataset", "labelled")),
        skeleton=dataset_skeleton,
        scored=_SYNTHETIC if is_synthetic else dataset_skeleton,
        read=lambda skipped: _read_folder(dataset, people, damaged_shards, skipped),
        split="none" if is_synthetic or not splits else split,
        split_source=source.removeprefix(f"{card.settings.get('split_by') or ''}: "),
        leaks=leaks,
        settings=card.settings,
        count=len(people),
        total=total,
        limit=limit if len(people) < total else None,
        clusters=not is_synthetic or card.settings.get("what") != "people",
    )


def _stored_rows(dataset: DatasetReader, damaged_shards: Skipped) -> pd.DataFrame:
    """(shard, row, split) of every stored person. Damaged shards are skipped and counted.

    Raises InputError if a shard is missing or all are damaged.
    """
    card, rows = dataset.card, []
    for shard in range(card.shards):
        path = dataset.path(shard)
        if not path.is_file():
            raise file_error(path, f"is missing: the dataset is not finished; run the same {card.writer} again")
        try:
            if card.people == "labelled":
                splits = [row["split"] for row in read_rows(path, card.people, ("split",))]
            else:
                splits = [None] * dataset.rows_of(card.people, shard)
        except InputError as error:
            count_skipped(damaged_shards, "damaged shards", error)
        else:
            rows += [(shard, row, split) for row, split in enumerate(splits)]
    for entry in damaged_shards.values():
        if entry["count"] == card.shards:
            raise InputError(
                f"none of the {card.shards} shards of {dataset.folder} can be read; the first: {entry['first']}"
            )
    return pd.DataFrame(rows, columns=["shard", "row", "split"])


def _read_folder(
    dataset: DatasetReader, people: pd.DataFrame, damaged_shards: Skipped, skipped: Skipped
) -> Iterator[EvalSample]:
    skipped.update({reason: dict(entry) for reason, entry in damaged_shards.items()})
    for shard, rows in people.groupby("shard")["row"]:
        path = dataset.path(shard)
        try:
            # read the whole shard first: if it turns out to be damaged half way, none of it is used
            stored_rows = list(read_rows(path, dataset.card.people))
        except InputError as error:
            count_skipped(skipped, "damaged shards", error)
            count_skipped(skipped, "people of damaged shards", path.name, len(rows))
            continue
        for row in rows:
            try:
                sample = dataset.sample(stored_rows[row])
            except InputError as error:
                count_skipped(skipped, "people whose rows are no sample", f"{path.name}, row {row}: {error}")
            else:
                yield EvalSample(
                    sample=sample, points=sample.points, point_times=sample.point_times, shard=int(shard), row=int(row)
                )


# ---- the sets that ship with the package


@dataclass(frozen=True, kw_only=True)
class Bench:
    """lidarpose-bench in memory. points: one (n, 3) float64 m per row, in the level frame at the sensor; joints
    (N, 26, 3) m; columns: the others by name, (N,) or (N, k)."""

    points: tuple[np.ndarray, ...]
    joints: np.ndarray
    columns: dict[str, np.ndarray]

    @property
    def people(self) -> np.ndarray:
        """Rows of people that are not frames of a clip."""
        return np.flatnonzero(self.columns["person"] & (self.columns["clip"] < 0))

    @property
    def objects(self) -> np.ndarray:
        """Rows of crops without a person."""
        return np.flatnonzero(~self.columns["person"])

    @property
    def clips(self) -> list[np.ndarray]:
        """Rows of each clip, in time order."""
        clip = self.columns["clip"]
        return [np.flatnonzero(clip == k) for k in range(int(clip.max(initial=-1)) + 1)]


def bench_path(which: str = BENCH) -> Path:
    """Path of the packaged file of a key of `BENCHES`."""
    return Path(str(resources.files("lidarpose.eval") / "assets" / f"{BENCHES[which].name}.parquet"))


def load_bench(which: str = BENCH) -> Bench:
    """Loads a set by its key in `BENCHES`. Raises InputError if the file differs from the frozen one, MissingExtra
    without pyarrow."""
    pa, parquet = pyarrow()
    path, (name, sha256) = bench_path(which), BENCHES[which]
    data = read_bytes(path, expected=f"{name}, a Parquet file")
    if hashlib.sha256(data).hexdigest() != sha256:
        raise file_error(path, f"differs from the frozen {name}: install lidarpose again")
    table = parquet.read_table(pa.BufferReader(data)).to_pandas()
    columns: dict[str, Any] = {name: values.to_numpy() for name, values in table.items()}
    columns |= {name: np.stack(columns[name]) for name in ("origin", "joints", "box")}
    pairs = zip(columns["origin"], columns.pop("points_mm"), strict=True)
    points = tuple(origin + millimeters.reshape(-1, 3) / 1e3 for origin, millimeters in pairs)
    columns["num_points"] = np.array([len(cloud) for cloud in points])
    # bench 1 holds only people, and has no families
    defaults = {
        "person": np.ones(len(points), bool),
        "others": np.zeros(len(points), int),
        "family": np.full(len(points), ""),
    }
    columns = defaults | columns
    joints = columns.pop("joints").reshape(-1, len(BODY26), 3)
    return Bench(points=points, joints=joints, columns=columns)


def _open_bench(key: str, split: str | None, limit: int | None) -> EvalDataset:
    """lidarpose-bench: its single people and, without a limit, the frames of its clips for the acceleration error."""
    name = BENCHES[key].name
    if split not in (None, EVERYBODY):
        raise InputError(f"{name} is one test set without splits, got {split!r}: leave split out")
    bench = load_bench(key)
    total = len(bench.people)
    limit = limit if limit is not None and limit < total else None
    rows = bench.people[evenly_drawn(total, limit)]
    if limit is None:
        rows = np.concatenate([rows, *bench.clips])
    return EvalDataset(
        name=name,
        kind=BENCH,
        skeleton=BODY26,
        scored=_SYNTHETIC,
        read=lambda skipped: (_bench_sample(bench, row) for row in rows.tolist()),
        bench=bench,
        count=total if limit is None else limit,
        total=total,
        limit=limit,
        clusters=False,
    )


def _bench_sample(bench: Bench, row: int) -> EvalSample:
    columns = {name: values[row] for name, values in bench.columns.items() if name != "part"}
    clip, frame, box = int(columns["clip"]), int(columns["frame"]), columns["box"]
    info_names = ("sensor", "kind", "distance", "visible", "clutter", "upright")
    sample = LabeledSample(
        points=bench.points[row].astype(np.float32),
        center=columns["origin"],
        pose=Pose(joints=bench.joints[row], skeleton=BODY26, frame="sensor"),
        box=Box(center=box[:3], size=box[3:6], yaw=float(box[6])),
        joint_labels=np.full(len(BODY26), SEEN, np.uint8),
        sequence=f"clip {clip}" if clip >= 0 else str(row),
        frame=frame,
        time=frame / 10 if clip >= 0 else np.nan,
        info=PersonInfo(**{name: columns[name] for name in info_names}),
    )
    categories: dict[str, Any] = {name: str(columns[name]) for name in ("condition", "poses", "family")}
    return EvalSample(sample=sample, points=bench.points[row], shard=0, row=row, moving=clip >= 0, **categories)


def facing(joints: np.ndarray, skeleton: Skeleton = BODY26) -> np.ndarray:
    """joints (N, J, 3) m -> (N,) rad: the yaw of the direction that hips and shoulders face, seen from above."""
    joint_index = skeleton.index
    left = joints[:, joint_index("left_hip")] - joints[:, joint_index("right_hip")]
    left = left + joints[:, joint_index("left_shoulder")] - joints[:, joint_index("right_shoulder")]
    return np.arctan2(-left[:, 0], left[:, 1])


def mean_poses(bench: Bench) -> dict[str, np.ndarray]:
    """Baselines that use only the center of the points: joints (N, 26, 3) m of the mean skeleton about that center.

    "mean pose, true facing" is rotated to the true facing, "mean pose" is not rotated. The means are over this set's
    people.
    """
    clouds = zip(bench.points, bench.columns["origin"], strict=True)
    center = np.stack([center_of(points) if len(points) else origin for points, origin in clouds])
    offset = bench.joints - center[:, None]
    R_level_person = rotation_about("z", facing(bench.joints))
    # row vectors: x_person = x_level @ R_level_person
    mean_offset_person = (offset @ R_level_person)[bench.people].mean(0)
    return {
        "mean pose, true facing": center[:, None] + mean_offset_person @ np.swapaxes(R_level_person, -1, -2),
        "mean pose": center[:, None] + offset[bench.people].mean(0),
    }
