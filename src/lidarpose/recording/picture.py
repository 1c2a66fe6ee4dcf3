"""The picture of a recording: the paths of its people from above, over the points of some frames. For a recording of
one frame, the people too."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.errors import counted
from lidarpose.geometry import transform_points
from lidarpose.inference.result_panels import person_label
from lidarpose.io.sources import Frame, FrameSource
from lidarpose.recording.coordinates import FixedFrame, moved_yaw
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import Skeleton
from lidarpose.viz.bird_eye import ScanPanel, draw_scan_and_people
from lidarpose.viz.person_view import Panel

# number of frames whose points are drawn if the sensor moves
_FRAMES = 8


def in_fixed_frame(line: dict[str, Any], fixed: FixedFrame) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """T_fixed_sensor (4, 4) of the next line, and its people with joints (J, 3) m and `Box` in the fixed frame, each
    None if missing."""
    T_fixed_sensor = fixed.from_sensor(line["T_world_sensor"])
    # people may already be in the world frame
    is_moved = line.get("coordinates") == "world"
    T_fixed_world = np.eye(4) if fixed.T_fixed_world is None else fixed.T_fixed_world
    T, R_upright = (T_fixed_world, None) if is_moved else (T_fixed_sensor, fixed.R_upright)
    people = []
    for person in line["people"]:
        joints, box = person["joints"], person["box"]
        if box is not None:
            center, yaw = transform_points(T, np.array(box["center"])), moved_yaw(box["yaw"], T, R_upright)
            box = Box(center=center, size=np.array(box["size"]), yaw=yaw, id=person["id"])
        joints = None if joints is None else transform_points(T, np.array(joints))
        people.append(person | {"joints": joints, "box": box})
    return T_fixed_sensor, people


class TrajectoryPicture:
    """Collects the positions of people from each line of a result, in the fixed frame."""

    def __init__(self, up: str):
        self._fixed = FixedFrame(up)
        self._frames: list[int] = []
        self._to_fixed: list[np.ndarray] = []
        self._ways: dict[int | None, list[np.ndarray]] = {}
        self._yaws: dict[int | None, float] = {}
        # people of the last frame
        self._people: list[dict[str, Any]] = []

    def add(self, line: dict[str, Any]) -> None:
        if line["error"] is not None:
            return
        T_fixed_sensor, self._people = in_fixed_frame(line, self._fixed)
        self._frames.append(line["frame"])
        self._to_fixed.append(T_fixed_sensor)
        for person in self._people:
            joints, box = person["joints"], person["box"]
            if joints is not None:
                self._ways.setdefault(person["track"], []).append((joints.min(0) + joints.max(0)) / 2)
                if box is not None:
                    self._yaws[person["track"]] = box.yaw

    def draw(self, source: FrameSource, skeleton: Skeleton, *, title: str) -> bytes:
        """The PNG image; reads the source again for the points of some frames."""
        paths = {id: np.array(places) for id, places in self._ways.items()}
        points, poses = self._points(source), None
        is_single = len(self._frames) == 1
        if is_single:
            # draw people as in a single scan: box ids match those on the cards
            boxes = [person["box"] for person in self._people if person["box"] is not None]
            joints = [person["joints"] for person in self._people if person["joints"] is not None]
            poses = Pose(joints=np.stack(joints), skeleton=skeleton) if joints else None
            count_text = counted(len(self._people), "person", "people")
        else:
            boxes = [
                Box(center=path[-1], size=np.array([0.8, 0.8, 1.8]), yaw=self._yaws.get(id, 0.0), id=id)
                for id, path in paths.items()
                if id is not None
            ]
            count_text = counted(len(boxes), "track")
            if not boxes and None in paths:
                count_text = counted(len(paths[None]), "pose")
        panel = ScanPanel(
            points=points,
            boxes=boxes,
            poses=poses,
            tracks=[path for id, path in paths.items() if id is not None],
            places=None if is_single else paths.get(None),
            label=f"{count_text} in {counted(len(self._frames), 'frame')}",
            axes=self._fixed.axes,
            # the sensor position of crops, people without boxes, is unknown
            sensor=None if not self._to_fixed or self._ways and not self._yaws else self._to_fixed[-1][:2, 3].tolist(),
        )
        return draw_scan_and_people(panel, list(self._cards(points, skeleton)) if is_single else [], title=title)

    def _cards(self, points: np.ndarray, skeleton: Skeleton) -> Iterator[Panel]:
        """One panel per person in a recording of one frame with points (n, 3) m."""
        for person in self._people:
            joints, box = person["joints"], person["box"]
            person_points = points if box is None else points[box.contains(points)]
            pose = None
            if joints is not None:
                pose = Pose(joints=joints, skeleton=skeleton, confidence=person["confidence"] or None)
            label = person_label(person["id"], person["score"], person.get("mounted"))
            distance = float("nan")
            # the sensor position of a crop, a person without a box, is unknown
            if box is not None and len(person_points):
                distance = float(np.linalg.norm(np.median(person_points, 0) - self._to_fixed[0][:3, 3]))
            yield Panel(points=person_points, pose=pose, label=label, box=box, distance=distance)

    def _points(self, source: FrameSource) -> np.ndarray:
        """Points (n, 3) m of evenly spaced frames; only of the last frame if the sensor is stationary."""
        if not self._frames:
            return np.zeros((0, 3))
        is_static, count = self._fixed.T_world_sensor is None, len(self._frames)
        rows = [count - 1] if is_static else evenly_spaced(count, _FRAMES).tolist()
        T_fixed_sensor = {self._frames[row]: self._to_fixed[row] for row in rows}
        frames = source.frames(min(T_fixed_sensor), only=T_fixed_sensor)
        clouds = [transform_points(T_fixed_sensor[f.index], f.points) for f in frames if isinstance(f, Frame)]
        return np.concatenate(clouds) if clouds else np.zeros((0, 3))
