"""A run's examples: their sources (synthetic, stored, mixed), and the loader of batches.

An example depends only on its source and its number in the run, so any process can make any example, in any order.
Chunk c holds the examples of the `BATCHES` steps from c * BATCHES on, whatever the number of workers and processes, so
a run can resume at any chunk. A chunk is sorted by size (voxels) before it is cut into batches, since a small network
spends most of its time on padding. It is sorted in lanes, and each process takes whole lanes: no process makes examples
for another, and all batches together are the same for any number of processes.
"""

import gc
import pickle
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import accumulate
from math import floor, gcd
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch.utils.data import DataLoader, IterableDataset

from lidarpose.arrays import evenly_spaced
from lidarpose.data.writer import end_with_parent
from lidarpose.errors import InputError
from lidarpose.sample import CLIP_FRAMES, LabeledSample
from lidarpose.synth.bodies import PoseBank, smpl_rig
from lidarpose.synth.generator import Generator
from lidarpose.synth.objects import draw_object
from lidarpose.synth.scene import RandomStream, scene_config
from lidarpose.train.augment import (
    PELVIS_CENTERED,
    Augmentation,
    ClipExample,
    Example,
    add_disturbances,
    augmented,
    clip_example,
    example,
    object_example,
    people_in,
)
from lidarpose.train.objectives.objective import Objective
from lidarpose.train.torch_dataset import InMemoryDataset, this_worker

# batches per chunk
BATCHES = 8
# maximum number of lanes, and so of processes
LANES = 8
# where Linux keeps shared memory, and how much a worker may need, bytes
_SHARED_MEMORY, _SHARED_OF_WORKER = Path("/dev/shm"), 2**30
# alignment of arrays in it, bytes
_ALIGNED = 64


class Source(Protocol):
    """Examples by their number in a run. Must be picklable."""

    def example(self, index: int) -> Any:
        """An example for the objective's `collate`; its `size` puts examples of similar cost into the same batch."""
        ...


@dataclass(frozen=True, kw_only=True)
class SyntheticSource:
    """Synthetic samples of a scene, of rising difficulty.

    easy: number of samples in which the maximum difficulty rises from zero to full. All difficulties below the maximum
    are sampled, harder ones more often; the paper's scenes use the maximum itself. motion, subjects, captured, body,
    strays, noise, objects, set: see `recipes.Pretrain`; pelvis_centered: see `example`; first: number of the first
    person of the seed. Raises InputError, when built, for an unknown scene and for clips that cannot be read.
    """

    scene: str
    seed: int
    easy: float = 0.0
    motion: str | None = None
    subjects: tuple[str, ...] = ()
    captured: float = 0.0
    body: str | None = None
    strays: float = 0.0
    noise: float = 0.0
    objects: float = 0.0
    set: tuple[str, ...] = ()
    pelvis_centered: float = PELVIS_CENTERED
    first: int = 0

    def __post_init__(self):
        # errors are raised here, not in a worker, whose errors come wrapped in a traceback
        self._generator  # noqa: B018

    def __getstate__(self) -> dict:
        # each process reads the clips itself
        return {name: value for name, value in vars(self).items() if name != "_generator"}

    @cached_property
    def _generator(self) -> Generator:
        bank = PoseBank.from_clips(self.motion, self.subjects) if self.motion else None
        captured = self.captured if bank is not None else 0.0
        scene = scene_config(self.scene).changed(self.set)
        rig = None if self.body is None else smpl_rig(self.body, self.motion, self.subjects)
        return Generator(scene=scene, bank=bank, captured=captured, rig=rig, measure=False)

    def example(self, index: int) -> Example:
        number = self.first + index
        rng = np.random.default_rng([self.seed, RandomStream.SYNTHETIC_AUGMENTATION, number])
        scene = self._generator.config
        if self.objects and rng.random() < self.objects:
            # crops of several scans are as frequent as among people, where their frequency depends on the difficulty
            difficulty = self._difficulty(index, rng) if scene.varied else None
            object_sample, _ = draw_object(scene, self.seed, number, hard=difficulty)
            # disturbed as people are: otherwise every blurred crop would show a person
            object_sample = add_disturbances(object_sample, strays=self.strays, noise=self.noise, rng=rng)
            return object_example(object_sample, rng, pelvis_centered=self.pelvis_centered)
        difficulty = self._difficulty(index, rng)
        sample = self._generator.person(self.seed, number, hard=difficulty).sample
        result = example(
            add_disturbances(sample, strays=self.strays, noise=self.noise, rng=rng),
            rng,
            pelvis_centered=self.pelvis_centered,
        )
        return replace(result, person=people_in(sample)) if self.objects else result

    def _difficulty(self, index: int, rng: np.random.Generator) -> float:
        """The difficulty of example `index`, in [0, 1]."""
        config = self._generator.config
        ceiling = config.hard * (min(index / self.easy, 1.0) if self.easy else 1.0)
        return ceiling if config.follows_paper else ceiling * np.sqrt(rng.random())

    def clip(self, index: int, *, trans_center: bool) -> ClipExample:
        """A clip of a person at the scene's difficulty."""
        number = self.first + index
        rng = np.random.default_rng([self.seed, RandomStream.SYNTHETIC_AUGMENTATION, number])
        samples = [person.sample for person in self._generator.clip(self.seed, number)]
        return clip_example(samples, rng, trans_center=trans_center, pelvis_centered=self.pelvis_centered)


