"""Sizes of the paper's network, its joints and heatmaps, and the configurations by name. Numpy only.

Legend: L levels (0 = the finest), J joints, W heatmap bins per axis.
"""

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.models.config import MOST, Config, at_least, check_counts, check_joints, is_number, probability
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24

# joint order of the released Waymo network: Waymo's own numbering, limb by limb
WAYMO_JOINTS = tuple(
    """nose left_shoulder left_elbow left_wrist left_hip left_knee left_ankle
    right_shoulder right_elbow right_wrist right_hip right_knee right_ankle head_center""".split()
)
# SMPL's 24 parts and 0 = background
PARTS = 25
# space-filling curves, see `voxel_tables`
CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")
# how joints are read from the decoder, see `DaptConfig`
NECKS = ("mde", "finest", "prn")
# bits of a cell index along each axis
CELL_BITS = 16

Range = tuple[float, float]

# settings that each reproduce a difference of the released code: of the network, of its losses in training; and those
# that inference with its weights needs
LOSS_FAULTS = ("squared_distance", "ignore_background", "unnormalized_heatmaps", "auxiliary_loss")
FAULTS = ("stale_convolution", "grid_from_minimum", "zero_anchors", *LOSS_FAULTS)
RELEASED_FAULTS: dict[str, Any] = {"stale_convolution": True, "grid_from_minimum": True}


