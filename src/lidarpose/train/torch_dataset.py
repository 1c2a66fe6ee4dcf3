"""Datasets to learn from: labeled samples in memory, and samples for a torch DataLoader.

`SyntheticPeople` and `ShardPeople` yield one `Sample` each, the same ones whatever the number of workers. Worker w of W
makes the runs of `batch` samples whose number is w modulo W, so a DataLoader gives them in order where its batch_size
is `batch` (1, as by default, also goes with batch_size=None); with other sizes they are the same samples, batched
differently. A Sample is no tensor: give the DataLoader a collate_fn, `list` if nothing else.

Legend: N samples, M points of all of them.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

import numpy as np
from torch.utils.data import IterableDataset, get_worker_info

from lidarpose.data.shards import CENTERS, DatasetReader, open_dataset, shard_path
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, listed
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, Box, LabeledSample, Pose, Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SceneConfig
from lidarpose.train.augment import UNKNOWN_PART, part_and_visible, seen


@dataclass(frozen=True, kw_only=True)
class InMemoryDataset:
    """Labeled samples of one or more datasets, each with the joints of body26.

    points (M, 3) float32 m; part (M,) int16, -1 unknown; start, end (N,): where a sample's points begin and end; joints
    (N, 26, 3) m, NaN without a label; visible (N, 26): 1 seen, 0 hidden, NaN unknown; center (N, 3) m; centers: by name
    (N, 3) m, NaN for none; box (N, 7), NaN for none; sensor_known (N,); sequence (N,): of `sequences`; skeleton:
    name of the datasets'; dataset: name of the first one, "" if synthetic; damaged: shards that cannot be read.
    """

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

    @classmethod
    def load(cls, folders: Sequence[str | Path], *, split: str | None = None, interval: int = 1) -> "InMemoryDataset":
        """All samples with points and a label of datasets that `lidarpose prepare` or `synth` wrote.

        split: of real datasets, None for all; interval: only every so many of a person's frames in a sequence, as
        published recipes thin out. A shard that is damaged is left out and named in `damaged`.
        Raises InputError where no sample is left, for a folder that is no dataset, and for different skeletons.
        """
        folders = [Path(folder) for folder in listed(folders)]
        samples: list[LabeledSample] = []
        damaged: list[str] = []
        skeletons = {}
        for folder in folders:
            dataset = open_dataset(folder)
            skeletons[dataset.card.skeleton] = folder
            if split is not None and dataset.card.people != "labelled":
                raise file_error(folder, f"holds synthetic people, which have no split {split!r}: say --split all")
            own = [_to_body26(sample) for sample in _thinned(_samples(dataset, split, damaged), interval)]
            if not any((sample.joint_labels == HIDDEN).any() for sample in own):
                # a dataset that never says hidden says nothing of what is seen
                unknown = np.full(len(BODY26), np.nan, np.float32)
                own = [replace(sample, pose=replace(sample.pose, visible=unknown)) for sample in own]
            samples += (sample for sample in own if sample.joint_labels.any())
        if len(skeletons) > 1:
            names = ", ".join(sorted(skeletons))
            raise InputError(f"datasets that are learned together need one skeleton, got {names}")
        if not samples:
            where = ", ".join(map(str, folders))
            why = f" ({len(damaged)} shards cannot be read: {damaged[0]})" if damaged else ""
            what = "labelled people" if split is None else f"labelled people in the split {split!r}"
            raise InputError(f"{where}: expected {what}, found none{why}; lidarpose prepare says what is there")
        sequences = sorted({sample.sequence for sample in samples})
        number = {name: k for k, name in enumerate(sequences)}
        counts = np.array([len(sample.points) for sample in samples])
        ends = counts.cumsum()
        nowhere = np.full(3, np.nan)
        part, visible = zip(*map(part_and_visible, samples), strict=True)
        return cls(
            points=np.concatenate([sample.points for sample in samples]),
            part=np.concatenate(part),
            start=ends - counts,
            end=ends,
            joints=np.stack([sample.joints for sample in samples]),
            visible=np.stack(visible),
            center=np.stack([sample.center for sample in samples]),
            centers={name: np.stack([s.centers.get(name, nowhere) for s in samples]) for name in CENTERS},
            box=np.stack([_box_row(sample.box) for sample in samples]),
            sensor_known=np.array([sample.sensor_known for sample in samples]),
            sequence=np.array([number[sample.sequence] for sample in samples]),
            sequences=tuple(sequences),
            skeleton=next(iter(skeletons)),
            dataset=str(open_dataset(folders[0]).card.settings.get("dataset", "")),
            damaged=tuple(damaged),
        )

    def __len__(self) -> int:
        return len(self.center)

    def sample(self, row: int) -> LabeledSample:
        """A sample in the sensor's frame; its pose says which joints are visible: 1, 0 or NaN where unknown."""
        own = slice(self.start[row], self.end[row])
        joints, box = self.joints[row], self.box[row]
        return LabeledSample(
            points=self.points[own],
            part=self.part[own],
            center=self.center[row],
            pose=Pose(joints=joints, visible=self.visible[row], skeleton=BODY26, frame="sensor"),
            joint_labels=_joint_labels(joints, self.visible[row]),
            centers={name: at[row] for name, at in self.centers.items() if not np.isnan(at[row]).any()},
            box=None if np.isnan(box).any() else Box(center=box[:3], size=box[3:6], yaw=float(box[6])),
            sensor_known=bool(self.sensor_known[row]),
            sequence=self.sequences[self.sequence[row]],
        )

    def without(self, sequences: Sequence[str]) -> "InMemoryDataset":
        """The samples that are not of some sequences; the points are shared."""
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


