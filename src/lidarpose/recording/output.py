"""NAME.poses.jsonl, .csv and .parquet: results of recordings that grow as they are made and go on after a kill.

While frames come, RESULT.part holds a finished line each, and RESULT.part.json beside it how it is made and what the
frames so far said of the next ones. At the end the lines become the result, whole.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import missing_extra
from lidarpose.geometry import transform_points
from lidarpose.io.files import atomic_path, check_writable, file_error
from lidarpose.io.sources import Source
from lidarpose.progress import Progress
from lidarpose.recording.coordinates import FixedFrame, moved_yaw, upright
from lidarpose.recording.predict_recording import FramePoses, FramePredictor
from lidarpose.sample import PER_JOINT, Pose
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.smoothing import smooth

FORMATS = ("jsonl", "csv", "parquet")
# what is made steady besides the joints, and its decimals
_SMOOTHED = {"spread": 4, "visible": 3, "confidence": 3}
# frames whose rows are written at a time
_ROWS_OF = 200
_COLUMNS = ("frame", "frame_id", "time", "person", "id", "track", "filled", "joint", "x", "y", "z", *PER_JOINT, "score")


class PartFile:
    """The finished lines of a result that is not whole yet.

    Args:
        result: the file that is to be; `.part` and `.part.json` are added to its name.
        command: what the lines depend on, as JSON holds it: lines of another command are not gone on with.
    """

    def __init__(self, result: Path, command: dict[str, Any]):
        self.path = result.with_name(result.name + ".part")
        self.state_path = result.with_name(result.name + ".part.json")
        self.command = json.loads(json.dumps(command))
        # what was found: frames that are finished, the last one's index and id, the predictor's state, and, where it is
        # of another command, what differs
        self.frames = 0
        self.last: tuple[int, str] | None = None
        self.state: dict[str, Any] | None = None
        self.other: list[str] = []
        check_writable(self.path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        size = self._read()
        self._file = open(self.path, "r+b" if size else "wb")  # noqa: SIM115
        self._file.truncate(size)
        self._file.seek(size)

    def _read(self) -> int:
        """How many bytes of the part hold finished lines of this command."""
        try:
            saved = json.loads(self.state_path.read_bytes())
            command, size = saved["command"], saved["bytes"]
            if self.path.stat().st_size < size:
                return 0
        except (OSError, ValueError, KeyError, TypeError):
            return 0
        if command != self.command:
            names = [*self.command, *command]
            self.other = sorted({name for name in names if command.get(name) != self.command.get(name)})
            return 0
        self.frames, self.last, self.state = saved["frames"], tuple(saved["last"]), saved["state"]
        return size

    def __enter__(self) -> "PartFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, frame: FramePoses, state: dict[str, Any]) -> None:
        """One more finished frame. A kill in between costs this frame: lines without their state are cut off."""
        self._file.write(json.dumps(frame.to_dict()).encode() + b"\n")
        self._file.flush()
        self.frames, self.last, self.state = self.frames + 1, (frame.index, frame.id), state
        saved = {
            "command": self.command,
            "bytes": self._file.tell(),
            "frames": self.frames,
            "last": self.last,
            "state": state,
        }
        temporary = self.state_path.with_name(self.state_path.name + ".new")
        temporary.write_text(json.dumps(saved))
        os.replace(temporary, self.state_path)

    def lines(self) -> Iterator[dict[str, Any]]:
        """The finished lines."""
        with open(self.path, "rb") as file:
            yield from map(json.loads, file)

    def remove(self) -> None:
        self._file.close()
        for path in (self.path, self.state_path):
            with suppress(OSError):
                path.unlink()


@dataclass
class Summary:
    """What a recording holds: counts, and of the warnings of frames and people an example and in how many frames; those
    that differ in numbers alone are one."""

    frames: int = 0
    people: int = 0
    damaged: int = 0
    tracks: set[int] = field(default_factory=set)
    first_error: str | None = None
    warnings: dict[str, str] = field(default_factory=dict)
    warned: Counter[str] = field(default_factory=Counter)

    def add(self, line: dict[str, Any]) -> None:
        self.frames += 1
        self.people += len(line["people"])
        self.tracks.update(person["track"] for person in line["people"] if person["track"] is not None)
        if line["error"] is not None:
            self.damaged += 1
            self.first_error = self.first_error or f"frame {line['frame']} ({line['id']}): {line['error']}"
        kinds = {}
        for text in (text for person in (line, *line["people"]) for text in person["warnings"]):
            kinds[re.sub(r"[\d.,]+", "0", text)] = text
        self.warnings = kinds | self.warnings
        self.warned.update(kinds.keys())

    def warning_lines(self, most: int) -> list[str]:
        """Lines for the user, at most so many, the first about damaged frames."""
        lines = [] if self.first_error is None else [f"{self.damaged:,} damaged, first {self.first_error}"]
        for kind, count in self.warned.most_common(most - 1):
            lines.append(f"{count:,} {'frame' if count == 1 else 'frames'}: {self.warnings[kind]}")
        return lines

    def text(self, is_tracked: bool) -> str:
        """The counts."""
        parts = [counted(self.frames, "frame"), counted(self.people, "person", "people")]
        parts += [counted(len(self.tracks), "track")] if is_tracked else []
        return ", ".join(parts + ([f"{self.damaged:,} damaged"] if self.damaged else []))


def counted(number: int, one: str, many: str | None = None) -> str:
    """ "1 frame", "2 frames"."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


