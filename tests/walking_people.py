"""Two people who walk on flat ground near a LiDAR: frames of a static sensor, and a recording of a moving sensor."""

from functools import cache

import numpy as np

import lidarpose
from lidarpose.geometry import UP_AXES, rigid_transform, rotation_about
from lidarpose.io.sources.frame import FrameSource, IndexedRecording, Sweep
from lidarpose.lidar.raycast import scan
from lidarpose.sample import Box
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.environment.mesh import Mesh, quad, union

FRAMES = 7
# positions of two people in the first frame, and their steps per frame, m
PLACES, STEPS = np.array([[4.0, 1.5], [3.0, -3.0]]), np.array([[0.1, 0.0], [0.0, 0.08]])
# origin of `walking_clouds` in the world frame of `moving_source`, m
_ORIGIN = np.array([100.0, -50.0, 2.0])


@cache
def walking_clouds():
    """Points (n, 3) m of each frame of a static VLP-32C."""
    sensor = lidarpose.sensor("vlp-32c")
    bodies = draw_bodies(None, captured=0.0, count=12, seed=1, block=0, moving=False)
    standing = [i for i, kind in enumerate(bodies.kinds) if kind in ("stand", "idle", "walk")][:2]
    floor = quad(30.0, np.zeros(2)).moved((0.0, 0.0, -sensor.height))
    frames = []
    for k in range(FRAMES):
        feet = np.column_stack([PLACES + k * STEPS, [-sensor.height] * 2])
        people = [Mesh(bodies.vertices[i], bodies.faces).moved(at) for i, at in zip(standing, feet, strict=True)]
        everything = union([*people, floor])
        frames.append(scan(everything.vertices, everything.faces, sensor).points)
    return frames


def places_in_world(frame):
    """Positions (2, 2) m of the people in the world frame of `moving_source`."""
    return PLACES + frame * STEPS + _ORIGIN[:2]


def world_pose(frame, up="z"):
    """T_world_sensor of a frame."""
    T_world_level = rigid_transform(rotation_about("z", 0.3 * frame), _ORIGIN + [frame, 0, 0])
    return T_world_level @ rigid_transform(UP_AXES[up], np.zeros(3))


def moving_source(clouds, *, times=None, up="z", unknown=()):
    """The clouds as frames of a sensor that moves and turns; its pose is None in the frames `unknown`."""

    def read(i):
        T_sensor_world = np.linalg.inv(world_pose(i, up))
        points = (clouds[i] + _ORIGIN) @ T_sensor_world[:3, :3].T + T_sensor_world[:3, 3]
        origin = T_sensor_world[:3, :3] @ _ORIGIN + T_sensor_world[:3, 3]
        return Sweep(points=points, T_world_sensor=None if i in unknown else world_pose(i, up), origin=origin)

    ids = [str(k) for k in range(len(clouds))]
    times = np.arange(len(clouds)) / 10 if times is None else times
    return FrameSource(IndexedRecording(name="moving", ids=ids, times=times, read=read))


def boxes_of(frames, up="z"):
    """Boxes of both people by frame, in the sensor frames of `moving_source`."""
    boxes = {}
    for k in range(frames):
        T_sensor_world = np.linalg.inv(world_pose(k, up))
        centers = np.column_stack([places_in_world(k), np.full(2, _ORIGIN[2] - 0.9)])
        centers = centers @ T_sensor_world[:3, :3].T + T_sensor_world[:3, 3]
        size, own_up = np.array([1.0, 1.0, 2.1]), None if up == "z" else up
        boxes[k] = [Box(center=center, size=size, up=own_up) for center in centers]
    return boxes
