"""Exports networks to ONNX or to a program of `torch.export`. Results are checked before they are written."""

import contextlib
import copy
import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from lidarpose._version import __version__
from lidarpose.errors import InputError, LidarPoseError, check_name, needs_extra
from lidarpose.io.atomic import atomic_path, check_suffix, check_writable, write_atomic
from lidarpose.io.files import check_not_input, content_digest
from lidarpose.models import weights_path
from lidarpose.models.checkpoint import DIGEST, ENTRY, Header, load_checkpoint
from lidarpose.models.detector.detector_config import INPUTS, OUTPUT
from lidarpose.models.detector.network import DetectorNet
from lidarpose.models.onnx import (
    NO_DIGEST,
    SOURCE,
    input_name,
    open_session,
    output_names,
    voxelize_people,
    with_digest,
)
from lidarpose.models.posenet import ArrayModule, PoseNet

# file suffix of each format
FORMATS = {"onnx": ".onnx", "torch": ".pt2"}
_OPSET = 18
# points per person: of the traced example, in which 0 and 1 would become constants, and of the checked examples
_TRACED, _CHECKED = (300, 60, 700), ((1, 2000, 37, 0, 9), (1,))
# an exported network may differ from torch by rounding; its logits are of order ten
_TOLERANCE = 1e-3
# mean difference of a detector's logits, of order 5, that convolutions in 8 bits may cause
_QUANTIZED = 0.5
# an array with fewer values is not worth a cast node
_WORTH = 64


def export(weights: str | os.PathLike, out: str | os.PathLike, *, format: str = "onnx") -> None:
    """Exports a checkpoint to a file of another format that computes in float32; writes the whole file or nothing.

    Args:
        weights: a name of bundled weights, or the path of a checkpoint.
        format: "onnx", a self-contained file that ONNX Runtime and this package run without torch, no larger than a
            float16 checkpoint; or "torch", a program (.pt2) for `torch.export.load`. Both take any number of people and
            points; docs/use.md, "Exported networks", describes inputs and outputs.

    Raises:
        InputError: the file is not a checkpoint of this package's own networks, or the suffix of `out` is not the one
            in `FORMATS`. MissingExtra: onnx is not installed.
    """
    check_name("format", format, FORMATS)
    weights = weights_path(weights)
    check_not_input(out, weights)
    check_suffix(out, FORMATS[format])
    network, header = load_checkpoint(weights)
    if isinstance(network, DetectorNet) and format == "onnx":
        export_detector(network, out, card=header.card)
        return
    if not isinstance(network, PoseNet):
        raise InputError(
            f"{os.fspath(weights)}: the network {network.config.name} cannot be exported as {format}: "
            "run it with torch, or export one of the package's own networks (tiny, small, base)"
        )
    # before tracing, which takes a minute
    check_writable(out)
    metadata = {ENTRY: header.to_json(), SOURCE: content_digest(weights, expected="a checkpoint")}
    if format == "onnx":
        content = with_digest(onnx_bytes(network, metadata | {DIGEST: NO_DIGEST}))
        session = open_session(content)

        def run(arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
            return session.run(
                list(output_names(network.config)), {input_name(name): array for name, array in arrays.items()}
            )

        check(network, run)
        write_atomic(out, content)
        return
    program = trace(network)
    module = program.module()
    check(network, lambda arrays: [value.detach().numpy() for value in module(*map(torch.as_tensor, arrays.values()))])
    with atomic_path(out) as path, path.open("wb") as file:
        torch.export.save(program, file, extra_files=metadata)


def export_detector(
    network: DetectorNet, out: str | os.PathLike, *, card: dict, examples: Sequence[dict[str, np.ndarray]] = ()
) -> None:
    """Exports a detector as ONNX; writes the whole file or nothing.

    Args:
        network: the detector.
        out: the file.
        card: of its header, see `detector.open_detector`.
        examples: inputs of candidates, by which the ranges of the convolutions are determined; these then compute with
            integers of 8 bits, which is faster, most of all with VNNI. Without examples they compute in float32.

    Raises:
        MissingExtra: onnx is not installed. LidarPoseError: the outputs of the file are not those of the network.
    """
    check_suffix(out, FORMATS["onnx"])
    check_writable(out)
    network = copy.deepcopy(network).eval().half().float()
    shapes = network.config.shapes
    dynamic_axes = ({0: "candidates"},) * len(INPUTS)
    example_inputs = tuple(torch.zeros(shape) for shape in shapes(2).values())
    metadata = {ENTRY: Header(config=network.config, card=card).to_json(), DIGEST: NO_DIGEST}
    content = with_digest(module_to_onnx(network, example_inputs, dynamic_axes, INPUTS, (OUTPUT,), metadata))
    session = open_session(content)
    rng = np.random.default_rng(0)
    for candidates in (1, 7):
        arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes(candidates).items()}
        with torch.inference_mode():
            expected = network(*map(torch.as_tensor, arrays.values())).numpy()
        _check_close(OUTPUT, expected, session.run([OUTPUT], arrays)[0])
    if examples:
        content = with_digest(_quantized(content, examples, metadata))
        _check_quantized(session, open_session(content), examples)
    write_atomic(out, content)