# ---- the whole result


def write_recording(
    source: Source,
    steps: FramePredictor,
    result: Path,
    *,
    command: dict[str, Any],
    world: bool = False,
    on_line: Callable[[dict[str, Any]], None] | None = None,
    tell: Callable[[str], None] = print,
) -> Summary:
    """Poses all frames of a source and writes them, going on where the same command was stopped.

    Args:
        result: NAME.jsonl, .csv or .parquet.
        command: see `PartFile`.
        world: joints and boxes in the world's frame where the sensor's poses are known.
        on_line: is called with each final line.
        tell: what is said about lines that were there.

    Raises:
        InputError: a result that cannot be written, or finished lines that are not of these frames.
        MissingExtra: Parquet without pyarrow.
    """
    check_format(result)
    check_writable(result)
    summary = Summary()
    with PartFile(result, command) as part:
        if part.other:
            tell(f"{part.path} is of another command ({', '.join(part.other)}): beginning anew")
        elif part.frames:
            tell(f"{part.frames:,} frames are in {part.path}: going on")
        _add_frames(source, steps, part)
        if not part.frames:
            part.remove()
            raise file_error(source.name, "has no frames between start and end: choose others")
        lines = steadied(part, steps) if steps.is_tracked and not steps.live else part.lines()

        def final() -> Iterator[dict[str, Any]]:
            for line in lines:
                line = in_world(line, steps.up) if world else line
                summary.add(line)
                if on_line is not None:
                    on_line(line)
                yield line

        write_result(result, final())
        part.remove()
    return summary


def _add_frames(source: Source, steps: FramePredictor, part: PartFile) -> None:
    """Poses the frames that are not in the part yet."""
    frames = source.frames()
    frame = None
    if part.state is not None and part.last is not None:
        steps.restore(part.state)
        index, id = part.last
        frames = source.frames(index)
        frame = next(frames, None)
        if frame is None or (frame.index, frame.id) != (index, id):
            raise file_error(part.path, f"was made of other frames, the last one {id}: remove it to begin anew")
    with Progress(source.count, unit="frames", done=part.frames) as shown:
        for done in steps.predict_all(frames):
            part.append(done, steps.state())
            shown.update(part.frames)
    steps.check_boxes(part.last)


