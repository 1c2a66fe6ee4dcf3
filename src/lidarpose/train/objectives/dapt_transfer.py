"""From the pre-trained network to the one to be fine-tuned. Strict: every tensor that is to be kept must fit."""

import torch
from torch import Tensor

from lidarpose.errors import InputError
from lidarpose.models.dapt.dapt_config import RELEASED_FAULTS, DaptConfig
from lidarpose.models.dapt.dapt_net import DaptNet

_ANCHORS = "keypoint_embedding"
# settings that change the meaning of the weights without changing the shape of any tensor
_MEANING = (*RELEASED_FAULTS, "grid", "strides", "encoder_heads", "decoder_heads", "anchor_heads", "neck")


def transferred(source: DaptNet, config: DaptConfig, *, keep_anchors: bool = False) -> DaptNet:
    """A network of `config` with the backbone of the pre-trained `source`, in training mode; `source` is unchanged.

    Anchors and heads are new, drawn from torch's global generator, as in the released code. With `keep_anchors`,
    anchors and the auxiliary head are copied by joint name, and so is every other head that both networks have; the
    last layer of a heatmap head is copied only if its bins and range are the same. Those of new joints are new. Raises
    InputError, one line, for the first setting or tensor of the backbone that does not fit.
    """
    network = DaptNet(config)
    initial_state = network.state_dict()
    state = initial_state | _backbone(source, network)
    if keep_anchors:
        # the backbones fit, so the widths of their anchors do, too; the neck prn has no anchors
        if (name := f"backbone.{_ANCHORS}") in initial_state:
            state[name] = _by_joint(source.state_dict()[name], initial_state[name], source.config.joints, config.joints)
        state |= _heads(source, network)
    network.load_state_dict(state)
    return network


def _backbone(trained: DaptNet, network: DaptNet) -> dict[str, Tensor]:
    """The trained backbone except its anchors. Raises InputError if it does not fit."""
    names = f"{trained.config.name} was pre-trained with", f"{network.config.name} has"
    remedy = "fine-tune with the sizes of the pre-trained network"
    trained_state, new_state = (
        {name: value for name, value in net.backbone.state_dict().items() if name != _ANCHORS}
        for net in (trained, network)
    )
    for name in sorted(trained_state.keys() | new_state.keys()):
        shapes = [tuple(state[name].shape) if name in state else "none" for state in (trained_state, new_state)]
        if shapes[0] != shapes[1]:
            raise InputError(
                f"tensor backbone.{name} does not fit: {names[0]} {shapes[0]}, {names[1]} {shapes[1]}: {remedy}"
            )
    for setting in _MEANING:
        values = [getattr(net.config, setting) for net in (trained, network)]
        if values[0] != values[1]:
            raise InputError(f"{setting} does not fit: {names[0]} {values[0]}, {names[1]} {values[1]}: {remedy}")
    return {f"backbone.{name}": value for name, value in trained_state.items()}


def _heads(trained: DaptNet, network: DaptNet) -> dict[str, Tensor]:
    """Tensors of the heads that both networks have, matched by function: the coordinate head has two names."""
    old_config, new_config = trained.config, network.config
    trained_state, new_state = trained.state_dict(), network.state_dict()
    # modules whose tensors are copied: old name to new name
    modules = {}
    if new_config.neck == "prn":
        modules["heads.prn."] = "heads.prn."
    elif old_config.coordinates and new_config.coordinates:
        old_prefix, new_prefix = (
            "heads.coordinate." if config.bins else "heads.query." for config in (old_config, new_config)
        )
        modules[old_prefix] = new_prefix
    if old_config.parts and new_config.parts:
        modules["heads.feat."] = "heads.feat."
    if old_config.bins and new_config.bins:
        for k in range(3):
            # bins of another position or width have another meaning
            is_same = old_config.bins[k] == new_config.bins[k] and old_config.ranges[k] == new_config.ranges[k]
            fc = f"heads.query.fcs.{k}." if is_same else f"heads.query.fcs.{k}.fc1."
            modules[fc] = fc
    heads: dict[str, Tensor] = {}
    if old_config.auxiliary and new_config.auxiliary:
        modules["heads.inter_feat.fc.fc1."] = "heads.inter_feat.fc.fc1."
        for name in ("heads.inter_feat.fc.fc2.weight", "heads.inter_feat.fc.fc2.bias"):
            # three rows per joint
            trained_rows, new_rows = (state[name].unflatten(0, (-1, 3)) for state in (trained_state, new_state))
            heads[name] = _by_joint(trained_rows, new_rows, old_config.joints, new_config.joints).flatten(0, 1)
    for name, value in trained_state.items():
        for old_prefix, new_prefix in modules.items():
            new_name = new_prefix + name.removeprefix(old_prefix)
            if name.startswith(old_prefix) and new_name in new_state and value.shape == new_state[new_name].shape:
                heads[new_name] = value
    if new_config.neck == "prn":
        # one row per joint; the part head has a row for background before them
        heads["heads.prn.joint"] = _by_joint(
            trained_state["heads.prn.joint"], new_state["heads.prn.joint"], old_config.joints, new_config.joints
        )
        last_layer = max(name for name in new_state if name.startswith("heads.prn.vote.parts.")).rpartition(".")[0]
        for name in (f"{last_layer}.weight", f"{last_layer}.bias"):
            rows = _by_joint(trained_state[name][1:], new_state[name][1:], old_config.joints, new_config.joints)
            heads[name] = torch.cat([trained_state[name][:1], rows])
    return heads


def _by_joint(trained: Tensor, initial: Tensor, trained_joints: tuple[str, ...], joints: tuple[str, ...]) -> Tensor:
    """initial (J', ...), with the rows of joints that `trained` (J, ...) also has replaced by those of `trained`."""
    rows = [
        trained[trained_joints.index(name)].to(initial) if name in trained_joints else initial[j]
        for j, name in enumerate(joints)
    ]
    return torch.stack(rows)
