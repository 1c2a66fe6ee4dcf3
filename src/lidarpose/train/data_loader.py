"""A run's people as batches, made by worker processes and shared out among the processes of a run. No network here.

Chunk c holds people c * CHUNK ... of the run, whatever the number of workers and processes, so a run can be taken up at
any chunk. A chunk is sorted by voxels before it is cut into batches: padding is what a small network spends its time
on. It is sorted in lanes, and a process takes whole lanes: nobody makes people for another process, and the batches of
all of them together are the same however many there are.
"""

import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import gcd
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lidarpose.errors import InputError
from lidarpose.train.example import Example
from lidarpose.train.objective import Objective
from lidarpose.train.sources import Source

# batches a chunk
BATCHES = 8
# lanes at most, and so processes
LANES = 8
# how often a worker looks whether its parent lives, s
_LOOK = 1.0
# what orders batches of a chunk
_ORDER = 8


@dataclass(frozen=True, kw_only=True)
class Chunks(IterableDataset):
    """The chunks of a run of so many `steps` from chunk `start` on, each a list of `BATCHES` batches as the task
    collates them, the last one perhaps shorter.

    batch: people of a step in all processes; rank, ranks: which process this is, of how many.
    """

    source: Source
    task: Objective
    batch: int
    seed: int
    start: int
    steps: int
    rank: int = 0
    ranks: int = 1

    def __post_init__(self):
        lanes_of(self.batch, self.ranks)

    def __iter__(self) -> Iterator[list[Any]]:
        worker = get_worker_info()
        first, stride = (0, 1) if worker is None else (worker.id, worker.num_workers)
        for chunk in range(self.start + first, chunks_of(self.steps), stride):
            # products of a few thousand numbers: threads of BLAS only get in each other's way
            with threadpool_limits(limits=1, user_api="blas"):
                batches = self._chunk(chunk)
            yield batches

    def _chunk(self, chunk: int) -> list[Any]:
        first, batches = chunk * BATCHES * self.batch, min(self.steps - chunk * BATCHES, BATCHES)
        lanes = lanes_of(self.batch, self.ranks)
        mine = []
        for lane in range(self.rank, lanes, self.ranks):
            people = [self.source.example(index) for index in range(first + lane, first + batches * self.batch, lanes)]
            mine.append(sorted(people, key=_width))
        share = self.batch // lanes
        order = np.random.default_rng([self.seed, _ORDER, chunk]).permutation(batches)
        return [self.task.collate([e for lane in mine for e in lane[k * share : (k + 1) * share]]) for k in order]


def chunks_of(steps: int) -> int:
    """How many chunks so many steps are."""
    return -(-steps // BATCHES)


def lanes_of(batch: int, ranks: int = 1) -> int:
    """How many lanes a chunk has, whatever the number of processes. Raises InputError where they cannot be shared out
    evenly among so many."""
    lanes = gcd(batch, LANES)
    if lanes % ranks:
        fit = ", ".join(str(n) for n in range(1, lanes + 1) if lanes % n == 0)
        raise InputError(f"a batch of {batch} can be shared out among {fit} processes, got {ranks}: change --batch")
    return lanes


def _width(one: Example) -> int:
    """Cells of 10 cm stand for voxels: what matters is that like comes to like."""
    return len(np.unique(np.floor(one.points * 10), axis=0))


def loader(chunks: Chunks, *, workers: int) -> DataLoader:
    """The chunks in order, made by `workers` processes (0: by this one)."""
    return DataLoader(
        chunks,
        batch_size=None,
        num_workers=workers,
        prefetch_factor=4 if workers else None,
        collate_fn=_as_it_is,
        worker_init_fn=partial(_end_with, os.getpid()) if workers else None,
    )


def _as_it_is(batches: list[Any]) -> list[Any]:
    # torch would turn arrays into tensors; the task does so, on its device
    return batches


def _end_with(parent: int, worker: int) -> None:
    """Ends this worker when its parent is no more: killed, that could not tell it, and it would wait for ever."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    # Ctrl-C reaches workers too, and the parent still needs them for the batches that it finishes
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()
