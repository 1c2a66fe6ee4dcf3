"""Weights on disk: one safetensors file that describes itself (see `header`).

Loading is strict: every tensor must be there, no other, each of its shape and finite.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import torch
from safetensors.torch import save as to_bytes

from lidarpose.io.files import file_error, write_atomic
from lidarpose.models.config import NetworkConfig
from lidarpose.models.header import ENTRY, Header, opened, parse_header
from lidarpose.models.posenet import PoseNet

if TYPE_CHECKING:
    from lidarpose.models.dapt.dapt_config import DaptConfig
    from lidarpose.models.dapt.dapt_net import DaptNet

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def save_checkpoint(path: str | os.PathLike, network: PoseNet | DaptNet, *, card: dict, half: bool = False) -> None:
    """Writes the network's weights and its card, whole or not at all; `half` stores them as float16.

    Raises InputError for weights that are not finite, or too large for float16: nothing could load them.
    """
    header = Header(config=network.config, card=card).to_json()
    dtype = torch.float16 if half else torch.float32
    tensors = {
        # counters stay whole numbers
        name: value.detach().to("cpu", dtype if value.is_floating_point() else value.dtype).contiguous()
        for name, value in network.state_dict().items()
    }
    for name, value in tensors.items():
        if not value.isfinite().all():
            kind = str(dtype).removeprefix("torch.")
            raise file_error(path, f"not written, since tensor {name} is not finite as {kind}")
    write_atomic(path, to_bytes(tensors, metadata={ENTRY: header}))


def load_checkpoint(path: str | os.PathLike) -> tuple[PoseNet | DaptNet, Header]:
    """The network in evaluation mode, float32 on the CPU, and its header.

    Raises InputError that names the file and the tensor for anything that does not fit.
    """
    with opened(path, framework="pt") as file:
        header = parse_header(path, (file.metadata() or {}).get(ENTRY))
        name = header.config.size if header.network == "pose" else header.config.name
        stored = set(file.keys())
        wanted = shapes(path, header.config, len(stored), by="its configuration", remedy="get the file again")
        loaded = {}
        for key, value in wanted.items():
            if key not in stored:
                raise file_error(path, f"tensor {key} is missing, so it is no whole {name} network: get the file again")
            shape = tuple(file.get_slice(key).get_shape())
            if shape != tuple(value.shape):
                raise file_error(
                    path,
                    f"tensor {key} should be {tuple(value.shape)} by its configuration, got {shape}: get the file "
                    f"again, or use the lidarpose version that wrote it ({header.version})",
                )
            loaded[key] = as_stored(path, key, file.get_tensor(key), value.dtype)
        extra = sorted(stored - set(wanted))
        if extra:
            raise file_error(
                path,
                f"unknown tensor {extra[0]}, which no {name} network has: use the lidarpose version that wrote it "
                f"({header.version})",
            )
    network = build(header.config)
    network.load_state_dict(loaded)
    return network.eval(), header


def as_stored(path: str | os.PathLike, name: str, tensor: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """A file's tensor in the network's type. Raises InputError for anything but finite floats where it has such."""
    cast = tensor.to(dtype)
    if dtype.is_floating_point and (tensor.dtype not in _FLOATS or not cast.isfinite().all()):
        raise file_error(path, f"tensor {name} holds numbers that are not finite or no floats: get the file again")
    return cast


def shapes(
    path: str | os.PathLike, config: NetworkConfig | DaptConfig, count: int, *, by: str, remedy: str
) -> dict[str, torch.Tensor]:
    """The tensors that a network of a configuration has, none of them in memory: whatever the header of a file of
    `count` tensors says, nothing is allocated for it before the file is known to hold it. Raises InputError, which says
    by what configuration, and what to do."""
    if config.layers > count:
        raise file_error(path, f"has {count} tensors, too few for {config.layers} layers by {by}: {remedy}")
    with torch.device("meta"):
        return build(config).state_dict()


def build(config: NetworkConfig | DaptConfig) -> PoseNet | DaptNet:
    """A network of a configuration, its weights random."""
    if isinstance(config, NetworkConfig):
        return PoseNet(config)
    from lidarpose.models.dapt.dapt_net import DaptNet

    return DaptNet(config)
