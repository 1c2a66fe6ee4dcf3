"""Shards by several processes, restartable: what is missing of a folder, who makes it, and what killed runs left.

Behind `lidarpose synth` and `prepare`. A shard is written whole or not at all, and its content depends on the settings
and its number alone. So nothing else need be remembered: what is missing is made, whoever makes it, and the folder ends
up the same byte for byte.
"""

import json
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from functools import partial
from pathlib import Path

from lidarpose.data.dataset_card import CARD, DatasetCard, read_card
from lidarpose.data.rows import TABLES
from lidarpose.data.shards import rows_of_shard, shard_path
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, is_unused, locked

# how many people, clips or streets are done since it last told
Counts = Generator[int, None, None]
# makes and writes a shard, by its number
Make = Callable[[int], Counts]

# how often progress is told, s
_TICK = 0.5
# of the files in a dataset's folder
_NAMES = rf"(?:(?:{'|'.join(TABLES)})-\d{{5}}\.parquet|{re.escape(CARD)})"
# keeps other processes from writing into a dataset's folder
lock_dataset = partial(
    locked, names=_NAMES, busy="another process writes this dataset: wait for its end, or give another folder"
)


def open_folder(folder: Path, card: DatasetCard, rows: Mapping[str, int] | None = None) -> list[int]:
    """The numbers of the shards that are missing, damaged or, by `rows`, not whole.

    rows: by table, how many rows each one of `card.count` has, where that is known. Raises InputError unless the folder
    is missing, empty or of this very dataset.
    """
    if folder.exists() and not folder.is_dir():
        raise file_error(folder, "is a file; give a folder for the dataset")
    if (folder / CARD).is_file():
        check_settings(folder, read_card(folder), card)
    elif not is_unused(folder, _NAMES):
        raise file_error(folder, f"holds other files and no {CARD}; give a new or empty folder for the dataset")
    return [shard for shard in range(card.shards) if not _is_whole(folder, card, shard, rows or {})]


def check_settings(folder: str | Path, present: DatasetCard, wanted: DatasetCard) -> None:
    """Raises InputError that names the settings in which a dataset differs from what is wanted."""
    old_settings, new_settings = (
        {"count": c.count, "per_shard": c.per_shard, "version": c.version, **c.settings} for c in (present, wanted)
    )
    pairs = {
        name: (json.dumps(old_settings.get(name)), json.dumps(new_settings.get(name)))
        for name in sorted(old_settings | new_settings)
    }
    differences = {
        name: f"{name} {present_value} there, {wanted_value} asked for"
        for name, (present_value, wanted_value) in pairs.items()
        if present_value != wanted_value
    }
    if len(differences) > 1:
        # digests, which say nothing that the others do not
        differences.pop("parts", None)
    if differences:
        problem = f"{folder} holds a dataset of other settings: {'; '.join(differences.values())}"
        raise InputError(f"{problem}; give another folder or the same settings")


def _is_whole(folder: Path, card: DatasetCard, shard: int, rows: Mapping[str, int]) -> bool:
    for table in card.tables:
        count = rows_of_shard(shard_path(folder, table, shard))
        if count is None or table in rows and count != rows[table] * card.size(shard):
            return False
    return True


def make_shards(make: Make, shards: list[int], *, workers: int = 1) -> Iterator[tuple[int, int]]:
    """Makes shards, here or in other processes; yields how many shards, and how many of what `make` counts, are done
    since it last did.

    With several workers `make` is pickled once for each; they end with this process, however it ends. Raises what
    `make` raises, and InputError where a worker dies.
    """
    workers = min(workers, len(shards))
    if workers > 1:
        yield from _by_processes(make, shards, workers)
        return
    for shard in shards:
        with closing(_counts(make, shard)) as counts:
            for count in counts:
                yield 0, count
        yield 1, 0


def _by_processes(make: Make, shards: list[int], workers: int) -> Iterator[tuple[int, int]]:
    # a fresh interpreter: threads and open files of this one are none of theirs
    context = multiprocessing.get_context("spawn")
    counter, stop = context.Value("q", 0), context.Event()
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(make, counter, stop)) as pool:
        try:
            reported_count, pending_futures = 0, {pool.submit(_shard, shard) for shard in shards}
            while pending_futures:
                done_futures, pending_futures = wait(pending_futures, timeout=_TICK, return_when=FIRST_COMPLETED)
                for future in done_futures:
                    future.result()
                current_count = counter.value
                yield len(done_futures), current_count - reported_count
                reported_count = current_count
        except BrokenProcessPool:
            raise InputError(
                f"a worker process died, of {workers}: give fewer --workers if memory ran out; "
                "the same command goes on where it stopped"
            ) from None
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


# of a worker process: what makes a shard, the count of what all have done, and whether to stop
_worker_state: tuple = ()


def _start(make: Make, counter, stop) -> None:
    global _worker_state
    # the parent says when to stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    _worker_state = (make, counter, stop)


def end_with_parent() -> None:
    """Ends this worker process when its parent is gone: a killed parent cannot stop it, and it would wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "runs in a worker"

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _shard(shard: int) -> None:
    make, counter, stop = _worker_state
    with closing(_counts(make, shard)) as counts:
        for count in counts:
            with counter.get_lock():
                counter.value += count
            if stop.is_set():
                return


def _counts(make: Make, shard: int) -> Counts:
    """As `make`, on one thread: in products of a few thousand numbers threads of BLAS only get in each other's way.
    What `make` does before it returns, such as reading what all shards need, has them all."""
    from threadpoolctl import threadpool_limits

    with closing(make(shard)) as counts, threadpool_limits(limits=1, user_api="blas"):
        yield from counts
