"""Export to ONNX and torch programs: equal outputs at other sizes, and errors of one line."""

import json
import shutil
import warnings
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings, strategies as st

import lidarpose
from lidarpose.errors import InputError, LidarPoseError, MissingExtra
from lidarpose.inference.backend import OnnxBackend, exported_beside
from lidarpose.inference.torch_backend import TorchBackend
from lidarpose.io.files import content_digest
from lidarpose.models import BUNDLED, DEFAULT, bundled_path, export as exporting
from lidarpose.models.checkpoint import DAMAGED, DIGEST, load_checkpoint, read_header, save_checkpoint
from lidarpose.models.config import NetworkConfig
from lidarpose.models.export import check, export, module_to_onnx
from lidarpose.models.onnx import (
    check_digest,
    expected_inputs,
    input_name,
    open_onnx,
    open_session,
    output_names,
    voxelize_people,
)
from lidarpose.models.posenet import ArrayModule, PoseNet

CARD = {"command": "none", "note": "random"}
# every kind of layer, few of each: tracing time grows with the number of layers
SMALL = NetworkConfig(
    size="small", channels=(16, 32, 32), head_channels=16, blocks=(0, 1, 0), convolution=8, person=True
)


def stored_network(path, config, seed=0):
    torch.manual_seed(seed)
    network = PoseNet(config)
    with torch.no_grad():
        # untrained outputs hardly differ between joints, which would hide swapped joints
        for parameter in network.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    save_checkpoint(path, network, card=CARD, half=True)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bundled checkpoint and its ONNX file, since an export takes half a minute."""
    folder = tmp_path_factory.mktemp("export")
    for suffix in (".safetensors", ".onnx"):
        shutil.copy(bundled_path(DEFAULT, suffix), folder / f"net{suffix}")
    return folder


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Like `folder`, of a random network; also contains the graph before its weights became float16."""
    folder = tmp_path_factory.mktemp("exported")
    path = stored_network(folder / "net.safetensors", SMALL)
    pack = exporting._pack

    def packed(graph):
        (folder / "before.graph").write_bytes(graph.SerializeToString())
        pack(graph)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "_pack", packed)
        export(path, folder / "net.onnx")
    return folder


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """A network, its exported torch program, and the metadata in the program's file."""
    folder = tmp_path_factory.mktemp("program")
    path = stored_network(folder / "net.safetensors", SMALL)
    export(path, folder / "net.pt2", format="torch")
    entries = {"lidarpose": ""}
    module = torch.export.load(folder / "net.pt2", extra_files=entries).module()
    assert_no_path_of_this_machine(folder / "net.pt2")
    return load_checkpoint(path)[0], module, json.loads(entries["lidarpose"])


def assert_no_path_of_this_machine(path):
    content = path.read_bytes()
    assert b"lidarpose/models/posenet.py" not in content and str(path.parent).encode() not in content


def people(*sizes, seed=1):
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(0, (0.2, 0.2, 0.5), (size, 3)) for size in sizes]
    view = rng.normal(size=(len(sizes), 5)).astype(np.float32)
    return clouds, view


SIZES = [(1,), (5000, 1, 20, 0), (0,), (40, 40), (3, 700, 90, 8, 15, 2, 1)]


@pytest.mark.long
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_export_torch_program_matches_network(program, sizes):
    network, module, entry = program
    assert entry["config"]["size"] == "small"
    arrays = voxelize_people(*people(*sizes), network.config).arrays()
    tensors = [torch.as_tensor(array) for array in arrays.values()]
    with torch.inference_mode():
        expected = ArrayModule(network, tuple(arrays))(*tensors)
        torch.testing.assert_close(tuple(module(*tensors)), expected, rtol=1e-4, atol=1e-5)