def _quantized(content: bytes, examples: Sequence[dict[str, np.ndarray]], metadata: dict[str, str]) -> bytes:
    """The content of an ONNX file with convolutions in 8 bits. Weights have 7, with which processors without VNNI do
    not saturate."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Examples(CalibrationDataReader):
        def __init__(self):
            self.rest = iter(examples)

        def get_next(self):
            return next(self.rest, None)

    with tempfile.TemporaryDirectory() as folder, _silence():
        original, folded, quantized = (os.path.join(folder, f"{name}.onnx") for name in ("original", "folded", "out"))
        with open(original, "wb") as file:
            file.write(content)
        quant_pre_process(original, folded, skip_symbolic_shape=True)
        quantize_static(
            folded,
            quantized,
            Examples(),
            op_types_to_quantize=["Conv"],
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        model = onnx.load(quantized)
    _pack(model.graph)
    # the quantizer declares operator sets that no node uses, and notes shapes
    used = {node.domain for node in model.graph.node}
    opsets = [opset for opset in model.opset_import if opset.domain in used]
    del model.opset_import[:], model.graph.value_info[:], model.metadata_props[:]
    model.opset_import.extend(opsets)
    onnx.helper.set_model_props(model, metadata)
    model.producer_name, model.producer_version = "lidarpose", __version__
    onnx.checker.check_model(model)
    return model.SerializeToString(deterministic=True)


def _check_quantized(session, quantized_session, examples: Sequence[dict[str, np.ndarray]]) -> None:
    """Raises LidarPoseError if quantization changes the logits by more than `_QUANTIZED` on average."""
    errors = [np.abs(quantized_session.run(None, e)[0] - session.run(None, e)[0])[:, 0] for e in examples]
    if not (error := float(np.concatenate(errors).mean())) <= _QUANTIZED:
        raise LidarPoseError(
            f"convolutions in 8 bits change the detector's logits by {error:.2f} on average, more than {_QUANTIZED}, "
            "so nothing was written: train it for longer"
        )


def trace(network: PoseNet) -> torch.export.ExportedProgram:
    """The network as a program with dynamic numbers of people and rows."""
    arrays = _people(network, _TRACED)
    dynamic_shapes = tuple(dict.fromkeys(axes, torch.export.Dim.DYNAMIC) for axes in _axes(arrays))
    module = ArrayModule(network.eval(), tuple(arrays))
    with torch.no_grad():
        program = torch.export.export(module, _tensors(arrays), dynamic_shapes=(dynamic_shapes,))
    for node in program.graph.nodes:
        # it holds paths of the machine that traced the network
        node.meta.pop("stack_trace", None)
    return program


def onnx_bytes(network: PoseNet, metadata: dict[str, str]) -> bytes:
    """The network as the content of an ONNX file. Raises MissingExtra without onnx or onnxscript."""
    arrays = _people(network, _TRACED)
    names = [input_name(name) for name in arrays]
    module = ArrayModule(network, tuple(arrays))
    return module_to_onnx(module, _tensors(arrays), (_axes(arrays),), names, module.outputs, metadata)


def module_to_onnx(
    module: nn.Module,
    tensors: tuple[Tensor, ...],
    axes: tuple,
    inputs: Sequence[str],
    outputs: Sequence[str],
    metadata: dict[str, str],
) -> bytes:
    """A module with tensor arguments as the content of an ONNX file. axes: of each argument, the dynamic axes and their
    names. Raises MissingExtra without onnx or onnxscript."""
    with needs_extra("export to ONNX"):
        import onnx
        import onnxscript  # noqa: F401
    with _silence(), torch.no_grad():
        program = torch.onnx.export(
            module.eval(),
            tensors,
            dynamic_shapes=axes,
            input_names=list(inputs),
            output_names=list(outputs),
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None, "of an export that names no file"
    model = program.model_proto
    # the source of each traced node: a third of the file, with paths of the machine that made it
    for node in [*model.graph.node, *(node for function in model.functions for node in function.node)]:
        del node.metadata_props[:]
        node.ClearField("doc_string")
    for value in [*model.graph.input, *model.graph.output, *model.graph.initializer]:
        del value.metadata_props[:]
    del model.graph.metadata_props[:], model.graph.value_info[:]
    _pack(model.graph)
    onnx.helper.set_model_props(model, metadata)
    model.producer_name, model.producer_version = "lidarpose", __version__
    onnx.checker.check_model(model)
    return model.SerializeToString(deterministic=True)


def check(network: PoseNet, run: Callable[[dict[str, np.ndarray]], list[np.ndarray]]) -> None:
    """Raises LidarPoseError if `run` does not return the network's outputs for other numbers of people and points."""
    for sizes in _CHECKED:
        arrays = _people(network, sizes)
        with torch.inference_mode():
            expected = ArrayModule(network.eval(), tuple(arrays))(*_tensors(arrays))
        for name, tensor, actual in zip(output_names(network.config), expected, run(arrays), strict=True):
            _check_close(name, tensor.numpy(), actual)


