"""Whole scans with labeled people: the frozen list of synthetic scenes, and folders of real scans."""

import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.dataset import evenly_drawn
from lidarpose.inference.inputs import as_origin, only_returns
from lidarpose.inference.scan import rows_inside
from lidarpose.io.boxes import read_boxes
from lidarpose.io.files import file_error, read_json, shorten
from lidarpose.io.point_cloud import SUFFIXES, read_points
from lidarpose.sample import Box

HELDOUT = "heldout"
_HELDOUT_FILE = "detector-heldout-1.json"
# edges of the groups of sensors by height above the ground, m, and by tilt, degrees
_HEIGHTS, _TILTS = (1.0, 2.2), (3.0, 10.0)
# categories of nuScenes, Argoverse 2, Waymo and KITTI: people on foot, mounted people, and things that resemble people
_ON_FOOT = set(
    "pedestrian person people human adult child construction_worker police_officer personal_mobility official_signaler "
    "person_sitting".split()
)
_MOUNTED = set("bicyclist cyclist motorcyclist wheeled_rider rider wheelchair mounted".split())
_LIKE_PEOPLE = set("stroller bicycle motorcycle bicycle_rack wheeled_device animal dog mannequin".split())


@dataclass(frozen=True, kw_only=True, eq=False)
class LabeledScan:
    """A scan with P labeled people, z up.

    points (n, 3) m; origin: the sensor's position (3,) m, None if unknown; boxes: P; num_points (P,): number of points
    on each person; is_person (P,) bool: False where the label is not a person; mounted (P,) bool: riders and people in
    wheelchairs; activities: P names; sensor, kind of scene, the sensor's height above the ground and its tilt, in
    words: "" if unknown; thing (n,): the kind of thing that each point lies on, an index of `things`, or -1;
    person (n,): an index of `boxes`, or -1; joints (P, 26, 3) m, body26; changed: the scan differs from the one that
    was frozen.
    """

    name: str
    points: np.ndarray
    origin: np.ndarray | None
    boxes: Sequence[Box]
    num_points: np.ndarray
    is_person: np.ndarray
    mounted: np.ndarray
    activities: Sequence[str] | None = None
    sensor: str = ""
    kind: str = ""
    height: str = ""
    tilt: str = ""
    thing: np.ndarray | None = None
    things: Sequence[str] = ()
    person: np.ndarray | None = None
    joints: np.ndarray | None = None
    changed: bool = False


@dataclass(frozen=True, kw_only=True)
class ScanSet:
    """Scans that are generated or read on demand."""

    name: str
    loaders: Sequence[Callable[[], LabeledScan]]


def heldout_scans(limit: int | None = None) -> ScanSet:
    """The frozen scenes; some of their kinds of things and rooms are not in any detector's training data."""
    content = json.loads((resources.files("lidarpose.eval") / "assets" / _HELDOUT_FILE).read_text("utf-8"))
    rows = evenly_drawn(len(content["indices"]), limit)
    scenes = [(content["seed"], content["indices"][k], content["family"], content["sha256"][k]) for k in rows]
    return ScanSet(name=HELDOUT, loaders=[partial(synthetic_scan, *scene) for scene in scenes])


def synthetic_scan(seed: int, index: int, family: str = HELDOUT, digest: str | None = None) -> LabeledScan:
    """A scene of `synth.detection_scene` as a labeled scan. digest: of its points when it was frozen."""
    from lidarpose.synth.detection_scene import detection_scene

    scene = detection_scene(seed, index, family=family)
    people = len(scene.boxes)
    field_names = "points origin boxes mounted activities sensor kind thing things person joints".split()
    return LabeledScan(
        name=f"{family} {index}",
        num_points=np.bincount(scene.person[scene.person >= 0], minlength=people),
        is_person=np.ones(people, bool),
        changed=digest not in (None, scene.points_digest()),
        height=_in_words(scene.height, _HEIGHTS, "m"),
        tilt=_in_words(np.degrees(np.arccos(min(scene.up[2], 1.0))), _TILTS, "degrees"),
        **{name: getattr(scene, name) for name in field_names},
    )


def _in_words(value: float, edges: tuple[float, float], unit: str) -> str:
    """The interval of the two edges that a value lies in."""
    low, high = edges
    if value < low:
        return f"under {low:g} {unit}"
    return f"{low:g} to {high:g} {unit}" if value < high else f"{high:g} {unit} and more"


