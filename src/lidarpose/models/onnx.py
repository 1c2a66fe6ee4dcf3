"""How an exported network lies in an ONNX file, and how ONNX Runtime opens it. No torch.

Inputs are the plan's arrays, "fine.position" by the name "in_fine_position": a bare "view" would be the name of a node
too. Numbers of people and of rows are free. The file's metadata hold the checkpoint's header, and the SHA-256 of the
checkpoint that it was made from.
"""

import os
from importlib import import_module

import numpy as np

from lidarpose.errors import InputError
from lidarpose.io.files import file_error, one_line, read_bytes
from lidarpose.models.config import NetworkConfig
from lidarpose.models.header import ENTRY, Header, parse_header
from lidarpose.models.voxelize import Plan, plan

SOURCE = "lidarpose.source"
# what a network gives, in this order
OUTPUTS = ("vote", "heatmap", "part", "confidence", "log_spread", "visible")
# a network this small only waits for more threads than that
_MOST_THREADS = 8


def network_inputs(tables: Plan) -> dict[str, np.ndarray]:
    """The arrays of a plan that a network reads, by dotted name, in the order that networks take them."""
    arrays = tables.arrays()
    # which voxel a point fell into: for who has parts to bring back to points
    del arrays["point_voxel"]
    return arrays


def plan_people(clouds: list[np.ndarray], view: np.ndarray | None, config: NetworkConfig) -> Plan:
    """The plan of people's clouds (n, 3) m, each about its person's center, as `config` wants it; view (B, 5)."""
    return plan(
        np.concatenate([np.zeros((0, 3)), *clouds]),
        np.array([len(cloud) for cloud in clouds], np.int64),
        grid=config.grid,
        max_voxels=config.max_voxels,
        view=view,
        neighbours=config.convolution > 0,
    )


def input_name(name: str) -> str:
    """ "fine.position" -> "in_fine_position"."""
    return "in_" + name.replace(".", "_")


def usable_threads() -> int:
    """Processors that this process may use, `_MOST_THREADS` at the most."""
    try:
        usable = len(os.sched_getaffinity(0))
    except AttributeError:
        # macOS and Windows cannot be asked
        usable = os.cpu_count() or 1
    return min(usable, _MOST_THREADS)


def _runtime():
    """The module onnxruntime. Raises InputError where it cannot be loaded, as for want of a system library."""
    try:
        return import_module("onnxruntime")
    except (ImportError, OSError) as error:
        # its extension makes one of Ctrl-C
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        remedy = "reinstall it, pip install --force-reinstall onnxruntime"
        raise InputError(one_line(f"ONNX Runtime cannot be loaded ({error}): {remedy}")) from None


def open_session(content: bytes, *, threads: int | None = None):
    """An `onnxruntime.InferenceSession` of a file's content. Raises what ONNX Runtime does."""
    runtime = _runtime()
    settings = runtime.SessionOptions()
    # set in any case: left alone it would pin threads to processors, which a container may forbid
    settings.intra_op_num_threads = usable_threads() if threads is None else threads
    settings.inter_op_num_threads = 1
    # what is wrong is raised; the log would add lines of its own
    settings.log_severity_level = 4
    return runtime.InferenceSession(content, settings, providers=["CPUExecutionProvider"])


def open_onnx(path: str | os.PathLike, *, threads: int | None = None) -> tuple[object, Header, str]:
    """The session of an exported network, its header, and the digest of the checkpoint that it was made from.

    Raises InputError, one line, for a file that is cut off, something else, or another program's ONNX.
    """
    content = read_bytes(path, expected="an ONNX file (.onnx)")
    # what is wrong with it is not the file's fault
    _runtime()
    try:
        session = open_session(content, threads=threads)
    except Exception as error:
        # its exceptions have no base of their own
        reason = " ".join(str(error).split())[:120]
        raise file_error(
            path,
            f"expected an ONNX file, but its {len(content):,} bytes are damaged, cut off or something else ({reason}): "
            "get it again, or make it anew with `lidarpose export`",
        ) from None
    metadata = session.get_modelmeta().custom_metadata_map
    header = parse_header(path, metadata.get(ENTRY))
    if header.network != "pose":
        raise file_error(path, f"expected a network of the kind pose, got {header.network}: use its .safetensors")
    for what, found, due in (
        ("input", {value.name for value in session.get_inputs()}, expected_inputs(header.config)),
        ("output", {value.name for value in session.get_outputs()}, OUTPUTS),
    ):
        wrong = sorted(found ^ set(due))
        if wrong:
            problem = "is missing" if wrong[0] in due else "is unknown"
            raise file_error(
                path, f"{what} {wrong[0]} {problem}: make the file anew with `lidarpose export` of this version"
            )
    return session, header, metadata.get(SOURCE, "")


def expected_inputs(config: NetworkConfig) -> list[str]:
    """Names of an exported network's inputs."""
    return [input_name(name) for name in network_inputs(plan_people([np.zeros((1, 3))], None, config))]
