"""Coordinate frames of a recording: points are in the sensor frame, tracks in the fixed frame. The fixed frame is the
world frame if the sensor poses are known, otherwise the sensor frame rotated to z up."""

from typing import Any

import numpy as np

from lidarpose.geometry import rigid_transform, rotation_of_boxes, transform_points


class FixedFrame:
    """The transform to the fixed frame, updated frame by frame. up: up axis of the points, as in `predict`."""

    def __init__(self, up: str):
        self.R_upright = rotation_of_boxes(up)
        self.T_world_sensor: np.ndarray | None = None

    def from_sensor(self, T_world_sensor: np.ndarray | list | None) -> np.ndarray:
        """T_fixed_sensor (4, 4) of the next frame; if the sensor pose of this frame is missing, that of the last
        frame."""
        if T_world_sensor is not None:
            self.T_world_sensor = np.asarray(T_world_sensor, float)
        return rigid_transform(self.R_upright, np.zeros(3)) if self.T_world_sensor is None else self.T_world_sensor


def moved_yaw(yaw: float, T: np.ndarray, R_from: np.ndarray | None = None, R_to: np.ndarray | None = None) -> float:
    """The yaw, rad, of a box transformed by T (4, 4). R_from, R_to (3, 3): `rotation_of_boxes` of the source and target
    frame, None if z is up."""
    heading = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    heading = T[:3, :3] @ (heading if R_from is None else R_from.T @ heading)
    x, y, _ = heading if R_to is None else R_to @ heading
    return float(np.arctan2(y, x))


def in_world(line: dict[str, Any], up: str = "z") -> dict[str, Any]:
    """The line with joints and boxes in the world frame if the sensor pose is known, else unchanged. up: up axis of the
    sensor frame."""
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
    """Points (..., 3) m transformed by T (4, 4), rounded as in lines."""
    return transform_points(T, np.asarray(points)).round(4).tolist()
