"""Initialization of a larger network from a smaller one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarpose.errors import InputError
from lidarpose.models import bundled_path
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.config import SIZES
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import Batch, PoseNet
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import example
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import optimizers
from lidarpose.train.recipes import Pretrain
from lidarpose.train.setup import make_setup


@pytest.fixture(scope="module")
def arrays():
    generator, rng = Generator(scene=scene_config("wild"), measure=False), np.random.default_rng(0)
    people = [example(generator.person(77, k).sample, rng, pelvis_centered=0.0) for k in range(24)]
    # with the neighbor tables of convolutions, which other networks ignore
    return PoseNetObjective(config=SIZES["tiny"]).collate(people)


def outputs_of(network, arrays):
    with torch.no_grad():
        return network.eval()(Batch.from_arrays(arrays))


@pytest.mark.long
@pytest.mark.parametrize("heatmap", ["window", "full", "none"])
def test_expand_weights_keeps_outputs(arrays, heatmap):
    torch.manual_seed(0)
    config = replace(SIZES["tiny"], heatmap=heatmap, convolution=0)
    small = PoseNet(config)
    larger = expand_weights(small, replace(config, size="deep", blocks=(2, 3, 2), convolution=8))
    before, after = outputs_of(small, arrays), outputs_of(larger, arrays)
    for name in ("vote", "heatmap", "part", "confidence", "log_spread", "visible"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), atol=1e-5, rtol=1e-5)


def test_expand_weights_tiny_to_small_keeps_joints(arrays):
    """Joints move by less than 2 % of their error, due to the norm of the joint head's two streams."""
    network, _ = load_checkpoint(bundled_path("tiny"))
    torch.manual_seed(0)
    before, after = (
        outputs_of(network, arrays).joints(),
        outputs_of(expand_weights(network, SIZES["small"]), arrays).joints(),
    )
    true = torch.as_tensor(arrays["joints"])
    errors = [float((joints - true).norm(dim=-1).mean()) for joints in (before, after)]
    moved = float((after - before).norm(dim=-1).mean())
    assert moved < 0.02 * errors[0] and errors[1] < 1.05 * errors[0], (moved, errors)
    # a network with random weights predicts other joints
    assert (outputs_of(PoseNet(SIZES["small"]), arrays).joints() - before).norm(dim=-1).mean() > 0.2


@pytest.mark.long
def test_expanded_network_trains_all_weights(arrays):
    torch.manual_seed(0)
    network, _ = load_checkpoint(bundled_path("tiny"))
    larger = expand_weights(network, SIZES["small"])
    before = {name: value.clone() for name, value in larger.named_parameters()}
    steppers, objective = optimizers(larger, Pretrain()), PoseNetObjective(config=SIZES["small"])
    for _ in range(3):
        terms = objective.terms(larger, arrays)
        total(terms).backward()
        for optimizer in steppers:
            optimizer.step()
            optimizer.zero_grad()
    assert all(value.detach().isfinite() for value in terms.values())
    for name, value in larger.named_parameters():
        still = value == before[name]
        if value.ndim > 1:
            # no row or column stays unchanged
            assert not still.all(-1).any(), name
            assert not still.flatten(0, -2).all(0).any(), name


def test_expand_weights_rejects_incompatible_configs():
    tiny = PoseNet(SIZES["tiny"])
    for change, words in (
        ({"channels": (32, 64, 96)}, "must not shrink"),
        ({"blocks": (1, 0, 1)}, "must not shrink"),
        ({"grid": 0.04}, "grid is 0.04 instead of 0.06"),
        ({"heatmap": "none"}, "heatmap"),
        ({"head_channels": 16}, "head_channels"),
        ({"convolution": 0}, "convolution is 0 instead of 12"),
        ({"convolution": 16}, "convolution is 16 instead of 12"),
    ):
        with pytest.raises(InputError, match=words):
            expand_weights(tiny, replace(SIZES["tiny"], **change))


def test_pretrain_initializes_from_smaller_network(tmp_path):
    setup = make_setup(Pretrain(size="small", init="tiny"))
    torch.manual_seed(0)
    network = setup.network()
    assert network.config == SIZES["small"] and network.training
    assert setup.card["init_card"]["people_seen"] > 0
    torch.manual_seed(0)
    assert all(map(torch.equal, network.state_dict().values(), setup.network().state_dict().values()))
    assert make_setup(Pretrain(size="base", init="tiny")).network().config == SIZES["base"]
    with pytest.raises(InputError, match="dapt starts from random weights"):
        make_setup(Pretrain(size="paper-small", init="tiny"))
    path = tmp_path / "small.safetensors"
    save_checkpoint(path, network, card={})
    with pytest.raises(InputError, match="must not shrink"):
        make_setup(Pretrain(size="tiny", init=str(path)))
