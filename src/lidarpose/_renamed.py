"""Module paths that the README and docs of 0.2 mentioned, kept importable until 1.0 as aliases of the new paths."""

import importlib
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# old path below `lidarpose.` -> new one
RENAMED = {
    "body.clips": "body.mocap.motion",
    "body.motion": "body.pose_prior.sampling",
    "body.retarget": "body.mocap.retarget",
    "body.shape": "body.rig",
    "body.sources": "body.mocap",
    "evaluate": "eval",
    "evaluate.metrics": "metrics",
    "infer": "inference",
    "infer.files": "inference.predict_scan",
    "infer.predictor": "inference.predictor",
    "infer.results": "inference.results",
    "io.formats": "io.point_cloud",
    "lidar.catalog": "lidar.presets",
    "lidar.pattern": "lidar.ray_pattern",
    "lidar.sensor_file": "lidar.presets",
    "model": "models",
    "model.bundled": "models",
    "model.checkpoint": "models.checkpoint",
    "model.export": "models.export",
    "model.header": "models.checkpoint",
    "model.network": "models.posenet",
    "model.plan": "models.voxelize",
    "model.presets": "models.config",
    "synth.garments": "synth.props.garments",
    "synth.generate": "synth.generator",
    "synth.mesh": "synth.environment.mesh",
    "train.job": "train.setup",
    "train.people": "train.torch_dataset",
    "view": "viz",
    "view.picture": "viz.draw",
}


class RenamedModules(MetaPathFinder, Loader):
    """Imports a module by its old path; the result is the module object of the new path."""

    def find_spec(self, fullname: str, path=None, target=None) -> ModuleSpec | None:
        old_path = fullname.removeprefix("lidarpose.")
        return ModuleSpec(fullname, self) if old_path != fullname and old_path in RENAMED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        new_path = "lidarpose." + RENAMED[spec.name.removeprefix("lidarpose.")]
        warnings.warn(f"{spec.name} is now {new_path}", DeprecationWarning, stacklevel=2)
        module = importlib.import_module(new_path)
        # importlib replaces the spec of the returned module: keep the original for `exec_module`
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = getattr(module.__spec__, "loader_state", None)


def install() -> None:
    """Makes the old paths importable."""
    if not any(isinstance(finder, RenamedModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, RenamedModules())
