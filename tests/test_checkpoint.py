"""Checkpoints: saving, loading, and error messages of one line."""

import copy
import json
import math
import re
import struct
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings, strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.models import BUNDLED, NETWORKS, bundled_path
from lidarpose.models.checkpoint import (
    Header,
    SafetensorsFile,
    load_checkpoint,
    parameter_count,
    read_header,
    save_checkpoint,
    with_digest,
)
from lidarpose.models.config import SIZES
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.dapt_net import DaptNet
from lidarpose.models.dapt.import_weights import import_released
from lidarpose.models.posenet import PoseNet
from lidarpose.skeleton import HUMAN15

CARD = {"command": "lidarpose pretrain run", "people_seen": 12, "scores": {"mpjpe": 0.1}}


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return PoseNet(SIZES["tiny"])


@pytest.fixture(scope="module")
def stored(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_checkpoint(path, network, card=CARD)
    return path


@pytest.mark.parametrize("half", [False, True])
def test_save_and_load_checkpoint_round_trip(network, tmp_path, half):
    path = tmp_path / "new" / "tiny.safetensors"
    save_checkpoint(path, network, card=CARD, half=half)
    loaded, header = load_checkpoint(path)
    assert not loaded.training and header.card == CARD and header.version == __version__
    assert header.config == network.config == loaded.config
    assert read_header(path) == header and header.network == "pose" and header.skeleton.name == "body26"
    count = sum(value.numel() for value in network.parameters())
    assert parameter_count(path) == count
    for name, value in network.state_dict().items():
        other = loaded.state_dict()[name]
        assert other.dtype == torch.float32 and torch.equal(other, value.half().float() if half else value)
    size = path.stat().st_size
    assert (2 if half else 4) * count < size < (2 if half else 4) * count + 20_000


def test_failed_save_checkpoint_keeps_network_and_old_file(network, stored, tmp_path):
    assert network.training and all(p.requires_grad for p in network.parameters())
    path = tmp_path / "a.safetensors"
    path.write_bytes(stored.read_bytes())
    with pytest.raises(TypeError):
        save_checkpoint(path, network, card={"bad": object()})
    assert path.read_bytes() == stored.read_bytes() and list(tmp_path.iterdir()) == [path]


def assert_one_line(path, *words, read=load_checkpoint):
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    for word in words:
        assert word in message or re.search(word, message), message


def test_load_checkpoint_rejects_missing_file_and_folder(tmp_path):
    assert_one_line(tmp_path / "none.safetensors", "does not exist")
    assert_one_line(tmp_path, "is a folder")


@pytest.mark.parametrize(
    "change, words",
    [
        *((lambda b, keep=keep: b[:keep], f"ends at byte {keep:,}: it was not") for keep in (4, 7)),
        *((lambda b, keep=keep: b[:keep], f"ends at byte {keep:,}, within its header") for keep in (8, 100, 5000)),
        (lambda b: b[:-1], "but its header says {size:,}: it was not copied completely: get it again"),
        (lambda b: b + b"more", "but its header says {size:,}"),
        (lambda b: b"", "is empty"),
        (lambda b: b[:1000] + b"\x00}}{" + b[1004:], "at byte 1,000"),
        # a high bit of an exponent: the number is still finite
        (
            lambda b: b[:-1] + bytes([b[-1] ^ 0x08]),
            "does not match the SHA-256 digest in its header: get the file again",
        ),
        (lambda b: b"hello world, this is text", "something else: give a file of weights"),
        (lambda b: b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x01u.", "something else"),
        (lambda b: b"\x1f\x8b" + bytes(50), "something else"),
        (lambda b: bytes(64), "something else"),
    ],
)
def test_load_checkpoint_describes_damage(stored, tmp_path, change, words):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(change(stored.read_bytes()))
    assert_one_line(path, words.format(size=stored.stat().st_size))


@pytest.mark.long
@settings(max_examples=120, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_load_checkpoint_detects_flipped_bits(stored, tmp_path_factory, at, bit):
    content = bytearray(stored.read_bytes())
    content[int(at * len(content))] ^= 1 << bit
    path = tmp_path_factory.mktemp("flip") / "x.safetensors"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            network, header = load_checkpoint(path)
        except InputError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            return
    # in the name of the digest, in padding or where JSON reads the same: the content must be unchanged
    due, expected = load_checkpoint(stored)
    assert header == expected
    for name, value in due.state_dict().items():
        assert torch.equal(network.state_dict()[name], value)


def test_load_checkpoint_warns_without_digest(stored, tmp_path):
    older = rewritten(stored, tmp_path / "older.safetensors")
    with pytest.warns(UserWarning, match="older.safetensors: has no digest, so damage goes unnoticed"):
        network, header = load_checkpoint(older)
    again = tmp_path / "again.safetensors"
    again.write_bytes(with_digest(older.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same, _ = load_checkpoint(again)
        # an existing digest is kept
        assert with_digest(again.read_bytes()) == again.read_bytes()
        for name in BUNDLED:
            load_checkpoint(bundled_path(name))
    assert all(torch.equal(value, same.state_dict()[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize("shape", [[10**4000, 10**4000], [5], [-4]])
def test_shape_of_a_tensor_fits_its_bytes(tmp_path, shape):
    header = json.dumps({"w": {"dtype": "F32", "shape": shape, "data_offsets": [0, 4]}}).encode()
    (tmp_path / "x.safetensors").write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    assert_one_line(tmp_path / "x.safetensors", "its header is damaged .tensor w.", read=parameter_count)


def test_safetensors_file_survives_truncation_after_open(network, stored, tmp_path):
    """With a memory-mapped file, the process would crash."""
    path = tmp_path / "x.safetensors"
    path.write_bytes(stored.read_bytes())
    file = SafetensorsFile.open(path)
    path.write_bytes(b"")
    assert file.check_digest()
    assert all(
        torch.equal(value, network.state_dict()[name]) for name, value in file.load(network.state_dict()).items()
    )


def test_load_checkpoint_rejects_foreign_safetensors(tmp_path):
    path = tmp_path / "foreign.safetensors"
    for metadata in (None, {"format": "pt"}):
        save_file({"weight": torch.zeros(3)}, path, metadata=metadata)
        assert_one_line(path, "not a checkpoint of lidarpose")


def rewritten(stored, path, *, tensors=dict, header=lambda entry: entry, config=None):
    """Write the stored file with changed tensors, header or configuration, without a digest; return its path."""
    with safe_open(stored, framework="pt") as file:
        entry = json.loads(file.metadata()["lidarpose"])
    text = header(entry | {"config": entry["config"] | (config or {})})
    text = text if isinstance(text, str) else json.dumps(text)
    save_file(tensors(load_file(stored)), path, metadata={"lidarpose": text})
    return path


@pytest.mark.parametrize(
    "tensors, words",
    [
        (lambda t: {k: v for k, v in t.items() if k != "vote.query.bias"}, "tensor vote.query.bias is missing"),
        (lambda t: t | {"more": torch.zeros(1)}, "unknown tensor more, not part of its configuration (tiny)"),
        (
            lambda t: t | {"part.weight": torch.zeros(24, 48)},
            "part.weight should be (25, 48) for its configuration (tiny), got (24, 48)",
        ),
        (
            lambda t: t | {"part.bias": torch.full((25,), torch.nan)},
            "tensor part.bias holds values that are not finite",
        ),
        (lambda t: t | {"part.bias": torch.zeros(25, dtype=torch.int32)}, "tensor part.bias holds .* not floats"),
        # finite as float64, but not as float32
        (lambda t: t | {"part.bias": torch.full((25,), 1e300, dtype=torch.float64)}, "part.bias .* not finite"),
    ],
)
def test_load_checkpoint_rejects_mismatched_tensors(stored, tmp_path, tensors, words):
    assert_one_line(rewritten(stored, tmp_path / "x.safetensors", tensors=tensors), words)


def test_load_checkpoint_rejects_oversized_configurations(stored, tmp_path):
    """Nothing is allocated for a header of gigabytes or thousands of layers in a file of half a megabyte."""
    for change, words in (
        ({"channels": [48, 64, 2**14]}, "get the file again"),
        ({"max_voxels": 10, "blocks": [1, 16_000, 1]}, "get the file again"),
        ({"channels": [48, 3_200_000_000_000, 96]}, "channels must be .* 16384"),
        ({"parts": 10**19}, "parts must be .* 16384"),
        ({"convolution": 10**9}, "convolution must be .* 16384"),
    ):
        assert_one_line(rewritten(stored, tmp_path / "x.safetensors", config=change), words)


def test_save_checkpoint_rejects_overflow_in_float16(network, tmp_path):
    out = tmp_path / "x.safetensors"
    large = copy.deepcopy(network)
    with torch.no_grad():
        large.part.bias[0] = 1e5
    save_checkpoint(out, large, card={})
    before = out.read_bytes()
    with pytest.raises(InputError, match="part.bias is not finite as float16"):
        save_checkpoint(out, large, card={}, half=True)
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    "header, words",
    [
        (
            {"schema": "lidarpose.checkpoint/9", "version": "7.1"},
            "got lidarpose.checkpoint/9 of lidarpose 7.1: use the",
        ),
        ({"schema": "lidarpose.checkpoint/1", "version": "0.1.0"}, "use lidarpose 0.1.0 for it, or train"),
        ({"network": "pointnet"}, "unknown kind of network 'pointnet'.*known are pose, dapt"),
        ({"network": "dapt"}, "unknown setting blocks"),
        ({"card": 5}, "cannot be read"),
        ({"config": 5}, "cannot be read"),
        ({"config": {"size": "tiny"}}, "channels"),
        (lambda h: {k: v for k, v in h.items() if k != "schema"}, "'schema'"),
        (lambda h: {k: v for k, v in h.items() if k != "card"}, "'card'"),
        (lambda h: {k: v for k, v in h.items() if k != "network"}, "'network'"),
        (lambda h: [h], "cannot be read"),
        (lambda h: json.dumps(h).replace('"card": {', '"card": {"n": ' + "1" * 5000 + ", ", 1), "cannot be read"),
        (lambda h: "{", "cannot be read"),
        (lambda h: "7", "cannot be read"),
    ],
)
def test_load_checkpoint_rejects_invalid_headers(stored, tmp_path, header, words):
    change = header if callable(header) else lambda entry: entry | header
    path = rewritten(stored, tmp_path / "x.safetensors", header=change)
    for read in (load_checkpoint, read_header):
        assert_one_line(path, words, read=read)


@pytest.mark.parametrize(
    "config, words",
    [
        ({"rotary": True}, "unknown setting rotary"),
        ({"channels": 64.0}, "channels must be 3 whole numbers"),
        ({"channels": [64, -1, 64]}, "channels must be 3 whole numbers"),
        ({"head_channels": 0}, "head_channels must be a whole number"),
        ({"head_channels": 5}, "must be divisible by head_channels"),
        ({"blocks": [1, 1]}, "blocks must be 3 whole numbers"),
        ({"blocks": 3}, "blocks must be 3 whole numbers"),
        *(({"grid": grid}, "grid must be a positive number") for grid in (-1, math.inf, 10**400)),
        ({"size": {"a": 1}}, "size must be text"),
        ({"heatmap": "round"}, "unknown heatmap 'round'"),
        ({"skeleton": "body27"}, "unknown skeleton 'body27'"),
    ],
)
def test_read_header_rejects_invalid_configurations(stored, tmp_path, config, words):
    assert_one_line(rewritten(stored, tmp_path / "x.safetensors", config=config), words, read=read_header)


# ---- the paper's network

SMALL = {
    "encoder_depths": (1, 1),
    "encoder_channels": (16, 16),
    "encoder_heads": (2, 2),
    "decoder_depths": (1,),
    "decoder_channels": (16,),
    "decoder_heads": (2,),
    "anchor_channels": (16, 16),
    "strides": (4,),
    "grid": 0.04,
}
TINY_DAPT = Path(__file__).parent / "parity" / "dapt_tiny.safetensors"


@pytest.mark.parametrize("half", [False, True])
def test_dapt_checkpoint_round_trip(tmp_path, half):
    torch.manual_seed(1)
    joints = ("left_hip", *HUMAN15.joints[:1], *HUMAN15.joints[2:])
    network = DaptNet(DaptConfig(name="mine", joints=joints, coordinates=True, **SMALL))
    path = tmp_path / "dapt.safetensors"
    save_checkpoint(path, network, card=CARD, half=half)
    loaded, header = load_checkpoint(path)
    assert isinstance(loaded, DaptNet) and not loaded.training
    assert header.network == "dapt" and header.config == network.config and header.skeleton is HUMAN15
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().to(value.dtype) if half else value)


@pytest.mark.parametrize("faulty", [False, True])
def test_load_checkpoint_reads_old_legacy_setting(tmp_path, faulty):
    faults = {"stale_convolution": faulty, "grid_from_minimum": faulty}
    network = DaptNet(DaptConfig(name="mine", joints=HUMAN15.joints, coordinates=True, **faults, **SMALL))
    path = tmp_path / "dapt.safetensors"
    save_checkpoint(path, network, card=CARD)
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    header = json.loads(metadata["lidarpose"])
    for name in ("stale_convolution", "grid_from_minimum", "zero_anchors"):
        del header["config"][name]
    header["config"]["legacy"] = faulty
    save_file(load_file(path), path, {"lidarpose": json.dumps(header)})
    with pytest.warns(UserWarning, match="no digest"):
        assert load_checkpoint(path)[1].config == network.config


def test_networks_table_entries_are_complete():
    for kind, entry in NETWORKS.items():
        config, network = entry.part("config"), entry.part("network")
        assert config.kind == kind and issubclass(network, torch.nn.Module)
        assert callable(entry.part("objective")) and callable(entry.part("backend"))
        assert {"name", "joints", "min_tensors", "to_dict"} <= set(dir(config)) | set(config.__dataclass_fields__)


def test_header_rejects_joints_of_no_known_skeleton():
    header = Header(config=DaptConfig(name="legs", joints=("left_knee", "right_knee"), coordinates=True), card={})
    with pytest.raises(InputError, match="the network legs predicts left_knee, right_knee"):
        _ = header.skeleton


def test_import_released_keeps_tensors(tmp_path):
    out = tmp_path / "in.safetensors"
    header = import_released(TINY_DAPT, out)
    loaded, again = load_checkpoint(out)
    assert again == header and header.card["command"] == "lidarpose import dapt_tiny.safetensors"
    released = load_file(TINY_DAPT)
    for name, value in loaded.state_dict().items():
        torch.testing.assert_close(value, released[name].to(value.dtype), rtol=0, atol=0)


def test_import_released_writes_nothing_on_error(tmp_path, stored):
    with pytest.raises(InputError, match="is missing"):
        import_released(stored, tmp_path / "in.safetensors", config="waymo")
    with pytest.raises(InputError, match=r"give a name that ends in \.safetensors"):
        import_released(TINY_DAPT, tmp_path / "in.onnx")
    whole = load_file(TINY_DAPT)
    name = next(name for name, value in whole.items() if value.is_floating_point())
    with safe_open(str(TINY_DAPT), framework="pt") as file:
        metadata = file.metadata()
    save_file(whole | {name: whole[name].int()}, tmp_path / "whole.safetensors", metadata=metadata)
    with pytest.raises(InputError, match=f"tensor {name} holds values that are not finite or not floats"):
        import_released(tmp_path / "whole.safetensors", tmp_path / "in.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["whole.safetensors"]


def test_load_checkpoint_keeps_random_state_and_default_dtype(stored):
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    torch.set_default_dtype(torch.float64)
    try:
        network, _ = load_checkpoint(stored)
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    assert {value.dtype for value in network.state_dict().values() if value.is_floating_point()} == {torch.float32}
    assert torch.equal(torch.rand(3), expected)
