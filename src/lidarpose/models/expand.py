"""Initializing a larger network from a smaller one by padding, after Net2Net (Chen et al. 2016).

New channels of a residual stream are initialized to the mean of the old channels: a layer norm over more channels
then sees the same mean, and a smaller variance, which its scale compensates. Layers that read the stream without a
norm read new channels with zero weights. New hidden units and heads are random, and layers read them with zero
weights. New blocks and convolutions add nothing. The remaining difference comes from the norm of the joint head,
which covers two streams at once: under a millimeter on average.
"""

from math import sqrt

import torch
from torch import Tensor

from lidarpose.errors import InputError
from lidarpose.models.config import NetworkConfig
from lidarpose.models.posenet import PoseNet

# settings that must be equal for the weights to keep their meaning
_SAME = ("grid", "skeleton", "parts", "heatmap", "head_channels")
# layers that read hidden units
_HIDDEN = ("stem.out", "attention.out", "among.out", "cross.out", "feed.2")
# layers that write a residual stream: their new rows are the mean of the old ones
_WRITERS = (*_HIDDEN, ".mix", ".place", "up_mid", "up_fine", "anchor_view")
# layers that read hidden units, and those that read a stream without a norm: their new columns are zero
_READERS = (
    *(*_HIDDEN, "joint.hidden.0", "joint.heatmap", "joint.certainty", "up_mid", "up_fine", "level_joints.0"),
    *("level_joints.1", "vote.query", "vote.key", "vote.residual", "part"),
)


def expand_weights(network: PoseNet, config: NetworkConfig) -> PoseNet:
    """A network of `config`, in training mode, whose outputs are nearly those of `network`, or the same for the same
    depth and width. New random weights come from torch's global generator. Raises InputError, one line, if `config` is
    narrower or shallower, or has another grid, skeleton, number of parts, heatmap, width of heads or of convolutions.
    """
    old_config = network.config
    # like new blocks, convolutions in a network that had none add nothing at first
    fixed_settings = (*_SAME, "convolution") if old_config.convolution else _SAME
    for name in ("channels", "blocks", *fixed_settings):
        old_value, new_value = getattr(old_config, name), getattr(config, name)
        is_smaller = name not in fixed_settings and any(b < a for a, b in zip(old_value, new_value, strict=True))
        if is_smaller or name in fixed_settings and new_value != old_value:
            raise InputError(
                f"a {config.size} network cannot start from this {old_config.size} network: {name} is {new_value!r} "
                f"instead of {old_value!r}{', and must not shrink' if is_smaller else ''}"
            )
    new_network = PoseNet(config)
    old_state = network.state_dict()
    if old_config.channels != config.channels:
        # the person head is small, quickly learned, and its input streams have another meaning now
        old_state = {name: value for name, value in old_state.items() if not name.startswith("person.")}
    state = new_network.state_dict()
    for name, value in state.items():
        if name in old_state:
            state[name] = _padded(name, old_state[name], value, network, new_network)
        elif name.rpartition(".")[0].endswith(_WRITERS):
            # in a new block: it adds nothing to the residual stream
            state[name] = torch.zeros_like(value)
    new_network.load_state_dict(state)
    return new_network.train()


def _padded(name: str, old: Tensor, new: Tensor, old_network: PoseNet, new_network: PoseNet) -> Tensor:
    """The old tensor padded to the new shape; new entries stay random, or are zero or the mean of a stream."""
    layer, _, entry = name.rpartition(".")
    out = new.clone()
    if name in ("anchors", "vote.offset"):
        out[:] = old.mean(1, keepdim=True) if name == "anchors" else 0
        out[:, : old.shape[1]] = old
        return out
    if "norm" in layer:
        # compensates the mean square, which is smaller by this factor over more channels
        value = old * sqrt(len(old) / len(new)) if entry == "weight" else old
        out[_places(old_network, new_network)[: len(old)] if layer == "joint.norm" else torch.arange(len(old))] = value
        return out
    if layer == "vote.query":
        # compensates that its products are divided by the root of the width
        old = old * sqrt(len(new) / len(old))
    if layer.endswith(_WRITERS):
        old = torch.cat([old, old.mean(0, keepdim=True).expand(len(new) - len(old), *old.shape[1:])])
    elif layer == "vote.key":
        out[len(old) :] = 0
    if old.ndim == 1:
        out[: len(old)] = old
        return out
    columns = _places(old_network, new_network) if layer == "joint.hidden.0" else torch.arange(old.shape[1])
    if layer.endswith(_READERS):
        is_new = torch.ones(new.shape[1], dtype=torch.bool)
        is_new[columns] = False
        out[:, is_new] = 0
    out[: len(old), columns] = old
    return out


def _places(old_network: PoseNet, new_network: PoseNet) -> Tensor:
    """Indices of the joint head's old inputs among the new ones: of the anchors, the voters and the vote."""
    (old_voters, old_width), (new_voters, new_width) = (
        (net.config.channels[0] if net.vote is not None else 0, net.config.channels[1])
        for net in (old_network, new_network)
    )
    starts = ((0, old_width), (new_width, old_voters), (new_width + new_voters, 3))
    return torch.cat([torch.arange(start, start + count) for start, count in starts])
