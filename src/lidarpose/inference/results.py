"""Results of a prediction: one person (`PersonPose`) or all people of a call (`Poses`), with JSON, file and picture
output."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, cast, overload

import numpy as np

from lidarpose.errors import counted
from lidarpose.io.atomic import check_suffix, write_atomic
from lidarpose.io.files import encodable, lined_json
from lidarpose.sample import JOINT_COLUMNS, PER_JOINT, Box, Pose, facing
from lidarpose.skeleton import Skeleton

if TYPE_CHECKING:
    import pandas

SCHEMA = "lidarpose.poses/1"
# decimals of the values in files, by column of tables
_DECIMALS = {"x": 4, "y": 4, "z": 4, "confidence": 3, "spread": 4, "visible": 3, "facing": 4}
_DECIMALS |= {"person_probability": 4, "second_person": 4, "score": 4}


class Picture(bytes):
    """The bytes of a PNG image, which a notebook displays as a picture."""

    def __repr__(self) -> str:
        return f"<PNG, {len(self):,} bytes>"

    def _repr_png_(self) -> bytes:
        return bytes(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class PersonPose:
    """The pose of one person, in the coordinate frame of the input.

    Args:
        pose: the pose, None if the person has too few points.
        skeleton: the skeleton of the pose.
        points: (n, 3) m, the points of the person's crop, without invalid points.
        id: id of the box, the track or the clip's frame; the index of the box if it has no id; None for arrays.
        box: the box that cropped the person, None without boxes.
        warnings: messages for the user about this person.
        model: name, version and settings of the network.
        up: up axis of the input frame, used for drawing.
        stored_points: number of points of the crop if `points` does not hold them, see `read_poses`.
        velocity: (3,) m/s of a tracked person over ground, along the axes of the input frame; None if unknown.
        pelvis: (3,) m, the pelvis that the network predicts, which `skeleton` may lack; None without a pose and for
            people read from files.
    """

    pose: Pose | None
    skeleton: Skeleton
    points: np.ndarray
    id: str | int | None = None
    box: Box | None = None
    warnings: tuple[str, ...] = ()
    model: dict = field(default_factory=dict)
    up: str = "z"
    stored_points: int | None = None
    velocity: np.ndarray | None = None
    pelvis: np.ndarray | None = None

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose. Without one, `joints` and all other per-joint values are None."""
        return self.pose is not None

    # typed as arrays although they are None without a pose
    @property
    def joints(self) -> np.ndarray:
        """(J, 3) m: joint positions."""
        return self._of_pose("joints")

    @property
    def confidence(self) -> np.ndarray:
        """(J,): probability that the joint is within 10 cm of the ground truth; None if the network does not predict
        it."""
        return self._of_pose("confidence")

    @property
    def spread(self) -> np.ndarray:
        """(J,) m: expected distance between the joint and the ground truth; None if the network does not predict it."""
        return self._of_pose("spread")

    @property
    def visible(self) -> np.ndarray:
        """(J,): probability that a point of the body lies within 18 cm of the joint; None if the network does not
        predict it."""
        return self._of_pose("visible")

    @property
    def in_range(self) -> np.ndarray:
        """(J,) bool: False if the joint lies at the end of the heatmap's range and may be farther out than predicted;
        None for networks without heatmaps."""
        return self._of_pose("in_range")

    @property
    def facing(self) -> np.ndarray | None:
        """(3,): the horizontal direction of length 1 in which hips and shoulders face, in the frame of the input; for
        people who lie on the back or belly, toward their feet or head. None without a pose and for people who lie on
        their side."""
        return facing(self.pose, self.up)

    @property
    def person(self) -> float | None:
        """Probability that the points show a person; None if the network does not predict it."""
        return self._number("person")

    @property
    def second_person(self) -> float | None:
        """Probability that the points show a second person as well; None if the network does not predict it."""
        return self._number("second_person")

    def _number(self, name: str) -> float | None:
        value = self._of_pose(name)
        return None if value is None else float(value)

    def _of_pose(self, name: str) -> np.ndarray:
        return cast(np.ndarray, None if self.pose is None else getattr(self.pose, name))

    @property
    def out_of_range(self) -> list[str]:
        """Names of the joints that are not `in_range`."""
        if self.in_range is None:
            return []
        return [name for name, is_inside in zip(self.skeleton.joints, self.in_range, strict=True) if not is_inside]

    @property
    def score(self) -> float | None:
        """Score of the box: the probability that it contains a person; None if unknown."""
        return None if self.box is None else self.box.score

    @property
    def mounted(self) -> bool | None:
        """Whether the person rides or sits in a wheelchair, as stated by the box; None if unknown."""
        return None if self.box is None else self.box.mounted

    @property
    def num_points(self) -> int:
        return len(self.points) if self.stored_points is None else self.stored_points

    def to_dict(self) -> dict:
        """The entry of this person in the list "people" of `Poses.to_dict`."""
        return {
            "id": self.id,
            "box": self.box and self.box.place_dict(),
            "score": None if self.score is None else round(self.score, _DECIMALS["score"]),
            "mounted": self.mounted,
            "num_points": self.num_points,
            "person": None if self.person is None else round(self.person, _DECIMALS["person_probability"]),
            "second_person": None
            if self.second_person is None
            else round(self.second_person, _DECIMALS["second_person"]),
            "facing": facing_entry(self.pose, self.up),
            "joints": None if self.pose is None else _rounded(self.joints, _DECIMALS["x"]),
            "confidence": _rounded(self.confidence, _DECIMALS["confidence"]),
            "spread": _rounded(self.spread, _DECIMALS["spread"]),
            "visible": _rounded(self.visible, _DECIMALS["visible"]),
            "out_of_range": self.out_of_range,
            "warnings": list(self.warnings),
        }

    def alone(self) -> "Poses":
        """A `Poses` that contains only this person."""
        return Poses(people=(self,), skeleton=self.skeleton, model=self.model, up=self.up)

    def to_json(self) -> str:
        """A JSON document with the schema lidarpose.poses/1 that contains only this person."""
        return self.alone().to_json()

    def save(self, path: str | Path) -> None:
        """Writes a .json or .csv file, see `Poses.save`."""
        self.alone().save(path)

    def picture(self, path: str | Path | None = None) -> Picture:
        """Front and side view of the person as PNG; also written to `path` if given."""
        return self.alone().picture(path)

    def html(self, path: str | Path | None = None, *, title: str = "") -> str:
        """An HTML page with the person in 3D, see `Poses.html`."""
        return self.alone().html(path, title=title)

    def to_dataframe(self) -> "pandas.DataFrame":
        """A table with one row per joint, see `Poses.to_dataframe`."""
        return self.alone().to_dataframe()

    def to_numpy(self) -> np.ndarray:
        """Joint positions (J, 3) m, NaN without a pose."""
        return self.alone().to_numpy()[0]

    def __repr__(self) -> str:
        name = "" if self.id is None else f"id={self.id!r}, "
        if self.pose is None:
            description = "no pose"
        elif self.pose.confidence is None:
            description = self.skeleton.name
        else:
            description = f"{self.skeleton.name}, confidence {self.confidence.mean():.2f}"
        return f"PersonPose({name}{description}, {self.num_points:,} points{_warning_count(self.warnings)})"

    def _repr_png_(self) -> bytes:
        return bytes(self.picture())


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses(Sequence[PersonPose]):
    """All people of one call: a sequence of `PersonPose` in the order of the boxes or arrays.

    The result of a scan with boxes or detected people holds the whole scan. To store many results without the memory
    of their scans, use `dataclasses.replace(poses, scan=None)`.

    Args:
        people: one entry per person, also for people without a pose.
        skeleton: the skeleton of all poses.
        source: name of the file or recording, None for arrays.
        model: name, version and settings of the network.
        warnings: messages for the user about the whole input.
        timing_ms: duration of each step in milliseconds, by name.
        up: up axis of the input frame, used for drawing.
        scan: (n, 3) m, the points around the boxes or detected people; None for crops.
        origin: (3,) m, the sensor position of that scan, None if unknown.
    """

    people: tuple[PersonPose, ...]
    skeleton: Skeleton
    source: str | None = None
    model: dict = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    timing_ms: dict[str, float] = field(default_factory=dict)
    up: str = "z"
    scan: np.ndarray | None = None
    origin: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.people)

    @overload
    def __getitem__(self, index: int | str) -> PersonPose: ...

    @overload
    def __getitem__(self, index: slice) -> "Poses": ...

    def __getitem__(self, index: int | str | slice) -> "PersonPose | Poses":
        """One person by index, one person by id given as text, or a slice as `Poses`."""
        if isinstance(index, slice):
            return replace(self, people=self.people[index])
        if isinstance(index, str):
            named_people = [person for person in self.people if person.id is not None]
            matches = [person for person in named_people if str(person.id) == index]
            if self.people and not named_people:
                raise KeyError(f"no person has the id {index!r}: ids are not set, use a position, such as [0]")
            if not matches:
                raise KeyError(f"no person has the id {index!r}: ids are {[person.id for person in self.people]}")
            return matches[0]
        try:
            return self.people[index]
        except IndexError:
            expected = f"there are {counted(len(self), 'person', 'people')}, counted from 0"
            raise IndexError(f"no person at {index}: {expected}, and ids are text, [{str(index)!r}]") from None

    def __repr__(self) -> str:
        num_posed = sum(person.has_pose for person in self.people)
        source = "" if self.source is None else f", from {self.source!r}"
        warnings = [*self.warnings, *(warning for person in self.people for warning in person.warnings)]
        return f"Poses({num_posed} of {len(self)} people, {self.skeleton.name}{source}{_warning_count(warnings)})"

    def _repr_html_(self) -> str:
        known = [name for name in ("score", "mounted") if any(getattr(p, name) is not None for p in self.people)]
        rows = [("th", ("id", "points", "confidence", *known, "warnings"))]
        for person in self.people:
            confidence = "no pose" if person.pose is None else _mean(person.pose.confidence)
            name = "" if person.id is None else str(person.id)
            values = {"score": "" if person.score is None else f"{person.score:.2f}"}
            values["mounted"] = {None: "", True: "yes", False: "no"}[person.mounted]
            cells = (name, f"{person.num_points:,}", confidence, *(values[name] for name in known))
            rows.append(("td", (*cells, "; ".join(person.warnings))))
        lines = ("".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row) for tag, row in rows)
        return f"<p>{escape(repr(self))}</p><table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"

    def to_numpy(self) -> np.ndarray:
        """Joint positions (N, J, 3) m, NaN for people without a pose."""
        joints = np.full((len(self), len(self.skeleton), 3), np.nan)
        for row, person in zip(joints, self.people, strict=True):
            if person.pose is not None:
                row[:] = person.pose.joints
        return joints

    def to_dataframe(self) -> "pandas.DataFrame":
        """A table with one row per joint of each person with a pose.

        Columns: person (index in this sequence), id, joint, x, y, z (m), confidence, spread (m), visible, in_range,
        person_probability (`PersonPose.person`), second_person, score, mounted. Unknown values are NaN.
        """
        import pandas

        rows = []
        for number, person in enumerate(self.people):
            if person.pose is None:
                continue
            values = [getattr(person.pose, name) for name in PER_JOINT]
            known_values = (person.person, person.second_person, person.score, person.mounted)
            person_values = [np.nan if value is None else value for value in known_values]
            # escape characters that cannot be encoded when the table is written
            id = encodable(person.id) if isinstance(person.id, str) else person.id
            for j, joint in enumerate(self.skeleton.joints):
                joint_values = [np.nan if value is None else value[j] for value in values]
                rows.append((number, id, joint, *person.pose.joints[j], *joint_values, *person_values))
        return pandas.DataFrame(rows, columns=["person", "id", *JOINT_COLUMNS])

    def to_csv(self) -> str:
        """`to_dataframe` as CSV text, with the decimals of `to_json`."""
        table = self.to_dataframe().round(_DECIMALS)
        return table.to_csv(index=False, quoting=csv_quoting(table["id"]))

    def to_dict(self) -> dict:
        """A document with the schema lidarpose.poses/1. Its top-level "warnings" concern the whole input."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            "frame": "input",
            "unit": "m",
            "up": self.up,
            "skeleton": {
                "name": self.skeleton.name,
                "joints": list(self.skeleton.joints),
                "bones": [list(bone) for bone in self.skeleton.bones],
            },
            "model": self.model,
            "people": [person.to_dict() for person in self.people],
            "warnings": list(self.warnings),
            "timing_ms": {name: round(value, 2) for name, value in self.timing_ms.items()},
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text with one line per person."""
        document = self.to_dict()
        last_entries = {key: document.pop(key) for key in ("people", "timing_ms")}
        return lined_json(document | last_entries, "people") + "\n"

    def save(self, path: str | Path) -> None:
        """Writes `to_json` to a .json file or `to_csv` to a .csv file; the file is written completely or not at
        all."""
        check_suffix(path, ".json", ".csv")
        is_csv = str(path).lower().endswith(".csv")
        write_atomic(path, self.to_csv() if is_csv else self.to_json())

    def picture(self, path: str | Path | None = None, *, title: str = "") -> Picture:
        """Front and side views of all people on one PNG; also written to `path` if given.

        For a scan with boxes or detected people, a bird's-eye view of the scan is placed above them.
        """
        from lidarpose.inference.result_panels import panels_of
        from lidarpose.viz.bird_eye import draw_scan_and_people
        from lidarpose.viz.draw import draw_people

        if path is not None:
            check_suffix(path, ".png")
        title = title or (self.source or "")
        panels, scan = panels_of(self)
        png = draw_people(panels, title=title) if scan is None else draw_scan_and_people(scan, panels, title=title)
        if path is not None:
            write_atomic(path, png)
        return Picture(png)

    def html(self, path: str | Path | None = None, *, title: str = "") -> str:
        """An HTML page with interactive 3D views of all people; also written to `path` if given.

        For a scan with boxes or detected people, a view of the scan is placed above them.
        """
        from lidarpose.inference.result_panels import panels_of
        from lidarpose.viz.html import render_report

        if path is not None:
            check_suffix(path, ".html", ".htm")
        panels, scan = panels_of(self)
        scans = [] if scan is None else [scan]
        text = render_report(panels, title=title or (self.source or "lidarpose"), summary=[], scans=scans)
        if path is not None:
            write_atomic(path, text.encode("utf-8", "replace"))
        return text


def csv_quoting(texts: Iterable[object]) -> int:
    """How to quote a CSV table with these texts: a carriage return, which `csv` does not quote by itself, would end the
    row."""
    return csv.QUOTE_NONNUMERIC if any("\r" in str(text) for text in texts) else csv.QUOTE_MINIMAL


def facing_entry(pose: Pose | None, up: str) -> list | None:
    """The entry `facing` of a person in JSON; up: up axis of the pose's frame."""
    forward = facing(pose, up)
    return None if forward is None else _rounded(forward, _DECIMALS["facing"])


def _rounded(values: np.ndarray | None, digits: int) -> list:
    """The rounded values as a list; an empty list for None."""
    return [] if values is None else np.round(np.asarray(values, float), digits).tolist()


def _warning_count(warnings: Sequence[str]) -> str:
    """ ", 2 warnings", or "" without warnings."""
    return f", {counted(len(warnings), 'warning')}" if warnings else ""


def _mean(values: np.ndarray | None) -> str:
    return "" if values is None else f"{values.mean():.2f}"
