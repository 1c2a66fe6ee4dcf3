"""Incremental output for recordings, which can be resumed after the process was killed.

While frames are processed, RESULT.part holds one finished line per frame, and RESULT.part.json beside it the options
and the state needed to resume. At the end, the lines are written to the result as a whole.
"""

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

from lidarpose.errors import InputError, counted
from lidarpose.io.atomic import check_writable, write_error
from lidarpose.io.files import file_error
from lidarpose.io.sources import DamagedFrame, Frame, FrameSource
from lidarpose.progress import Progress
from lidarpose.recording.coordinates import in_world
from lidarpose.recording.predict_recording import FramePoses, FramePredictor
from lidarpose.recording.result_files import check_format, write_result
from lidarpose.recording.steady_tracks import smoothed_lines

try:
    import fcntl
except ImportError:
    # not available on Windows
    fcntl = None  # type: ignore[assignment]


class PartFile:
    """The finished lines of an incomplete result.

    Args:
        result: the final file; `.part` and `.part.json` are appended to its name.
        command: all options that the lines depend on, as JSON values; lines of another command are not resumed.
    """

    def __init__(self, result: Path, command: dict[str, Any]):
        self.path = result.with_name(result.name + ".part")
        self.state_path = result.with_name(result.name + ".part.json")
        self.command = json.loads(json.dumps(command))
        # from an existing part: number of finished frames; index, id and digest of the last one; state of the
        # predictor; names of the options that differ if it belongs to another command
        self.frames = 0
        self.last: tuple[int, str, int] | None = None
        self.state: dict[str, Any] | None = None
        self.other: list[str] = []
        check_writable(self.path)
        parent = self.path.parent
        self._new_folders = [folder for folder in (parent, *parent.parents) if not folder.exists()]
        parent.mkdir(parents=True, exist_ok=True)
        # do not truncate or read the file before it is locked by this process
        self._file = os.fdopen(os.open(self.path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666), "r+b")
        if not _is_locked(self._file):
            self._file.close()
            raise file_error(
                self.path, "another lidarpose process is writing it: wait for its end, or choose another --out"
            )
        # an existing part is kept until there is a line to write, so that a wrong command destroys nothing
        self._size: int | None = self._read()

    def _read(self) -> int:
        """Number of bytes of the part that hold finished lines of this command."""
        try:
            content = json.loads(self.state_path.read_bytes())
            command, size, frames, state = (content[name] for name in ("command", "bytes", "frames", "state"))
            index, id, digest = content["last"]
            # after a power failure, the state may refer to lines that were not written
            is_whole = self._last_line(size) == (frames, index, id)
            if not (is_whole and isinstance(command, dict) and isinstance(state, dict)):
                return 0
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            return 0
        if command != self.command:
            names = [*self.command, *command]
            self.other = sorted({name for name in names if command.get(name) != self.command.get(name)})
            return 0
        self.frames, self.last, self.state = frames, (index, id, digest), state
        return size

    def _last_line(self, size: int) -> tuple[int, int, str]:
        """Number of lines in the first `size` bytes, and frame and id of the last line. Raises ValueError if the bytes
        are not whole lines of JSON."""
        count, length, text = 0, 0, b""
        with open(self.path, "rb") as file:
            while length < size and (text := file.readline()):
                line = json.loads(text)
                count, length = count + 1, length + len(text)
        if not count or length != size or not text.endswith(b"\n"):
            raise ValueError
        return count, line["frame"], line["id"]

    def __enter__(self) -> "PartFile":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not self._file.closed and not os.fstat(self._file.fileno()).st_size:
            self.remove()
        self._file.close()

    def _cut(self) -> None:
        """Truncates the file to the finished lines of this command."""
        if self._size is not None:
            self._file.truncate(self._size)
            self._file.seek(self._size)
            self._size = None

    def append(self, frame: FramePoses, state: dict[str, Any], digest: int) -> None:
        """Appends a finished frame. digest: of its points. If the process is killed during the call, the frame is lost:
        lines without a state are truncated on resume."""
        self.frames, self.last, self.state = self.frames + 1, (frame.index, frame.id, digest), state
        temporary = self.state_path.with_name(self.state_path.name + ".new")
        try:
            self._cut()
            self._file.write(json.dumps(frame.to_dict()).encode() + b"\n")
            self._file.flush()
            content = {
                "command": self.command,
                "bytes": self._file.tell(),
                "frames": self.frames,
                "last": self.last,
                "state": state,
            }
            temporary.write_text(json.dumps(content))
            os.replace(temporary, self.state_path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            raise write_error(self.path, self.path.parent, error) from None

    def lines(self) -> Iterator[dict[str, Any]]:
        """Reads the finished lines."""
        self._cut()
        with open(self.path, "rb") as file:
            yield from map(json.loads, file)

    def remove(self) -> None:
        """Removes the part, and the folders that were created for it if they are empty."""
        # remove it while it is locked: once it is closed, another process may open it
        for path in (self.state_path, self.path):
            with suppress(OSError):
                path.unlink()
        self._file.close()
        if fcntl is None:
            # Windows cannot remove open files
            with suppress(OSError):
                self.path.unlink()
        for folder in self._new_folders:
            with suppress(OSError):
                folder.rmdir()


def _is_locked(file: BinaryIO) -> bool:
    """Locks a file until it is closed. Returns whether this process holds the lock; True as well if the system or disk
    does not support locks."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    # the previous holder of the lock may have removed the file in the meantime
    return os.fstat(file.fileno()).st_nlink > 0


@dataclass
class Summary:
    """Statistics of a recording's result.

    frames, poses, damaged, in_world: counts; damaged and in_world count frames, the latter those in the world frame;
    tracks: ids; first_error: message of the first damaged frame; warnings: an example of each kind of warning of frames
    and people; warned: number of frames with each kind. Warnings that differ only in numbers are of one kind.
    """

    frames: int = 0
    poses: int = 0
    damaged: int = 0
    in_world: int = 0
    tracks: set[int] = field(default_factory=set)
    first_error: str | None = None
    warnings: dict[str, str] = field(default_factory=dict)
    warned: Counter[str] = field(default_factory=Counter)

    def add(self, line: dict[str, Any]) -> None:
        self.frames += 1
        self.in_world += line.get("coordinates") == "world"
        posed = [person for person in line["people"] if person["joints"] is not None]
        self.poses += len(posed)
        self.tracks.update(person["track"] for person in posed if person["track"] is not None)
        if line["error"] is not None:
            self.damaged += 1
            name = f" ({line['id']})" if line["id"] else ""
            self.first_error = self.first_error or f"frame {line['frame']}{name}: {line['error']}"
        kinds = {}
        for text in (text for person in (line, *line["people"]) for text in person["warnings"]):
            kinds[re.sub(r"(-?[\d.,]+)+", "0", text)] = text
        self.warnings = kinds | self.warnings
        self.warned.update(kinds.keys())

    def warning_lines(self, most: int) -> list[str]:
        """At most `most` messages for the user, starting with damaged frames."""
        lines = [] if self.first_error is None else [f"{self.damaged:,} damaged, first {self.first_error}"]
        for kind, count in self.warned.most_common(most - 1):
            lines.append(f"{counted(count, 'frame')}: {self.warnings[kind]}")
        return lines

    def text(self, is_tracked: bool) -> str:
        """The counts as text."""
        parts = [counted(self.frames, "frame"), counted(self.poses, "pose")]
        parts += [counted(len(self.tracks), "track")] if is_tracked else []
        return ", ".join(parts + ([f"{self.damaged:,} damaged"] if self.damaged else []))


def write_recording(
    source: FrameSource,
    predictor: FramePredictor,
    result: Path,
    *,
    command: dict[str, Any],
    world: bool = False,
    on_line: Callable[[dict[str, Any]], None] | None = None,
    tell: Callable[[str], None] = print,
) -> Summary:
    """Poses all frames of a source and writes the result, resuming if the same command was interrupted.

    Args:
        source: the frames.
        predictor: poses the frames.
        result: path NAME.jsonl, .csv or .parquet.
        command: see `PartFile`.
        world: whether to write joints and boxes in the world frame if the sensor poses are known.
        on_line: called with each final line.
        tell: called with a message if finished lines are found.

    Returns:
        Statistics of the result.

    Raises:
        InputError: the result cannot be written, no frame can be read, or the finished lines belong to other frames.
        MissingExtra: Parquet output without pyarrow.
    """
    check_format(result)
    check_writable(result)
    summary = Summary()
    with PartFile(result, command) as part:
        if part.other:
            tell(f"{part.path} is from another command ({', '.join(part.other)}): starting over")
        elif part.frames:
            tell(f"{part.frames:,} frames are in {part.path}: resuming")
        try:
            _add_frames(source, predictor, part)
            if not part.frames:
                # before the lines of another command are cut
                raise nothing_read(source.name, 0, None)
            if not any(line["error"] is None for line in part.lines()):
                error = next((line["error"] for line in part.lines()), None)
                part.remove()
                raise nothing_read(source.name, part.frames, error)
            is_smoothed = predictor.is_tracked and not predictor.live
            lines = part.lines()
            if is_smoothed:
                are_boxes_given = predictor.boxes is not None
                lines = smoothed_lines(part.lines, predictor.up, predictor.wanted, are_boxes_given=are_boxes_given)

            def final() -> Iterator[dict[str, Any]]:
                for line in lines:
                    line = in_world(line, predictor.up) if world else line
                    summary.add(line)
                    if on_line is not None:
                        on_line(line)
                    yield line

            write_result(result, final())
        except KeyboardInterrupt:
            place = f"the finished frames are in {part.path}, and the same command resumes"
            raise KeyboardInterrupt(f"stopped: {place}" if part.frames else "stopped") from None
        part.remove()
    return summary


def nothing_read(name: str, frames: int, first_error: str | None) -> InputError:
    """The error for a recording without readable frames. frames: number of frames."""
    if not frames:
        return file_error(name, "has no frames between start and end: choose another start or end")
    return file_error(name, f"none of {counted(frames, 'frame')} can be read, the first: {first_error}")


def _add_frames(source: FrameSource, predictor: FramePredictor, part: PartFile) -> None:
    """Poses the frames that are not yet in the part."""
    frames = source.frames()
    if part.state is not None and part.last is not None:
        predictor.restore(part.state)
        index, id, digest = part.last
        frames = source.frames(index)
        frame = next(frames, None)
        if frame is None or (frame.index, frame.id, _digest(frame)) != (index, id, digest):
            raise file_error(part.path, f"was made from other frames, the last one {id}: remove it to start over")
    digests: dict[int, int] = {}

    def noted_frames() -> Iterator[Frame | DamagedFrame]:
        for frame in frames:
            digests[frame.index] = _digest(frame)
            yield frame

    with Progress(source.count, unit="frames", done=part.frames) as bar:
        for frame_poses in predictor.predict_all(noted_frames()):
            part.append(frame_poses, predictor.state(), digests.pop(frame_poses.index))
            bar.update(part.frames)
    predictor.check_boxes(part.last and part.last[:2])


def _digest(frame: Frame | DamagedFrame) -> int:
    """A checksum of a frame's points, to recognize the frame on resume; 0 for a damaged frame."""
    return crc32(frame.points.tobytes()) if isinstance(frame, Frame) else 0
