"""From the pre-trained network to the one to be fine-tuned. Strict: what is to be kept must fit, tensor by tensor."""

import torch
from torch import Tensor

from lidarpose.errors import InputError
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.dapt_net import DaptNet

_ANCHORS = "keypoint_embedding"
# settings that no tensor's shape betrays, but without which its numbers mean something else
_MEANING = ("legacy", "grid", "strides", "encoder_heads", "decoder_heads", "anchor_heads", "neck")


def transferred(source: DaptNet, config: DaptConfig, *, keep_anchors: bool = False) -> DaptNet:
    """A network of `config` that begins with the backbone of the pre-trained one, in training mode; `source` stays.

    Anchors and heads are new, drawn from torch's global generator, as in the released code. With `keep_anchors` anchors
    go on by joint name, as does the auxiliary head, and every other head that both have, the last layer of a heatmap's
    only where its bins and range are the same; those of new joints are new. Raises InputError, one line, for the first
    setting or tensor of the backbone that does not fit.
    """
    network = DaptNet(config)
    wanted = network.state_dict()
    state = wanted | _backbone(source, network)
    if keep_anchors:
        # the backbones fit, so the widths of their anchors do; the neck prn has none
        if (name := f"backbone.{_ANCHORS}") in wanted:
            state[name] = _by_joint(source.state_dict()[name], wanted[name], source.config.joints, config.joints)
        state |= _heads(source, network)
    network.load_state_dict(state)
    return network


def _backbone(trained: DaptNet, network: DaptNet) -> dict[str, Tensor]:
    """All of the trained backbone but its anchors. Raises InputError where it does not fit."""
    names = f"{trained.config.name} was pre-trained with", f"{network.config.name} has"
    remedy = "fine-tune with the sizes of the pre-trained network"
    stored, wanted = (
        {name: value for name, value in net.backbone.state_dict().items() if name != _ANCHORS}
        for net in (trained, network)
    )
    for name in sorted(stored.keys() | wanted.keys()):
        shapes = [tuple(state[name].shape) if name in state else "none" for state in (stored, wanted)]
        if shapes[0] != shapes[1]:
            raise InputError(
                f"tensor backbone.{name} does not fit: {names[0]} {shapes[0]}, {names[1]} {shapes[1]}: {remedy}"
            )
    for setting in _MEANING:
        values = [getattr(net.config, setting) for net in (trained, network)]
        if values[0] != values[1]:
            raise InputError(f"{setting} does not fit: {names[0]} {values[0]}, {names[1]} {values[1]}: {remedy}")
    return {f"backbone.{name}": value for name, value in stored.items()}


def _heads(trained: DaptNet, network: DaptNet) -> dict[str, Tensor]:
    """Tensors of the heads that both networks have, by what they do: the coordinate head has two names."""
    old, new = trained.config, network.config
    stored, wanted = trained.state_dict(), network.state_dict()
    # modules whose tensors go on, by their old names and by their new ones
    modules = {}
    if new.neck == "prn":
        modules["heads.prn."] = "heads.prn."
    elif old.coordinates and new.coordinates:
        before, after = ("heads.coordinate." if config.bins else "heads.query." for config in (old, new))
        modules[before] = after
    if old.parts and new.parts:
        modules["heads.feat."] = "heads.feat."
    if old.bins and new.bins:
        for k in range(3):
            # bins of another place or width mean something else
            same = old.bins[k] == new.bins[k] and old.ranges[k] == new.ranges[k]
            fc = f"heads.query.fcs.{k}." if same else f"heads.query.fcs.{k}.fc1."
            modules[fc] = fc
    heads: dict[str, Tensor] = {}
    if old.auxiliary and new.auxiliary:
        modules["heads.inter_feat.fc.fc1."] = "heads.inter_feat.fc.fc1."
        for name in ("heads.inter_feat.fc.fc2.weight", "heads.inter_feat.fc.fc2.bias"):
            # three rows a joint
            ours, fresh = (state[name].unflatten(0, (-1, 3)) for state in (stored, wanted))
            heads[name] = _by_joint(ours, fresh, old.joints, new.joints).flatten(0, 1)
    for name, value in stored.items():
        for before, after in modules.items():
            new_name = after + name.removeprefix(before)
            if name.startswith(before) and new_name in wanted and value.shape == wanted[new_name].shape:
                heads[new_name] = value
    if new.neck == "prn":
        # a row a joint, of parts background before them
        heads["heads.prn.joint"] = _by_joint(
            stored["heads.prn.joint"], wanted["heads.prn.joint"], old.joints, new.joints
        )
        last = max(name for name in wanted if name.startswith("heads.prn.vote.parts.")).rpartition(".")[0]
        for name in (f"{last}.weight", f"{last}.bias"):
            rows = _by_joint(stored[name][1:], wanted[name][1:], old.joints, new.joints)
            heads[name] = torch.cat([stored[name][:1], rows])
    return heads


def _by_joint(before: Tensor, after: Tensor, had: tuple[str, ...], has: tuple[str, ...]) -> Tensor:
    """after (J', ...), the rows of joints that `before` (J, ...) has too taken from there."""
    rows = [before[had.index(name)].to(after) if name in had else after[j] for j, name in enumerate(has)]
    return torch.stack(rows)