def _samples(dataset: DatasetReader, split: str | None, damaged: list[str]) -> Iterator[LabeledSample]:
    """The samples of a split, shard by shard, but for shards that are damaged. Raises InputError where one is missing:
    the dataset is not finished."""
    for shard in range(dataset.card.shards):
        there = shard_path(dataset.folder, dataset.card.people, shard).is_file()
        try:
            rows = list(dataset.rows(shards=range(shard, shard + 1)))
        except InputError as error:
            if not there:
                raise
            damaged.append(str(error))
        else:
            yield from (dataset.sample(row) for row in rows if split is None or row["split"] == split)


def _thinned(samples: Iterator[LabeledSample], interval: int) -> Iterator[LabeledSample]:
    """Those with points of every `interval`th frame of a person, however frames are numbered: time stamps too."""
    frames: Counter[tuple[str, str]] = Counter()
    for sample in samples:
        person = sample.sequence, sample.track
        if frames[person] % interval == 0 and len(sample.points):
            yield sample
        frames[person] += 1


def _to_body26(sample: LabeledSample) -> LabeledSample:
    """The sample with body26's joints, NaN where its skeleton lacks them, and their visibility."""
    columns = [BODY26.index(joint) for joint in sample.skeleton.joints]
    joints = np.full((len(BODY26), 3), np.nan, np.float32)
    visible = np.full(len(BODY26), np.nan, np.float32)
    joints[columns] = sample.joints
    part = np.full(len(sample.points), UNKNOWN_PART, np.int16) if sample.part is None else sample.part.astype(np.int16)
    if sample.info is None:
        visible[columns] = np.select([sample.joint_labels == SEEN, sample.joint_labels == HIDDEN], [1.0, 0.0], np.nan)
    elif sample.part is not None:
        # from the parts, as of samples made during training
        visible[columns] = seen(joints[columns], sample.points[part > 0])
    return replace(
        sample,
        part=part,
        ring=None,
        pose=Pose(joints=joints, visible=visible, skeleton=BODY26, frame="sensor"),
        joint_labels=_joint_labels(joints, visible),
        sequence=sample.sequence if sample.info is None else "",
    )


def _joint_labels(joints: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(26,) uint8; a joint of which nothing says whether it is visible counts as seen."""
    labels = np.where(visible == 0, HIDDEN, SEEN)
    return np.where(np.isnan(joints).any(-1), UNLABELED, labels).astype(np.uint8)


def _box_row(box: Box | None) -> np.ndarray:
    """(7,): center, size, yaw; NaN for no box."""
    return np.full(7, np.nan) if box is None else np.array([*box.center, *box.size, box.yaw])


@dataclass(frozen=True, kw_only=True)
class SyntheticPeople(IterableDataset):
    """Samples `start` ... `stop` - 1 of `seed`, without end where `stop` is None, see `Generator.person`.

    scene, bank and captured are the generator's; hard in [0, 1] replaces the scene's difficulty. With a `batch` of
    many samples workers draw fewer bodies twice (see `generator.BLOCK`). Raises InputError for settings out of range.
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
        _check_batch(self.batch)
        # errors come here, not in a worker
        self._generator()
        if self.hard is not None:
            self.scene.eased(self.hard)

    def _generator(self) -> Generator:
        return Generator(scene=self.scene, bank=self.bank, captured=self.captured, measure=False)

    def __iter__(self) -> Iterator[Sample]:
        generator = self._generator()
        worker, workers = _worker()
        for run in count(worker, workers):
            first = self.start + run * self.batch
            if self.stop is not None and first >= self.stop:
                return
            last = first + self.batch
            for index in range(first, last if self.stop is None else min(last, self.stop)):
                yield generator.person(self.seed, index, hard=self.hard).sample


@dataclass(frozen=True, kw_only=True)
class ShardPeople(IterableDataset):
    """The samples of a dataset that `lidarpose synth` wrote, in its order. Raises InputError where it is none."""

    folder: str | Path
    batch: int = 1
    dataset: DatasetReader = field(init=False, repr=False)

    def __post_init__(self):
        _check_batch(self.batch)
        object.__setattr__(self, "dataset", open_dataset(self.folder))

    def __iter__(self) -> Iterator[Sample]:
        worker, workers = _worker()
        for number, row in enumerate(self.dataset.rows()):
            if number // self.batch % workers == worker:
                yield self.dataset.sample(row)


def _check_batch(batch: int) -> None:
    if batch < 1:
        raise InputError(f"batch must be 1 or more, got {batch}")


def _worker() -> tuple[int, int]:
    """The number of this DataLoader's worker, and of how many."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)
