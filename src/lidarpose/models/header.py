"""What a file of weights says of itself, read without torch.

A checkpoint is one safetensors file. Its header's entry "lidarpose" is JSON: schema, package version, the kind of
network, the network's configuration, and "card": what it was trained with (command, seed, people seen) and what it
scores. An exported ONNX file carries the same entry.
"""

import json
import math
import os
import struct
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors import SafetensorError, safe_open

from lidarpose._version import __version__
from lidarpose.errors import InputError, unknown_name
from lidarpose.io.files import file_error
from lidarpose.models.config import NetworkConfig
from lidarpose.skeleton import SKELETONS, Skeleton, skeleton

if TYPE_CHECKING:
    from lidarpose.models.dapt.dapt_config import DaptConfig

ENTRY = "lidarpose"
SCHEMA = "lidarpose.checkpoint/2"
_FAMILY = SCHEMA.rpartition("/")[0]
# kinds of network: this package's own, and the paper's
KINDS = ("pose", "dapt")


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a checkpoint says of itself. card: plain JSON values; version: the package's that wrote it."""

    config: "NetworkConfig | DaptConfig"
    card: dict
    version: str = __version__

    @property
    def network(self) -> str:
        """The kind of network, one of `KINDS`."""
        return "pose" if isinstance(self.config, NetworkConfig) else "dapt"

    @property
    def skeleton(self) -> Skeleton:
        """The joints that the network predicts. Raises InputError for a network whose joints make up no skeleton."""
        if self.network == "pose":
            return skeleton(self.config.skeleton)
        own = set(self.config.joints)
        inside = [one for one in SKELETONS.values() if set(one.joints) <= own]
        if not inside:
            raise InputError(
                f"the network {self.config.name} predicts {', '.join(self.config.joints)}, which hold none of the "
                f"skeletons {', '.join(SKELETONS)}: its joints cannot be drawn or named"
            )
        return max(inside, key=len)

    def to_json(self) -> str:
        entry = {"schema": SCHEMA, "version": self.version, "network": self.network}
        return json.dumps(entry | {"config": self.config.to_dict(), "card": self.card})


def runs_of(card: dict) -> list[dict]:
    """The cards of the runs that made weights: the last one's, that of the weights it began with, and so on."""
    before = card.get("init_card")
    return [card, *(runs_of(before) if isinstance(before, dict) else [])]


def read_header(path: str | os.PathLike) -> Header:
    """The header of a checkpoint. Raises InputError where the file is not a checkpoint of this package."""
    with opened(path) as file:
        return parse_header(path, (file.metadata() or {}).get(ENTRY))


def parameter_count(path: str | os.PathLike) -> int:
    """Numbers that a checkpoint holds. Raises InputError as `read_header` does."""
    with opened(path) as file:
        return sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())


def opened(path: str | os.PathLike, framework: str = "np"):
    """The safetensors file at `path`, to use in a `with`; framework: "np", or "pt" for torch's tensors.

    Raises InputError that names the byte for a file that is cut off or something else.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise file_error(path, f"expected a checkpoint (.safetensors), but it {what}: check the path")
    try:
        return safe_open(str(path), framework=framework)
    except (SafetensorError, OSError, ValueError) as error:
        raise file_error(path, _damage(path, error)) from None


def _damage(path: Path, error: Exception) -> str:
    """What is wrong with a file that safetensors refuses: 8 bytes of a length, so much JSON, then the tensors."""
    again = "it was not copied completely: get it again"
    size = path.stat().st_size
    with open(path, "rb") as file:
        start = file.read(9)
        if size < 8:
            return f"expected a checkpoint (.safetensors), but the file ends at byte {size}: {again}"
        length = struct.unpack("<Q", start[:8])[0]
        if start[8:] not in (b"", b"{") or not 0 < length <= 100_000_000:
            return "expected a checkpoint (.safetensors), but the file is something else: name a checkpoint"
        if size < 8 + length:
            return f"the file ends at byte {size:,}, within its header of {length:,} bytes: {again}"
        file.seek(8)
        try:
            entries = json.loads(file.read(length))
            ends = [entry["data_offsets"][1] for name, entry in entries.items() if name != "__metadata__"]
            due = 8 + length + max(ends, default=0)
            if size != due:
                return f"the file ends at byte {size:,} where its header says {due:,}: {again}"
        except json.JSONDecodeError as broken:
            return f"its header is damaged at byte {8 + broken.pos:,} ({broken.msg}): get the file again"
        except (ValueError, AttributeError, KeyError, IndexError, TypeError, RecursionError):
            pass
    return f"its header is damaged ({error}): get the file again"


def parse_header(path: str | os.PathLike, entry: str | None) -> Header:
    """The header from its JSON entry, None where there is none; `path` names the file in errors. Raises InputError."""
    if entry is None:
        raise file_error(
            path,
            "not a checkpoint of lidarpose (its header has no entry for it): name one that `lidarpose pretrain` wrote; "
            "weights of the released DAPT code come in by `lidarpose import`",
        )
    try:
        header = json.loads(entry)
        if header["schema"] != SCHEMA:
            raise file_error(path, _other_schema(header["schema"], header.get("version")))
        kind = header["network"]
        if kind not in KINDS:
            raise file_error(path, str(unknown_name("kind of network", kind, KINDS)))
        config = _config(path, kind, header["config"])
        version, card = header["version"], header["card"]
        if not isinstance(card, dict):
            raise TypeError(f"card is a {type(card).__name__}")
        return Header(version=str(version), config=config, card=card)
    except InputError:
        raise
    # a number of thousands of digits is a plain ValueError
    except (KeyError, TypeError, AttributeError, RecursionError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise file_error(path, f"its header cannot be read ({reason}): get the file again, or train anew") from None


def _other_schema(schema: object, version: object) -> str:
    got = f"expected schema {SCHEMA}, got {schema}"
    if schema == f"{_FAMILY}/1":
        return (
            f"{got}: written by lidarpose {version}, whose network this version ({__version__}) has replaced: "
            f"use lidarpose {version} for it, or train anew"
        )
    by = f" of lidarpose {version}" if version else ""
    return f"{got}{by}: use the lidarpose version that wrote it (this is {__version__})"


def _config(path: str | os.PathLike, kind: str, entries: dict) -> "NetworkConfig | DaptConfig":
    if not isinstance(entries, dict):
        raise TypeError(f"config is a {type(entries).__name__}")
    if kind == "dapt":
        from lidarpose.models.dapt.dapt_config import DaptConfig as Config
    else:
        Config = NetworkConfig
    extra = sorted(set(entries) - {field.name for field in fields(Config)})
    if extra:
        raise file_error(
            path, f"unknown setting {extra[0]} in its configuration: update lidarpose, a newer version wrote it"
        )
    try:
        return Config(**entries)
    except InputError as error:
        raise file_error(path, f"its configuration does not fit: {error}") from None
