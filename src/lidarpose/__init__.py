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
    from lidarpose import evaluation as evaluation, metrics as metrics
    from lidarpose.body.pose_prior.sampling import sample_poses as sample_poses
    from lidarpose.errors import (
        InputError as InputError,
        LidarPoseError as LidarPoseError,
        MissingExtra as MissingExtra,
    )
    from lidarpose.inference.background import learn_background as learn_background
    from lidarpose.inference.predict_scan import predict as predict
    from lidarpose.inference.predictor import Predictor as Predictor, load as load
    from lidarpose.inference.read_poses import read_poses as read_poses
    from lidarpose.inference.results import PersonPose as PersonPose, Poses as Poses
    from lidarpose.inference.single_scan import detect as detect
    from lidarpose.io.boxes import Boxes as Boxes, read_boxes as read_boxes
    from lidarpose.io.point_cloud import read_points as read_points
    from lidarpose.io.sources import Frame as Frame, open_source as open_source
    from lidarpose.lidar.presets import sensor as sensor
    from lidarpose.lidar.raycast import cast_rays as cast_rays
    from lidarpose.lidar.sensor import Sensor as Sensor
    from lidarpose.models.dapt.import_weights import import_dapt as import_dapt
    from lidarpose.models.export import export as export
    from lidarpose.recording.predict_recording import FramePoses as FramePoses, predict_recording as predict_recording
    from lidarpose.sample import Box as Box, Pose as Pose, Sample as Sample
    from lidarpose.skeleton import SKELETONS as SKELETONS, Skeleton as Skeleton

# module -> public names that it defines
_PUBLIC = {
    "inference.predictor": ("load", "Predictor"),
    "inference.predict_scan": ("predict",),
    "recording.predict_recording": ("predict_recording", "FramePoses"),
    "inference.single_scan": ("detect",),
    "inference.background": ("learn_background",),
    "models.export": ("export",),
    "models.dapt.import_weights": ("import_dapt",),
    "inference.results": ("PersonPose", "Poses"),
    "lidar.raycast": ("cast_rays",),
    "lidar.presets": ("sensor",),
    "lidar.sensor": ("Sensor",),
    "body.pose_prior.sampling": ("sample_poses",),
    "io.point_cloud": ("read_points",),
    "io.boxes": ("read_boxes", "Boxes"),
    "inference.read_poses": ("read_poses",),
    "io.sources": ("open_source",),
    "io.sources.frame": ("Frame",),
    "sample": ("Box", "Pose", "Sample"),
    "skeleton": ("Skeleton", "SKELETONS"),
    "errors": ("LidarPoseError", "InputError", "MissingExtra"),
}
_HOMES = {name: f"lidarpose.{module}" for module, names in _PUBLIC.items() for name in names}

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