@dataclass(frozen=True, kw_only=True)
class DaptConfig(Config):
    """The network: a Point Transformer V3 U-Net, joint anchors that attend to every level of its decoder, heads.

    name: of the configuration; joints: names in the network's own order; bins, ranges: heatmap bins (W) and (low, high)
    in meters for x, y and z, both empty without heatmaps; encoder_*: one entry per level; decoder_*: one entry per
    level but the last; anchor_channels: width of the anchors after each level's exchange, the last entry before any
    exchange; anchor_heads, anchor_dropout: of the neck's layers; neck: "mde", anchors attend to every level of the
    decoder (the paper's network); "finest", four layers attend to the finest level alone (Table 3 without MDE), anchors
    and layers as wide as that level; "prn", no anchors, voxels vote and attention refines the votes (`PrnNeck`), which
    gives the coordinates; patch: number of voxels within which attention is full; grid: edge of a voxel of level 0,
    meters; strides: width of the next level's voxels relative to each level's; orders: curves for people with more than
    `patch` voxels; drop_path: of the last block; parts: classes of the part head, 0 for no part head; coordinates: a
    head that predicts x, y, z from each anchor (the paper's pre-training); auxiliary: a head that predicts all joints
    from the bottleneck (the released fine-tuning). `FAULTS` of the released code, each False for the corrected
    behavior; its weights need the first two: stale_convolution: the convolutions of later blocks read rows from before
    the last sum (see `dapt_net`); grid_from_minimum: cells count from the cloud's own minimum, so that one outlier
    moves them all; zero_anchors: new anchors are initialized to zero, all equal. Four concern training alone (see
    `dapt_losses`): squared_distance: distances are squared; ignore_background: background points have no loss of parts;
    unnormalized_heatmaps: targets do not sum to 1, and the divergence is averaged over bins; auxiliary_loss: fine-tuned
    networks have the head `auxiliary`, with a loss.
    """

    kind: ClassVar[str] = "dapt"

    name: str
    joints: tuple[str, ...]
    bins: tuple[int, ...] = ()
    ranges: tuple[Range, ...] = ()
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)
    decoder_channels: tuple[int, ...] = (128, 128, 128, 256)
    decoder_heads: tuple[int, ...] = (8, 8, 8, 16)
    anchor_channels: tuple[int, ...] = (128, 128, 128, 256, 256)
    anchor_heads: int = 4
    anchor_dropout: float = probability(0.1)
    neck: str = "mde"
    mlp_ratio: int = 4
    patch: int = 1024
    grid: float = 0.01
    strides: tuple[int, ...] = (2, 2, 2, 2)
    orders: tuple[str, ...] = CURVES
    drop_path: float = probability(0.3)
    parts: int = at_least(0, 0)
    coordinates: bool = False
    auxiliary: bool = False
    stale_convolution: bool = False
    grid_from_minimum: bool = False
    zero_anchors: bool = False
    squared_distance: bool = False
    ignore_background: bool = False
    unnormalized_heatmaps: bool = False
    auxiliary_loss: bool = False

    def __post_init__(self):
        super().__post_init__()
        levels = len(self.encoder_depths) if isinstance(self.encoder_depths, tuple) else 0
        lengths = {"encoder_depths": max(levels, 2)}
        lengths |= dict.fromkeys(("encoder_channels", "encoder_heads", "anchor_channels"), levels)
        lengths |= dict.fromkeys(("decoder_depths", "decoder_channels", "decoder_heads", "strides"), levels - 1)
        for name, length in lengths.items():
            counts = check_counts(name, getattr(self, name), length, levels=f" (encoder_depths has {levels})")
            object.__setattr__(self, name, counts)
        if not set(self.strides) <= {2, 4, 8} or np.prod(self.strides, dtype=float) > 1 << CELL_BITS:
            raise InputError(
                f"strides must be 2, 4 or 8 each, and their product at most {1 << CELL_BITS}, got {self.strides}"
            )
        for module, head_module in (("encoder", "encoder"), ("decoder", "decoder"), ("decoder", "anchor")):
            channels, heads = f"{module}_channels", f"{head_module}_heads"
            if np.any(np.array(getattr(self, channels)) % getattr(self, heads)):
                raise InputError(
                    f"{channels} must be divisible by {heads}, got {getattr(self, channels)} and {getattr(self, heads)}"
                )
        if not isinstance(self.orders, tuple) or not self.orders:
            curves = ", ".join(CURVES)
            raise InputError(f"orders must be a tuple of at least one curve of {curves}, got {self.orders!r}")
        for order in self.orders:
            check_name("curve", order, CURVES)
        check_joints(self.joints)
        check_name("neck", self.neck, NECKS)
        self._check_heads()

    def _check_heads(self) -> None:
        if self.bins or self.ranges:
            check_counts("bins", self.bins, 3, levels=" (x, y, z)")
            if not isinstance(self.ranges, tuple) or len(self.ranges) != 3 or not all(map(_is_range, self.ranges)):
                raise InputError(f"ranges must be three pairs (low, high) of meters, or none, got {self.ranges!r}")
        elif not self.coordinates:
            raise InputError(
                "a network needs heatmaps (bins and ranges) or coordinates=True: without them it predicts nothing"
            )
        if self.parts == 1:
            raise InputError(f"parts must be 0 (no part head) or from 2 to {MOST}, got 1")
        if self.neck == "prn":
            if self.bins or self.parts or not self.coordinates:
                reason = "the neck prn has joints and parts of its own"
                raise InputError(f"{reason}: leave bins, ranges and parts empty and set coordinates=True")
            for name in ("zero_anchors", "unnormalized_heatmaps", "auxiliary_loss"):
                if getattr(self, name):
                    raise InputError(f"{name}: the neck prn has no anchors, heatmaps or auxiliary head: omit it")

    @property
    def min_tensors(self) -> int:
        """Number of blocks at all levels, encoder and decoder."""
        return sum(self.encoder_depths) + sum(self.decoder_depths)

    @property
    def anchor_width(self) -> int:
        """Channels of the anchors that the heads read."""
        return self.anchor_channels[0] if self.neck == "mde" else self.decoder_channels[0]

    @property
    def low(self) -> np.ndarray:
        """(3,) m: position of bin 0 on each axis."""
        return np.array([low for low, _ in self.ranges])

    @property
    def step(self) -> np.ndarray:
        """(3,) m: spacing of the bins on each axis. position = low + index * step, as in the released code."""
        return np.array([(high - low) / n for (low, high), n in zip(self.ranges, self.bins, strict=True)])

    @classmethod
    def from_dict(cls, entries: dict) -> "DaptConfig":
        """From `to_dict`'s entries, or from the constructor arguments of the authors' backbone.

        The latter are recognized by `enc_depths`. In them, `grid` holds the heatmap arguments "size" and "range" of a
        fine-tuned network (heatmaps and auxiliary head); without `grid` the network is a pre-trained one (coordinates
        and parts). Joints follow from `num_keypoints`: 14 are Waymo's, 15 HumanM3's, 24 SMPL's, unless `joints` names
        them; name, parts, coordinates, auxiliary and `FAULTS` may be added, or legacy for both of `RELEASED_FAULTS`.
        Raises InputError for entries that do not fit.
        """
        entries = cls.renamed(entries)
        if "enc_depths" in entries:
            entries = _from_reference(entries)
        setting_names = [field.name for field in fields(cls)]
        for entry in entries:
            check_name("setting of the network", entry, setting_names)
        for entry in ("name", "joints"):
            if entry not in entries:
                raise InputError(f"a configuration needs the entry {entry!r}, got only {', '.join(entries) or 'none'}")
        return cls(**entries)

    @staticmethod
    def renamed(entries: dict[str, Any]) -> dict[str, Any]:
        """Replaces `legacy`, which stands for both of `RELEASED_FAULTS`, with these two settings."""
        if "legacy" not in entries:
            return entries
        return {name: value for name, value in entries.items() if name != "legacy"} | dict.fromkeys(
            RELEASED_FAULTS, entries["legacy"]
        )


