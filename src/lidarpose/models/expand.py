"""A larger `PoseNet` that begins where a smaller one is: what has been learned goes on in more channels and blocks.

After Net2Net (Chen et al. 2016), by padding. Channels that are new in a residual stream begin as the mean of the old
ones: a layer norm over more channels then sees the same mean, and a variance smaller by as much as its scale makes up
for; what reads the stream without a norm reads them by zero. Hidden units and heads that are new begin at random, and
what reads them at zero; blocks and convolutions that are new add nothing. What is left of the difference is the norm
of the joint head, which sees two streams at once: under a millimetre on average.
"""

from math import sqrt

import torch
from torch import Tensor

from lidarpose.errors import InputError
from lidarpose.models.config import NetworkConfig
from lidarpose.models.posenet import PoseNet

# what must be alike for numbers to mean the same
_SAME = ("grid", "skeleton", "parts", "heatmap", "head_channels")
# layers that write a residual stream: their new rows are the mean of the old ones
_WRITERS = (
    *("stem.out", ".mix", ".place", "up_mid", "up_fine", "attention.out", "among.out", "cross.out", "feed.2"),
    "anchor_view",
)
# layers that read hidden units, and those that read a stream without a norm: their new columns are zero
_READERS = (
    *("stem.out", "attention.out", "among.out", "cross.out", "feed.2", "joint.heatmap", "joint.certainty"),
    *("up_mid", "up_fine", "level_joints.0", "level_joints.1", "vote.query", "vote.key", "vote.residual", "part"),
    "joint.hidden.0",
)


def expand_weights(network: PoseNet, config: NetworkConfig) -> PoseNet:
    """A network of `config`, in training mode, that answers nearly as `network` does; of the same depth and width, the
    same. What is drawn comes from torch's global generator. Raises InputError, one line, where `config` is narrower or
    shallower, or of another grid, skeleton, heatmap, width of heads or of convolutions.
    """
    small, size = network.config, config.size
    for name in ("channels", "blocks"):
        if any(new < old for new, old in zip(getattr(config, name), getattr(small, name), strict=True)):
            raise InputError(
                f"a {size} network cannot begin as this {small.size} one: its {name} are {getattr(config, name)}, "
                f"there {getattr(small, name)}, and none may shrink"
            )
    # convolutions where there are none add nothing, as new blocks
    for name in (*_SAME, "convolution") if small.convolution else _SAME:
        if getattr(small, name) != getattr(config, name):
            raise InputError(
                f"a {size} network cannot begin as this {small.size} one: {name} is {getattr(config, name)!r}, "
                f"there {getattr(small, name)!r}"
            )
    larger = PoseNet(config)
    learned = network.state_dict()
    state = larger.state_dict()
    for name, value in state.items():
        state[name] = _padded(name, learned[name], value, network, larger) if name in learned else _idle(name, value)
    larger.load_state_dict(state)
    return larger.train()


def _idle(name: str, value: Tensor) -> Tensor:
    """A tensor of a new block, which adds nothing to what goes through it."""
    return torch.zeros_like(value) if name.rpartition(".")[0].endswith(_WRITERS) else value


def _padded(name: str, old: Tensor, new: Tensor, small: PoseNet, larger: PoseNet) -> Tensor:
    """The old tensor in the larger one's shape; what is new of it as it was drawn, zero, or the mean of a stream."""
    layer, _, entry = name.rpartition(".")
    out = new.clone()
    if name in ("anchors", "vote.offset"):
        out[:] = old.mean(1, keepdim=True) if name == "anchors" else 0
        out[:, : old.shape[1]] = old
        return out
    if "norm" in layer:
        # the mean square over more channels is smaller by as much
        value = old * sqrt(len(old) / len(new)) if entry == "weight" else old
        out[_places(small, larger)[: len(old)] if layer == "joint.norm" else torch.arange(len(old))] = value
        return out
    if layer == "vote.query":
        # its products are divided by the root of the width
        old = old * sqrt(len(new) / len(old))
    if layer.endswith(_WRITERS):
        old = torch.cat([old, old.mean(0, keepdim=True).expand(len(new) - len(old), *old.shape[1:])])
    elif layer == "vote.key":
        out[len(old) :] = 0
    if old.ndim == 1:
        out[: len(old)] = old
        return out
    columns = _places(small, larger) if layer == "joint.hidden.0" else torch.arange(old.shape[1])
    if layer.endswith(_READERS):
        fresh = torch.ones(new.shape[1], dtype=torch.bool)
        fresh[columns] = False
        out[:, fresh] = 0
    out[: len(old), columns] = old
    return out


def _places(small: PoseNet, larger: PoseNet) -> Tensor:
    """Where the joint head's old inputs lie among the new ones: the anchors', the voters', and the vote."""
    (voter_channels, width), (more_voter_channels, wider) = (
        (net.config.channels[0] if net.vote is not None else 0, net.config.channels[1]) for net in (small, larger)
    )
    after = wider + more_voter_channels
    return torch.cat([torch.arange(width), wider + torch.arange(voter_channels), after + torch.arange(3)])
