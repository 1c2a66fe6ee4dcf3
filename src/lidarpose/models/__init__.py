"""The kinds of network, and the weights that ship with them: their names, and where they lie. No torch, no numpy here.

A further network is a module that holds it and its configuration, an objective that trains it, a backend that runs it,
and an entry in `NETWORKS`. Its checkpoints then are written, read and checked as all others.
"""

import os
from dataclasses import dataclass
from importlib import import_module, resources
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError, check_name


@dataclass(frozen=True)
class NetworkKind:
    """Where the parts of a kind of network are defined, as "module:name": they are imported when first needed.

    config: a `models.config.Config` with `kind` (its key in `NETWORKS`), `name` (for messages), `joints` (names, in the
    order of the outputs) and `layers` (a lower bound of its tensors), which raises InputError for what cannot be;
    network: a module made from the config alone, which it keeps as `config`; objective: a
    `train.objectives.objective.Objective`; backend: called with (network, header, device=, compile=), an
    `inference.backend.Backend`.
    """

    config: str
    network: str
    objective: str
    backend: str

    def part(self, name: str) -> Any:
        """The class that `config`, `network`, `objective` or `backend` names."""
        folder = {"objective": "train.objectives", "backend": "inference"}.get(name, "models")
        module, _, attribute = getattr(self, name).partition(":")
        return getattr(import_module(f"lidarpose.{folder}.{module}"), attribute)


def _baseline(name: str, objective: str, backend: str) -> NetworkKind:
    config = f"baselines.baseline_config:{name}Config"
    return NetworkKind(config, f"baselines.{name.lower()}:{name}", objective, f"torch_backend:{backend}")


_FRAMES = ("baseline_objective:BaselineObjective", "BaselineBackend")
_CLIPS = ("baseline_objective:ClipObjective", "ClipBackend")
# by the name that checkpoints give, modules of `models`, `train.objectives` and `inference`: this package's own, the
# paper's, those that the paper compares with, and one that finds people and poses nobody
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
# what is taken where nothing is named: the best whose two files are at most 6 MB
DEFAULT = "small"
# the network that tells people from what the detector takes for people; it poses nobody
VERIFIER = "verifier"
# the same, for help texts
NAMES = ", ".join(f"{name} (default)" if name == DEFAULT else name for name in BUNDLED)


def bundled_path(name: str = DEFAULT, suffix: str = ".safetensors") -> Path:
    """Where the package keeps a bundled checkpoint, or with the suffix .onnx its exported twin."""
    check_name("bundled weights", name, BUNDLED)
    return weights_file(f"{name}{suffix}")


def weights_file(name: str) -> Path:
    """Where the package keeps a file of weights."""
    return Path(str(resources.files("lidarpose.models") / "weights" / name))


def weights_path(weights: str | os.PathLike) -> Path:
    """The file that a name of bundled weights or a path means. Raises InputError for an unknown name."""
    try:
        name = os.fsdecode(weights)
    except TypeError:
        kind = type(weights).__name__
        raise InputError(f"expected weights as {', '.join(BUNDLED)} or the path of a file, got {kind}") from None
    is_path = not isinstance(weights, str) or "/" in name or name.endswith((".safetensors", ".onnx"))
    is_path = name not in BUNDLED and (is_path or os.path.isfile(name))
    return Path(name) if is_path else bundled_path(name)