def write_result(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    """Writes lines as the format that the file's name says, whole or not at all.

    Raises InputError where it cannot be written, MissingExtra for Parquet without pyarrow.
    """
    suffix = path.suffix.lower()
    with atomic_path(path) as temporary:
        if suffix == ".jsonl":
            with open(temporary, "w", encoding="utf-8") as file:
                file.writelines(json.dumps(line) + "\n" for line in lines)
        elif suffix == ".csv":
            for number, table in enumerate(_tables(lines)):
                table.to_csv(temporary, index=False, mode="a" if number else "w", header=not number)
        elif suffix == ".parquet":
            _write_parquet(temporary, lines)
        else:
            raise file_error(path, f"expected a name that ends in .{' .'.join(FORMATS)}, got {suffix or 'none'}")


def check_format(path: Path) -> None:
    """Raises MissingExtra where a format cannot be written, before the work."""
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ModuleNotFoundError as error:
            raise missing_extra(error, "writing Parquet", "synth") from None


def _write_parquet(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    import pyarrow
    import pyarrow.parquet

    writer = None
    for table in _tables(lines):
        rows = pyarrow.Table.from_pandas(table, preserve_index=False)
        writer = writer or pyarrow.parquet.ParquetWriter(path, rows.schema)
        writer.write_table(rows)
    if writer is not None:
        writer.close()


def _tables(lines: Iterable[dict[str, Any]]) -> Iterator[Any]:
    """Data frames of a row a frame, person and joint, of some frames at a time; of the same types all, one at least."""
    import pandas

    remaining = iter(lines)
    for first in chain(islice(remaining, 1), [None]):
        # the first table, or an empty one
        some = [] if first is None else [first, *islice(remaining, _ROWS_OF - 1)]
        while some or first is None:
            table = pandas.DataFrame([row for line in some for row in _rows(line)], columns=list(_COLUMNS))
            table["id"] = table["id"].map(lambda id: None if id is None else str(id)).astype("string")
            for name in ("frame_id", "joint"):
                table[name] = table[name].astype("string")
            types = {"frame": "int64", "person": "int64", "track": "Int64", "filled": "bool", "in_range": "boolean"}
            others = set(_COLUMNS) - set(types) - {"id", "frame_id", "joint"}
            yield table.astype(types | dict.fromkeys(others, "float64"))
            some = list(islice(remaining, _ROWS_OF))
            if not some:
                return


def _rows(line: dict[str, Any]) -> Iterator[tuple]:
    joints = line["skeleton"]["joints"]
    for number, person in enumerate(line["people"]):
        if person["joints"] is None:
            continue
        of_person = (number, person["id"], person["track"], person["filled"])
        known = [person[name] or [None] * len(joints) for name in ("confidence", "spread", "visible")]
        for j, name in enumerate(joints):
            values = (*(value[j] for value in known), name not in person["out_of_range"], person["score"])
            yield line["frame"], line["id"], line["time"], *of_person, name, *person["joints"][j], *values


def in_world(line: dict[str, Any], up: str = "z") -> dict[str, Any]:
    """The line with joints and boxes in the world's frame, where the sensor's pose is known. up: of the sensor's."""
    if line["T_world_sensor"] is None:
        return line
    T = np.array(line["T_world_sensor"])
    people = []
    for person in line["people"]:
        moved: dict[str, Any] = {}
        if person["joints"] is not None:
            moved["joints"] = _transformed(T, person["joints"])
        if (box := person["box"]) is not None:
            yaw = moved_yaw(box["yaw"], T, upright(up))
            moved["box"] = box | {"center": _transformed(T, box["center"]), "yaw": yaw}
        people.append(person | moved)
    return line | {"people": people, "coordinates": "world"}


def _transformed(T: np.ndarray, points: Any) -> list:
    return transform_points(T, np.asarray(points)).round(4).tolist()


# ---- steady tracks


def steadied(part: PartFile, steps: FramePredictor) -> Iterator[dict[str, Any]]:
    """The lines with every track made steady, and people added where they were hidden."""
    times: list[float] = []
    to_fixed: list[np.ndarray] = []
    is_damaged: list[bool] = []
    # by track and row of the lines, in the fixed frame
    tracks: dict[int, dict[int, Pose]] = {}
    fixed = FixedFrame(steps.up)
    for row, line in enumerate(part.lines()):
        to_fixed.append(fixed.from_sensor(line["T_world_sensor"]))
        times.append(np.nan if line["time"] is None else line["time"])
        is_damaged.append(line["error"] is not None)
        for person in line["people"]:
            if person["joints"] is not None:
                joints = transform_points(to_fixed[-1], np.array(person["joints"]))
                others: dict[str, Any] = {
                    name: np.array(person[name], np.float32) for name in _SMOOTHED if person[name]
                }
                pose = Pose(joints=joints, skeleton=steps.wanted, **others)
                tracks.setdefault(person["track"], {})[row] = pose
    steady: list[dict[int, tuple[Pose, bool]]] = [{} for _ in times]
    for id in list(tracks):
        for row, pose, is_filled in _steady(tracks.pop(id), np.array(times)):
            if not is_damaged[row]:
                steady[row][id] = pose, is_filled
    for line, people, T_fixed_sensor in zip(part.lines(), steady, to_fixed, strict=True):
        T_sensor_fixed = np.linalg.inv(T_fixed_sensor)
        entries = {id: _entry(pose, T_sensor_fixed) | {"filled": filled} for id, (pose, filled) in people.items()}
        people.clear()
        yield line | {"people": list(_with_steady(line["people"], entries))}


def _steady(poses: dict[int, Pose], times: np.ndarray) -> Iterator[tuple[int, Pose, bool]]:
    """The smoothed poses of a track by row, first to last, and whether each was filled in. times: s, of all rows."""
    rows = np.arange(min(poses), max(poses) + 1)
    # time that stands still or jumps back cannot be smoothed over: such frames stay as they are
    highest = np.maximum.accumulate(np.concatenate([[-np.inf], np.nan_to_num(times[rows], nan=-np.inf)]))[:-1]
    rows = rows[times[rows] > highest]
    skeleton = next(iter(poses.values())).skeleton
    track = smooth(TrackPoses.of_poses(times[rows], [poses.get(row) for row in rows.tolist()], skeleton))
    for i, row in enumerate(rows.tolist()):
        if (pose := track.pose(i)) is not None:
            yield row, pose, row not in poses


def _entry(pose: Pose, T_sensor_fixed: np.ndarray) -> dict[str, Any]:
    """What a line holds of a smoothed pose."""
    known = {name: (getattr(pose, name), digits) for name, digits in _SMOOTHED.items()}
    values = {
        name: value.astype(np.float32).astype(float).round(digits).tolist()
        for name, (value, digits) in known.items()
        if value is not None
    }
    return values | {"joints": _transformed(T_sensor_fixed, pose.joints)}


def _with_steady(people: list[dict[str, Any]], entries: dict[int, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """People of a line, with what is smoothed of them, then those who were hidden."""
    for person in people:
        yield person | entries.pop(person["track"], {})
    for id, entry in sorted(entries.items()):
        nobody: dict[str, Any] = {"id": id, "num_points": 0}
        nobody |= dict.fromkeys(("box", "score", "mounted", "person", "second_person", "joints"))
        empty: dict[str, list] = {"confidence": [], "spread": [], "visible": [], "out_of_range": [], "warnings": []}
        yield nobody | empty | {"track": id} | entry
