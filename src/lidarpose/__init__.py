"""lidarpose: 3D human pose from LiDAR.

    import lidarpose
    pose = lidarpose.load().predict(points)                       # one person, (n, 3) metres, z up
    people = lidarpose.predict("sweep.pcd", boxes="boxes.json")   # everybody in a sweep

Names are loaded when first used: importing the package costs no torch and no numba, and predicting needs neither.
"""

from importlib import import_module

from lidarpose import _renamed
from lidarpose._version import __version__
from lidarpose.errors import missing_extra

# public name -> where it lives
_HOMES = {
    "load": "lidarpose.inference.predictor",
    "Predictor": "lidarpose.inference.predictor",
    "predict": "lidarpose.inference.predict_file",
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
    "Box": "lidarpose.sample",
    "Pose": "lidarpose.sample",
    "Sample": "lidarpose.sample",
    "Skeleton": "lidarpose.skeleton",
    "SKELETONS": "lidarpose.skeleton",
    "LidarPoseError": "lidarpose.errors",
    "InputError": "lidarpose.errors",
}

_renamed.install()

# modules of their own, for `lidarpose.metrics.mpjpe`
_MODULES = ("metrics", "evaluation")

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str):
    if name in _HOMES:
        try:
            return getattr(import_module(_HOMES[name]), name)
        except ModuleNotFoundError as error:
            raise missing_extra(error, f"lidarpose.{name}", "export" if name == "export" else None) from None
    if name in _MODULES:
        return import_module(f"lidarpose.{name}")
    raise AttributeError(f"module 'lidarpose' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