def _is_range(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(map(is_number, value)) and value[0] < value[1]


# settings that the authors name differently: their name, and this package's
_REFERENCE = dict(
    pair.split(":")
    for pair in """enc_depths:encoder_depths enc_channels:encoder_channels enc_num_head:encoder_heads
    dec_depths:decoder_depths dec_channels:decoder_channels dec_num_head:decoder_heads dec_kp_channels:anchor_channels
    mlp_ratio:mlp_ratio stride:strides order:orders drop_path:drop_path grid_size:grid""".split()
)
# values that the authors' arguments must have: others describe a different network
_FIXED = {"in_channels": 3, "dec_kp_mixer": "attn", "num_extra": 0, "pre_norm": True, "qkv_bias": True}
_FIXED |= dict.fromkeys(("enable_rpe", "cls_mode", "pdnorm_bn", "pdnorm_ln"), False)
_JOINTS = (WAYMO_JOINTS, HUMAN15.joints, SMPL24.joints)


def _from_reference(entries: dict) -> dict:
    """Settings of a `DaptConfig` from the constructor arguments of the authors' backbone."""
    for name, value in _FIXED.items():
        if entries.get(name, value) != value:
            raise InputError(f"{name} must be {value!r} for the paper's network, got {entries[name]!r}")
    sizes = [entries.get(name, 1024) for name in ("enc_patch_size", "dec_patch_size")]
    patches = {patch for size in sizes for patch in (size if isinstance(size, list | tuple) else [size])}
    if len(patches) != 1:
        raise InputError(f"enc_patch_size and dec_patch_size must be one number throughout, got {sorted(patches)}")
    settings = {setting: entries[argument] for argument, setting in _REFERENCE.items() if argument in entries}
    count = entries.get("num_keypoints", 14)
    joints = entries.get("joints", next((names for names in _JOINTS if len(names) == count), None))
    if not isinstance(count, int) or joints is None:
        raise InputError(f"num_keypoints must be 14, 15 or 24 where no joints are named, got {count!r}: add 'joints'")
    settings |= {"joints": joints, "patch": patches.pop(), **RELEASED_FAULTS}
    heatmaps = entries.get("grid")
    if heatmaps is None:
        settings |= {"name": "pretrain", "coordinates": True, "parts": PARTS}
    else:
        try:
            settings |= {"bins": heatmaps["size"], "ranges": heatmaps["range"], "name": "released", "auxiliary": True}
        except (KeyError, TypeError):
            raise InputError(f"grid must be {{'size': ..., 'range': ...}} of the heatmaps, got {heatmaps!r}") from None
    # settings that their arguments do not cover
    extra_names = ("name", "parts", "coordinates", "auxiliary", *FAULTS)
    return settings | {name: entries[name] for name in extra_names if name in entries}


def _released(name: str, joints: tuple[str, ...], bins: tuple[int, int], half_widths: Range) -> DaptConfig:
    """A released configuration; bins and half widths in meters are each (of x and y, of z)."""
    xy_range, z_range = ((-r, r) for r in half_widths)
    heads: dict[str, Any] = {"bins": (bins[0], *bins), "ranges": (xy_range, xy_range, z_range), "auxiliary": True}
    return DaptConfig(name=name, joints=joints, **heads, **RELEASED_FAULTS)


_ALL_HEADS: dict[str, Any] = {"parts": PARTS, "coordinates": True, "auxiliary": True}
# `paper`: the paper's network for the superset skeleton, with the heads of both stages, so that none is discarded
# between pre-training and fine-tuning; the others: the networks in the authors' own files
CONFIGS = {
    "paper": DaptConfig(name="paper", joints=BODY26.joints, bins=(220,) * 3, ranges=((-1.1, 1.1),) * 3, **_ALL_HEADS),
    "waymo": _released("waymo", WAYMO_JOINTS, (72, 120), (0.9, 1.5)),
    "humanm3": _released("humanm3", HUMAN15.joints, (140, 220), (0.7, 1.1)),
    "lidarhuman26m": _released("lidarhuman26m", SMPL24.joints, (220, 220), (1.1, 1.1)),
    "sloper4d": _released("sloper4d", SMPL24.joints, (100, 100), (1.0, 1.0)),
    "pretrain": DaptConfig(name="pretrain", joints=HUMAN15.joints, parts=PARTS, coordinates=True, **RELEASED_FAULTS),
}


def named_config(name: str) -> DaptConfig:
    """A configuration by name: paper, or one of the released waymo, humanm3, lidarhuman26m, sloper4d and pretrain."""
    check_name("DAPT configuration", name, CONFIGS)
    return CONFIGS[name]
