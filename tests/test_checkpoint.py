"""Weights on disk: there and back, and one line for every fault."""

import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.model.checkpoint import SCHEMA, load_checkpoint, read_header, save_checkpoint
from lidarpose.model.network import PoseNet
from lidarpose.model.presets import preset

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
    assert read_header(path) == header
    for name, value in network.state_dict().items():
        other = loaded.state_dict()[name]
        assert other.dtype == torch.float32
        if half:
            torch.testing.assert_close(other, value, rtol=1e-3, atol=1e-7)
            torch.testing.assert_close(other, value.half().float(), rtol=0, atol=0)
        else:
            torch.testing.assert_close(other, value, rtol=0, atol=0)
    size = path.stat().st_size
    assert (2 if half else 4) * 348_218 < size < (2 if half else 4) * 348_218 + 20_000


def test_saving_leaves_the_network_and_an_older_file_in_peace(network, stored, tmp_path):
    assert network.training and all(p.requires_grad for p in network.parameters())
    path = tmp_path / "a.safetensors"
    path.write_bytes(stored.read_bytes())
    with pytest.raises(TypeError):
        save_checkpoint(path, network, card={"bad": object()})
    assert path.read_bytes() == stored.read_bytes() and list(tmp_path.iterdir()) == [path]


def assert_one_line(path, *parts):
    with pytest.raises(InputError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    for part in parts:
        assert part in message


def test_no_such_file_and_a_folder(tmp_path):
    assert_one_line(tmp_path / "none.safetensors", "does not exist")
    assert_one_line(tmp_path, "is a directory")


@pytest.mark.parametrize("keep", [0, 4, 100, 5000, -1])
def test_a_truncated_file(stored, tmp_path, keep):
    path = tmp_path / "cut.safetensors"
    path.write_bytes(stored.read_bytes()[:keep])
    assert_one_line(path, "damaged or something else")


@pytest.mark.parametrize(
    "content", [b"hello world, this is text", b"\x80\x02}q\x00.", b"\x1f\x8b" + bytes(50), bytes(64)]
)
def test_another_kind_of_file(tmp_path, content):
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    assert_one_line(path, "damaged or something else")


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
    wrong = rewritten(stored, path, tensors=lambda t: t | {"part.weight": torch.zeros(24, 64)})
    assert_one_line(wrong, "part.weight should be (25, 64), got (24, 64)")


@pytest.mark.parametrize(
    "header, part",
    [
        (lambda h: h | {"schema": "lidarpose.checkpoint/9"}, "expected schema lidarpose.checkpoint/1, got"),
        (lambda h: {k: v for k, v in h.items() if k != "schema"}, "'schema'"),
        (lambda h: {k: v for k, v in h.items() if k != "card"}, "'card'"),
        (lambda h: h | {"config": h["config"] | {"rotary": True}}, "unknown setting rotary"),
        (lambda h: h | {"config": {"size": "tiny"}}, "channels"),
        (lambda h: h | {"config": 5}, "cannot be read"),
        (lambda h: h | {"config": h["config"] | {"channels": 64.0}}, "channels must be a whole number"),
        (lambda h: h | {"config": h["config"] | {"channels": "64"}}, "channels must be a whole number"),
        (lambda h: h | {"config": h["config"] | {"heads": 0}}, "heads must be a whole number"),
        (lambda h: h | {"config": h["config"] | {"channels": -64}}, "channels must be a whole number"),
        (lambda h: h | {"config": h["config"] | {"heads": 5}}, "channels must divide by heads"),
        (lambda h: h | {"config": h["config"] | {"blocks": [1, 1]}}, "blocks must be three whole numbers"),
        (lambda h: h | {"config": h["config"] | {"blocks": 3}}, "blocks must be three whole numbers"),
        (lambda h: h | {"config": h["config"] | {"grid": -1}}, "grid must be a positive number"),
        (lambda h: h | {"config": h["config"] | {"skeleton": "body27"}}, "unknown skeleton 'body27'"),
        (lambda h: [h], "cannot be read"),
        (lambda h: "{", "cannot be read"),
        (lambda h: "7", "cannot be read"),
    ],
)
def test_a_header_that_does_not_fit(stored, tmp_path, header, part):
    assert SCHEMA == "lidarpose.checkpoint/1"
    assert_one_line(rewritten(stored, tmp_path / "x.safetensors", header=header), part)
