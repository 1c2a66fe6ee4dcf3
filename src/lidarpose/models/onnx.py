"""How an exported network lies in an ONNX file, and how ONNX Runtime opens it. No torch.

Inputs are a pyramid's arrays, "fine.position" by the name "in_fine_position": a bare "view" would be the name of a node
too. Numbers of people and of rows are free. The file's metadata hold the checkpoint's header, the SHA-256 of the
checkpoint that it was made from, and a digest: the SHA-256 of the file with zeros in the digest's place.
"""

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_int
from lidarpose.io.files import file_error, one_line, read_bytes
from lidarpose.models.checkpoint import DAMAGED, DIGEST, ENTRY, Header, parse_header, warn_without_digest
from lidarpose.models.config import NetworkConfig
from lidarpose.models.voxelize import VoxelPyramid, voxelize

SOURCE = "lidarpose.source"
# what stands for a digest while it is computed
NO_DIGEST = "0" * 64
# a tensor in a file of its own: the key of where that lies, as protocol buffers write it
_EXTERNAL = b"\n\x08location\x12"
# what every network gives, in this order
OUTPUTS = ("vote", "heatmap", "part", "confidence", "log_spread", "visible")
# a network this small only waits for more threads than that
_MOST_THREADS = 8
# more are a mistake
_THREADS_LIMIT = 1024


def voxelize_people(clouds: list[np.ndarray], view: np.ndarray | None, config: NetworkConfig) -> VoxelPyramid:
    """The voxels of people's clouds (n, 3) m, each about its person's center, as `config` wants it; view (B, 5)."""
    return voxelize(
        np.concatenate([np.zeros((0, 3)), *clouds]),
        np.array([len(cloud) for cloud in clouds], np.int64),
        grid=config.grid,
        max_voxels=config.max_voxels,
        view=view,
        neighbors=config.convolution > 0,
    )


def input_name(name: str) -> str:
    """ "fine.position" -> "in_fine_position"."""
    # as spelled in files that are out there
    return "in_" + name.replace(".", "_").replace("neighbors", "neighbours")


def usable_threads() -> int:
    """Processors that this process may use, `_MOST_THREADS` at the most, and what OMP_NUM_THREADS says."""
    # macOS and Windows cannot be asked
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # a list is of nested regions, the outermost first
    bound = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    most = int(bound) if bound.isascii() and bound.isdecimal() else 0
    return min(processors, _MOST_THREADS, most or _MOST_THREADS)


def thread_count(threads: int | None) -> int:
    """So many threads, `usable_threads` for None. Raises InputError for a number that is none or far too large."""
    return usable_threads() if threads is None else check_int("threads", threads, least=1, most=_THREADS_LIMIT)


def map_in_threads(function: Callable, parts: Sequence, threads: int) -> list:
    """What a function makes of each part, several at once on so many threads.

    They last for the call: threads that stayed would not be there in a process forked later.
    """
    count = min(threads, len(parts))
    if count < 2:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, parts))


def runtime() -> ModuleType:
    """The module onnxruntime, without its telemetry. Raises InputError where it cannot be loaded, as for want of a
    system library."""
    # read when it is loaded: else it notes machine and process in ~/.cache and sends that to its maker
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        return import_module("onnxruntime")
    except (ImportError, OSError) as error:
        # its extension makes one of Ctrl-C
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        remedy = "reinstall it, pip install --force-reinstall onnxruntime"
        raise InputError(one_line(f"ONNX Runtime cannot be loaded ({error}): {remedy}")) from None


def open_session(content: bytes):
    """An `onnxruntime.InferenceSession` of a file's content, whose runs take one thread each and may be several at
    once. Raises what ONNX Runtime does."""
    module = runtime()
    settings = module.SessionOptions()
    # networks this small gain little from several threads for one run, and much from several runs at once
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    # what is wrong is raised; the log would add lines of its own
    settings.log_severity_level = 4
    return module.InferenceSession(content, settings, providers=["CPUExecutionProvider"])


