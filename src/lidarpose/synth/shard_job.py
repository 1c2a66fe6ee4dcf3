"""The job behind `lidarpose synth`: writes people, clips or streets to Parquet shards, see `data.writer`."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lidarpose.body.mocap import digest as motion_digest
from lidarpose.data.dataset_card import CARD, DatasetCard, write_card
from lidarpose.data.rows import person_row
from lidarpose.data.shards import shard_path, shard_writer
from lidarpose.data.writer import Counts, make_shards, open_folder
from lidarpose.errors import InputError, check_int, check_name
from lidarpose.io.files import content_digest, file_error
from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.sample import CLIP_FRAMES
from lidarpose.synth.scene import ACQUISITIONS, RandomStream, scene_config

if TYPE_CHECKING:
    from lidarpose.synth.generator import Generator

# persons, clips or streets per shard
PER_SHARD = {"people": 2000, "clips": 125, "streets": 2}
_TABLES = {"people": ("people",), "clips": ("people",), "streets": ("people", "frames")}
STREET_FRAMES = 10
# number of rows in a table per person or clip; not fixed for streets
_ROWS = {"people": {"people": 1}, "clips": {"people": CLIP_FRAMES}}
# default share of captured poses if a motion file is given
_CAPTURED = 0.5
# shard numbers have five digits
_MOST_SHARDS = 100_000


@dataclass(frozen=True, kw_only=True)
class SynthesisJob:
    """The settings of a dataset. what: people, clips or streets; count: their number; scene: a preset's name; sensors:
    names or files of tables, None: the scene's; hard: difficulty in [0, 1]; motion: a file of captured clips whose
    poses make up a share `captured` of all (None: half); subjects: which of the clips, None: all; body: the user's SMPL
    file instead of the shipped body; set: changes of the scene, see `SceneConfig.changed`; per_shard: persons, clips or
    streets per file, None: as `PER_SHARD`."""

    what: str
    count: int
    scene: str = "wild"
    sensors: tuple[str, ...] | None = None
    seed: int = 0
    hard: float = 1.0
    motion: str | None = None
    subjects: tuple[str, ...] | None = None
    captured: float | None = None
    body: str | None = None
    per_shard: int | None = None
    set: tuple[str, ...] = ()

    def __post_init__(self):
        check_name("kind of dataset", self.what, PER_SHARD)
        check_int(f"the number of {self.what}", self.count, least=1)
        check_int("--per-shard", self.shard_size, least=1)
        check_int("the seed", self.seed, least=0)
        if self.what == "streets":
            not_theirs = {
                "--scene": self.scene != "wild",
                "--hard": self.hard != 1,
                "--motion": self.motion,
                "--body": self.body,
                "--set or --keep": self.set,
            }
            if names := ", ".join(name for name, is_set in not_theirs.items() if is_set):
                raise InputError(f"streets have their own scene, difficulty and walkers: omit {names}")
        if -(-self.count // self.shard_size) > _MOST_SHARDS:
            raise InputError(
                f"{self.count:,} {self.what} would take more than {_MOST_SHARDS:,} shards: give a larger --per-shard"
            )
        if self.motion is None and (self.subjects is not None or self.captured is not None):
            raise InputError("--subjects and --captured need captured clips: give their file with --motion too")
        if self.subjects is not None and not self.subjects:
            raise InputError("expected the subjects of clips, got none: omit --subjects for all of them")
        if self.captured is not None and not 0 <= self.captured <= 1:
            raise InputError(f"expected a share of captured poses between 0 and 1, got {self.captured}")
        scene = scene_config(self.scene).eased(self.hard).changed(self.set)
        if scene.recorded and self.what == "clips":
            raise InputError("recorded=1 keeps the positions of single poses: omit it or --clips")
        set_names = {change.partition("=")[0] for change in self.set}
        twice = {"--sensor": ("sensors", self.sensors is not None), "--hard": ("hard", self.hard != 1)}
        for option, (name, is_given) in twice.items():
            if is_given and name in set_names:
                raise InputError(f"expected {option} or --set {name}=..., got both: omit one of the two")
        acquisitions = [name for name in ACQUISITIONS if name in set_names and getattr(scene, name)]
        if acquisitions and self.what == "clips":
            raise InputError(f"clips are scanned in one way only: omit {', '.join(acquisitions)}, or --clips")
        if "sparse" in acquisitions and self.sensors is not None:
            raise InputError("sparse scans with sensors of its own: omit it or --sensor")
        for name in self.sensors or ():
            sensor(name)
        devices = map(sensor, scene.sensors if self.sensors is None else self.sensors)
        has_rosette = any(isinstance(device, RayPattern) and device.duration for device in devices)
        has_motion = self.what == "clips" or scene.accumulated or (scene.integration and has_rosette)
        without_effect = {
            "tempo": (
                not (self.share and has_motion),
                "captured motion of clips or accumulated frames: give --motion, and --clips or accumulated, too",
            ),
            "clear_limbs": (not self.share, "captured poses: give their file with --motion too"),
            "double_rate": (self.what == "clips" or not scene.merged, "merged clouds of people: set merged, too"),
            "integration": (not has_rosette, "rosettes: name one by --sensor"),
            "sigma": (scene.noise.dapt_compat, "symmetric range noise: set dapt_compat=0"),
        }
        for name, (is_unused, needed) in without_effect.items():
            if name in set_names and getattr(scene, name, True) and is_unused:
                raise InputError(f"{name} changes nothing without {needed}, or omit it")
        if self.sensors is not None and not self.sensors:
            raise InputError("expected the names of sensors, got none; lidarpose sensors lists them")

    @property
    def shard_size(self) -> int:
        """Number of persons, clips or streets per file."""
        return PER_SHARD[self.what] if self.per_shard is None else self.per_shard

    @property
    def share(self) -> float:
        """Share of captured poses."""
        return 0.0 if self.motion is None else _CAPTURED if self.captured is None else self.captured

    def generator(self) -> "Generator":
        """The generator of the people. Raises InputError if motion cannot be read, MissingExtra without numba."""
        from lidarpose.synth.bodies import CLIP_HZ, PoseBank, smpl_rig
        from lidarpose.synth.generator import Generator

        scene = scene_config(self.scene).eased(self.hard).changed(self.set)
        if self.sensors is not None:
            # `sparse` would replace the chosen sensors by others
            scene = replace(scene, sensors=self.sensors, sparse=0.0)
        bank = PoseBank.from_clips(self.motion, self.subjects) if self.motion is not None else None
        if self.what == "clips" and bank and self.share and not len(bank.clips.window_starts(CLIP_FRAMES + 1)):
            raise file_error(
                self.motion, f"no clip lasts {CLIP_FRAMES / CLIP_HZ:g} s: give longer motion, or omit --clips"
            )
        rig = None if self.body is None else smpl_rig(self.body, self.motion, self.subjects or ())
        return Generator(scene=scene, bank=bank, captured=self.share, rig=rig)

    def card(self) -> DatasetCard:
        """The dataset's card: all settings that determine its content."""
        sensors = self.sensors or scene_config(self.scene).changed(self.set).sensors
        scene_changes = [change for change in self.set if not change.startswith("sensors=")]
        settings: dict[str, Any] = {
            "what": self.what,
            "sensors": [name if name in SENSORS else Path(name).name for name in sensors],
            "seed": self.seed,
        }
        if self.what != "streets":
            settings |= {"scene": self.scene, "hard": self.hard} | ({"set": scene_changes} if scene_changes else {})
        # files are identified by content, so that another file of the same name is detected and a moved file is not
        tables = [name for name in dict.fromkeys(sensors) if name not in SENSORS]
        if tables:
            settings["tables"] = [content_digest(name, expected="a sensor's table")[:16] for name in tables]
        if self.motion is not None:
            settings["motion"] = motion_digest(self.motion)
            settings["captured"] = self.share
            settings["subjects"] = list(self.subjects) if self.subjects else None
        if self.body is not None:
            settings["body"] = content_digest(self.body, expected="a body of the SMPL family")[:16]
        return DatasetCard(settings=settings, count=self.count, per_shard=self.shard_size, tables=_TABLES[self.what])