@dataclass(frozen=True, kw_only=True)
class DatasetSource:
    """Samples or clips of datasets: each once per epoch, in a new random order, each time with a new augmentation.

    dataset: see `InMemoryDataset.load`; strays, noise: see `add_disturbances`.
    """

    dataset: InMemoryDataset
    seed: int
    strays: float = 0.0
    noise: float = 0.0

    def _drawn(self, index: int, count: int) -> tuple[int, np.random.Generator]:
        """Which of `count` items example `index` shows, and its random generator."""
        epoch, place = divmod(index, count)
        rng = np.random.default_rng([self.seed, RandomStream.STORED_AUGMENTATION, index])
        return int(_order(self.seed, epoch, count)[place]), rng

    def _sample(self, row: int, rng: np.random.Generator) -> LabeledSample:
        sample = self.dataset.sample(row)
        if not (self.strays or self.noise):
            return sample
        return add_disturbances(sample, strays=self.strays, noise=self.noise, rng=rng)


@dataclass(frozen=True, kw_only=True)
class StoredSource(DatasetSource):
    """The samples of datasets."""

    augmentation: Augmentation

    def example(self, index: int) -> Example:
        row, rng = self._drawn(index, len(self.dataset))
        return augmented(self._sample(row, rng), self.augmentation, rng)


