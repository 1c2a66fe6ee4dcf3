"""`lidarpose predict` of folders and recordings: many frames, a line each."""

import argparse
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lidarpose._version import __version__
from lidarpose.cli.predicting import output_paths, prediction_options
from lidarpose.cli.terminal import add_options, option_names, tell
from lidarpose.errors import InputError, counted

_FRAMES = """
[folders and recordings]
--track  track people over time and smooth their poses
--live  track causally: smooth with past frames only, as frames arrive
--world  joints in the world frame, if sensor poses are known
--topic NAME  point cloud topic of a bag
--meta FILE  an Ouster sensor's JSON file (default: the recording's name beside it)
--rate HZ  frames per second if timestamps are missing (default 10)
--start S  first time to process, seconds after the first frame
--end S  last time to process, seconds after the first frame
--every N  process every N-th frame
--format {jsonl,csv,parquet}  format of NAME.poses.FORMAT (default jsonl)
"""
# maximum number of printed lines for the warnings of frames
_MOST_WARNINGS = 8


def add(commands) -> None:
    """Lets the parser's `predict` take folders and recordings too."""
    parser = commands.choices["predict"]
    add_options(parser, _FRAMES)
    parser.set_defaults(run=partial(_predict, parser.get_default("run")))


def _predict(predict_scan: Callable[[argparse.Namespace], None], options: argparse.Namespace) -> None:
    if not _is_recording(options):
        predict_scan(options)
        return
    from lidarpose.recording.result_files import FORMATS

    formats = (options.format,) if options.format else FORMATS
    outputs = output_paths(options, _name_of(options.source), formats)
    _predict_recording(options, *outputs, prediction_options(options))


def _is_recording(options: argparse.Namespace) -> bool:
    """Whether the command is about many frames rather than one plain file."""
    from lidarpose.io.sources import is_single_scan

    if any(
        value is not None and value is not False for value in (getattr(options, name) for name in option_names(_FRAMES))
    ):
        return True
    return not is_single_scan(options.source)


def _name_of(paths: Sequence[str]) -> str:
    """What results are named after: the file's or folder's stem, of several files their folder's."""
    from lidarpose.io.files import common_folder
    from lidarpose.io.sources.folders import scan_id

    path = paths[0] if len(paths) == 1 else common_folder(paths)
    if path is None:
        return "recording"
    if any(letter in path for letter in "*?[") and not os.path.exists(path):
        path = os.path.dirname(path.split("**")[0]) or "."
    path = os.path.realpath(path)
    name = os.path.basename(path)
    return (name if os.path.isdir(path) else scan_id(Path(name))) or "recording"


def _predict_recording(
    options: argparse.Namespace,
    result: Path | None,
    picture: Path | None,
    page: Path | None,
    posing_options: dict[str, Any],
) -> None:
    """Poses all frames, and says what came of it. posing_options: as of `FramePredictor`."""
    from lidarpose.io.atomic import write_atomic
    from lidarpose.io.sources import open_source
    from lidarpose.recording.output import write_recording
    from lidarpose.recording.page import RecordingPage
    from lidarpose.recording.picture import TrajectoryPicture
    from lidarpose.recording.predict_recording import FramePredictor

    if len(options.source) > 1 and any(map(os.path.isdir, options.source)):
        raise InputError(f"expected one folder, or files, got {len(options.source)}: run the command for each folder")
    frames = {name: getattr(options, name) for name in ("columns", "topic", "meta", "rate", "start", "end")}
    source = open_source(options.source, every=1 if options.every is None else options.every, **frames)
    predictor = FramePredictor(
        name=source.name,
        topic=options.topic,
        meta=options.meta,
        track=options.track,
        live=options.live,
        **posing_options,
    )
    tracks_picture = None if picture is None else TrajectoryPicture()
    frames_page = None if page is None else RecordingPage()
    views = [view for view in (tracks_picture, frames_page) if view is not None]

    def on_line(line: dict[str, Any]) -> None:
        for view in views:
            view.add(line)

    if result is None:
        summary = _print_lines(options, source, predictor, on_line)
    else:
        summary = write_recording(
            source,
            predictor,
            result,
            command=_command(options, [path.name for path in (result, picture, page) if path is not None]),
            world=options.world,
            on_line=on_line,
            tell=lambda text: tell(f"lidarpose: {text}"),
        )
    # read before the pictures below read single frames, which resets the counts in these warnings
    source_warnings = [f"{source.name}: {line}" for line in source.warnings]
    if tracks_picture is not None and picture is not None:
        write_atomic(picture, tracks_picture.draw(source, title=Path(source.name).name))
    if frames_page is not None and page is not None:
        write_atomic(page, frames_page.render(source, predictor.wanted, title=Path(source.name).name))
    outputs = [str(path) for path in (result, picture, page) if path is not None]
    _report(options, source_warnings, summary, f" -> {' and '.join(outputs)}" if outputs else "")


def _print_lines(options: argparse.Namespace, source, predictor, on_line: Callable[[dict[str, Any]], None]):
    """Frames as they come, on the standard output. Returns their `Summary`."""
    from lidarpose.recording.coordinates import in_world
    from lidarpose.recording.output import Summary, nothing_read

    if predictor.is_tracked and not predictor.live:
        raise InputError("--out - prints frames as they come: use --live, which needs no later frames, or give a file")
    if options.format not in (None, "jsonl"):
        raise InputError(f"--out - prints lines of JSON, not {options.format}: give a file")
    summary = Summary()
    for frame in predictor.predict_all(source.frames()):
        line = frame.to_dict()
        line = in_world(line, predictor.up) if options.world else line
        summary.add(line)
        on_line(line)
        print(json.dumps(line), flush=True)
    if summary.damaged == summary.frames:
        raise nothing_read(source.name, summary.frames, summary.first_error)
    return summary


def _report(options: argparse.Namespace, source_warnings: list[str], summary, outputs: str) -> None:
    if options.world and (num_others := summary.frames - summary.in_world):
        source_warnings.append(
            f"the sensor's pose in the world is unknown in {num_others:,} of {counted(summary.frames, 'frame')}: "
            "their joints are in the sensor's frame"
        )
    for line in [*source_warnings, *summary.warning_lines(_MOST_WARNINGS)]:
        tell(f"lidarpose: warning: {line}")
    tell(summary.text(options.track or options.live) + outputs)


def _command(options: argparse.Namespace, outputs: Sequence[str]) -> dict[str, Any]:
    """All that the poses of frames depend on. outputs: names of the files that the command writes."""
    ignored_names = ("run", "command", "quiet", "out", "format", "picture", "html", "world", "source")
    command = {name: value for name, value in vars(options).items() if name not in ignored_names}
    command["every"] = options.every or 1
    files = [options.weights, options.boxes, options.calib, options.meta, *(options.background or ())]
    changed = {path: _changed(Path(path), outputs) for path in files if path and os.path.exists(path)}
    sources = [os.path.abspath(path) for path in options.source]
    return command | {"source": sources, "files changed": changed, "version": __version__}


def _changed(path: Path, outputs: Sequence[str]) -> str:
    """When a file was changed last, ns; for a folder, a digest of that of its files. Files whose names begin as
    `outputs` do, such as the unfinished result, are left out: the command itself changes them."""
    if not path.is_dir():
        return str(path.stat().st_mtime_ns)
    # neither folders, in which the result may be, nor broken links
    files = sorted(file for file in path.iterdir() if file.is_file() and not file.name.startswith((".", *outputs)))
    return hashlib.sha256(repr([(file.name, file.stat().st_mtime_ns) for file in files]).encode()).hexdigest()
