"""Checkpoints: a self-describing safetensors file. Its header is read without torch.

The metadata of a checkpoint hold two entries. "lidarpose" is JSON: schema, package version, the kind of network, the
network's configuration, and "card": how it was trained (command, seed, number of samples) and its scores.
"lidarpose.sha256" is a digest of everything else in the file. An exported ONNX file carries the same entries.

Loading is strict: the digest must match, and the file must hold exactly the expected tensors, each finite and of the
expected shape. Files are read, not memory-mapped: truncating a mapped file would crash the process.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from lidarpose._version import __version__
from lidarpose.errors import InputError, check_name
from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import file_error, read_bytes
from lidarpose.models import NETWORKS
from lidarpose.skeleton import SKELETONS, Skeleton

if TYPE_CHECKING:
    import torch
    from torch import nn

ENTRY, DIGEST = "lidarpose", "lidarpose.sha256"
SCHEMA = "lidarpose.checkpoint/2"
_FAMILY = SCHEMA.rpartition("/")[0]
_EXPECTED = "a checkpoint (.safetensors)"
# last part of the names of tensors that are no parameters: of batch norms and of the authors' heatmap head
_BUFFERS = ("running_mean", "running_var", "num_batches_tracked", "coord_range", "joint_wise_weight")
# largest header that safetensors allows, bytes
_MOST_HEADER = 100_000_000
# end of any tensor in a file, bytes: numbers of thousands of digits cannot be printed
_MOST_BYTES = 1 << 63
_AGAIN = "get the file again"


@dataclass(frozen=True, kw_only=True)
class Header:
    """The description of a checkpoint. config: see `models.NetworkKind`; card: plain JSON values; version: of the
    package that wrote the file."""

    config: Any
    card: dict
    version: str = __version__

    @property
    def network(self) -> str:
        """The kind of network, a key of `models.NETWORKS`."""
        return self.config.kind

    @property
    def skeleton(self) -> Skeleton:
        """The largest skeleton that the network's joints contain. Raises InputError if they contain none."""
        names = self.config.joints
        candidates = [candidate for candidate in SKELETONS.values() if set(candidate.joints) <= set(names)]
        if not candidates:
            raise InputError(
                f"the network {self.config.name} predicts {', '.join(names)}, which contain none of the skeletons "
                f"{', '.join(SKELETONS)}: its joints cannot be drawn or named"
            )
        return max(candidates, key=len)

    def to_json(self) -> str:
        entry = {"schema": SCHEMA, "version": self.version, "network": self.network}
        return json.dumps(entry | {"config": self.config.to_dict(), "card": self.card})


def runs_of(card: dict) -> list[dict]:
    """The cards of all training runs behind the weights: the last run first, then the run that it started from, etc."""
    runs = [card]
    # random initial weights have no card
    while isinstance(init_card := runs[-1].get("init_card"), dict) and init_card:
        runs.append(init_card)
    return runs


# ---- reading and writing


def read_header(path: str | os.PathLike) -> Header:
    """The header of a checkpoint. Raises InputError if the file is not a checkpoint of this package."""
    return parse_header(path, SafetensorsFile.open(path).metadata.get(ENTRY))


def parameter_count(path: str | os.PathLike) -> int:
    """Number of parameters in a checkpoint, as of the network's `parameters()`: without buffers. Raises InputError as
    `read_header` does."""
    shapes = SafetensorsFile.open(path).shapes
    return sum(math.prod(shape) for name, shape in shapes.items() if name.rpartition(".")[2] not in _BUFFERS)


def save_checkpoint(path: str | os.PathLike, network: nn.Module, *, card: dict, half: bool = False) -> None:
    """Writes the network's weights and its card, the whole file or nothing; `half` stores the weights as float16.

    Raises InputError for weights that are not finite or too large for float16: the file could not be loaded.
    """
    import torch
    from safetensors.torch import save

    header = Header(config=network.config, card=card).to_json()
    dtype = torch.float16 if half else torch.float32
    tensors = {
        # counters stay integers
        name: value.detach().to("cpu", dtype if value.is_floating_point() else value.dtype).contiguous()
        for name, value in network.state_dict().items()
    }
    for name, value in tensors.items():
        if not value.isfinite().all():
            kind = str(dtype).removeprefix("torch.")
            raise file_error(path, f"not written, since tensor {name} is not finite as {kind}")
    write_atomic(path, with_digest(save(tensors, metadata={ENTRY: header})))


def load_checkpoint(path: str | os.PathLike) -> tuple[Any, Header]:
    """The network in evaluation mode, float32 on the CPU, and its header.

    Warns about a file without a digest. Raises InputError that names the file and the tensor if anything does not fit.
    """
    file = SafetensorsFile.open(path)
    has_digest = file.check_digest()
    header = parse_header(path, file.metadata.get(ENTRY))
    remedy = f"{_AGAIN}, or use the lidarpose version that wrote it ({header.version})"
    network = file.network(header.config, source=f"its configuration ({header.config.name})", remedy=remedy)
    if not has_digest:
        warn_without_digest(path)
    return network, header


