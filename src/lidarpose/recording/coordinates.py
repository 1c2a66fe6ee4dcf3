"""Coordinates of a recording: those of the sensor, in which points are, and of the fixed frame, in which tracks live:
the world's where the sensor's poses are known, else the sensor's with z up."""

from typing import Any

import numpy as np

from lidarpose.geometry import rigid_transform, rotation_of_boxes, transform_points


class FixedFrame:
    """The fixed frame as frames come. up: of the points, as in `predict`."""

    def __init__(self, up: str):
        self.R_upright = rotation_of_boxes(up)
        self.T_world_sensor: np.ndarray | None = None

    def from_sensor(self, T_world_sensor: np.ndarray | list | None) -> np.ndarray:
        """T_fixed_sensor (4, 4) of the next frame; without the sensor's pose, where others have it, the last one."""
        if T_world_sensor is not None:
            self.T_world_sensor = np.asarray(T_world_sensor, float)
        return rigid_transform(self.R_upright, np.zeros(3)) if self.T_world_sensor is None else self.T_world_sensor


def moved_yaw(yaw: float, T: np.ndarray, R_from: np.ndarray | None = None, R_to: np.ndarray | None = None) -> float:
    """The yaw of a box moved by T (4, 4), rad. R_from, R_to (3, 3): as of `rotation_of_boxes`, of both frames; None
    where z is up."""
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    heading = T[:3, :3] @ (heading if R_from is None else R_from.T @ heading)
    x, y, _ = heading if R_to is None else R_to @ heading
    return float(np.arctan2(y, x))


def in_world(line: dict[str, Any], up: str = "z") -> dict[str, Any]:
    """The line with joints and boxes in the world's frame, where the sensor's pose is known. up: of the sensor's."""
    if line["T_world_sensor"] is None:
        return line
    T = np.array(line["T_world_sensor"])
    people = []
    for person in line["people"]:
        changes: dict[str, Any] = {}
        if person["joints"] is not None:
            changes["joints"] = rounded_points(T, person["joints"])
        if (box := person["box"]) is not None:
            yaw = moved_yaw(box["yaw"], T, rotation_of_boxes(up))
            changes["box"] = box | {"center": rounded_points(T, box["center"]), "yaw": yaw}
        people.append(person | changes)
    return line | {"people": people, "coordinates": "world"}


def rounded_points(T: np.ndarray, points: Any) -> list:
    """Points (..., 3) m moved by T (4, 4), as lines hold them."""
    return transform_points(T, np.asarray(points)).round(4).tolist()
