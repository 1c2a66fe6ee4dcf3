"""People for a torch DataLoader, one `Sample` each: made as they are needed, or read from the shards of a dataset.

Both are the same people whatever the number of workers. Worker w of W makes the runs of `batch` people whose number
is w modulo W, so a DataLoader gives them in order where its batch_size is `batch` (1, as by default, also goes with
batch_size=None); with other sizes they are the same people, batched differently. A Sample is no tensor: give the
DataLoader a collate_fn, `list` if nothing else.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from torch.utils.data import IterableDataset, get_worker_info

from lidarpose.data.shards import DatasetReader, open_dataset
from lidarpose.errors import InputError
from lidarpose.sample import Sample
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SceneConfig


@dataclass(frozen=True, kw_only=True)
class SyntheticPeople(IterableDataset):
    """Persons `start` ... `stop` - 1 of `seed`, without end where `stop` is None, see `Generator.person`.

    scene, bank and captured are the generator's; hard in [0, 1] replaces the scene's difficulty. With a `batch` of
    many people workers draw fewer bodies twice (see `generate.BLOCK`). Raises InputError for settings out of range.
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
        # told now, not in a worker
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
    """The people of a dataset that `lidarpose synth` wrote, in its order. Raises InputError where it is none."""

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
