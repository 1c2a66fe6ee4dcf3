"""What a prediction returns: one person (`PersonPose`) or all people of a call (`Poses`); JSON, files, pictures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lidarpose.geometry import UP_AXES, rotation_from_up
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import Skeleton

SCHEMA = "lidarpose.poses/1"


@dataclass(frozen=True, kw_only=True, eq=False)
class PersonPose:
    """One person's pose in the input's own frame.

    pose: None where there are too few points; points (n, 3) m: what it was read from; warnings: lines for the user;
    up: the frame's up axis, which pictures need.
    """

    pose: Pose | None
    skeleton: Skeleton
    points: np.ndarray
    id: str | int | None = None
    box: Box | None = None
    warnings: tuple[str, ...] = ()
    model: dict = field(default_factory=dict)
    up: str = "z"

    @property
    def joints(self) -> np.ndarray | None:
        """(J, 3) m, or None."""
        return None if self.pose is None else self.pose.joints

    @property
    def confidence(self) -> np.ndarray | None:
        """(J,): probability that the joint is within 10 cm."""
        return None if self.pose is None else self.pose.confidence

    @property
    def spread(self) -> np.ndarray | None:
        """(J,) m: expected distance between the joint and the truth."""
        return None if self.pose is None else self.pose.spread

    @property
    def visible(self) -> np.ndarray | None:
        """(J,): probability that the sensor sees the joint; None where the network does not say."""
        return None if self.pose is None else self.pose.visible

    @property
    def in_range(self) -> np.ndarray | None:
        """(J,) bool: False where the joint may lie farther out than it says; None where the network does not say."""
        return None if self.pose is None else self.pose.in_range

    @property
    def out_of_range(self) -> list[str]:
        """Names of the joints that are not `in_range`."""
        if self.in_range is None:
            return []
        return [name for name, inside in zip(self.skeleton.joints, self.in_range, strict=True) if not inside]

    @property
    def num_points(self) -> int:
        return len(self.points)

    def to_dict(self) -> dict:
        """The entry of this person under "people"."""
        box = self.box
        return {
            "id": self.id,
            "box": None
            if box is None
            else {"center": box.center.tolist(), "size": box.size.tolist(), "yaw": float(box.yaw)},
            "num_points": self.num_points,
            "joints": None if self.pose is None else _rounded(self.joints, 4),
            "confidence": _rounded(self.confidence, 3),
            "spread": _rounded(self.spread, 4),
            "visible": _rounded(self.visible, 3),
            "out_of_range": self.out_of_range,
            "warnings": list(self.warnings),
        }

    def alone(self) -> "Poses":
        """The same person as the only one of a call."""
        return Poses(people=(self,), skeleton=self.skeleton, model=self.model, up=self.up)

    def to_json(self) -> str:
        """A document of the schema lidarpose.poses/1 with this one person."""
        return self.alone().to_json()

    def save(self, path: str | Path) -> None:
        """Writes `to_json` to a file, whole or not at all."""
        self.alone().save(path)

    def picture(self, path: str | Path | None = None) -> bytes:
        """The person from the front and the side, as PNG; also written to `path` where given."""
        return self.alone().picture(path)


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses(Sequence):
    """The people of one call, in the order of the boxes or arrays. A sequence of `PersonPose`.

    warnings concern the whole input; timing_ms: what took how long; up: the frame's up axis, which pictures need.
    """

    people: tuple[PersonPose, ...]
    skeleton: Skeleton
    source: str | None = None
    model: dict = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    timing_ms: dict[str, float] = field(default_factory=dict)
    up: str = "z"

    def __len__(self) -> int:
        return len(self.people)

    def __getitem__(self, index):
        return self.people[index]

    def to_dict(self) -> dict:
        """The document of the schema lidarpose.poses/1; "warnings" beside it concern the whole input."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            "frame": "input",
            "unit": "m",
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
        """`to_dict` as JSON, people and joints a line each."""
        document = self.to_dict()
        people = document.pop("people")
        timing = document.pop("timing_ms")
        head = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in document.items())
        rows = ",\n".join("  " + json.dumps(person) for person in people)
        body = f"[\n{rows}\n ]" if people else "[]"
        return f'{{\n{head},\n "people": {body},\n "timing_ms": {json.dumps(timing)}\n}}\n'

    def save(self, path: str | Path) -> None:
        """Writes `to_json` to a file, whole or not at all."""
        from lidarpose.io.files import write_atomic

        write_atomic(path, self.to_json())

    def picture(self, path: str | Path | None = None, *, title: str = "") -> bytes:
        """Everybody from the front and the side on one PNG; also written to `path` where given."""
        from lidarpose.viz.draw import Panel, draw_people

        upright = [_upright(person, self.up) for person in self.people]
        panels = [
            Panel(points=p.points, pose=p.pose, label="" if p.id is None else str(p.id), box=p.box) for p in upright
        ]
        return draw_people(panels, path, title=title or (self.source or ""))


def _upright(person: PersonPose, up: str) -> PersonPose:
    """The person with z up, as pictures are drawn. A box of a frame that leans would lean in them: it is left out."""
    R_house_input = rotation_from_up(up)
    pose, box = person.pose, person.box if up in UP_AXES else None
    return replace(
        person,
        points=person.points @ R_house_input.T,
        pose=pose and replace(pose, joints=pose.joints @ R_house_input.T),
        box=box and replace(box, center=R_house_input @ box.center),
    )


def _rounded(values: np.ndarray | None, digits: int) -> list:
    """Nothing for what is not known."""
    return [] if values is None else np.round(np.asarray(values, float), digits).tolist()