def labeled_scans(folder: str | os.PathLike, limit: int | None = None) -> ScanSet:
    """The scans of a folder: SCAN.json with people next to SCAN.pcd, .bin, .ply, .npy or another format.

    SCAN.json holds the boxes that `read_boxes` reads. Each of its "people" may also have:

    - `category`, "PEDESTRIAN" by default. Riders and people in wheelchairs are mounted, as are all boxes with
      `mounted`. Strollers, riderless two-wheelers, animals and mannequins are labels that are not people. Labels of
      other categories are dropped.
    - `num_points`; by default the points in the box are counted.

    Next to "people", SCAN.json may have `sensor`, `kind` of scene and `sensor_origin` (0, 0, 0 by default). Points and
    boxes are z up; a scan that states another `up` is refused when it is read.

    Raises:
        InputError: the folder has no labels, or a label file has no scan.
    """
    folder = Path(folder)
    # boxes and poses that `detect` and `predict` wrote there are not labels
    labels = [path for path in sorted(folder.glob("*.json")) if not path.name.endswith((".boxes.json", ".poses.json"))]
    clouds = [next((p for s in SUFFIXES if (p := path.with_suffix(s)).is_file()), None) for path in labels]
    if not labels:
        raise file_error(folder, "expected labeled scans, SCAN.json of people beside SCAN.pcd or another, got no .json")
    for path, cloud in zip(labels, clouds, strict=True):
        if cloud is None:
            raise file_error(path, f"expected its scan beside it, {path.stem} with {' '.join(SUFFIXES)}, got none")
    pairs = list(zip(labels, clouds, strict=True))
    rows = evenly_drawn(len(pairs), limit).tolist()
    return ScanSet(name=folder.resolve().name, loaders=[partial(_read_scan, *pairs[k]) for k in rows])


def _read_scan(labels: Path, cloud: Path) -> LabeledScan:
    labeled_boxes = read_boxes(labels)
    content = read_json(labels, expected="labels of people")
    document: dict[str, Any] = content if isinstance(content, dict) else {"people": content}
    for up in (labeled_boxes.up, document.get("up")):
        if up not in (None, "z"):
            problem = f"expected points and boxes with z up, got up {shorten(repr(up))}: turn both until z points up"
            raise file_error(labels, problem)
    boxes, people, kinds = [], [], []
    for box, entry in zip(labeled_boxes, document["people"], strict=True):
        entry = entry if isinstance(entry, dict) else {}
        kind = _kind(_text(entry, "category", labels) or "pedestrian")
        if box.mounted or kind in _ON_FOOT | _MOUNTED | _LIKE_PEOPLE:
            boxes.append(box)
            people.append(entry)
            kinds.append(kind)
    is_mounted = np.array([kind in _MOUNTED or bool(box.mounted) for kind, box in zip(kinds, boxes, strict=True)], bool)
    is_on_foot = np.array([kind in _ON_FOOT for kind in kinds], bool)
    points = only_returns(read_points(cloud).points)[0]
    point_counts = [len(rows) for rows in rows_inside(boxes, points)]
    try:
        given_counts = [entry.get("num_points") for entry in people]
        counts = [b if a is None else int(a) for a, b in zip(given_counts, point_counts, strict=True)]
        num_points = np.array(counts, np.int64)
        if (num_points < 0).any():
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        problem = "expected whole numbers of at least 0 as num_points of people: correct or drop them"
        raise file_error(labels, problem) from None
    try:
        origin = as_origin(document.get("sensor_origin", (0.0, 0.0, 0.0)))
    except InputError as error:
        raise file_error(labels, error) from None
    return LabeledScan(
        name=labels.stem,
        points=points,
        origin=origin,
        boxes=boxes,
        num_points=num_points,
        is_person=is_on_foot | is_mounted,
        mounted=is_mounted,
        sensor=_text(document, "sensor", labels),
        kind=_text(document, "kind", labels),
    )


def _text(entry: dict[str, Any], name: str, labels: Path) -> str:
    """An optional text of a label file, "" if it is absent or null. Raises InputError if it is not text."""
    value = entry.get(name)
    if not isinstance(value, str | None):
        raise file_error(labels, f"expected text as {name}, got {shorten(repr(value))}")
    return value or ""


def _kind(category: str) -> str:
    """The last part of a label's name: adult for human.pedestrian.adult, cyclist for TYPE_CYCLIST, person_sitting for
    "Person sitting"."""
    return re.sub(r"[\s-]+", "_", category.lower().rpartition(".")[2].strip()).removeprefix("type_")
