"""`lidarpose predict` of one scan, and `lidarpose detect`; folders and recordings are `cli.recordings`."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from lidarpose.cli.terminal import add_command, is_file_name, tell
from lidarpose.errors import InputError, counted, first_names
from lidarpose.models import DEFAULT, NAMES

# io.point_cloud.SUFFIXES, which is not imported just for a help text
_FILES = ".pcd .ply .las .laz .npy .npz .csv .xyz .txt .asc .pts .bin"
# advice if no person was found although there is one
_ADVICE = (
    "if there should be: points need meters and z up (--up), a lower --min-score finds more, and predict --crop "
    "treats all points as one person"
)
# parts of the warnings that state why no person was detected: wrong axes, units, sensor position or background
_CAUSES = ("try --up", "all coordinates by", "the background", "where people are not searched")
# maximum characters of an id in a warning
_LONGEST_ID = 40

_FRAME = """
--sensor-origin X,Y,Z  sensor position, or unknown (default: ORIGIN)
--up AXIS  the file's up axis: z (default), y or x, -y where y points down (cameras), or a direction x,y,z; z or a
 direction, if given, is exact: ground that leans is then a slope and not a tilt of the sensor
--columns N  values per point in a .bin: 4 for KITTI, 5 for nuScenes
"""
_SEARCH = """
--min-score P  score threshold of detections, 0 to 1 (default: the detector's, with which most scans have no false
 positive; 0.5 finds more people, mainly indoors)
--range M  maximum distance from the sensor, m (default 40)
--max-people N  only the N people with the highest scores
--background FILE+  static scene of a fixed sensor, left out of the search: a file of static points, several scans, or
 a folder of scans
"""
_PREDICT = f"""
estimate the poses of the people in a point file, a folder of them or a recording
Detects the people in a scan, unless boxes are given or the file holds one person, and writes STEM.poses.json: the
 joints of each person, in meters and in the file's own frame. For a folder or a recording it writes NAME.poses.jsonl,
 one line per frame; if interrupted, the same command resumes. Existing files of the same name are replaced.
$ lidarpose predict sweep.pcd --picture
$ lidarpose predict sweep.pcd --boxes people.json
$ lidarpose predict person.ply --crop --out person.csv
$ lidarpose predict drive/ --track
$ lidarpose predict street.mcap --every 2 --format parquet
<source> FILE+  {_FILES}; a folder, a pattern, several files, or a recording
[input]
--boxes FILE  people to pose: {{"people": [{{"center": [x,y,z], "size": [l,w,h], "yaw": rad}}]}}, .npy rows, KITTI
 labels
