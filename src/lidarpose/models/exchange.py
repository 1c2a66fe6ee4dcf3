"""Joint anchors and the exchange module (the paper's MDE).

Paper: A_{m-1} = MDE_m(A_m, f_m). An anchor is a learned vector a joint; a module lets the anchors look at the voxels of
one density level, then at each other, from the coarsest level to the finest. Deviations: pre-norm; the bottleneck is
read too (the released code begins one level above it); voxels are read by place, rotary and relative to where the
anchor believes its joint to be, and by density; anchors keep one width, so it is the keys that are brought to it.
"""

from torch import Tensor, nn

from lidarpose.models.layers import CrossAttention, FeedForward, Places, SelfAttention


class Exchange(nn.Module):
    """One exchange: anchors (B, J, C), their joints believed at `believed`, read voxels (B, K, E), then each other."""

    def __init__(self, channels: int, heads: int, voxel_channels: int):
        super().__init__()
        self.norm_cross = nn.LayerNorm(channels)
        self.norm_voxels = nn.LayerNorm(voxel_channels)
        self.cross = CrossAttention(channels, heads, voxel_channels)
        self.norm_self = nn.LayerNorm(channels)
        self.among = SelfAttention(channels, heads)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(
        self, anchors: Tensor, believed: Places, voxels: Tensor, places: Places, log_count: Tensor, bias: Tensor
    ) -> Tensor:
        read = self.cross(self.norm_cross(anchors), believed, self.norm_voxels(voxels), places, log_count, bias)
        anchors = anchors + read
        anchors = anchors + self.among(self.norm_self(anchors), None, None)
        return anchors + self.feed(self.norm_feed(anchors))