def write_dataset(
    job: SynthesisJob, folder: str | Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> int:
    """Makes the missing shards of a dataset; returns the number of persons, clips or streets that this call made.

    workers: number of processes; progress(done, total) is called at the start and after each one is done. Raises
    InputError if the folder holds another dataset or other files, or cannot be written, MissingExtra without numba or
    pyarrow.
    """
    check_int("--workers", workers, least=1)
    folder, card = Path(folder), job.card()
    with open_folder(folder, card, _ROWS.get(job.what)) as missing_shards:
        remaining = sum(card.size(shard) for shard in missing_shards)
        done_count = card.count - remaining
        # before anything is written, so that an unreadable motion file leaves no folder behind
        maker = Maker(job=job, card=card, folder=folder, generator=job.generator()) if missing_shards else None
        has_card = (folder / CARD).is_file()
        if not has_card:
            write_card(folder, card)
        if progress is not None:
            progress(done_count, card.count)
        try:
            for _, count in make_shards(maker, missing_shards, workers=workers) if maker is not None else ():
                done_count += count
                if progress is not None:
                    progress(done_count, card.count)
        except InputError:
            # if nothing was made, the card would prevent another try with other settings
            if not has_card and not any(folder.glob("*.parquet")):
                (folder / CARD).unlink()
            raise
    return remaining


@dataclass(frozen=True, kw_only=True)
class Maker:
    """Makes and writes the shards of a job: called with a shard's number, yields counts of persons, clips or streets as
    they are done. The shard is written before the last count is yielded. May be pickled."""

    job: SynthesisJob
    card: DatasetCard
    folder: Path
    generator: "Generator"

    def __call__(self, shard: int) -> Counts:
        rows_of = self._street_rows if self.job.what == "streets" else self._people_rows
        first_index, size = shard * self.card.per_shard, self.card.size(shard)
        with ExitStack() as stack:
            row_writers = {
                table: stack.enter_context(shard_writer(shard_path(self.folder, table, shard), table))
                for table in self.card.tables
            }
            for index in range(first_index, first_index + size):
                if index > first_index:
                    yield 1
                for table, rows in rows_of(index).items():
                    for row in rows:
                        row_writers[table](row)
        yield 1

    def _people_rows(self, index: int) -> dict[str, list]:
        generator, seed = self.generator, self.job.seed
        if self.job.what == "people":
            people = [generator.person(seed, index)]
        else:
            people = generator.clip(seed, index, frames=CLIP_FRAMES)
        return {"people": [person_row(p.sample, index=index, frame=f, info=p.facts) for f, p in enumerate(people)]}

    def _street_rows(self, index: int) -> dict[str, list]:
        from lidarpose.synth.street import samples, street

        seed, sensors = self.job.seed, self.generator.config.sensors
        scene = street(seed, index, sensor=sensors[index % len(sensors)], frames=STREET_FRAMES)
        # every sample of a street has a box, whose id is its track
        people = [
            person_row(sample, index=index, frame=frame, track=int(cast("Any", sample.box).id))
            for frame, sample in samples(scene, np.random.default_rng([seed, RandomStream.STREET_BOXES, index]))
        ]
        frames = [
            {
                **{"index": index, "frame": number, "sensor": scene.sensor},
                **{"points": frame.points.ravel(), "ring": frame.ring, "person": frame.person, "part": frame.part},
                "track": [box.id for box in frame.boxes],
                "box": [np.concatenate([box.center, box.size, [box.yaw]]) for box in frame.boxes],
                "joints": frame.joints,
            }
            for number, frame in enumerate(scene.frames)
        ]
        return {"people": people, "frames": frames}
