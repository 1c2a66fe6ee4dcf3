"""Datasets for training: labeled samples in memory, and synthesized samples for a torch DataLoader.

`SyntheticPeople` yields the same samples whatever the number of workers. Samples are made in runs of `batch`; worker w
of W makes the runs whose index is w modulo W. A DataLoader therefore yields them in order if its batch_size is `batch`
(the default 1 also works with batch_size=None); with other sizes they are the same samples, batched differently. A
Sample is not a tensor: give the DataLoader a collate_fn, for example `list`.

Legend: N samples.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import IterableDataset, get_worker_info

from lidarpose.data.clips import consecutive
from lidarpose.data.shards import DatasetReader, open_dataset, pyarrow, to_arrow
from lidarpose.errors import InputError, check_int
from lidarpose.io.files import file_error, listed
from lidarpose.sample import CLIP_FRAMES, HIDDEN, SEEN, UNLABELED, LabeledSample, Pose, Sample, clip_windows
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SceneConfig
from lidarpose.train.augment import UNKNOWN_PART, visible_joints


@dataclass(frozen=True, kw_only=True, eq=False)
class InMemoryDataset:
    """Labeled samples of one or more datasets, each with the joints of body26.

    They are stored as in the shards, in Arrow memory, which worker processes share. parts: for each shard its dataset,
    its rows, and whether any joint of the dataset is labeled as hidden; place (N, 2): each sample's part and row;
    sequence (N,): index into `sequences`; skeleton: name of the datasets' skeleton; dataset: name of the first dataset,
    "" if synthetic; damaged: shards that cannot be read; empty: folders of datasets without any of these samples.
    """

    parts: list[tuple[DatasetReader, Any, bool]]
    place: np.ndarray
    sequence: np.ndarray
    sequences: tuple[str, ...]
    skeleton: str
    dataset: str
    damaged: tuple[str, ...]
    empty: tuple[str, ...] = ()

    @classmethod
    def load(cls, folders: Sequence[str | Path], *, split: str | None = None, interval: int = 1) -> "InMemoryDataset":
        """All samples with points and a label, from datasets that `lidarpose prepare` or `synth` wrote.

        split: of real datasets, None for all; interval: keeps only every `interval`th frame of a person in a sequence,
        like published recipes. A damaged shard is left out and named in `damaged`. Raises InputError if no sample is
        left, for a folder that is not a dataset, and for different skeletons.
        """
        datasets = [open_dataset(Path(folder)) for folder in listed(folders)]
        parts: list[tuple[DatasetReader, Any, bool]] = []
        names: list[str] = []
        damaged: list[str] = []
        empty: list[str] = []
        for dataset in datasets:
            if split is not None and dataset.card.people != "labelled":
                problem = f"contains synthetic people, which have no split {split!r}: give --split all"
                raise file_error(dataset.folder, problem)
            num_damaged = len(damaged)
            shards = list(_shards(dataset, split, interval, damaged))
            has_hidden = any(hidden for _, _, hidden in shards)
            parts += [(dataset, rows, has_hidden) for rows, _, _ in shards]
            dataset_names = list(chain.from_iterable(shard_names for _, shard_names, _ in shards))
            names += dataset_names
            empty += [] if dataset_names or len(damaged) > num_damaged else [str(dataset.folder)]
        skeletons = sorted({dataset.card.skeleton for dataset in datasets})
        if len(skeletons) > 1:
            raise InputError(f"datasets of one training need the same skeleton, got {', '.join(skeletons)}")
        if not names:
            paths = ", ".join(str(dataset.folder) for dataset in datasets)
            damage = f" ({len(damaged)} shards cannot be read: {damaged[0]})" if damaged else ""
            expected = "labeled people" if split is None else f"labeled people in the split {split!r}"
            raise InputError(f"{paths}: expected {expected}, got none{damage}; lidarpose prepare says what is there")
        sequences, sequence = np.unique(names, return_inverse=True)
        return cls(
            parts=parts,
            place=np.array([(part, row) for part, (_, rows, _) in enumerate(parts) for row in range(rows.num_rows)]),
            sequence=sequence,
            sequences=tuple(sequences.tolist()),
            skeleton=skeletons[0],
            dataset=str(datasets[0].card.settings.get("dataset", "")),
            damaged=tuple(damaged),
            empty=tuple(empty),
        )

    def __len__(self) -> int:
        return len(self.place)

    def sample(self, row: int) -> LabeledSample:
        """A sample in the sensor's frame; its pose has the visibility of each joint: 1, 0, or NaN if unknown."""
        part, place = self.place[row]
        dataset, rows, has_hidden = self.parts[part]
        cells = zip(rows.column_names, rows.columns, strict=True)
        sample = _to_body26(dataset.sample({name: _value(column[int(place)]) for name, column in cells}))
        if has_hidden:
            return sample
        # if a dataset labels no joint as hidden, its labels tell nothing about visibility
        visible = np.full(len(BODY26), np.nan, np.float32)
        return replace(sample, pose=replace(sample.pose, visible=visible))

    def clips(self, *, following: int = 0) -> tuple[np.ndarray, Counter[str]]:
        """Rows (C, `CLIP_FRAMES` + following) of clips of consecutive frames with rotations, each with the `following`
        rows after it, and the numbers of frames left out, by reason."""
        tracks, frames, has_rotations = [], [], []
        for dataset, rows, _ in self.parts:
            name = "sequence" if "sequence" in rows.column_names else "index"
            columns = (rows.column(column).to_pylist() for column in (name, "track", "frame"))
            for sequence, track, frame in zip(*columns, strict=True):
                tracks.append((dataset.folder, sequence, track))
                frames.append(frame)
            has_rotations += rows.column("rotations").is_valid().to_pylist()
        # indices of this dataset's samples among the rows of all parts
        start = np.cumsum([0, *(rows.num_rows for _, rows, _ in self.parts)])
        part_rows = start[self.place[:, 0]] + self.place[:, 1]
        usable_rows = np.flatnonzero(np.array(has_rotations, bool)[part_rows])
        skipped = Counter({"frames without rotations": len(part_rows) - len(usable_rows)})
        frame_rows = part_rows[usable_rows].tolist()
        runs = consecutive([tracks[k] for k in frame_rows], [frames[k] for k in frame_rows])
        clips = [usable_rows[clip_windows(run, following=following)] for run in runs]
        return np.concatenate([np.zeros((0, CLIP_FRAMES + following), int), *clips]), +skipped

    def without(self, sequences: Sequence[str]) -> "InMemoryDataset":
        """The dataset without some sequences; the points are shared."""
        names = np.array(self.sequences)
        is_kept = ~np.isin(names, sequences)
        rows = is_kept[self.sequence]
        sequence = (is_kept.cumsum() - 1)[self.sequence[rows]]
        return replace(self, place=self.place[rows], sequence=sequence, sequences=tuple(names[is_kept].tolist()))


