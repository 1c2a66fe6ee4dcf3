"""Weights on disk: one safetensors file that describes itself.

The header's entry "lidarpose" is JSON: schema, package version, the network's configuration, and "card": what it was
trained with (command, seed, people seen) and what it scores. Loading is strict: every tensor must be there, no other.
"""

import json
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from lidarpose._version import __version__
from lidarpose.data.files import write_atomic
from lidarpose.errors import InputError
from lidarpose.model.network import PoseNet
from lidarpose.model.presets import NetworkConfig

SCHEMA = "lidarpose.checkpoint/1"


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a checkpoint says of itself. card: plain JSON values."""

    version: str
    config: NetworkConfig
    card: dict


def save_checkpoint(path: str | Path, network: PoseNet, *, card: dict, half: bool = False) -> None:
    """Writes the network's weights and its card, whole or not at all; `half` stores them as float16."""
    dtype = torch.float16 if half else torch.float32
    tensors = {name: value.detach().to("cpu", dtype).contiguous() for name, value in network.state_dict().items()}
    header = {"schema": SCHEMA, "version": __version__, "config": network.config.to_dict(), "card": card}
    write_atomic(path, to_bytes(tensors, metadata={"lidarpose": json.dumps(header)}))


def read_header(path: str | Path) -> Header:
    """The header alone. Raises InputError where the file is not a checkpoint of this package."""
    with _opened(path) as file:
        return _header(path, file)


def load_checkpoint(path: str | Path) -> tuple[PoseNet, Header]:
    """The network in evaluation mode, float32 on the CPU, and its header.

    Raises InputError that names the file and the tensor for anything that does not fit.
    """
    with _opened(path) as file:
        header = _header(path, file)
        network = PoseNet(header.config)
        wanted = network.state_dict()
        stored = set(file.keys())
        for name, value in wanted.items():
            if name not in stored:
                raise InputError(f"{path}: tensor {name} is missing, so it is no whole {header.config.size} network")
            shape = tuple(file.get_slice(name).get_shape())
            if shape != tuple(value.shape):
                raise InputError(f"{path}: tensor {name} should be {tuple(value.shape)}, got {shape}")
        extra = sorted(stored - set(wanted))
        if extra:
            raise InputError(f"{path}: unknown tensor {extra[0]}: written by another version ({header.version})?")
        network.load_state_dict({name: file.get_tensor(name).float() for name in wanted})
    return network.eval(), header


def _opened(path: str | Path):
    path = Path(path)
    if not path.is_file():
        what = "is a directory" if path.is_dir() else "does not exist"
        raise InputError(f"{path}: expected a checkpoint (.safetensors), but it {what}")
    try:
        return safe_open(str(path), framework="pt")
    except (SafetensorError, OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: expected a safetensors file, but it is damaged or something else ({reason})"
        ) from None


def _header(path: str | Path, file) -> Header:
    raw = (file.metadata() or {}).get("lidarpose")
    if raw is None:
        raise InputError(
            f"{path}: a safetensors file, but not a checkpoint of lidarpose (its header has no entry for it)"
        )
    try:
        header = json.loads(raw)
        schema = header["schema"]
        if schema != SCHEMA:
            raise InputError(f"{path}: expected schema {SCHEMA}, got {schema}: use the lidarpose version that wrote it")
        known = {field.name for field in fields(NetworkConfig)}
        extra = set(header["config"]) - known
        if extra:
            raise InputError(
                f"{path}: unknown setting {sorted(extra)[0]} in its configuration: written by a newer version?"
            )
        config = _config(path, header["config"])
        return Header(version=header["version"], config=config, card=header["card"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: its header cannot be read ({type(error).__name__}: {error})") from None


def _config(path: str | Path, entries: dict) -> NetworkConfig:
    try:
        return NetworkConfig(**entries)
    except InputError as error:
        raise InputError(f"{path}: its configuration does not fit: {error}") from None
