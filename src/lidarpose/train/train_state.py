"""The state of a run on disk, from which it goes on to the same losses: weights, their mean, the optimizers' memory."""

import json
from math import inf
from pathlib import Path
from types import NoneType

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from lidarpose.errors import InputError
from lidarpose.io.files import write_atomic
from lidarpose.train.muon import Muon

# progress of a run besides tensors: steps taken, seconds, error of the best and of the last validation in mm or None
_ERROR = (int, float, NoneType)
_PROGRESS = {"steps": (int,), "seconds": (int, float), "best": _ERROR, "validation": _ERROR}
# entries that an optimizer cannot go on without
MEMORY = {torch.optim.AdamW: ("step", "exp_avg", "exp_avg_sq"), Muon: ("momentum_buffer",)}


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
        # read, not mapped: a mapped file that is cut off meanwhile would end the process
        content = path.read_bytes()
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        progress = json.loads(header["__metadata__"]["progress"])
        # states of 0.1 lack the last validation
        progress.setdefault("validation", None)
        for entry, types in _PROGRESS.items():
            value = progress.get(entry)
            if entry not in progress or type(value) not in types or value is not None and not 0 <= value < inf:
                raise ValueError(f"its {entry} is {value!r}")
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
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
        optimizer.load_state_dict(optimizer.state_dict() | {"state": _memory(path, tensors, k, optimizer)})
    return progress


def _memory(
    path: Path, tensors: dict[str, Tensor], k: int, optimizer: torch.optim.Optimizer
) -> dict[int, dict[str, Tensor]]:
    """What optimizer k remembers of each parameter. Raises InputError where an entry lacks or has another shape."""
    memory: dict[int, dict[str, Tensor]] = {}
    try:
        for name, value in _part(tensors, f"optimizer.{k}.").items():
            index, _, entry = name.partition(".")
            memory.setdefault(int(index), {})[entry] = value
        for index, parameter in enumerate(p for group in optimizer.param_groups for p in group["params"]):
            # a parameter without a gradient so far has no memory
            for entry in MEMORY[type(optimizer)] if index in memory else ():
                shape = memory[index][entry].shape
                if entry != "step" and shape != parameter.shape:
                    raise ValueError(f"{entry} of parameter {index} has the shape {tuple(shape)}")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: the optimizer's memory is damaged ({error}): start a new run") from None
    return memory


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