def _value(cell: Any) -> Any:
    """The value of a cell, as `rows_of` gives it for its own types, but twice as fast, since nothing is cast."""
    if not cell.is_valid:
        return None
    return cell.values.to_numpy() if hasattr(cell, "values") else cell.as_py()


def _shards(
    dataset: DatasetReader, split: str | None, interval: int, damaged: list[str]
) -> Iterator[tuple[Any, list[str], bool]]:
    """For each shard its rows with points and a label, their sequences, and whether any joint is labeled as hidden.

    Frames of a person are counted for `interval`, so frame numbers may also be time stamps. Raises InputError if a
    shard is missing: the dataset is incomplete.
    """
    frames: Counter[tuple[str, str]] = Counter()
    for shard in range(dataset.card.shards):
        is_present = dataset.path(shard).is_file()
        try:
            rows = list(dataset.rows(shards=[shard]))
        except InputError as error:
            if not is_present:
                raise
            damaged.append(str(error))
            continue
        labeled_rows, names, has_hidden = [], [], False
        for row in rows:
            if split is not None and row["split"] != split:
                continue
            sample = dataset.sample(row)
            person = sample.sequence, sample.track
            if frames[person] % interval == 0 and len(sample.points) and sample.joint_labels.any():
                sample = _to_body26(sample)
                labeled_rows.append(row)
                names.append(sample.sequence)
                has_hidden |= bool((sample.joint_labels == HIDDEN).any())
            frames[person] += 1
        yield to_arrow(pyarrow()[0], dataset.card.people, labeled_rows), names, has_hidden


