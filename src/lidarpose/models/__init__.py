"""The kinds of network, and the names and paths of the bundled weights. No torch, no numpy here.

A new kind of network needs a module for the network and its configuration, an objective that trains it, a backend that
runs it, and an entry in `NETWORKS`. Its checkpoints are then written, read and checked like all others.
"""

import os
from dataclasses import dataclass
from importlib import import_module, resources
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError, check_name


@dataclass(frozen=True)
class NetworkKind:
    """Where the parts of a kind of network are defined, as "module:name"; they are imported on first use.

    config: a `models.config.Config` with `kind` (its key in `NETWORKS`), `name` (for messages), `joints` (names, in the
    order of the outputs) and `min_tensors` (a lower bound of the number of its tensors), which raises InputError for
    invalid settings; network: a module built from the config alone, which it stores as `config`; objective: a
    `train.objectives.objective.Objective`; backend: called with (network, header, device=, compile=), returns an
    `inference.backend.Backend`.
    """

    config: str
    network: str
    objective: str
    backend: str

    def part(self, name: str) -> Any:
        """The class or function that `config`, `network`, `objective` or `backend` names."""
        folder = {"objective": "train.objectives", "backend": "inference"}.get(name, "models")
        module, _, attribute = getattr(self, name).partition(":")
        return getattr(import_module(f"lidarpose.{folder}.{module}"), attribute)


def _baseline(name: str, objective: str, backend: str) -> NetworkKind:
    config = f"baselines.baseline_config:{name}Config"
    return NetworkKind(config, f"baselines.{name.lower()}:{name}", objective, f"torch_backend:{backend}")


_FRAMES = ("baseline_objective:BaselineObjective", "BaselineBackend")
_CLIPS = ("baseline_objective:ClipObjective", "ClipBackend")
# by their names in checkpoints, with modules of `models`, `train.objectives` and `inference`: this package's own
# network, the paper's, the baselines that the paper compares with, and a detector, which predicts no poses
NETWORKS = {
    "pose": NetworkKind(
        "config:NetworkConfig", "posenet:PoseNet", "posenet_objective:PoseNetObjective", "torch_backend:TorchBackend"
    ),
    "dapt": NetworkKind(
        "dapt.dapt_config:DaptConfig",
        "dapt.dapt_net:DaptNet",
        "dapt_objective:DaptObjective",
        "torch_backend:DaptBackend",
    ),
    **{name.lower(): _baseline(name, *_FRAMES) for name in ("Prn", "Lpformer")},
    **{name.lower(): _baseline(name, *_CLIPS) for name in ("Lidarcap", "Ne")},
    "detector": NetworkKind(
        "detector.detector_config:DetectorConfig",
        "detector.network:DetectorNet",
        "detector_objective:DetectorObjective",
        "torch_backend:no_poses",
    ),
}

BUNDLED = ("tiny", "small")
# the default: the best network whose two files have at most 6 MB
DEFAULT = "small"
# the network that rejects the detector's false positives; it predicts no poses
VERIFIER = "verifier"
# the names of `BUNDLED`, for help texts
NAMES = ", ".join(f"{name} (default)" if name == DEFAULT else name for name in BUNDLED)


def bundled_path(name: str = DEFAULT, suffix: str = ".safetensors") -> Path:
    """Path of a bundled checkpoint, or, with the suffix .onnx, of its exported network."""
    check_name("bundled weights", name, BUNDLED)
    return weights_file(f"{name}{suffix}")


def weights_file(name: str) -> Path:
    """Path of a weights file in the package."""
    return Path(str(resources.files("lidarpose.models") / "weights" / name))


def weights_name(path: Path) -> str:
    """The name of weights in results: that of the file, or of the run whose model.safetensors or best.safetensors it
    is."""
    run = path.resolve().parent.name
    return {"model": run, "best": f"{run}-best"}.get(path.stem, path.stem) or path.stem


def weights_path(weights: str | os.PathLike) -> Path:
    """The path for a name of bundled weights, or the given path. Raises InputError for an unknown name."""
    try:
        name = os.fsdecode(weights)
    except TypeError:
        kind = type(weights).__name__
        raise InputError(f"expected weights as {', '.join(BUNDLED)} or the path of a file, got {kind}") from None
    is_path = not isinstance(weights, str) or "/" in name or name.endswith((".safetensors", ".onnx"))
    # a run's folder is a path, too: reading it says which file to give
    is_path = name not in BUNDLED and (is_path or os.path.exists(name))
    return Path(name) if is_path else bundled_path(name)