class Halved(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = torch.nn.Linear(8, 16)
        torch.nn.init.constant_(self.linear.weight, 0.25)

    def forward(self, x):
        return self.linear(x).relu().sum(1), x / 2


@pytest.mark.long
def test_module_to_onnx_has_dynamic_rows_and_only_given_metadata():
    module = Halved()
    content = module_to_onnx(module, (torch.ones(3, 5, 8),), ({0: "rows"},), ["x"], ["sum", "half"], {"note": "a note"})
    session = open_session(content)
    assert session.get_modelmeta().custom_metadata_map == {"note": "a note"}
    assert [value.shape for value in session.get_inputs()] == [["rows", 5, 8]]
    assert b"test_export.py" not in content
    # weights that half precision represents exactly
    assert onnx.TensorProto.FLOAT16 in {each.data_type for each in onnx.load_from_string(content).graph.initializer}
    for rows in (1, 7):
        x = torch.rand(rows, 5, 8)
        for ours, due in zip(session.run(None, {"x": x.numpy()}), module(x), strict=True):
            np.testing.assert_allclose(ours, due.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_onnx_backend_matches_torch_backend(exported, sizes):
    clouds, view = people(*sizes)
    network, header = load_checkpoint(exported / "net.safetensors")
    ours = OnnxBackend(exported / "net.onnx", threads=1).run(clouds, view)
    due = TorchBackend(network, header).run(clouds, view)
    for name in ("vote", "confidence", "log_spread", "visible", "person", "low", "step"):
        np.testing.assert_allclose(getattr(ours, name), getattr(due, name), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(ours.heatmaps, due.heatmaps, rtol=1e-4, atol=1e-4)
    assert np.ptp(due.heatmaps[0]) > 0.1


@pytest.mark.slow
def test_export_stores_float16_weights_without_loss(exported):
    """The file is smaller and all outputs are bit-identical."""
    network, header = load_checkpoint(exported / "net.safetensors")
    packed = (exported / "net.onnx").read_bytes()
    assert_no_path_of_this_machine(exported / "net.onnx")
    model = onnx.load_from_string(packed)
    model.graph.ParseFromString((exported / "before.graph").read_bytes())
    whole = model.SerializeToString()
    parameters = sum(value.numel() for value in network.parameters())
    assert len(packed) < len(whole) - 1.5 * parameters
    arrays = voxelize_people(*people(300, 5, 900), header.config).arrays()
    given = {input_name(name): array for name, array in arrays.items()}
    for ours, due in zip(*(open_session(file).run(None, given) for file in (packed, whole)), strict=True):
        np.testing.assert_array_equal(ours, due)


def test_pack_keeps_float32_where_float16_loses_precision():
    rng = np.random.default_rng(0)
    kept = {
        "fine": rng.normal(size=100).astype(np.float32),
        "large": np.full(100, 1e6, np.float32),
        "few": np.ones(3, np.float32),
        "whole": np.arange(100),
    }
    half = rng.normal(size=100).astype(np.float16).astype(np.float32)
    arrays = kept | {"half": half}
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["half"], ["out"])],
        "weights",
        [],
        [onnx.helper.make_tensor_value_info("out", onnx.TensorProto.FLOAT, [100])],
        [onnx.numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    exporting._pack(graph)
    stored = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    assert list(stored) == [*kept, "half.half"] and stored["half.half"].dtype == np.float16
    for name, array in kept.items():
        assert stored[name].dtype == array.dtype
        np.testing.assert_array_equal(stored[name], array)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=8)
    onnx.checker.check_model(model)
    np.testing.assert_array_equal(open_session(model.SerializeToString()).run(None, {})[0], half)


def assert_tells_what_it_is(folder):
    session, header, source = open_onnx(folder / "net.onnx")
    config = header.config
    assert header == read_header(folder / "net.safetensors") and config.convolution and config.person
    assert source == content_digest(folder / "net.safetensors", expected="a checkpoint")
    assert [value.name for value in session.get_inputs()] == expected_inputs(config)
    assert "in_mid_neighbours" in expected_inputs(config)
    assert [value.name for value in session.get_outputs()] == list(output_names(config))
    shapes = {value.name: value.shape for value in [*session.get_inputs(), *session.get_outputs()]}
    assert shapes["in_fine_position"] == ["people", "fine_rows", 3] and shapes["in_view"] == ["people", 5]
    assert shapes["in_mid_neighbours"] == ["people", "mid_rows", 27] and shapes["part"] == ["people", "fine_rows", 25]
    assert_no_path_of_this_machine(folder / "net.onnx")


def test_open_onnx_reads_header_of_bundled_file(folder):
    assert_tells_what_it_is(folder)


@pytest.mark.slow
def test_open_onnx_reads_header_of_exported_file(exported):
    assert_tells_what_it_is(exported)


def test_load_accepts_onnx_file(folder, capfd):
    model = lidarpose.load(folder / "net.onnx")
    assert model.backend.name == "onnx" and model.model["name"] == "net"
    beside = lidarpose.load(folder / "net.safetensors", backend="onnx")
    (cloud,), _ = people(300)
    np.testing.assert_array_equal(model.predict(cloud).joints, beside.predict(cloud).joints)
    due = lidarpose.load(folder / "net.safetensors").predict(cloud)
    assert np.abs(model.predict(cloud).joints - due.joints).max() < 1e-4
    assert capfd.readouterr() == ("", "")


# ---- errors of files


def assert_one_line(path, *parts, read=OnnxBackend):
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message, message
    for part in parts:
        assert part in message


def changed(folder, path, change):
    """Writes the exported file with a changed protocol buffer, without the digest, which would not match."""
    model = onnx.load(folder / "net.onnx")
    with_entry(DIGEST, None)(model)
    change(model)
    path.write_bytes(model.SerializeToString())
    return path


def with_entry(key, value):
    def change(model):
        for entry in [entry for entry in model.metadata_props if entry.key == key]:
            model.metadata_props.remove(entry)
        if value is not None:
            model.metadata_props.add(key=key, value=value)

    return change


@pytest.mark.parametrize(
    "content, words",
    [*((slice(end), "") for end in (1, 50, 20_000, -1, -3000)), (b"text", ""), (bytes(64), ""), (b"", "is empty")],
    ids=str,
)
def test_onnx_backend_rejects_truncated_and_foreign_files(folder, tmp_path, content, words, capfd):
    path = tmp_path / "bad.onnx"
    path.write_bytes(content if isinstance(content, bytes) else (folder / "net.onnx").read_bytes()[content])
    assert_one_line(path, words)
    assert capfd.readouterr() == ("", "")
    assert_one_line(tmp_path / "none.onnx", "no such file")
    assert_one_line(tmp_path, "got a folder")


@settings(max_examples=120, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_check_digest_detects_flipped_bit(folder, at, bit):
    content = bytearray((folder / "net.onnx").read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    try:
        has_digest = check_digest("x.onnx", bytes(content))
    except InputError as error:
        assert str(error) == f"x.onnx: {DAMAGED}"
        return
    # the flipped bit is in the name of the digest's entry
    assert not has_digest


def test_open_onnx_warns_without_digest(folder, tmp_path):
    older = changed(folder, tmp_path / "older.onnx", lambda model: None)
    with pytest.warns(UserWarning, match="older.onnx: has no digest, so damage goes unnoticed"):
        open_onnx(older)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_onnx(folder / "net.onnx")
        for name in BUNDLED:
            assert check_digest(name, bundled_path(name, ".onnx").read_bytes())


def test_onnx_backend_rejects_external_weights(folder, tmp_path, monkeypatch):
    """They would be read from the current folder."""
    model = onnx.load(folder / "net.onnx")
    path = tmp_path / "x.onnx"
    onnx.save(model, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    monkeypatch.chdir(tmp_path)
    assert (tmp_path / "weights.bin").is_file()
    assert_one_line(path, "keeps its weights in other files", "lidarpose export")


def test_predict_reports_nan_weights_as_damaged(folder, tmp_path):
    def without_numbers(model):
        for weight in model.graph.initializer:
            values = onnx.numpy_helper.to_array(weight)
            if values.dtype.kind == "f":
                weight.CopyFrom(onnx.numpy_helper.from_array(np.full_like(values, np.nan), weight.name))

    path = changed(folder, tmp_path / "nan.onnx", without_numbers)
    with pytest.warns(UserWarning, match="has no digest"):
        model = lidarpose.load(path)
    with pytest.raises(InputError, match="no finite joints.*weights are damaged"):
        model.predict(people(300)[0][0])


@pytest.mark.long
def test_onnx_backend_rejects_foreign_and_other_version_models(folder, tmp_path):
    entry = json.loads(read_header(folder / "net.safetensors").to_json())
    for change, words in (
        (with_entry("lidarpose", None), "not a checkpoint of lidarpose"),
        (with_entry("lidarpose", json.dumps(entry | {"schema": "lidarpose.checkpoint/1"})), "expected schema"),
        (with_entry("lidarpose", "{"), "cannot be read"),
        (
            with_entry("lidarpose", json.dumps(entry | {"config": entry["config"] | {"convolution": 0}})),
            "input in_coarse_neighbours is unknown",
        ),
        (lambda model: model.graph.output.remove(model.graph.output[-1]), "output person is missing"),
    ):
        assert_one_line(changed(folder, tmp_path / "x.onnx", change), words)


def test_exported_beside_requires_onnx_of_same_weights(folder, tmp_path):
    path = tmp_path / "net.safetensors"
    path.write_bytes((folder / "net.safetensors").read_bytes())
    assert_one_line(path, "net.onnx beside it, which does not exist", "lidarpose export", read=exported_beside)
    (tmp_path / "net.onnx").write_bytes((folder / "net.onnx").read_bytes())
    assert exported_beside(path).header == read_header(path)
    stored_network(path, SMALL)
    with pytest.raises(InputError, match="other weights than net.safetensors beside it: make it with"):
        exported_beside(path)


# ---- errors of export


def test_export_rejects_bad_format_name_and_path(folder, tmp_path, monkeypatch):
    out = tmp_path / "out.onnx"
    with pytest.raises(InputError, match="unknown format 'tflite': known are onnx, torch"):
        export(folder / "net.safetensors", out, format="tflite")
    with pytest.raises(InputError, match="does not exist"):
        export(tmp_path / "none.safetensors", out)
    for name, format, ending in (("x.safetensors", "onnx", ".onnx"), ("x.onnx", "torch", ".pt2")):
        with pytest.raises(InputError, match=f"give a name that ends in {ending}"):
            export(folder / "net.safetensors", tmp_path / name, format=format)
    (tmp_path / "file").write_text("")
    # before tracing, which takes a minute
    monkeypatch.setattr("lidarpose.models.export.onnx_bytes", None)
    with pytest.raises(InputError, match="a part of the path is a file"):
        export(folder / "net.safetensors", tmp_path / "file" / "out.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_export_names_missing_extra(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxscript", None)
    with pytest.raises(MissingExtra, match=r'pip install "\.\[export\]"'):
        export(folder / "net.safetensors", tmp_path / "out.onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_export_writes_nothing_if_outputs_differ(folder, tmp_path, monkeypatch):
    network, _ = load_checkpoint(folder / "net.safetensors")
    other, _ = load_checkpoint(stored_network(tmp_path / "other.safetensors", SMALL, seed=5))
    content = (folder / "net.onnx").read_bytes()
    monkeypatch.setattr(exporting, "onnx_bytes", lambda network, metadata: content)
    export(folder / "net.safetensors", tmp_path / "same.onnx")
    with pytest.raises(LidarPoseError, match="vote is off by .* nothing was written"):
        export(tmp_path / "other.safetensors", tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()

    def run(network, change):
        return lambda arrays: [
            change(v.detach().numpy())
            for v in ArrayModule(network, tuple(arrays))(*map(torch.as_tensor, arrays.values()))
        ]

    check(network, run(network, lambda value: value + 1e-5))
    for change in (lambda value: value * np.nan, lambda value: value[:0], lambda value: value + 0.01):
        with pytest.raises(LidarPoseError, match="is off by"):
            check(network, run(network, change))
    with pytest.raises(LidarPoseError, match="is off by"):
        check(network, run(other, lambda value: value))


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"heatmap": "full"}, {"heatmap": "none"}, {"convolution": 0, "blocks": (2, 1, 1)}])
def test_export_supports_network_variants(tmp_path, change):
    path = stored_network(tmp_path / "net.safetensors", replace(SMALL, **change))
    export(path, tmp_path / "net.onnx")
    export(path, tmp_path / "net.pt2", format="torch")
    (cloud,), _ = people(300)
    due = lidarpose.load(path).predict(cloud)
    ours = lidarpose.load(path, backend="onnx").predict(cloud)
    assert np.abs(ours.joints - due.joints).max() < 1e-4
    assert (ours.in_range is None) == (change.get("heatmap") == "none")


@pytest.mark.slow
def test_export_accepts_bundled_name(tmp_path):
    export("tiny", tmp_path / "tiny.onnx")
    assert OnnxBackend(tmp_path / "tiny.onnx").source == content_digest(bundled_path("tiny"), expected="a checkpoint")
