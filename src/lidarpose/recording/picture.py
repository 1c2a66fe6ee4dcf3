"""The picture of a recording: the paths of its people from above, over the points of some frames. For a recording of
one frame, the people too."""

from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.errors import counted
from lidarpose.geometry import inverse_transform, rotation_of_boxes, transform_points
from lidarpose.inference.read_poses import read_poses
from lidarpose.inference.result_panels import panels_of
from lidarpose.inference.results import Poses
from lidarpose.inference.scan import Scan
from lidarpose.io.sources import Frame, FrameSource
from lidarpose.recording.coordinates import FixedFrame, in_world, moved_yaw
from lidarpose.sample import Box
from lidarpose.viz.bird_eye import ScanPanel, draw_scan_and_people

# number of frames whose points are drawn if the sensor moves
_FRAMES = 8


def in_fixed_frame(
    line: dict[str, Any], fixed: FixedFrame
) -> tuple[np.ndarray, list[dict[str, Any]], np.ndarray | None]:
    """T_fixed_sensor (4, 4) of the next line; its people with joints (J, 3) m, `Box` and yaw of the heading; and the
    sensor position (3,) m, all in the fixed frame and None if missing. Of a tilted sensor the boxes are approximate."""
    T_fixed_sensor = T = fixed.from_sensor(line["T_world_sensor"])
    if line.get("coordinates") == "world":
        T = np.eye(4) if fixed.T_fixed_world is None else fixed.T_fixed_world
    people = []
    for person in line["people"]:
        joints, box, facing, yaw = person["joints"], person["box"], person.get("facing"), None
        if box is not None:
            yaw = moved_yaw(box["yaw"], T, rotation_of_boxes(line["up"]))
            center = transform_points(T, np.array(box["center"]))
            box = Box(center=center, size=np.array(box["size"]), yaw=yaw, id=person["id"])
        elif facing is not None:
            x, y, _ = T[:3, :3] @ facing
            yaw = float(np.arctan2(y, x))
        joints = None if joints is None else transform_points(T, np.array(joints))
        people.append(person | {"joints": joints, "box": box, "yaw": yaw})
    origin = line.get("sensor_origin")
    return T_fixed_sensor, people, None if origin is None else transform_points(T, np.array(origin))


def nearest_points(points: np.ndarray, joints: np.ndarray, count: int) -> np.ndarray:
    """The `count` of points (n, 3) m that are nearest to joints (J, 3) m, in their order: the box of a tilted sensor
    holds more than the person's points."""
    if len(points) <= count:
        return points
    distance = np.linalg.norm(points[:, None] - joints, axis=-1).min(1)
    return points[np.sort(np.argsort(distance, kind="stable")[:count])]


class TrajectoryPicture:
    """Collects the positions of people from each line of a result, in the fixed frame."""

    def __init__(self) -> None:
        self._fixed: FixedFrame | None = None
        self._frames: list[int] = []
        self._to_fixed: list[np.ndarray] = []
        self._ways: dict[int | None, list[np.ndarray]] = {}
        # heading of the last pose of each track, None if unknown
        self._yaws: dict[int | None, float | None] = {}
        # the last line, and the sensor position of that frame
        self._line: dict[str, Any] = {}
        self._origin: np.ndarray | None = None

    def add(self, line: dict[str, Any]) -> None:
        if line["error"] is not None:
            return
        # the up direction may have been estimated
        self._fixed = self._fixed or FixedFrame(line["up"], level=True)
        T_fixed_sensor, people, self._origin = in_fixed_frame(line, self._fixed)
        self._line = line
        self._frames.append(line["frame"])
        self._to_fixed.append(T_fixed_sensor)
        for person in people:
            joints = person["joints"]
            if joints is not None:
                self._ways.setdefault(person["track"], []).append((joints.min(0) + joints.max(0)) / 2)
                self._yaws[person["track"]] = person["yaw"]

    def draw(self, source: FrameSource, *, title: str) -> bytes:
        """The PNG image; reads the source again for the points of some frames."""
        paths = {id: np.array(places) for id, places in self._ways.items()}
        points = self._points(source)
        tracks = {id: path for id, path in paths.items() if id is not None}
        if len(self._frames) == 1:
            cards, scan = panels_of(self._as_scan(points))
            assert scan is not None
            panel = replace(scan, label=f"{scan.label} in 1 frame", tracks=list(tracks.values()))
            return draw_scan_and_people(panel, cards, title=title)
        boxes = [
            Box(center=path[-1], size=np.array([0.8, 0.8, 1.8]), yaw=self._yaws[id] or 0.0, id=id)
            for id, path in tracks.items()
        ]
        count_text = counted(len(boxes), "track")
        if not boxes and None in paths:
            count_text = counted(len(paths[None]), "pose")
        panel = ScanPanel(
            points=points,
            boxes=boxes,
            headings=[self._yaws[id] is not None for id in tracks],
            tracks=list(tracks.values()),
            places=paths.get(None),
            label=f"{count_text} in {counted(len(self._frames), 'frame')}",
            axes=("x", "y") if self._fixed is None else self._fixed.axes,
            sensor=None if self._origin is None else self._origin[:2].tolist(),
        )
        return draw_scan_and_people(panel, [], title=title)

    def _as_scan(self, points: np.ndarray) -> Poses:
        """The only frame, with points (n, 3) m in the fixed frame, as the result of a scan: in the world frame if it is
        known, else in that of the sensor."""
        line = self._line
        if line["T_world_sensor"] is None:
            points = transform_points(inverse_transform(self._to_fixed[0]), points)
        elif line.get("coordinates") != "world":
            line = in_world(line, line["up"])
        poses, origin = read_poses(line), line.get("sensor_origin")
        boxes = [person.box for person in poses if person.box is not None]
        # a person without a box is a crop, and all points are the person's
        rows = Scan(points=points, boxes=boxes, up=poses.up).rows if boxes else [np.arange(len(points))] * len(poses)
        clouds = [
            points[own] if person.pose is None else nearest_points(points[own], person.joints, person.num_points)
            for person, own in zip(poses, rows, strict=True)
        ]
        people = [replace(person, points=cloud) for person, cloud in zip(poses, clouds, strict=True)]
        return replace(poses, people=tuple(people), scan=points, origin=None if origin is None else np.array(origin))

    def _points(self, source: FrameSource) -> np.ndarray:
        """Points (n, 3) m of evenly spaced frames; only of the last frame if the sensor is stationary."""
        if self._fixed is None:
            return np.zeros((0, 3))
        is_static, count = self._fixed.T_world_sensor is None, len(self._frames)
        rows = [count - 1] if is_static else evenly_spaced(count, _FRAMES).tolist()
        T_fixed_sensor = {self._frames[row]: self._to_fixed[row] for row in rows}
        frames = source.frames(min(T_fixed_sensor), only=T_fixed_sensor)
        clouds = [transform_points(T_fixed_sensor[f.index], f.points) for f in frames if isinstance(f, Frame)]
        return np.concatenate(clouds) if clouds else np.zeros((0, 3))