@dataclass(frozen=True, kw_only=True)
class ClipSource(DatasetSource):
    """The clips of datasets. clips, skipped: see `InMemoryDataset.clips`; trans_center, turn, normalize: see
    `clip_example`. If the clips have following rows, all clips of an epoch are shifted by the same random number of
    frames, limited so that each stays within its run."""

    clips: np.ndarray
    trans_center: bool
    turn: bool = False
    normalize: bool = False
    skipped: Counter[str] = field(default_factory=Counter)

    def example(self, index: int) -> ClipExample:
        clip, rng = self._drawn(index, len(self.clips))
        rows = self.clips[clip]
        if following := len(rows) - CLIP_FRAMES:
            epoch_rng = np.random.default_rng([self.seed, RandomStream.EPOCH_ORDER, index // len(self.clips), 1])
            # beyond the end of a run, its last row is repeated
            start = min(int(epoch_rng.integers(following + 1)), max(len(np.unique(rows)) - CLIP_FRAMES, 0))
            rows = rows[start : start + CLIP_FRAMES]
        samples = [self._sample(row, rng) for row in rows]
        return clip_example(samples, rng, trans_center=self.trans_center, turn=self.turn, normalize=self.normalize)

    def validation_clips(self, count: int) -> list[ClipExample]:
        """At most `count` clips, evenly spread, for validation: centered on their points, or as `trans_center`
        says."""
        rng = np.random.default_rng(self.seed)
        clip_rows = self.clips[evenly_spaced(len(self.clips), count), :CLIP_FRAMES]
        clips = [[self.dataset.sample(row) for row in rows] for rows in clip_rows]
        return [clip_example(clip, rng, trans_center=self.trans_center, pelvis_centered=0.0) for clip in clips]


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    """(count,) int: the rows in the order of an epoch."""
    return np.random.default_rng([seed, RandomStream.EPOCH_ORDER, epoch]).permutation(count)


@dataclass(frozen=True, kw_only=True)
class MixedSource:
    """Examples of `main` in order, with examples of `other` evenly spread among them: a `share` in [0, 1) of all."""

    main: Source
    other: Source
    share: float

    def example(self, index: int) -> Any:
        other_index, next_index = floor(index * self.share), floor((index + 1) * self.share)
        return self.other.example(other_index) if next_index > other_index else self.main.example(index - other_index)


@dataclass(frozen=True, kw_only=True)
class Chunks(IterableDataset):
    """The chunks of a run of `steps` steps from chunk `start` on, each a list of `BATCHES` batches collated by the
    objective; the last chunk may be shorter.

    batch: samples per step, in all processes together; rank, ranks: index of this process, number of processes.
    """

    source: Source
    objective: Objective
    batch: int
    seed: int
    start: int
    steps: int
    rank: int = 0
    ranks: int = 1

    def __iter__(self) -> Iterator[list[Any]]:
        worker, workers = this_worker()
        for chunk in range(self.start + worker, chunks_of(self.steps), workers):
            yield self.batches_of(chunk)

    def batches_of(self, chunk: int) -> list[Any]:
        """The batches of a chunk of the run, which may be before `start`."""
        first_number, batch_count = chunk * BATCHES * self.batch, min(self.steps - chunk * BATCHES, BATCHES)
        lane_count = lanes_of(self.batch, self.ranks)
        share = self.batch // lane_count
        order = np.random.default_rng([self.seed, RandomStream.BATCH_ORDER, chunk]).permutation(batch_count)
        # matrix products have only a few thousand numbers: BLAS threads slow each other down
        with threadpool_limits(limits=1, user_api="blas"):
            lanes = []
            for offset in range(self.rank, lane_count, self.ranks):
                numbers = range(first_number + offset, first_number + batch_count * self.batch, lane_count)
                lanes.append(sorted(map(self.source.example, numbers), key=attrgetter("size")))
            starts = share * order
            return [self.objective.collate([e for lane in lanes for e in lane[k : k + share]]) for k in starts]


def chunks_of(steps: int) -> int:
    """Number of chunks for a number of steps."""
    return -(-steps // BATCHES)


def lanes_of(batch: int, ranks: int = 1) -> int:
    """Number of lanes of a chunk, the same for any number of processes. Raises InputError if they cannot be distributed
    evenly over `ranks` processes."""
    lane_count = gcd(batch, LANES)
    if lane_count % ranks:
        counts = ", ".join(str(n) for n in range(1, lane_count + 1) if lane_count % n == 0)
        raise InputError(f"a batch of {batch} can be shared out among {counts} processes, got {ranks}: change --batch")
    return lane_count


def loader(chunks: Chunks, *, workers: int) -> Iterator[list[Any]]:
    """The chunks in order, made by `workers` processes (0: by this one)."""
    is_packed = workers > 0 and _has_shared_memory(workers)
    data_loader = DataLoader(
        chunks,
        batch_size=None,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        collate_fn=_packed if is_packed else _unchanged,
        worker_init_fn=_begin_worker,
    )
    return map(_unpacked, data_loader) if is_packed else iter(data_loader)


def _unchanged(batches: list[Any]) -> list[Any]:
    # prevents torch's conversion of arrays to tensors; the objective does it, on its device
    return batches


# ---- a chunk's arrays go between processes in one block of shared memory: hundreds of megabytes through a pipe take
# longer than a GPU's steps


def _has_shared_memory(workers: int) -> bool:
    """Whether shared memory can hold the chunks of all workers; containers have 64 MB unless configured otherwise."""
    return _SHARED_MEMORY.is_dir() and shutil.disk_usage(_SHARED_MEMORY).free > workers * _SHARED_OF_WORKER


def _packed(batches: list[Any]) -> tuple[bytes, list[tuple[int, int]], torch.Tensor]:
    """A chunk as a pickle without its arrays, the start and end of each array in a block, and the block (n,) uint8."""
    buffers: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(batches, protocol=5, buffer_callback=buffers.append)
    arrays = [np.frombuffer(buffer.raw(), np.uint8) for buffer in buffers]
    *starts, size = accumulate((-(-len(array) // _ALIGNED) * _ALIGNED for array in arrays), initial=0)
    spans = [(start, start + len(array)) for start, array in zip(starts, arrays, strict=True)]
    block = torch.empty(size, dtype=torch.uint8)
    for (start, end), array in zip(spans, arrays, strict=True):
        block.numpy()[start:end] = array
    return rest, spans, block


def _unpacked(chunk: tuple[bytes, list[tuple[int, int]], torch.Tensor]) -> list[Any]:
    rest, spans, block = chunk
    memory = block.numpy().data
    return pickle.loads(rest, buffers=[memory[start:end] for start, end in spans])


def _begin_worker(worker: int) -> None:
    # Ctrl-C and the SIGTERM of a batch system also reach workers, but the parent still needs them for the batches that
    # it finishes
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
    # objects inherited from the parent are excluded from garbage collection: 5 % of the time of making people
    gc.freeze()
