"""Coordinate frames of a recording: points are in the sensor frame, tracks in the fixed frame. The fixed frame is the
world frame if the sensor poses are known, otherwise the sensor frame rotated to z up."""

from typing import Any

import numpy as np

from lidarpose.geometry import (
    axes_from_above,
    inverse_transform,
    rigid_transform,
    rotation_from_up,
    rotation_of_boxes,
    transform_points,
    upright_axis,
)
from lidarpose.inference.read_poses import stated_skeleton
from lidarpose.inference.results import facing_entry
from lidarpose.sample import Pose


class FixedFrame:
    """The transform to the fixed frame, updated frame by frame. If the first frames have no sensor pose, the fixed
    frame stays that of these frames, as if the sensor had not moved until the first known pose.

    up: up axis of the points, as in `predict`. level: whether z of the fixed frame is exactly `up`, for drawing, and
    not the axis nearest to it, along which boxes are upright.
    """

    def __init__(self, up: str, *, level: bool = False):
        self._up = up if level else upright_axis(up)
        self.R_upright = rotation_from_up(self._up)
        self.T_world_sensor: np.ndarray | None = None
        self.T_fixed_world: np.ndarray | None = None
        self._is_first = True

    def from_sensor(self, T_world_sensor: np.ndarray | list | None) -> np.ndarray:
        """T_fixed_sensor (4, 4) of the next frame; if the sensor pose of this frame is missing, that of the last
        frame."""
        T_upright_sensor = rigid_transform(self.R_upright, np.zeros(3))
        if T_world_sensor is not None:
            self.T_world_sensor = np.asarray(T_world_sensor, float)
            if self.T_fixed_world is None:
                self.T_fixed_world = (
                    np.eye(4) if self._is_first else T_upright_sensor @ inverse_transform(self.T_world_sensor)
                )
        self._is_first = False
        if self.T_world_sensor is None or self.T_fixed_world is None:
            return T_upright_sensor
        return self.T_fixed_world @ self.T_world_sensor

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the fixed frame's x and y in the input: axes of the sensor's frame, or of the world's."""
        is_world = self.T_fixed_world is not None and np.array_equal(self.T_fixed_world, np.eye(4))
        return ("x", "y") if is_world else axes_from_above(self._up)

    def state(self) -> list:
        """The state after the frames so far, as JSON values."""
        poses = (self.T_world_sensor, self.T_fixed_world)
        return [self._is_first, *(None if T is None else T.tolist() for T in poses)]

    def restore(self, state: list) -> None:
        """Resumes from the result of `state()`."""
        self._is_first = state[0]
        self.T_world_sensor, self.T_fixed_world = (None if T is None else np.array(T) for T in state[1:])


def moved_yaw(yaw: float, T: np.ndarray, R_from: np.ndarray | None = None, R_to: np.ndarray | None = None) -> float:
    """The yaw, rad, of a box transformed by T (4, 4). R_from, R_to (3, 3): `rotation_of_boxes` of the source and target
    frame, None if z is up."""
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    heading = T[:3, :3] @ (heading if R_from is None else R_from.T @ heading)
    x, y, _ = heading if R_to is None else R_to @ heading
    return float(np.arctan2(y, x))


def in_world(line: dict[str, Any], up: str = "z") -> dict[str, Any]:
    """The line in the world frame, z up, if the sensor pose is known, else unchanged. up: up axis of the sensor
    frame."""
    if line["T_world_sensor"] is None:
        return line
    T, skeleton = np.array(line["T_world_sensor"]), stated_skeleton(line["skeleton"])
    people = []
    for person in line["people"]:
        changes: dict[str, Any] = {}
        if person["joints"] is not None:
            changes["joints"] = rounded_points(T, person["joints"])
            if person.get("facing") is not None:
                # horizontal in the world, also where the sensor is out of level
                changes["facing"] = facing_entry(Pose(joints=np.array(changes["joints"]), skeleton=skeleton), "z")
        if (velocity := person.get("velocity")) is not None:
            changes["velocity"] = (T[:3, :3] @ velocity).round(4).tolist()
        if (box := person["box"]) is not None:
            yaw = round(moved_yaw(box["yaw"], T, rotation_of_boxes(up)), 4)
            changes["box"] = box | {"center": rounded_points(T, box["center"]), "yaw": yaw}
        people.append(person | changes)
    origin = line.get("sensor_origin")
    origin = None if origin is None else rounded_points(T, origin)
    return line | {"people": people, "sensor_origin": origin, "coordinates": "world", "up": "z"}


def rounded_points(T: np.ndarray, points: Any) -> list:
    """Points (..., 3) m transformed by T (4, 4), rounded as in lines."""
    return transform_points(T, np.asarray(points)).round(4).tolist()