--calib FILE  KITTI's calibration (default: calib/N.txt beside label_2)
--crop  the file holds one person (assumed under 4 m across)
{_FRAME.replace("ORIGIN", "unknown for one person, else 0,0,0")}
[detection, without boxes]
--find  detect people even in a file under 4 m across, as with any of the options below
{_SEARCH}
[output]
--out PATH = .  a folder, or a .json or .csv file (of a recording .jsonl, .csv or .parquet); - prints the JSON
--picture  also draw STEM.poses.png; with --out FILE.json FILE.png
--html  also write STEM.poses.html: people and scan in 3D; a recording is played
--skeleton NAME  smpl24, human15, waymo14, itop14 or body26 (default smpl24, else the network's own)
[network]
--weights NAME|FILE = {DEFAULT}  {NAMES}, a checkpoint, or an exported .onnx
--backend NAME  onnx or torch (default onnx for bundled weights and .onnx, torch for .safetensors and other devices)
--device NAME = cpu  cpu (default), or cuda (backend torch)
--decode NAME = window  how heatmaps are decoded: window (default), argmax or dark
--tta N = 1  test-time augmentation: passes per person, averaged with the centering pass, 1 (default) to 8
"""
_DETECT = f"""
find the people in a point file
Writes STEM.boxes.json: a box for each detected person, highest score first; the score is the probability of a person.
 `lidarpose predict --boxes` reads the file.
$ lidarpose detect sweep.pcd --out people.json
$ lidarpose detect sweep.pcd --min-score 0.6 --background recording/
<file> FILE  {_FILES}
[input]
{_FRAME.replace("ORIGIN", "0,0,0")}
[detection]
{_SEARCH}
[output]
--out PATH = .  a folder, or a .json file (default: the current folder); - prints it
"""


def add(commands) -> None:
    """Adds the commands to the parser's."""
    add_command(commands, "predict", _predict, _PREDICT)
    add_command(commands, "detect", _detect, _DETECT)


def _predict(options: argparse.Namespace) -> None:
    from lidarpose.inference.predict_scan import predict
    from lidarpose.io.atomic import write_all_atomic
    from lidarpose.io.sources.folders import scan_id

    file = Path(options.source[0])
    result, picture, page = output_paths(options, scan_id(file), ("json", "csv"))
    poses = predict(options.source[0], **prediction_options(options), progress=True)
    outputs: dict[Path, bytes] = {}
    if result is not None:
        is_csv = result.suffix.lower() == ".csv"
        outputs[result] = (poses.to_csv() if is_csv else poses.to_json()).encode()
    if picture is not None:
        outputs[picture] = poses.picture(title=file.name)
    if page is not None:
        outputs[page] = poses.html(title=file.name).encode("utf-8", "replace")
    write_all_atomic(outputs)
    if result is None:
        print(poses.to_json(), end="")
    for line in _warnings(poses):
        tell(f"lidarpose: warning: {line}")
    num_posed = sum(person.has_pose for person in poses)
    destination = f" -> {' and '.join(map(str, outputs))}" if outputs else ""
    if not poses:
        tell(_none_found(destination, poses.warnings) if "find" in poses.timing_ms else f"no boxes{destination}")
        return
    search = f"searched in {poses.timing_ms['find'] / 1e3:.1f} s, " if "find" in poses.timing_ms else ""
    people = counted(len(poses), "person", "people")
    tell(f"{num_posed} of {people}, {search}{poses.timing_ms['per_person']:.0f} ms each{destination}")


def output_paths(
    options: argparse.Namespace, name: str, formats: Sequence[str]
) -> tuple[Path | None, Path | None, Path | None]:
    """Where `predict` writes its result, in one of the formats, a picture and a page, None for what it does not write.
    Raises InputError where one cannot be written, or is a file that is read."""
    from lidarpose.io.atomic import check_writable
    from lidarpose.io.files import check_not_input
    from lidarpose.io.point_cloud import SUFFIXES
    from lidarpose.io.sources import matching_paths
    from lidarpose.io.sources.folders import is_result, list_folder

    result = _result_path(options.out, name, "poses", *(f".{suffix}" for suffix in formats))
    base_path = result or Path(f"{name}.poses.json")
    picture = base_path.with_suffix(".png") if options.picture else None
    page = base_path.with_suffix(".html") if options.html else None
    sources: list[str | Path] = []
    for source in options.source:
        # what does not exist is reported when it is read
        with suppress(InputError):
            sources += matching_paths(source)
    # for a folder, its point files are inputs, but not the results that an earlier command wrote there
    files = [file for path in sources if os.path.isdir(path) for file in list_folder(Path(path))]
    files = [file for file in files if file.suffix.lower() in SUFFIXES and not is_result(file)]
    inputs = (options.boxes, options.calib, options.weights, *(options.background or ()))
    for path in filter(None, (result, picture, page)):
        check_not_input(path, *sources, *files, *inputs)
        # checked before the work
        check_writable(path)
    return result, picture, page


def prediction_options(options: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `lidarpose.predict`; the network is loaded once the input has proved readable."""
    from lidarpose.inference.predictor import check_settings, load
    from lidarpose.skeleton import as_skeleton

    choices = {name: getattr(options, name) for name in ("backend", "device", "decode", "tta")}
    check_settings(options.weights, backend=options.backend, decode=options.decode, tta=options.tta)
    if options.skeleton is not None:
        as_skeleton(options.skeleton)
    scan_options = {name: getattr(options, name) for name in ("boxes", "calib", "crop", "skeleton")}
    # without --find, the input decides
    scan_options["find"] = options.find or None
    return scan_options | _reading(options) | {"model": partial(load, options.weights, **choices)}


def _detect(options: argparse.Namespace) -> None:
    from lidarpose.inference.single_scan import detect
    from lidarpose.io.atomic import check_writable
    from lidarpose.io.files import check_not_input
    from lidarpose.io.sources.folders import scan_id

    result = _result_path(options.out, scan_id(Path(options.file)), "boxes", ".json")
    if result is not None:
        check_not_input(result, options.file, *(options.background or ()))
        check_writable(result)
    boxes = detect(options.file, **_reading(options))
    if result is None:
        print(boxes.to_json(), end="")
    else:
        boxes.save(result)
    for line in boxes.warnings:
        tell(f"lidarpose: warning: {line}")
    destination = f" -> {result}" if result else ""
    summary = f"{counted(len(boxes), 'person', 'people')} found{destination}"
    tell(summary if boxes else _none_found(destination, boxes.warnings))


def _none_found(destination: str, warnings: Sequence[str]) -> str:
    """The line for a scan without people, with advice unless a warning states the likely cause."""
    is_explained = any(cause in warning for cause in _CAUSES for warning in warnings)
    return f"no people found{destination}" + ("" if is_explained else f"; {_ADVICE}")


def _reading(options: argparse.Namespace) -> dict[str, Any]:
    """How a scan is read and searched, for `predict` and `detect` alike."""
    names = ("sensor_origin", "up", "columns", "min_score", "max_people")
    background = options.background
    # a single path is a file of static points or a folder; several paths are scans
    background = background[0] if background and len(background) == 1 else background
    reading = {name: getattr(options, name) for name in names}
    if options.up is None:
        del reading["up"]
    return reading | {"max_range": options.range, "background": background}


def _result_path(out: str, name: str, what: str, *suffixes: str) -> Path | None:
    """The file to write, with one of the suffixes, in a folder the first; None for the standard output. Raises
    InputError for a file of another type."""
    if out == "-":
        if sys.stdout is None:
            raise InputError("--out - prints to the standard output, which is closed: give a file")
        return None
    if is_file_name(out):
        suffix = Path(out).suffix.lower()
        if suffix in suffixes:
            return Path(out)
        files = " or ".join(suffixes)
        raise InputError(f"--out {out}: expected a folder or a file {files}, got {suffix}: give one")
    return Path(out) / f"{name}.{what}{suffixes[0]}"


def _warnings(poses) -> list[str]:
    """The input's warnings, and each of the people's once with the ids of those it is about."""
    from lidarpose.io.files import shorten

    ids_by_warning: dict[str, list[str]] = {}
    for person in poses:
        for warning in person.warnings:
            ids_by_warning.setdefault(warning, []).append(shorten(str(person.id), _LONGEST_ID))
    lines = list(poses.warnings)
    for warning, ids in ids_by_warning.items():
        lines.append(f"{'person' if len(ids) == 1 else 'people'} {first_names(ids)}: {warning}")
    return lines
