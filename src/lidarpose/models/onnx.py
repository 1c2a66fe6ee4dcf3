"""The layout of an exported network in an ONNX file, and how ONNX Runtime opens it. No torch.

Inputs are the arrays of a pyramid; "fine.position" is named "in_fine_position", since a bare "view" would also be the
name of a node. The numbers of people and of rows are dynamic. The file's metadata hold the checkpoint's header, the
SHA-256 of the source checkpoint, and a digest: the SHA-256 of the file with zeros in the digest's place.
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
# placeholder for the digest while it is computed
NO_DIGEST = "0" * 64
# marks a tensor in an external file: the key of its location, as protocol buffers encode it
_EXTERNAL = b"\n\x08location\x12"
# outputs of every network, in this order
OUTPUTS = ("vote", "heatmap", "part", "confidence", "log_spread", "visible")
# a network this small does not run faster on more threads than this
_MOST_THREADS = 8
# a larger number must be a mistake
_THREADS_LIMIT = 1024


def voxelize_people(clouds: list[np.ndarray], view: np.ndarray | None, config: NetworkConfig) -> VoxelPyramid:
    """Voxelizes clouds (n, 3) m, each centered on its person, with the settings of `config`; view (B, 5)."""
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
    # the spelling in files that are already exported
    return "in_" + name.replace(".", "_").replace("neighbors", "neighbours")


def usable_threads() -> int:
    """Number of processors that this process may use, at most `_MOST_THREADS` and at most OMP_NUM_THREADS."""
    # macOS and Windows do not report the processors of a process
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # a list has one entry per level of nested regions, the outermost first
    bound = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    most = int(bound) if bound.isascii() and bound.isdecimal() else 0
    return min(processors, _MOST_THREADS, most or _MOST_THREADS)


def thread_count(threads: int | None) -> int:
    """The given number of threads, `usable_threads` for None. Raises InputError unless it is 1 to `_THREADS_LIMIT`."""
    return usable_threads() if threads is None else check_int("threads", threads, least=1, most=_THREADS_LIMIT)


def map_in_threads(function: Callable, parts: Sequence, threads: int) -> list:
    """Applies a function to each part, on up to the given number of threads; results are in the order of the parts.

    The threads end with the call: persistent threads would not exist in a process that is forked later.
    """
    count = min(threads, len(parts))
    if count < 2:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, parts))


def runtime() -> ModuleType:
    """The module onnxruntime, with its telemetry disabled. Raises InputError if it cannot be loaded, for example
    because a system library is missing."""
    # read on import: otherwise it records machine and process in ~/.cache and sends that to its vendor
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        return import_module("onnxruntime")
    except (ImportError, OSError) as error:
        # its extension module turns Ctrl-C into such an error
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        remedy = "reinstall it, pip install --force-reinstall onnxruntime"
        raise InputError(one_line(f"ONNX Runtime cannot be loaded ({error}): {remedy}")) from None


def open_session(content: bytes):
    """An `onnxruntime.InferenceSession` of a file's content. Each run uses one thread, and several may run at once.
    Raises the exceptions of ONNX Runtime."""
    module = runtime()
    settings = module.SessionOptions()
    # networks this small gain little from several threads per run, and much from several concurrent runs
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    # errors are raised; the log would only repeat them
    settings.log_severity_level = 4
    return module.InferenceSession(content, settings, providers=["CPUExecutionProvider"])


def open_onnx(path: str | os.PathLike) -> tuple[Any, Header, str]:
    """The session of an exported network, its header, and the digest of its source checkpoint.

    Raises InputError as `open_network` does, and for a network of another kind than pose.
    """
    session, header = open_network(path)
    if not isinstance(header.config, NetworkConfig):
        raise file_error(path, f"expected a network of the kind pose, got {header.network}: use its .safetensors")
    check_names(path, session, expected_inputs(header.config), output_names(header.config))
    return session, header, session.get_modelmeta().custom_metadata_map.get(SOURCE, "")


def open_network(path: str | os.PathLike) -> tuple[Any, Header]:
    """The session of an exported network of any kind, and its header.

    Warns about a file without a digest. Raises InputError, one line, for a file that is damaged, truncated, not ONNX,
    another program's ONNX, or that stores its weights in external files.
    """
    content = read_bytes(path, expected="an ONNX file (.onnx)")
    if _EXTERNAL in content:
        # those would be read from the current folder, whatever it contains
        raise file_error(path, "keeps its weights in other files: make a single file with `lidarpose export`")
    # a checkpoint begins with 8 bytes of length, followed by its JSON header
    if content[8:9] == b"{":
        raise file_error(path, "expected an ONNX file, got a checkpoint: convert it with `lidarpose export`")
    has_digest = check_digest(path, content)
    # outside the try: if ONNX Runtime cannot be loaded, the file is not at fault
    runtime()
    try:
        session = open_session(content)
    except Exception as error:
        # ONNX Runtime's exceptions have no base class of their own
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
    """Raises InputError unless the inputs and outputs of a session have exactly these names."""
    for kind, values, expected in (("input", session.get_inputs(), inputs), ("output", session.get_outputs(), outputs)):
        if mismatches := sorted({value.name for value in values} ^ set(expected)):
            problem = "is missing" if mismatches[0] in expected else "is unknown"
            remedy = "make the file anew with `lidarpose export` of this version"
            raise file_error(path, f"{kind} {mismatches[0]} {problem}: {remedy}")


def with_digest(content: bytes) -> bytes:
    """Replaces `NO_DIGEST` in the entry `DIGEST` of an ONNX file with the file's digest."""
    start = _digest_start(content)
    return content[:start] + _digest(content, start) + content[start + len(NO_DIGEST) :]


def check_digest(path: str | os.PathLike, content: bytes) -> bool:
    """Whether a file has a digest. Raises InputError if the digest does not match the content."""
    start = _digest_start(content)
    if start and content[start : start + len(NO_DIGEST)] != _digest(content, start):
        raise file_error(path, DAMAGED)
    return start > 0


def _digest_start(content: bytes) -> int:
    """Offset of the digest, 0 without one. It follows its key, a tag of one byte and a length of one byte."""
    key = DIGEST.encode()
    key_start = content.rfind(key)
    return key_start + len(key) + 2 if key_start >= 0 else 0


def _digest(content: bytes, start: int) -> bytes:
    digest = hashlib.sha256(memoryview(content)[:start])
    digest.update(NO_DIGEST.encode())
    digest.update(memoryview(content)[start + len(NO_DIGEST) :])
    return digest.hexdigest().encode()


def output_names(config: NetworkConfig) -> tuple[str, ...]:
    """Names of an exported network's outputs, in order."""
    return (*OUTPUTS, "person") if config.person else OUTPUTS


def expected_inputs(config: NetworkConfig) -> list[str]:
    """Names of an exported network's inputs."""
    return [input_name(name) for name in voxelize_people([np.zeros((1, 3))], None, config).arrays()]
