"""PRN, the pose regression network of LiDAR-HMR (Fan et al. 2023): points vote for joints, attention refines the votes.

`Prn` is the published network on Point Transformer V2. `PrnNeck` is the same idea on the features of any backbone, as
the paper exchanges it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lidarpose.models.baselines.baseline_config import PrnConfig
from lidarpose.models.baselines.point_transformer_v2 import EMBEDDING, PointTransformerV2, Rows, segment_reduce
from lidarpose.models.layers import attend

# a point votes if its background probability is below this and its most likely part's probability is above it
VOTES = 0.6


@dataclass(frozen=True, kw_only=True)
class PrnOutputs:
    """joints (B, J, 3) m, refined; voted (B, J, 3) m; parts (M, J + 1) logits; offsets (M, 3) m from points to their
    joints."""

    joints: Tensor
    voted: Tensor
    parts: Tensor
    offsets: Tensor


class Prn(nn.Module):
    """1.74 M parameters. As in the published network, background is the last part."""

    # tensors with one row per joint, in order, and some with one more row for background
    per_joint = ("joint.", "vote.parts.7.", "unused.3.")

    def __init__(self, config: PrnConfig):
        super().__init__()
        self.config = config
        joints, channels = len(config.joints), EMBEDDING // config.width_divisor
        self.backbone = PointTransformerV2(config.width_divisor, config.missing_in_softmax)
        # a classifier that the published network has but does not use
        self.unused = nn.Sequential(
            nn.Linear(channels, channels), nn.BatchNorm1d(channels), nn.ReLU(), nn.Linear(channels, joints + 1)
        ).requires_grad_(False)
        self.vote = OffsetHead(channels, joints, background=joints)
        width = channels + 3
        self.joint = nn.Embedding(joints, 32)
        self.embed = nn.Linear(32 + 3, channels)
        dropout = config.attention_dropout
        self.attention = nn.ModuleList(BareAttention(width, heads=3, dropout=dropout) for _ in range(2))
        # no activation between the last two layers, as published
        self.output = nn.Sequential(nn.Linear(width, 16), nn.ReLU(), nn.Linear(16, 8), nn.Linear(8, 3))

    def forward(self, points: Tensor, valid: Tensor, center: Tensor | None = None) -> PrnOutputs:
        """points (B, N, 3) m relative to the middle of their extent, valid (B, N) bool, at least one per person;
        center: used by `Lpformer` alone."""
        person = torch.arange(len(points), device=points.device)[:, None].expand_as(valid)[valid]
        rows = Rows(xyz=points[valid], person=person, count=valid.sum(1))
        features = self.backbone(rows)
        voted, parts, offsets = self.vote(features, rows)
        joint_features = torch.cat([voted, self.joint.weight.expand(len(voted), -1, -1)], -1)
        tokens = torch.cat([voted, self.embed(joint_features)], -1)
        context = points.new_zeros(*valid.shape, tokens.shape[-1])
        context[valid] = torch.cat([rows.xyz, features], -1)
        tokens = torch.cat([tokens, context], 1)
        mask = torch.cat([valid.new_ones(voted.shape[:2]), valid], 1)
        first_layer, last_layer = self.attention
        tokens = last_layer(first_layer(tokens, mask), mask, queries=voted.shape[1])
        return PrnOutputs(joints=self.output(tokens), voted=voted, parts=parts, offsets=offsets)


class OffsetHead(nn.Module):
    """Parts and offsets of points, and the joints that they vote for.

    The inputs are the points' features and the maximum and mean of each person's features. background: index of the
    background part.
    """

    def __init__(self, channels: int, joints: int, *, background: int):
        super().__init__()
        self.background = background
        self.parts = _point_head(channels, joints + 1)
        self.offsets = _point_head(channels, 3)

    def forward(self, features: Tensor, rows: Rows) -> tuple[Tensor, Tensor, Tensor]:
        people = len(rows.count)
        summary = [segment_reduce(features, rows.person, people, kind)[rows.person] for kind in ("amax", "mean")]
        context = torch.cat([features, *summary], 1)
        parts, offsets = self.parts(context), self.offsets(context)
        # votes are summed in single precision, also under half precision
        probability = parts.float().softmax(1)
        background = probability[:, self.background]
        joint_probability = torch.cat([probability[:, : self.background], probability[:, self.background + 1 :]], 1)
        is_voting = (background < VOTES) & (probability.amax(1) > VOTES)
        weight = joint_probability * is_voting[:, None]
        target = rows.xyz + offsets
        weight_sum = weight.new_zeros(people, joint_probability.shape[1]).index_add(0, rows.person, weight)
        vote_sum = weight.new_zeros(people, joint_probability.shape[1], 3).index_add(
            0, rows.person, weight[..., None] * target[:, None]
        )
        return vote_sum / (weight_sum[..., None] + 1e-8), parts, offsets


class BareAttention(nn.Module):
    """x + attention(x), without norm, feed-forward or output layer. Dropout is on the weights."""

    def __init__(self, channels: int, heads: int, dropout: float = 0.1):
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.query, self.key, self.value = (nn.Linear(channels, channels) for _ in range(3))

    def forward(self, x: Tensor, valid: Tensor, queries: int | None = None) -> Tensor:
        """x (B, N, C), valid (B, N): rows that may be attended to -> (B, N, C), or the first `queries` rows of it. Rows
        that are not valid are returned as they are."""
        query_rows, is_query = x[:, :queries], valid[:, :queries]
        dropout = self.dropout if self.training else 0.0
        counts, query_counts = valid.sum(1).tolist(), is_query.sum(1).tolist()
        projected = [
            layer(rows).unflatten(-1, (self.heads, -1)).split(lengths)
            for layer, rows, lengths in (
                (self.query, query_rows[is_query], query_counts),
                (self.key, x[valid], counts),
                (self.value, x[valid], counts),
            )
        ]
        # person by person: padded to the largest one, attention takes several times the memory and the time
        attended = [
            attend(*(rows.transpose(0, 1)[None] for rows in person), dropout=dropout)[0].transpose(0, 1).flatten(1)
            for person in zip(*projected, strict=True)
        ]
        # under autocast rows may have a lower precision than x
        rows = torch.cat(attended).to(query_rows.dtype)
        output = torch.zeros_like(query_rows).masked_scatter(is_query[..., None], rows)
        return query_rows + output


class PrnNeck(nn.Module):
    """The neck of the DAPT repository: votes, and three layers of stock attention, on features (M, C) of a backbone.

    Background is part 0. No configuration of its training is published; see docs/method.md for ours.
    """

    def __init__(self, channels: int, joints: int, heads: int = 4, dropout: float = 0.1):
        super().__init__()
        self.vote = OffsetHead(channels, joints, background=0)
        self.joint = nn.Parameter(torch.zeros(joints, channels))
        self.embed = nn.Linear(channels + 3, channels)
        self.token = nn.Linear(channels + 3, channels)
        layer = nn.TransformerEncoderLayer(channels, heads, 4 * channels, dropout, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, 3, enable_nested_tensor=False)
        self.norm = nn.LayerNorm(channels)
        self.output = nn.Sequential(nn.Linear(channels, 16), nn.ReLU(), nn.Linear(16, 8), nn.Linear(8, 3))

    def forward(self, features: Tensor, rows: Rows) -> PrnOutputs:
        voted, parts, offsets = self.vote(features, rows)
        joint_features = self.embed(torch.cat([voted, self.joint.expand(len(voted), -1, -1)], -1))
        joint_tokens = self.token(torch.cat([voted, joint_features], -1))
        point_tokens = self.token(torch.cat([rows.xyz, features], -1)).split(rows.count.tolist())
        # person by person: padded to the largest one, attention took several times the memory and the time
        refined = [
            self.layers(torch.cat([joint_tokens[i], tokens])[None])[0, : voted.shape[1]]
            for i, tokens in enumerate(point_tokens)
        ]
        joints = self.output(self.norm(torch.stack(refined)))
        return PrnOutputs(joints=joints, voted=voted, parts=parts, offsets=offsets)


def _point_head(channels: int, out_channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(3 * channels, 2 * channels),
        nn.BatchNorm1d(2 * channels),
        nn.ReLU(),
        nn.Dropout(0.5),
        nn.Linear(2 * channels, channels),
        nn.BatchNorm1d(channels),
        nn.ReLU(),
        nn.Linear(channels, out_channels),
    )
