"""What every reader of a dataset yields, and what it must offer.

A dataset's raw files fall into parts, each read on its own (a sequence, a segment, a file): that is what processes
share out, and what is written as one shard.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lidarpose.errors import InputError
from lidarpose.sample import Sample

# of a joint: not labelled (its position is NaN), labelled though hidden or uncertain, labelled and seen
UNLABELED, HIDDEN, SEEN = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class Item:
    """One labelled person in one frame.

    sample: points in the sensor's frame (level, z up, metres) and pose in the dataset's own skeleton, NaN where a joint
    is not labelled; joint_labels (J,) uint8: UNLABELED, HIDDEN or SEEN; sequence, frame, track: where it comes from;
    time: seconds since the sequence's beginning, NaN if unknown; centers: other origins that published protocols use,
    by name, (3,) m each ("trans", "box", "joints_box").
    """

    sample: Sample
    joint_labels: np.ndarray
    sequence: str
    frame: int
    track: str
    time: float
    centers: dict[str, np.ndarray]

    def __post_init__(self):
        pose = self.sample.pose
        if pose is None or self.joint_labels.shape != (len(pose.skeleton),):
            raise InputError(f"Item: needs a pose and one joint label a joint, got {self.joint_labels.shape} labels")
        missing = np.isnan(pose.joints).any(-1)
        if (missing != (self.joint_labels == UNLABELED)).any():
            raise InputError("Item: a joint is NaN exactly where its label is UNLABELED")


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """What was left out: reason, the same words for the same reason, and where."""

    reason: str
    where: str


class Reader(Protocol):
    """A dataset's raw files. Raises InputError, one line, where the root is not what it should be."""

    name: str
    skeleton: str

    def parts(self, root: Path) -> list[str]:
        """Names of what can be read on its own, sorted; also checks that the root is complete."""
        ...

    def read(self, root: Path, part: str) -> Iterator[Item | Skipped]:
        """Everybody in one part, in an order that never changes."""
        ...
