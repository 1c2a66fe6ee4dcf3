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


@dataclass(frozen=True, kw_only=True)
class NetworkKind:
    """Where the parts of a kind of network are defined, as "module:name": they are imported when first needed.

    config: a frozen dataclass of plain values with `kind` (its key in `NETWORKS`), `name` (for messages), `joints`
    (names, in the order of the outputs), `layers` (a lower bound of its tensors) and `to_dict`, which raises InputError
    for what cannot be; network: a module made from the config alone, which it keeps as `config`; objective: a
    `train.objectives.objective.Objective`; backend: called with (network, header, device=, compile=), an
    `inference.backend.Backend`.
    """

    config: str
    network: str
    objective: str
    backend: str

    def part(self, name: str) -> Any:
        """The class that `config`, `network`, `objective` or `backend` names."""
        module, _, attribute = getattr(self, name).partition(":")
        return getattr(import_module(module), attribute)


# by the name that checkpoints give: this package's own, the paper's, and its baselines
NETWORKS = {
    "pose": NetworkKind(
        config="lidarpose.models.config:NetworkConfig",
        network="lidarpose.models.posenet:PoseNet",
        objective="lidarpose.train.objectives.posenet_objective:PoseNetObjective",
        backend="lidarpose.inference.torch_backend:TorchBackend",
    ),
    "dapt": NetworkKind(
        config="lidarpose.models.dapt.dapt_config:DaptConfig",
        network="lidarpose.models.dapt.dapt_net:DaptNet",
        objective="lidarpose.train.objectives.dapt_objective:DaptObjective",
        backend="lidarpose.inference.torch_backend:DaptBackend",
    ),
    # those that the paper compares with
    "prn": NetworkKind(
        config="lidarpose.models.baselines.baseline_config:PrnConfig",
        network="lidarpose.models.baselines.prn:Prn",
        objective="lidarpose.train.objectives.baseline_objective:BaselineObjective",
        backend="lidarpose.inference.torch_backend:BaselineBackend",
    ),
    "lpformer": NetworkKind(
        config="lidarpose.models.baselines.baseline_config:LpformerConfig",
        network="lidarpose.models.baselines.lpformer:Lpformer",
        objective="lidarpose.train.objectives.baseline_objective:BaselineObjective",
        backend="lidarpose.inference.torch_backend:BaselineBackend",
    ),
    "lidarcap": NetworkKind(
        config="lidarpose.models.baselines.baseline_config:LidarcapConfig",
        network="lidarpose.models.baselines.lidarcap:Lidarcap",
        objective="lidarpose.train.objectives.clip_objective:ClipObjective",
        backend="lidarpose.inference.torch_backend:ClipBackend",
    ),
    "ne": NetworkKind(
        config="lidarpose.models.baselines.baseline_config:NeConfig",
        network="lidarpose.models.baselines.ne:Ne",
        objective="lidarpose.train.objectives.clip_objective:ClipObjective",
        backend="lidarpose.inference.torch_backend:ClipBackend",
    ),
    # finds people and poses nobody
    "detector": NetworkKind(
        config="lidarpose.models.detector.detector_config:DetectorConfig",
        network="lidarpose.models.detector.network:DetectorNet",
        objective="lidarpose.train.objectives.detector_objective:DetectorObjective",
        backend="lidarpose.inference.torch_backend:no_poses",
    ),
}

BUNDLED = ("tiny", "small")
# what is taken where nothing is named: the best whose two files are at most 6 MB
DEFAULT = "small"
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
