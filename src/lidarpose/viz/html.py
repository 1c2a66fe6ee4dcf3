"""One HTML file with a table of numbers and interactive 3D views of people. It loads nothing from the network."""

import json
import math
from collections.abc import Sequence
from html import escape
from importlib import resources
from numbers import Integral

import numpy as np

from lidarpose._version import __version__
from lidarpose.arrays import evenly_spaced
from lidarpose.errors import is_number
from lidarpose.sample import Pose, within_reach
from lidarpose.skeleton import SMPL24, Skeleton
from lidarpose.viz.bird_eye import ScanPanel
from lidarpose.viz.person_view import (
    Panel,
    bone_sides,
    confidences,
    describe,
    facing_of,
    is_known,
    middle,
    missing_pose,
    side,
)

MAX_POINTS = 60_000  # of all people together; about 0.9 MB of text
_FEWEST_POINTS = 150  # minimum limit per person, for any number of people
# approximate number of boxes near which points are preferred, if only the frames over time have boxes
_FEW_BOXES = 100
# points of all scans together; minimum limit per scan, half of it for points within this distance of its people, m; and
# extent of a scan around all its people, m
_SCAN_POINTS, _FEWEST_SCAN_POINTS, _NEAR, _SCAN_REACH = 40_000, 15_000, 1.0, 15.0