def open_onnx(path: str | os.PathLike) -> tuple[Any, Header, str]:
    """The session of an exported network, its header, and the digest of the checkpoint that it was made from.

    Raises InputError as `open_network` does, and for a file that holds no network of poses.
    """
    session, header = open_network(path)
    if not isinstance(header.config, NetworkConfig):
        raise file_error(path, f"expected a network of the kind pose, got {header.network}: use its .safetensors")
    check_names(path, session, expected_inputs(header.config), output_names(header.config))
    return session, header, session.get_modelmeta().custom_metadata_map.get(SOURCE, "")


def open_network(path: str | os.PathLike) -> tuple[Any, Header]:
    """The session of an exported network of any kind, and its header.

    Warns of a file without a digest. Raises InputError, one line, for a file that is damaged, cut off, something else,
    another program's ONNX, or one that keeps its weights elsewhere.
    """
    content = read_bytes(path, expected="an ONNX file (.onnx)")
    if _EXTERNAL in content:
        # they would be looked up in the current folder, whatever lies there
        raise file_error(path, "keeps its weights in other files: make one file of it with `lidarpose export`")
    # a checkpoint begins with the length of its header in JSON
    if content[8:9] == b"{":
        raise file_error(path, "expected an ONNX file, got a checkpoint: make one of it with `lidarpose export`")
    has_digest = check_digest(path, content)
    # what is wrong with it is not the file's fault
    runtime()
    try:
        session = open_session(content)
    except Exception as error:
        # its exceptions have no base of their own
        reason = " ".join(str(error).split())[:120]
        raise file_error(
            path,
            f"expected an ONNX file, but its {len(content):,} bytes are damaged, cut off or something else ({reason}): "
            "get it again, or make it anew with `lidarpose export`",
        ) from None
    header = parse_header(path, session.get_modelmeta().custom_metadata_map.get(ENTRY))
    if not has_digest:
        warn_without_digest(path)
    return session, header


def check_names(path: str | os.PathLike, session: Any, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raises InputError unless a session reads and gives arrays of these names."""
    for kind, values, expected in (
        ("input", session.get_inputs(), inputs),
        ("output", session.get_outputs(), outputs),
    ):
        if mismatches := sorted({value.name for value in values} ^ set(expected)):
            problem = "is missing" if mismatches[0] in expected else "is unknown"
            remedy = "make the file anew with `lidarpose export` of this version"
            raise file_error(path, f"{kind} {mismatches[0]} {problem}: {remedy}")


def with_digest(content: bytes) -> bytes:
    """An ONNX file whose entry `DIGEST` is `NO_DIGEST`, with the digest there."""
    start = _digest_start(content)
    return content[:start] + _digest(content, start) + content[start + len(NO_DIGEST) :]


def check_digest(path: str | os.PathLike, content: bytes) -> bool:
    """Whether a file has a digest. Raises InputError where it is not the content's."""
    start = _digest_start(content)
    if start and content[start : start + len(NO_DIGEST)] != _digest(content, start):
        raise file_error(path, DAMAGED)
    return start > 0


def _digest_start(content: bytes) -> int:
    """Where the digest begins, 0 where there is none: a key, a tag and a length of one byte each, then its digits."""
    key = DIGEST.encode()
    key_start = content.rfind(key)
    return key_start + len(key) + 2 if key_start >= 0 else 0


def _digest(content: bytes, start: int) -> bytes:
    digest = hashlib.sha256(memoryview(content)[:start])
    digest.update(NO_DIGEST.encode())
    digest.update(memoryview(content)[start + len(NO_DIGEST) :])
    return digest.hexdigest().encode()


def output_names(config: NetworkConfig) -> tuple[str, ...]:
    """What an exported network gives, in this order."""
    return (*OUTPUTS, "person") if config.person else OUTPUTS


def expected_inputs(config: NetworkConfig) -> list[str]:
    """Names of an exported network's inputs."""
    return [input_name(name) for name in voxelize_people([np.zeros((1, 3))], None, config).arrays()]
