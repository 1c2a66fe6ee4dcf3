"""Restartable writing of shards by several processes: finds the missing shards of a folder and makes them.

Used by `lidarpose synth` and `prepare`. A shard is written atomically, and its content depends only on the settings and
its number. So no other state is needed: missing shards are made by any process, and the resulting folder is always the
same, byte for byte.
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
from contextlib import closing, contextmanager
from pathlib import Path

from lidarpose.data.dataset_card import CARD, DatasetCard, read_card
from lidarpose.data.rows import TABLES
from lidarpose.data.shards import rows_of_shard, shard_path
from lidarpose.errors import InputError
from lidarpose.io.atomic import is_unused, locked
from lidarpose.io.files import file_error

# yields the number of people, clips or streets done since the last yield
Counts = Generator[int, None, None]
# makes and writes the shard of a number
Make = Callable[[int], Counts]

# interval between progress reports, s
_TICK = 0.5
# pattern of the file names in a dataset's folder
_NAMES = rf"(?:(?:{'|'.join(TABLES)})-\d{{5}}\.parquet|{re.escape(CARD)})"
_BUSY = "another process writes this dataset: wait for its end, or give another folder"


@contextmanager
def open_folder(folder: Path, card: DatasetCard, rows: Mapping[str, int] | None = None) -> Iterator[list[int]]:
    """Locks a dataset's folder, see `atomic.locked`, and yields the numbers of the shards that are missing, damaged or,
    according to `rows`, incomplete.

    rows: by table, the number of rows of each of the `card.count` items, if known. Raises InputError unless the folder
    is missing, empty or of this dataset, and if another process writes there.
    """
    # before locking, which removes the file .lock at the end: it may belong to another program
    _check_folder(folder, card)
    with locked(folder, _NAMES, busy=_BUSY):
        # again: meanwhile another process may have written a dataset
        _check_folder(folder, card)
        yield [shard for shard in range(card.shards) if not _is_whole(folder, card, shard, rows or {})]


def _check_folder(folder: Path, card: DatasetCard) -> None:
    if folder.exists() and not folder.is_dir():
        raise file_error(folder, "is a file; give a folder for the dataset")
    if (folder / CARD).is_file():
        check_settings(folder, read_card(folder), card)
    elif not is_unused(folder, _NAMES):
        raise file_error(folder, f"holds other files and no {CARD}; give a new or empty folder for the dataset")


def check_settings(folder: str | Path, present: DatasetCard, wanted: DatasetCard) -> None:
    """Raises InputError that names the settings in which a dataset differs from the wanted one."""
    old_settings, new_settings = (
        {"count": c.count, "per_shard": c.per_shard, "version": c.version, **c.settings} for c in (present, wanted)
    )
    pairs = {
        name: (json.dumps(old_settings.get(name)), json.dumps(new_settings.get(name)))
        for name in sorted(old_settings | new_settings)
    }
    # of a prepared dataset, items are parts of the release
    labels = {"count": "the number of the release's parts"} if "parts" in new_settings else {}
    differences = {
        name: f"{labels.get(name, name)} is {present_value}, requested is {wanted_value}"
        for name, (present_value, wanted_value) in pairs.items()
        if present_value != wanted_value
    }
    if len(differences) > 1:
        # a digest, which adds nothing to the other differences
        differences.pop("parts", None)
    if differences:
        problem = f"{folder} has a dataset with other settings: {'; '.join(differences.values())}"
        raise InputError(f"{problem}; give another folder or the same settings")


def _is_whole(folder: Path, card: DatasetCard, shard: int, rows: Mapping[str, int]) -> bool:
    for table in card.tables:
        count = rows_of_shard(shard_path(folder, table, shard))
        if count is None or table in rows and count != rows[table] * card.size(shard):
            return False
    return True


def make_shards(make: Make, shards: list[int], *, workers: int = 1) -> Iterator[tuple[int, int]]:
    """Makes shards, in this or in other processes; yields the numbers of shards, and of the items that `make` counts,
    done since the last yield.

    With several workers, `make` is pickled once for each; workers end with this process, however it ends. Raises what
    `make` raises, and InputError if a worker dies.
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
    # fresh interpreters: workers must not inherit threads and open files
    context = multiprocessing.get_context("spawn")
    # Windows waits for at most 61 processes
    workers = min(workers, 61) if os.name == "nt" else workers
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
                f"one of {workers} worker processes died: give fewer --workers if memory ran out; "
                "the same command continues where it stopped"
            ) from None
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


# state of a worker process: the maker of shards, the counter shared by all workers, and the stop event
_worker_state: tuple = ()


def _start(make: Make, counter, stop) -> None:
    global _worker_state
    # only the parent decides when to stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    _worker_state = (make, counter, stop)


def end_with_parent() -> None:
    """Ends this worker process when its parent ends: a killed parent cannot stop it, and it would wait forever."""
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
    """Iterates `make` with one BLAS thread: in matrix products of a few thousand numbers, more threads slow each other
    down. Work that `make` does before it returns, such as reading data for all shards, may use all threads."""
    from threadpoolctl import threadpool_limits

    with closing(make(shard)) as counts, threadpool_limits(limits=1, user_api="blas"):
        yield from counts
