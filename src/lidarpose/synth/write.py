"""The job behind `lidarpose synth`: people, clips or streets into Parquet shards, by many processes, restartable.

A shard is written whole or not at all, and its content depends on the settings and its number alone. So nothing else
need be remembered: what is missing is made, whoever makes it, and the folder ends up the same byte for byte.
"""

import hashlib
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.files import file_error, read_bytes
from lidarpose.data.shards import (
    CARD,
    TABLES,
    Card,
    check_settings,
    person_row,
    read_card,
    rows_of_shard,
    shard_path,
    shard_writer,
    write_card,
)
from lidarpose.errors import InputError
from lidarpose.lidar.sensor import SENSORS, sensor
from lidarpose.synth.scene import scene_config

# persons, clips or streets a shard
PER_SHARD = {"people": 2000, "clips": 125, "streets": 2}
_TABLES = {"people": ("people",), "clips": ("people",), "streets": ("people", "frames")}
CLIP_FRAMES = 16
STREET_FRAMES = 10
# how often a shard tells how far it is
_TOLD = 50
# share of captured poses where a file of them is given
_CAPTURED = 0.5
# as many as names of five digits can number
_MOST_SHARDS = 100_000


@dataclass(frozen=True, kw_only=True)
class Job:
    """What to make. what: people, clips or streets; count of them; scene: a preset's name; sensors: names or files of
    tables, None: the scene's; hard in [0, 1]; motion: a file of captured clips whose poses make up a share `captured`
    of all (None: half), subjects: which of them; per_shard: persons, clips or streets a file, None: as `PER_SHARD`."""

    what: str
    count: int
    scene: str = "wild"
    sensors: tuple[str, ...] | None = None
    seed: int = 0
    hard: float = 1.0
    motion: str | None = None
    subjects: tuple[str, ...] | None = None
    captured: float | None = None
    per_shard: int | None = None

    def __post_init__(self):
        if self.what not in PER_SHARD:
            raise InputError(f"what to make must be one of {', '.join(PER_SHARD)}, got {self.what!r}")
        if self.count < 1:
            raise InputError(f"expected at least 1 of {self.what}, got {self.count}")
        if self.per_shard is not None and self.per_shard < 1:
            raise InputError(f"expected at least 1 of {self.what} a shard, got {self.per_shard}")
        if self.what == "streets" and (self.scene != "wild" or self.hard != 1 or self.motion is not None):
            raise InputError("streets have scene, difficulty and walkers of their own: leave these options out")
        if -(-self.count // (self.per_shard or PER_SHARD[self.what])) > _MOST_SHARDS:
            raise InputError(
                f"{self.count:,} {self.what} would take more than {_MOST_SHARDS:,} shards: give a larger --per-shard"
            )
        if self.motion is None and (self.subjects is not None or self.captured is not None):
            raise InputError("--subjects and --captured are of captured clips: name their file with --motion too")
        if self.captured is not None and not 0 <= self.captured <= 1:
            raise InputError(f"expected a share of captured poses between 0 and 1, got {self.captured}")
        if self.seed < 0:
            raise InputError(f"expected a seed of at least 0, got {self.seed}")
        scene_config(self.scene).eased(self.hard)
        for name in self.sensors or ():
            sensor(name)
        if self.sensors is not None and not self.sensors:
            raise InputError("expected the names of sensors, got none; lidarpose sensors lists them")

    @property
    def share(self) -> float:
        """Of the poses, how many are captured."""
        return 0.0 if self.motion is None else _CAPTURED if self.captured is None else self.captured

    def card(self) -> Card:
        """The dataset's card: all that decides its content."""
        sensors = self.sensors or scene_config(self.scene).sensors
        settings: dict[str, Any] = {
            "what": self.what,
            "sensors": [name if name in SENSORS else Path(name).name for name in sensors],
            "seed": self.seed,
        }
        if self.what != "streets":
            settings |= {"scene": self.scene, "hard": self.hard}
        # files by content, so that another file of the same name is noticed and the same one elsewhere is not
        tables = {name: _digest(name, "a sensor's table") for name in dict.fromkeys(sensors) if name not in SENSORS}
        if tables:
            settings["tables"] = list(tables.values())
        if self.motion is not None:
            settings["motion"] = _digest(self.motion, "motion") if os.path.isfile(self.motion) else str(self.motion)
            settings["captured"] = self.share
            settings["subjects"] = list(self.subjects) if self.subjects else None
        per_shard = self.per_shard or PER_SHARD[self.what]
        return Card(settings=settings, count=self.count, per_shard=per_shard, tables=_TABLES[self.what])


def _digest(path: str, expected: str) -> str:
    return hashlib.sha256(read_bytes(path, expected=expected)).hexdigest()[:16]


def write_dataset(
    job: Job, folder: str | Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> int:
    """Makes what is missing of a dataset; returns how many persons, clips or streets were made now.

    workers: processes; progress(done, total) is called at the start and as they are done. Raises InputError where the
    folder holds another dataset or something else, or cannot be written, MissingExtra without numba or pyarrow.
    """
    if workers < 1:
        raise InputError(f"expected at least 1 worker, got {workers}")
    folder, card = Path(folder), job.card()
    _check_folder(folder, card)
    missing = [shard for shard in range(card.shards) if not _is_whole(folder, card, shard)]
    left = sum(card.size(shard) for shard in missing)
    done = card.count - left
    # before anything is written, so that motion that cannot be read leaves no folder
    maker = Maker(job) if missing else None
    _clean(folder)
    if not (folder / CARD).is_file():
        write_card(folder, card)
    if progress is not None:
        progress(done, card.count)
    workers = min(workers, len(missing))
    for count in _by_processes(job, folder, missing, workers) if workers > 1 else _here(maker, folder, missing):
        done += count
        if progress is not None:
            progress(done, card.count)
    _clean(folder)
    return left


def _check_folder(folder: Path, card: Card) -> None:
    """Raises InputError unless the folder is missing, empty or of this very dataset."""
    if folder.exists() and not folder.is_dir():
        raise file_error(folder, "is a file; give a folder for the dataset")
    if (folder / CARD).is_file():
        check_settings(folder, read_card(folder), card)
    elif folder.is_dir() and any(not _LEFT.fullmatch(path.name) for path in folder.iterdir()):
        raise file_error(folder, f"holds other files and no {CARD}; give a new or empty folder for the dataset")


def _clean(folder: Path) -> None:
    """Removes what killed runs left: temporary files whose process is gone, or that nobody wrote to for long."""
    for path in folder.iterdir() if folder.is_dir() else ():
        left = _LEFT.fullmatch(path.name)
        with suppress(OSError):
            # a number of a process may have been given to another one
            if left and (not _is_alive(int(left[1])) or time.time() - path.stat().st_mtime > _STALE):
                path.unlink()


# a shard is written in a few seconds, s
_STALE = 600.0
# the temporary names of `files.atomic_path`
_LEFT = re.compile(rf"\.(\d+)-\d+-(?:(?:{'|'.join(TABLES)})-\d{{5}}\.parquet|{re.escape(CARD)})")


def _is_alive(process: int) -> bool:
    if process == os.getpid():
        return False
    if os.name != "posix":
        # asking would end it there
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _is_whole(folder: Path, card: Card, shard: int) -> bool:
    for table in card.tables:
        rows = rows_of_shard(shard_path(folder, table, shard))
        each = _PEOPLE_EACH.get(card.settings["what"])
        if rows is None or each is not None and table == "people" and rows != each * card.size(shard):
            return False
    return True


# rows of "people" that one of them has, where that is known
_PEOPLE_EACH = {"people": 1, "clips": CLIP_FRAMES}


def _here(maker: "Maker | None", folder: Path, shards: list[int]) -> Iterator[int]:
    """Makes shards in this process; yields how many persons, clips or streets are done, as they are."""
    if not shards:
        return
    with _one_thread():
        for shard in shards:
            yield from maker.shard(folder, shard)


def _by_processes(job: Job, folder: Path, shards: list[int], workers: int) -> Iterator[int]:
    """As `_here`, in other processes. They end with this one, however it ends."""
    # a fresh interpreter: threads and open files of this one are none of theirs
    context = multiprocessing.get_context("spawn")
    done, stop = context.Value("q", 0), context.Event()
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(job, done, stop)) as pool:
        try:
            told, waiting = 0, {pool.submit(_shard, folder, shard) for shard in shards}
            while waiting:
                ready, waiting = wait(waiting, timeout=_TICK, return_when=FIRST_COMPLETED)
                for future in ready:
                    future.result()
                now = done.value
                yield now - told
                told = now
        except BrokenProcessPool:
            raise InputError(
                f"a worker process died, of {workers}: give fewer --workers if memory ran out; "
                "the same command goes on where it stopped"
            ) from None
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


# how often progress is told, s
_TICK = 0.5
# of a worker process: its maker, the count of what all have done, and whether to stop
_mine: tuple = ()


def _start(job: Job, done, stop) -> None:
    global _mine
    # the parent says when to stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    _mine = (Maker(job), done, stop)


def _leave_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _shard(folder: Path, shard: int) -> None:
    maker, done, stop = _mine
    with _one_thread(), closing(maker.shard(folder, shard)) as counts:
        for count in counts:
            with done.get_lock():
                done.value += count
            if stop.is_set():
                return


def _one_thread():
    """Products of a few thousand numbers: threads of BLAS only get in each other's way."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")


class Maker:
    """Makes the rows of a job's persons, clips or streets."""

    def __init__(self, job: Job):
        from lidarpose.synth.bodies import PoseBank
        from lidarpose.synth.generate import Generator

        self._job, self._card = job, job.card()
        scene = scene_config(job.scene).eased(job.hard)
        if job.sensors is not None:
            scene = replace(scene, sensors=job.sensors)
        self._sensors = scene.sensors
        bank = PoseBank.from_clips(job.motion, job.subjects) if job.motion is not None else None
        self._generator = Generator(scene=scene, bank=bank, captured=job.share)
        self._rows = {"people": self._person, "clips": self._clip, "streets": self._street}[job.what]

    def shard(self, folder: Path, shard: int) -> Iterator[int]:
        """Makes and writes a shard; yields counts of what is done, as it is. Written when the last one was yielded."""
        first, size = shard * self._card.per_shard, self._card.size(shard)
        told, step = 0, max(1, self._card.per_shard // _TOLD)
        with ExitStack() as stack:
            add = {
                table: stack.enter_context(shard_writer(shard_path(folder, table, shard), table))
                for table in self._card.tables
            }
            for k in range(size):
                for table, rows in self._rows(first + k).items():
                    for row in rows:
                        add[table](row)
                if (k + 1) % step == 0 and k + 1 < size:
                    yield k + 1 - told
                    told = k + 1
        yield size - told

    def _person(self, index: int) -> dict[str, list]:
        person = self._generator.person(self._job.seed, index)
        return {"people": [person_row(person.sample, index=index, facts=person.facts)]}

    def _clip(self, index: int) -> dict[str, list]:
        clip = self._generator.clip(self._job.seed, index, frames=CLIP_FRAMES)
        return {"people": [person_row(p.sample, index=index, frame=f, facts=p.facts) for f, p in enumerate(clip)]}

    def _street(self, index: int) -> dict[str, list]:
        from lidarpose.synth.street import samples, street

        seed = self._job.seed
        found = street(seed, index, sensor=self._sensors[index % len(self._sensors)], frames=STREET_FRAMES)
        people = []
        for frame, sample in samples(found, np.random.default_rng([seed, 5, index])):
            people.append(person_row(sample, index=index, frame=frame, track=int(sample.box.id)))
        frames = [
            {
                "index": index,
                "frame": number,
                "sensor": found.sensor,
                "points": frame.points.ravel(),
                "ring": frame.ring,
                "person": frame.person,
                "part": frame.part,
                "track": [box.id for box in frame.boxes],
                "box": [np.concatenate([box.center, box.size, [box.yaw]]) for box in frame.boxes],
                "joints": frame.joints,
            }
            for number, frame in enumerate(found.frames)
        ]
        return {"people": people, "frames": frames}