def render_report(people: list[Panel], *, title: str, summary: list[dict], scans: Sequence[ScanPanel] = ()) -> str:
    """The text of an HTML page; deterministic.

    Args:
        people: one 3D view each; more than 60,000 points in total are thinned evenly.
        title: printed at the top.
        summary: rows of the table at the top. Its columns are the rows' keys in order of appearance; columns of numbers
            are right-aligned.
        scans: whole scans with all their people, shown first.
    """
    people = list(people)
    skeletons = {pose.skeleton.name: pose.skeleton for p in people for pose in (p.pose, p.truth) if pose is not None}
    panels = [panel for scan in scans for panel in (scan, *scan.frames)]
    skeletons |= {panel.poses.skeleton.name: panel.poses.skeleton for panel in panels if panel.poses is not None}
    limit = max(_FEWEST_POINTS, MAX_POINTS // max(len(people), 1))
    people_data = [_person_data(p, limit) for p in people]
    scans_data = [_scan_data(scan, max(_FEWEST_SCAN_POINTS, _SCAN_POINTS // len(scans))) for scan in scans]
    data = {
        "skeletons": {name: _skeleton_data(s) for name, s in skeletons.items()},
        "people": people_data,
        "scans": scans_data,
    }
    # inside a script element, only "<" could end the element early
    json_text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    cards = [
        _scan_card(f"scan{i}", scan, len(d["points"]) // 3)
        for i, (scan, d) in enumerate(zip(scans, scans_data, strict=True))
    ]
    cards += [_card(i, p, len(d["points"]) // 3) for i, (p, d) in enumerate(zip(people, people_data, strict=True))]
    fields = {
        "TITLE": escape(title),
        "VERSION": escape(__version__),
        "STYLE": _asset("report.css"),
        "SCRIPT": _asset("report.js"),
        "SUMMARY": _table(summary),
        "CARDS": "\n".join(cards) or '<p class="none">no people</p>',
        "DATA": json_text,
    }
    # only the template is split, so that the caller's texts that look like a field are not replaced
    pieces = _asset("report.html").split("%%")
    return "".join(fields[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def _asset(name: str) -> str:
    return (resources.files("lidarpose.viz") / "assets" / name).read_text(encoding="utf-8").rstrip("\n")


def _skeleton_data(skeleton: Skeleton) -> dict:
    """Names and sides of the joints, and bones as [parent, child, side]."""
    bones = [[a, b, s[0]] for (a, b), s in zip(skeleton.bones, bone_sides(skeleton), strict=True)]
    return {"joints": skeleton.joints, "sides": "".join(side(j)[0] for j in skeleton.joints), "bones": bones}


def _person_data(person: Panel, limit: int) -> dict:
    """A person's data; coordinates are integer millimeters relative to the middle, about 14 characters per point."""
    center = middle(person)
    center = np.zeros(3) if center is None else center
    rows = np.flatnonzero(within_reach(person.points))
    rows = rows[evenly_spaced(len(rows), limit)]
    forward = facing_of(person)
    data: dict[str, object] = {
        "points": _millimeters(person.points[rows], center),
        "spins": True,
        "facing": None if forward is None else round(math.atan2(forward[1], forward[0]), 4),
        "pose": _pose_data(person.pose, center),
        "truth": _pose_data(person.truth, center),
    }
    if person.part is not None:
        data["sides"] = "".join(_PART_SIDES[np.clip(person.part[rows], 0, len(SMPL24))])
    return data


def _scan_data(scan: ScanPanel, limit: int) -> dict:
    """Like `_person_data`, but with all people's poses, relative to their median, and with at most `limit` points."""
    points = scan.points[within_reach(scan.points)]
    boxes = [box for panel in (scan, *scan.frames) for box in panel.boxes]
    centers = np.array([box.center for box in boxes])
    if len(centers):
        low, high = centers.min(0) - _SCAN_REACH, centers.max(0) + _SCAN_REACH
        points = points[((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all(1)]
    is_near = np.zeros(len(points), bool)
    for box in scan.boxes or boxes[:: max(len(boxes) // _FEW_BOXES, 1)]:
        is_near |= box.contains(points, margin=_NEAR)
    rows = [np.flatnonzero(is_near), np.flatnonzero(~is_near)]
    rows = [group[evenly_spaced(len(group), limit // 2)] for group in rows]
    points = points[np.sort(np.concatenate(rows))]
    if not len(centers):
        centers = points if len(points) else np.zeros((1, 3))
    center = np.median(centers, axis=0)
    entry = {"facing": None, "pose": None, "truth": None, "labeled": scan.labeled}
    frames = [_frame_data(panel, panel.points, center) | {"label": panel.label} for panel in scan.frames]
    entry |= _frame_data(scan, points, center) | ({"frames": frames, "step": scan.step} if frames else {})
    has_poses = any(one["poses"] for one in (entry, *frames))
    return entry | {"predicted": has_poses and not scan.labeled}


def _frame_data(panel: ScanPanel, points: np.ndarray, center: np.ndarray) -> dict:
    """Points and the poses of all people, relative to a center (3,) m."""
    entries = []
    if panel.poses is not None:
        for k, joints in enumerate(panel.poses.joints):
            confidence = None if panel.poses.confidence is None else panel.poses.confidence[k]
            data = _pose_data(Pose(joints=joints, skeleton=panel.poses.skeleton, confidence=confidence), center)
            if data is not None:
                entries.append(data | ({"name": panel.names[k]} if panel.names else {}))
    return {"points": _millimeters(points, center), "poses": entries}


# one letter per part: n = background, else that of the body side
_PART_SIDES = np.array(["n"] + [side(joint)[0] for joint in SMPL24.joints])


def _pose_data(pose: Pose | None, center: np.ndarray) -> dict | None:
    if not is_known(pose):
        return None
    joints = [_millimeters(joint, center) if np.isfinite(joint).all() else None for joint in pose.joints]
    data = {"skeleton": pose.skeleton.name, "joints": joints}
    if pose.confidence is not None:
        data["confidence"] = confidences(pose).round(3).tolist()
    return data


def _millimeters(points: np.ndarray, center: np.ndarray) -> list[int]:
    return np.rint((np.asarray(points, float) - center) * 1000).astype(int).ravel().tolist()


def _card(i: int, person: Panel, num_drawn: int) -> str:
    """The HTML of a person; num_drawn: number of the person's points that are drawn."""
    notes = [missing_pose(person)]
    if num_drawn < len(person.points):
        notes.append(f"{num_drawn:,} of {len(person.points):,} points drawn")
    return _figure(str(i), "card", person.label, describe(person), [note for note in notes if note])


def _scan_card(key: str, scan: ScanPanel, num_drawn: int) -> str:
    caption = f"{len(scan.points):,} points{' of the surroundings' if scan.frames else ''}"
    if num_drawn < len(scan.points):
        caption = f"{num_drawn:,} of {caption} drawn"
    return _figure(
        key, "card scan", scan.label, caption, [], _PLAYER.format(len(scan.frames) - 1) if scan.frames else ""
    )


_PLAYER = (
    '<div class="player"><button type="button">play</button>'
    '<input type="range" min="0" max="{}" value="0" aria-label="frame"><output></output></div>'
)


def _figure(key: str, kind: str, label: str, caption: str, notes: list[str], player: str = "") -> str:
    note = "".join(f'<p class="note">{escape(n)}</p>' for n in notes)
    return (
        f'<figure class="{kind}"><canvas data-person="{key}" tabindex="0" role="img" '
        f'aria-label="3D view of {escape(label)}"></canvas>{note}{player}<figcaption><strong>{escape(label)}</strong>'
        f"<span>{escape(caption)}</span></figcaption></figure>"
    )


def _is_missing(value: object) -> bool:
    return value is None or (is_number(value) and not math.isfinite(value))


def _decimals(values: list) -> int:
    """Decimals of a column: four digits for its largest number, at most three decimals, no common trailing zeros."""
    values = [abs(float(v)) for v in values if not isinstance(v, Integral)]
    largest = max(values, default=0.0)
    limit = int(np.clip(3 - math.floor(math.log10(largest)), 0, 3)) if largest > 0 else 3
    return next((d for d in range(limit) if all(round(v, d) == round(v, limit) for v in values)), limit)


def _table(rows: list[dict]) -> str:
    """An HTML table: columns of numbers are right-aligned, `–` marks missing values, booleans are yes and no."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    if not columns:
        return ""
    classes, decimals = {}, {}
    for key in columns:
        values = [row[key] for row in rows if not _is_missing(row.get(key))]
        is_numeric = bool(values) and all(is_number(v) for v in values)
        classes[key] = ' class="number"' if is_numeric else ""
        decimals[key] = _decimals(values) if is_numeric else 3

    def cell(row: dict, key: str) -> str:
        value = row.get(key)
        if _is_missing(value):
            text = "–"
        elif isinstance(value, bool | np.bool_):
            text = "yes" if value else "no"
        elif isinstance(value, Integral) or not is_number(value):
            text = str(value)
        else:
            text = f"{float(value):.{decimals[key]}f}"
        return f"<td{classes[key]}>{escape(text)}</td>"

    head = "".join(f"<th{classes[key]} scope=col>{escape(str(key))}</th>" for key in columns)
    body = "\n".join("<tr>" + "".join(cell(row, key) for key in columns) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