def build(config: Any) -> nn.Module:
    """A network of a configuration, with random weights."""
    return NETWORKS[config.kind].part("network")(config)


@contextmanager
def _float32() -> Iterator[None]:
    """Sets torch's default type to float32 within the context."""
    import torch

    default_type = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(default_type)


@dataclass(frozen=True, kw_only=True)
class SafetensorsFile:
    """A safetensors file, checked to be complete.

    metadata: strings by name; header: the whole JSON header; shapes: of the tensors, by the network's names for them;
    content: the whole file; prefix: of the names in the file.
    """

    path: str | os.PathLike
    header: dict
    content: bytes
    prefix: str = ""

    @classmethod
    def open(cls, path: str | os.PathLike, *, prefix: str = "") -> SafetensorsFile:
        """prefix: removed if all tensor names begin with it. Raises InputError that names the damaged byte."""
        problem = "is a folder" if os.path.isdir(path) else "" if os.path.isfile(path) else "does not exist"
        if problem:
            raise file_error(path, f"expected {_EXPECTED}, but it {problem}: check the path")
        content = read_bytes(path, expected=_EXPECTED)
        header = _parse_safetensors(path, content)
        names = [name for name in header if name != "__metadata__"]
        is_wrapped = prefix and names and all(name.startswith(prefix) for name in names)
        return cls(path=path, header=header, content=content, prefix=prefix if is_wrapped else "")

    @property
    def metadata(self) -> dict[str, str]:
        return self.header.get("__metadata__", {})

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        entries = {name: entry for name, entry in self.header.items() if name != "__metadata__"}
        return {name.removeprefix(self.prefix): tuple(entry["shape"]) for name, entry in entries.items()}

    def check_digest(self) -> bool:
        """Whether the header has a digest. Raises InputError if the digest does not match the content."""
        expected = self.metadata.get(DIGEST)
        if expected not in (None, _digest(self.header, _data_of(self.content))):
            raise file_error(self.path, DAMAGED)
        return expected is not None

    def network(self, config: Any, *, source: str, remedy: str) -> Any:
        """The network of a configuration with the file's tensors, in evaluation mode.

        source: origin of the configuration, for messages; remedy: what to do if it does not fit. Raises InputError for
        the first tensor that is missing, unknown, of another shape, or does not hold finite floats where floats are
        expected. Whatever the configuration requests, nothing is allocated for it before the file is known to hold it.
        """
        import torch

        shapes = self.shapes
        if config.min_tensors > len(shapes):
            problem = f"has {len(shapes)} tensors, too few for the {config.min_tensors} or more of {source}: {remedy}"
            raise file_error(self.path, problem)
        with _float32(), torch.device("meta"):
            expected = build(config).state_dict()
        if missing_names := [name for name in expected if name not in shapes]:
            raise file_error(self.path, f"tensor {missing_names[0]} is missing, but {source} needs it: {remedy}")
        if unknown_names := sorted(shapes.keys() - expected.keys()):
            raise file_error(self.path, f"unknown tensor {unknown_names[0]}, not part of {source}: {remedy}")
        for name, value in expected.items():
            if shapes[name] != tuple(value.shape):
                problem = f"tensor {name} should be {tuple(value.shape)} for {source}, got {shapes[name]}: {remedy}"
                raise file_error(self.path, problem)
        state = self.load(expected)
        # building a network draws random weights: the fork leaves the global random state unchanged
        with _float32(), torch.random.fork_rng(devices=[]):
            network = build(config)
        network.load_state_dict(state)
        return network.eval()

    def load(self, wanted: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The wanted tensors, converted to the given tensors' types. Raises InputError for anything but finite floats
        if a float is wanted."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        try:
            file_tensors = load(self.content)
        except (SafetensorError, ValueError, KeyError) as error:
            raise file_error(self.path, f"its header is damaged ({error}): {_AGAIN}") from None
        tensors = {}
        for name, template in wanted.items():
            value = file_tensors[self.prefix + name]
            tensors[name] = value.to(template.dtype)
            is_float = value.is_floating_point() or not template.is_floating_point()
            if not is_float or not tensors[name].isfinite().all():
                raise file_error(self.path, f"tensor {name} holds values that are not finite or not floats: {_AGAIN}")
        return tensors


def _parse_safetensors(path: str | os.PathLike, content: bytes) -> dict:
    """The header of a file, which consists of 8 bytes of header length, the header as JSON, and the tensors. Raises
    InputError with the problem and its position."""
    remedy = "it was not copied completely: get it again"
    size = len(content)
    if size < 8:
        raise file_error(path, f"expected {_EXPECTED}, but the file ends at byte {size}: {remedy}")
    length = struct.unpack("<Q", content[:8])[0]
    if content[8:9] not in (b"", b"{") or not 0 < length <= _MOST_HEADER:
        raise file_error(path, f"expected {_EXPECTED}, but the file is something else: give a file of weights")
    if size < 8 + length:
        raise file_error(path, f"the file ends at byte {size:,}, within its header of {length:,} bytes: {remedy}")
    end = 0
    try:
        header = json.loads(content[8 : 8 + length])
        metadata = header.get("__metadata__", {})
        if not all(isinstance(text, str) for text in metadata.values()):
            raise TypeError("metadata that are not text")
        for name, entry in header.items():
            if name != "__metadata__":
                start, stop = entry["data_offsets"]
                is_valid = all(isinstance(n, int) and n >= 0 for n in (start, stop - start, *entry["shape"]))
                # no type of number takes less than a byte
                if not is_valid or math.prod(entry["shape"]) > stop - start or stop > _MOST_BYTES:
                    raise ValueError(f"tensor {name}")
                end = max(end, stop)
    except json.JSONDecodeError as error:
        raise file_error(path, f"its header is damaged at byte {8 + error.pos:,} ({error.msg}): {_AGAIN}") from None
    except (ValueError, AttributeError, KeyError, IndexError, TypeError, RecursionError) as error:
        raise file_error(path, f"its header is damaged ({error}): {_AGAIN}") from None
    if size != 8 + length + end:
        problem = f"the file ends at byte {size:,}, but its header says {8 + length + end:,}: {remedy}"
        raise file_error(path, problem)
    return header


# ---- digests

DAMAGED = "is damaged: its content does not match the SHA-256 digest in its header: get the file again"


def warn_without_digest(path: str | os.PathLike) -> None:
    """Warns that a weights file was written before digests were introduced."""
    remedy = "if it may be damaged, get it again or write it anew with this version"
    warnings.warn(f"{os.fspath(path)}: has no digest, so damage goes unnoticed: {remedy}", stacklevel=3)


def with_digest(content: bytes) -> bytes:
    """Adds a digest of the tensors and of the rest of the header to the metadata of a safetensors file."""
    data = _data_of(content)
    header = json.loads(content[8 : len(content) - len(data)])
    header["__metadata__"] = header.get("__metadata__", {}) | {DIGEST: _digest(header, data)}
    text = json.dumps(header, separators=(",", ":")).encode()
    # tensors must begin at a multiple of 8
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + bytes(data)


def _data_of(content: bytes) -> memoryview:
    return memoryview(content)[8 + struct.unpack("<Q", content[:8])[0] :]


def _digest(header: dict, data: memoryview) -> str:
    metadata = {name: text for name, text in header.get("__metadata__", {}).items() if name != DIGEST}
    header_json = json.dumps(header | {"__metadata__": metadata}, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(header_json.encode())
    digest.update(data)
    return digest.hexdigest()


# ---- the header's own entry


def parse_header(path: str | os.PathLike, entry: str | None) -> Header:
    """The header from its JSON entry, None if the file has none; `path` names the file in errors. Raises InputError."""
    if entry is None:
        raise file_error(
            path,
            "not a checkpoint of lidarpose (its header has no entry for it): give one that `lidarpose pretrain` wrote, "
            "or convert weights of the released DAPT code with `lidarpose import`",
        )
    try:
        header = json.loads(entry)
        schema, version = header["schema"], header.get("version")
        if schema != SCHEMA:
            writer = f" of lidarpose {version}" if version else ""
            remedy = f"use the lidarpose version that wrote it (this is {__version__})"
            if schema == f"{_FAMILY}/1":
                remedy = f"this version ({__version__}) has replaced that network: use lidarpose {version} for it, "
                remedy += "or train anew"
            raise InputError(f"expected schema {SCHEMA}, got {schema}{writer}: {remedy}")
        check_name("kind of network", header["network"], NETWORKS)
        config_class = NETWORKS[header["network"]].part("config")
        entries, card = header["config"], header["card"]
        for name, value in (("config", entries), ("card", card)):
            if not isinstance(value, dict):
                raise TypeError(f"{name} is a {type(value).__name__}")
        entries = config_class.renamed(entries)
        if unknown_settings := sorted(set(entries) - {field.name for field in fields(config_class)}):
            raise InputError(f"unknown setting {unknown_settings[0]}: update lidarpose, a newer version wrote it")
        return Header(version=str(header["version"]), config=config_class(**entries), card=card)
    except InputError as error:
        raise file_error(path, f"its header does not fit: {error}") from None
    # an integer with thousands of digits raises a plain ValueError
    except (KeyError, TypeError, AttributeError, RecursionError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise file_error(path, f"its header cannot be read ({reason}): {_AGAIN}, or train anew") from None
