"""Datasets in memory, joints by the names of body26.

Legend: N samples, M points of all of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarpose.data.schema import CENTERS
from lidarpose.data.shards import DatasetReader, open_dataset, shard_path
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, listed
from lidarpose.sample import HIDDEN, SEEN, UNLABELED, Box, LabeledSample, Pose
from lidarpose.skeleton import BODY26
from lidarpose.train.example import UNKNOWN_PART, seen


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
            if not any((sample.pose.visible == 0).any() for sample in own):
                # a dataset that never says hidden tells nothing of what is seen
                unknown = np.full(len(BODY26), np.nan, np.float32)
                own = [replace(sample, pose=replace(sample.pose, visible=unknown)) for sample in own]
            samples += (sample for sample in own if sample.joint_labels.any())
        if len(skeletons) > 1:
            raise InputError(
                f"datasets that are learned together need one skeleton, got {', '.join(sorted(skeletons))}"
            )
        if not samples:
            where = ", ".join(map(str, folders))
            why = f" ({len(damaged)} shards cannot be read: {damaged[0]})" if damaged else ""
            what = "labelled people" if split is None else f"labelled people in the split {split!r}"
            raise InputError(f"{where}: expected {what}, found none{why}; lidarpose prepare says what is there")
        names = sorted({sample.sequence for sample in samples})
        number = {name: k for k, name in enumerate(names)}
        counts = np.array([len(sample.points) for sample in samples])
        ends = counts.cumsum()
        nowhere = np.full(3, np.nan)
        return cls(
            points=np.concatenate([sample.points for sample in samples]),
            part=np.concatenate([sample.part for sample in samples]),
            start=ends - counts,
            end=ends,
            joints=np.stack([sample.joints for sample in samples]),
            visible=np.stack([sample.pose.visible for sample in samples]),
            center=np.stack([sample.center for sample in samples]),
            centers={name: np.stack([s.centers.get(name, nowhere) for s in samples]) for name in CENTERS},
            box=np.stack([_box_row(sample.box) for sample in samples]),
            sensor_known=np.array([sample.sensor_known for sample in samples]),
            sequence=np.array([number[sample.sequence] for sample in samples]),
            sequences=tuple(names),
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
    frames: dict[tuple[str, str], int] = {}
    for sample in samples:
        person = sample.sequence, sample.track
        frames[person] = frames.get(person, -1) + 1
        if frames[person] % interval == 0 and len(sample.points):
            yield sample


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
        # parts tell it, as of people made meanwhile
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