def _check_close(name: str, expected: np.ndarray, actual: np.ndarray) -> None:
    max_error = np.abs(actual - expected).max(initial=0) if actual.shape == expected.shape else np.inf
    if not max_error <= _TOLERANCE:
        raise LidarPoseError(
            f"the exported network's {name} is off by {max_error:g}, so nothing was written: report this with the "
            f"versions that `lidarpose info` prints"
        )


def _people(network: PoseNet, sizes: tuple[int, ...]) -> dict[str, np.ndarray]:
    """The network's inputs for random people with the given numbers of points."""
    rng = np.random.default_rng(0)
    clouds = [rng.normal(0, (0.2, 0.2, 0.5), (size, 3)) for size in sizes]
    return voxelize_people(clouds, rng.normal(size=(len(sizes), 5)), network.config).arrays()


def _tensors(arrays: dict[str, np.ndarray]) -> tuple[Tensor, ...]:
    return tuple(torch.as_tensor(array) for array in arrays.values())


def _axes(arrays: dict[str, np.ndarray]) -> tuple[dict[int, str], ...]:
    """The dynamic axes of each array, with the names of what they count: people, and rows of a level."""
    levels = [name.partition(".")[0] if "." in name else "fine" for name in arrays]
    rows = [{0: "people", 1: f"{level}_rows"} for level in levels]
    return tuple({0: "people"} if name == "view" else axes for name, axes in zip(arrays, rows, strict=True))


def _pack(graph) -> None:
    """Stores weights as float16 where that is lossless, as for a float16 checkpoint, which halves the file.

    A node casts each back to float32; runtimes do that once, when they open the file.
    """
    from onnx import TensorProto, helper, numpy_helper

    casts = []
    for weight in graph.initializer:
        if weight.data_type != TensorProto.FLOAT:
            continue
        values = numpy_helper.to_array(weight)
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        if values.size < _WORTH or not np.array_equal(half.astype(np.float32), values):
            continue
        name = weight.name
        weight.CopyFrom(numpy_helper.from_array(half, f"{name}.half"))
        casts.append(helper.make_node("Cast", [weight.name], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


@contextlib.contextmanager
def _silence():
    """Suppresses the exporter's logs and warnings; errors are still raised."""
    disable_level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disable_level)
