"""lidarpose: 3D human pose from LiDAR.

    import lidarpose
    pose = lidarpose.load().predict(points)                       # one person, (n, 3) meters, z up
    people = lidarpose.predict("sweep.pcd")                       # all people in a sweep

Names are imported on first use: importing the package imports neither torch nor numba, and prediction needs neither.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from lidarpose import _renamed
from lidarpose._version import __version__
from lidarpose.errors import needs_extra

if TYPE_CHECKING:
    # the names below, for editors and type checkers
    from lidarpose import evaluation as evaluation
    from lidarpose import metrics as metrics
    from lidarpose.body.pose_prior.sampling import sample_poses as sample_poses
    from lidarpose.errors import InputError as InputError
    from lidarpose.errors import LidarPoseError as LidarPoseError
    from lidarpose.errors import MissingExtra as MissingExtra
    from lidarpose.inference.background import learn_background as learn_background
    from lidarpose.inference.predict_scan import predict as predict
    from lidarpose.inference.predictor import Predictor as Predictor
    from lidarpose.inference.predictor import load as load
    from lidarpose.inference.read_poses import read_poses as read_poses
    from lidarpose.inference.results import PersonPose as PersonPose
    from lidarpose.inference.results import Poses as Poses
    from lidarpose.inference.single_scan import detect as detect
    from lidarpose.io.boxes import Boxes as Boxes
    from lidarpose.io.boxes import read_boxes as read_boxes
    from lidarpose.io.point_cloud import read_points as read_points
    from lidarpose.io.sources import Frame as Frame
    from lidarpose.io.sources import open_source as open_source
    from lidarpose.lidar.presets import sensor as sensor
    from lidarpose.lidar.raycast import cast_rays as cast_rays
    from lidarpose.lidar.sensor import Sensor as Sensor
    from lidarpose.models.dapt.import_weights import import_dapt as import_dapt
    from lidarpose.models.export import export as export
    from lidarpose.recording.predict_recording import FramePoses as FramePoses
    from lidarpose.recording.predict_recording import predict_recording as predict_recording
    from lidarpose.sample import Box as Box
    from lidarpose.sample import Pose as Pose
    from lidarpose.sample import Sample as Sample
    from lidarpose.skeleton import SKELETONS as SKELETONS
    from lidarpose.skeleton import Skeleton as Skeleton

# public name -> module that defines it
_HOMES = {
    "load": "lidarpose.inference.predictor",
    "Predictor": "lidarpose.inference.predictor",
    "predict": "lidarpose.inference.predict_scan",
    "predict_recording": "lidarpose.recording.predict_recording",
    "FramePoses": "lidarpose.recording.predict_recording",
    "detect": "lidarpose.inference.single_scan",
    "learn_background": "lidarpose.inference.background",
    "export": "lidarpose.models.export",
    "import_dapt": "lidarpose.models.dapt.import_weights",
    "PersonPose": "lidarpose.inference.results",
    "Poses": "lidarpose.inference.results",
    "cast_rays": "lidarpose.lidar.raycast",
    "sensor": "lidarpose.lidar.presets",
    "Sensor": "lidarpose.lidar.sensor",
    "sample_poses": "lidarpose.body.pose_prior.sampling",
    "read_points": "lidarpose.io.point_cloud",
    "read_boxes": "lidarpose.io.boxes",
    "read_poses": "lidarpose.inference.read_poses",
    "open_source": "lidarpose.io.sources",
    "Frame": "lidarpose.io.sources.frame",
    "Box": "lidarpose.sample",
    "Boxes": "lidarpose.io.boxes",
    "Pose": "lidarpose.sample",
    "Sample": "lidarpose.sample",
    "Skeleton": "lidarpose.skeleton",
    "SKELETONS": "lidarpose.skeleton",
    "LidarPoseError": "lidarpose.errors",
    "InputError": "lidarpose.errors",
    "MissingExtra": "lidarpose.errors",
}

_renamed.install()

# public modules, used as in `lidarpose.metrics.mpjpe`
_MODULES = ("metrics", "evaluation")

# names that need a module beyond the base install, left out of `__all__` without it: help() and `import *` access every
# name in `__all__`
_NEEDS = {"export": "torch", "import_dapt": "torch", "cast_rays": "numba"}

__all__ = ["__version__", *(name for name in _HOMES if name not in _NEEDS or find_spec(_NEEDS[name]))]


def __getattr__(name: str):
    if name in _HOMES:
        with needs_extra(f"lidarpose.{name}", "export" if name == "export" else None):
            return getattr(import_module(_HOMES[name]), name)
    if name in _MODULES:
        return import_module(f"lidarpose.{name}")
    raise AttributeError(f"module 'lidarpose' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
