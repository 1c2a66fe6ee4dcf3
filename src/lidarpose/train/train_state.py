"""The state of a run on disk, from which it goes on to the same losses: weights, their mean, the optimizers' memory."""

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from lidarpose.errors import InputError
from lidarpose.io.files import write_atomic

# what a state tells of the run besides tensors: steps taken, seconds, error of the best validation or None
_PROGRESS = {"steps", "seconds", "best"}


def save_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer], progress: dict
) -> None:
    """Writes all of it whole or not at all; the last state stays until the new one is complete."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"mean.{name}": value for name, value in mean.items()}
    for k, optimizer in enumerate(optimizers):
        for index, memory in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{k}.{index}.{name}": torch.as_tensor(value) for name, value in memory.items()}
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    write_atomic(path, to_bytes(tensors, metadata={"progress": json.dumps(progress)}))


def load_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer]
) -> dict:
    """Fills network, mean and optimizers in place and returns the progress. Raises InputError where it does not fit."""
    try:
        with safe_open(str(path), framework="pt") as file:
            progress = json.loads((file.metadata() or {})["progress"])
            if missing := _PROGRESS - set(progress):
                raise ValueError(f"it does not tell {', '.join(sorted(missing))}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: expected the state of a run, but it is damaged ({error}): start a new run") from None
    stored_mean = _part(tensors, "mean.")
    try:
        network.load_state_dict(_part(tensors, "network."))
        for name, value in mean.items():
            value.copy_(stored_mean[name])
    except (RuntimeError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: the state is not of this network ({reason}): start a new run") from None
    for k, optimizer in enumerate(optimizers):
        memory: dict[int, dict[str, Tensor]] = {}
        for name, value in _part(tensors, f"optimizer.{k}.").items():
            index, _, entry = name.partition(".")
            memory.setdefault(int(index), {})[entry] = value
        optimizer.load_state_dict(optimizer.state_dict() | {"state": memory})
    return progress


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
