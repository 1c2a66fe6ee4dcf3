"""Weights on disk: there and back, and one line for every fault."""

import copy
import json
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.models import BUNDLED, bundled_path
from lidarpose.models.checkpoint import (
    SCHEMA,
    Header,
    SafetensorsFile,
    load_checkpoint,
    parameter_count,
    read_header,
    save_checkpoint,
    with_digest,
)
from lidarpose.models.config import preset
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.dapt_net import DaptNet
from lidarpose.models.dapt.import_weights import import_released
from lidarpose.models.posenet import PoseNet
from lidarpose.skeleton import HUMAN15

CARD = {"command": "lidarpose pretrain run", "people_seen": 12, "scores": {"mpjpe": 0.1}}


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return PoseNet(preset("tiny"))


@pytest.fixture(scope="module")
def stored(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_checkpoint(path, network, card=CARD)
    return path


@pytest.mark.parametrize("half", [False, True])
def test_there_and_back(network, tmp_path, half):
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
        assert other.dtype == torch.float32
        if half:
            torch.testing.assert_close(other, value, rtol=1e-3, atol=1e-7)
            torch.testing.assert_close(other, value.half().float(), rtol=0, atol=0)
        else:
            torch.testing.assert_close(other, value, rtol=0, atol=0)
    size = path.stat().st_size
    assert (2 if half else 4) * count < size < (2 if half else 4) * count + 20_000


def test_saving_leaves_the_network_and_an_older_file_in_peace(network, stored, tmp_path):
    assert network.training and all(p.requires_grad for p in network.parameters())
    path = tmp_path / "a.safetensors"
    path.write_bytes(stored.read_bytes())
    with pytest.raises(TypeError):
        save_checkpoint(path, network, card={"bad": object()})
    assert path.read_bytes() == stored.read_bytes() and list(tmp_path.iterdir()) == [path]


def assert_one_line(path, *parts, read=load_checkpoint):
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    for part in parts:
        assert part in message


def test_no_such_file_and_a_folder(tmp_path):
    assert_one_line(tmp_path / "none.safetensors", "does not exist")
    assert_one_line(tmp_path, "is a folder")


@pytest.mark.parametrize("keep", [4, 8, 100, 5000, -1])
def test_a_truncated_file_names_the_byte(stored, tmp_path, keep):
    path = tmp_path / "cut.safetensors"
    path.write_bytes(stored.read_bytes()[:keep])
    size, whole = path.stat().st_size, stored.stat().st_size
    assert_one_line(path, f"ends at byte {size:,}", "get it again", *([f"says {whole:,}"] if size > 20_000 else []))


def test_an_empty_file(tmp_path):
    (tmp_path / "empty.safetensors").write_bytes(b"")
    assert_one_line(tmp_path / "empty.safetensors", "is empty", "copied completely")


def test_a_file_with_more_behind_it(stored, tmp_path):
    path = tmp_path / "long.safetensors"
    path.write_bytes(stored.read_bytes() + b"more")
    assert_one_line(path, f"says {stored.stat().st_size:,}")


def test_a_broken_header_names_the_byte(stored, tmp_path):
    path = tmp_path / "bad.safetensors"
    content = bytearray(stored.read_bytes())
    content[1000:1004] = b"\x00}}{"
    path.write_bytes(content)
    assert_one_line(path, "at byte 1,000", "get the file again")


@pytest.mark.parametrize(
    "content",
    [b"hello world, this is text", b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x01u.", b"\x1f\x8b" + bytes(50), bytes(64)],
)
def test_another_kind_of_file(tmp_path, content):
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    assert_one_line(path, "something else", "name a checkpoint")


@settings(max_examples=120, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_noticed(stored, tmp_path_factory, at, bit):
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
    # of the digest's own name, of a blank at the header's end, or one that JSON reads as the same: nothing is lost
    due, expected = load_checkpoint(stored)
    assert header == expected
    for name, value in due.state_dict().items():
        assert torch.equal(network.state_dict()[name], value)


def test_a_flipped_bit_of_a_weight_names_the_digest(stored, tmp_path):
    content = bytearray(stored.read_bytes())
    # a high bit of an exponent: still a finite number
    content[-1] ^= 0x08
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    assert_one_line(path, "does not fit the SHA-256 digest", "get the file again")


def test_a_file_without_a_digest_loads_with_a_note(stored, tmp_path):
    older = rewritten(stored, tmp_path / "older.safetensors")
    with pytest.warns(UserWarning, match="older.safetensors: has no digest, so damage goes unnoticed"):
        network, header = load_checkpoint(older)
    again = tmp_path / "again.safetensors"
    again.write_bytes(with_digest(older.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same, _ = load_checkpoint(again)
        # what has one keeps it
        assert with_digest(again.read_bytes()) == again.read_bytes()
        for name in BUNDLED:
            load_checkpoint(bundled_path(name))
    assert all(torch.equal(value, same.state_dict()[name]) for name, value in network.state_dict().items())


def test_a_file_may_be_cut_off_once_it_is_read(stored, tmp_path):
    """A mapped file would end the process."""
    path = tmp_path / "x.safetensors"
    path.write_bytes(stored.read_bytes())
    file = SafetensorsFile.open(path)
    path.write_bytes(b"")
    network = PoseNet(preset("tiny"))
    loaded = file.load(network.state_dict())
    assert file.check_digest() and all(torch.isfinite(value).all() for value in loaded.values())


def test_somebody_else_s_safetensors(tmp_path):
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": torch.zeros(3)}, path)
    assert_one_line(path, "not a checkpoint of lidarpose")
    save_file({"weight": torch.zeros(3)}, path, metadata={"format": "pt"})
    assert_one_line(path, "not a checkpoint of lidarpose")


def rewritten(stored, path, *, tensors=None, header=None):
    """The stored file with other tensors or another header."""
    kept = load_file(stored)
    with safe_open(stored, framework="pt") as file:
        entry = json.loads(file.metadata()["lidarpose"])
    change = tensors or dict
    text = header(entry) if header else entry
    save_file(change(kept), path, metadata={"lidarpose": text if isinstance(text, str) else json.dumps(text)})
    return path


def test_a_missing_an_extra_and_a_misshapen_tensor(stored, tmp_path):
    path = tmp_path / "x.safetensors"
    without = rewritten(stored, path, tensors=lambda t: {k: v for k, v in t.items() if k != "vote.query.bias"})
    assert_one_line(without, "tensor vote.query.bias is missing", "tiny")
    assert_one_line(rewritten(stored, path, tensors=lambda t: t | {"more": torch.zeros(1)}), "unknown tensor more")
    wrong = rewritten(stored, path, tensors=lambda t: t | {"part.weight": torch.zeros(24, 48)})
    assert_one_line(wrong, "part.weight should be (25, 48) by its configuration (tiny), got (24, 48)")


@pytest.mark.parametrize("change", [{"channels": [48, 64, 2**14]}, {"max_voxels": 10, "blocks": [1, 16_000, 1]}])
def test_nothing_is_allocated_for_what_a_header_says(stored, tmp_path, change):
    """A network of gigabytes, or of thousands of layers, in a file of half a megabyte."""
    path = rewritten(stored, tmp_path / "x.safetensors", header=lambda h: h | {"config": h["config"] | change})
    assert_one_line(path, "get the file again")


@pytest.mark.parametrize(
    "change",
    [
        {"channels": [48, 3_200_000_000_000, 96]},
        {"channels": [48, 10**7, 96]},
        {"parts": 10**19},
        {"convolution": 10**9},
    ],
)
def test_no_width_is_taken_that_nobody_trains(stored, tmp_path, change):
    path = rewritten(stored, tmp_path / "x.safetensors", header=lambda h: h | {"config": h["config"] | change})
    assert_one_line(path, f"{next(iter(change))} must be", "16384")


def test_weights_that_could_not_be_loaded_are_not_written(network, tmp_path):
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
    "value",
    [
        torch.full((25,), torch.nan),
        torch.zeros(25, dtype=torch.int32),
        # finite until they are float32
        torch.full((25,), 1e300, dtype=torch.float64),
    ],
)
def test_a_tensor_that_is_no_finite_float(stored, tmp_path, value):
    path = rewritten(stored, tmp_path / "x.safetensors", tensors=lambda t: t | {"part.bias": value})
    assert_one_line(path, "tensor part.bias", "not finite or no floats")


@pytest.mark.parametrize(
    "header, part",
    [
        (
            lambda h: h | {"schema": "lidarpose.checkpoint/9", "version": "7.1"},
            "use the lidarpose version that wrote it",
        ),
        (
            lambda h: h | {"schema": "lidarpose.checkpoint/9", "version": "7.1"},
            "got lidarpose.checkpoint/9 of lidarpose 7.1",
        ),
        (
            lambda h: h | {"schema": "lidarpose.checkpoint/1", "version": "0.1.0"},
            "use lidarpose 0.1.0 for it, or train",
        ),
        (lambda h: {k: v for k, v in h.items() if k != "schema"}, "'schema'"),
        (lambda h: {k: v for k, v in h.items() if k != "card"}, "'card'"),
        (lambda h: {k: v for k, v in h.items() if k != "network"}, "'network'"),
        (lambda h: h | {"network": "pointnet"}, "unknown kind of network 'pointnet'"),
        (lambda h: h | {"network": "dapt"}, "unknown setting blocks"),
        (lambda h: h | {"card": 5}, "cannot be read"),
        (lambda h: h | {"config": h["config"] | {"rotary": True}}, "unknown setting rotary"),
        (lambda h: h | {"config": {"size": "tiny"}}, "channels"),
        (lambda h: h | {"config": 5}, "cannot be read"),
        (lambda h: h | {"config": h["config"] | {"channels": 64.0}}, "channels must be 3 whole numbers"),
        (lambda h: h | {"config": h["config"] | {"channels": [64, -1, 64]}}, "channels must be 3 whole numbers"),
        (lambda h: h | {"config": h["config"] | {"head_channels": 0}}, "head_channels must be a whole number"),
        (lambda h: h | {"config": h["config"] | {"head_channels": 5}}, "must divide by head_channels"),
        (lambda h: h | {"config": h["config"] | {"blocks": [1, 1]}}, "blocks must be 3 whole numbers"),
        (lambda h: h | {"config": h["config"] | {"blocks": 3}}, "blocks must be 3 whole numbers"),
        (lambda h: h | {"config": h["config"] | {"grid": -1}}, "grid must be a positive number"),
        (lambda h: h | {"config": h["config"] | {"heatmap": "round"}}, "unknown heatmap 'round'"),
        (lambda h: h | {"config": h["config"] | {"skeleton": "body27"}}, "unknown skeleton 'body27'"),
        (lambda h: [h], "cannot be read"),
        (lambda h: json.dumps(h).replace('"card": {', '"card": {"n": ' + "1" * 5000 + ", ", 1), "cannot be read"),
        (lambda h: "{", "cannot be read"),
        (lambda h: "7", "cannot be read"),
    ],
)
def test_a_header_that_does_not_fit(stored, tmp_path, header, part):
    assert SCHEMA == "lidarpose.checkpoint/2"
    path = rewritten(stored, tmp_path / "x.safetensors", header=header)
    assert_one_line(path, part)
    assert_one_line(path, part, read=read_header)


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
def test_the_papers_network_there_and_back(tmp_path, half):
    torch.manual_seed(1)
    config = DaptConfig(
        name="mine", joints=("left_hip", *HUMAN15.joints[:1], *HUMAN15.joints[2:]), coordinates=True, **SMALL
    )
    network = DaptNet(config)
    path = tmp_path / "dapt.safetensors"
    save_checkpoint(path, network, card=CARD, half=half)
    loaded, header = load_checkpoint(path)
    assert isinstance(loaded, DaptNet) and not loaded.training
    assert header.network == "dapt" and header.config == config and header.skeleton is HUMAN15
    for name, value in network.state_dict().items():
        other = loaded.state_dict()[name]
        assert other.dtype == value.dtype
        torch.testing.assert_close(other, value.half().to(value.dtype) if half else value, rtol=0, atol=0)


def test_joints_that_make_up_no_skeleton():
    header = Header(config=DaptConfig(name="legs", joints=("left_knee", "right_knee"), coordinates=True), card={})
    with pytest.raises(InputError, match="the network legs predicts left_knee, right_knee"):
        _ = header.skeleton


def test_released_weights_come_in(tmp_path):
    out = tmp_path / "in.safetensors"
    header = import_released(TINY_DAPT, out)
    loaded, again = load_checkpoint(out)
    assert again == header and header.card["command"] == "lidarpose import dapt_tiny.safetensors"
    released = load_file(TINY_DAPT)
    for name, value in loaded.state_dict().items():
        torch.testing.assert_close(value, released[name].to(value.dtype), rtol=0, atol=0)


def test_a_refused_import_writes_nothing(tmp_path, stored):
    with pytest.raises(InputError, match="is missing"):
        import_released(stored, tmp_path / "in.safetensors", config="waymo")
    with pytest.raises(InputError, match=r"give a name that ends in \.safetensors"):
        import_released(TINY_DAPT, tmp_path / "in.onnx")
    whole = load_file(TINY_DAPT)
    name = next(name for name, value in whole.items() if value.is_floating_point())
    with safe_open(str(TINY_DAPT), framework="pt") as file:
        metadata = file.metadata()
    save_file(whole | {name: whole[name].int()}, tmp_path / "whole.safetensors", metadata=metadata)
    with pytest.raises(InputError, match=f"tensor {name} holds numbers that are not finite or no floats"):
        import_released(tmp_path / "whole.safetensors", tmp_path / "in.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["whole.safetensors"]