def _to_body26(sample: LabeledSample) -> LabeledSample:
    """The sample with body26's joints, NaN if its skeleton lacks them, and their visibility; a labeled joint of unknown
    visibility gets the label `SEEN`."""
    columns = [BODY26.index(joint) for joint in sample.skeleton.joints]
    joints = np.full((len(BODY26), 3), np.nan, np.float32)
    visible = np.full(len(BODY26), np.nan, np.float32)
    joints[columns] = sample.joints
    part = np.full(len(sample.points), UNKNOWN_PART, np.int16) if sample.part is None else sample.part.astype(np.int16)
    if sample.info is None:
        visible[columns] = np.select([sample.joint_labels == SEEN, sample.joint_labels == HIDDEN], [1.0, 0.0], np.nan)
    elif sample.part is not None:
        # computed from the parts, as for samples made during training
        visible[columns] = visible_joints(joints[columns], sample.points[part > 0])
    labels = np.where(np.isnan(joints).any(-1), UNLABELED, np.where(visible == 0, HIDDEN, SEEN))
    return replace(
        sample,
        part=part,
        ring=None,
        point_times=None,
        pose=Pose(joints=joints, visible=visible, skeleton=BODY26, frame="sensor"),
        joint_labels=labels.astype(np.uint8),
        sequence=sample.sequence if sample.info is None else "",
    )


@dataclass(frozen=True, kw_only=True)
class SyntheticPeople(IterableDataset):
    """Samples `start` ... `stop` - 1 of `seed`, endless if `stop` is None, see `Generator.person`.

    scene, bank and captured are the generator's; hard in [0, 1] replaces the scene's difficulty. With a large `batch`,
    fewer bodies are drawn by two workers (see `generator.BLOCK`). Raises InputError for settings out of range.
    """

    scene: SceneConfig
    seed: int = 0
    start: int = 0
    stop: int | None = None
    hard: float | None = None
    bank: PoseBank | None = None
    captured: float = 0.0
    batch: int = 1

    def __post_init__(self):
        if self.seed < 0 or self.start < 0 or self.stop is not None and self.stop < self.start:
            raise InputError(
                f"SyntheticPeople needs a seed >= 0 and 0 <= start <= stop, got {self.seed}, {self.start}, {self.stop}"
            )
        check_int("batch", self.batch, least=1)
        # built once so that errors are raised here, not in a worker
        self._generator()
        if self.hard is not None:
            self.scene.eased(self.hard)

    def _generator(self) -> Generator:
        return Generator(scene=self.scene, bank=self.bank, captured=self.captured, measure=False)

    def __iter__(self) -> Iterator[Sample]:
        generator = self._generator()
        worker, workers = this_worker()
        for run in count(worker, workers):
            first = self.start + run * self.batch
            if self.stop is not None and first >= self.stop:
                return
            last = first + self.batch
            for index in range(first, last if self.stop is None else min(last, self.stop)):
                yield generator.person(self.seed, index, hard=self.hard).sample


def this_worker() -> tuple[int, int]:
    """The index of this DataLoader worker, and the number of workers."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)
