"""Joint anchors and the exchange module (the paper's MDE).

Paper: A_{m-1} = MDE_m(A_m, f_m). An anchor is a learned vector a joint; a module lets the anchors look at each other
and at the voxels of one density level, from the coarsest to the finest. Deviations: pre-norm; the bottleneck is read
too (the released code begins one level above it); voxel features carry position, point count and the view of the
sensor, so that what an anchor gathers depends on density in fact; all levels share one width, so no alignment MLP.
"""

from torch import Tensor, nn

from lidarpose.model.layers import Attention, FeedForward


class Exchange(nn.Module):
    """One exchange: anchors (B, J, C) read voxels (B, K, C) of a level, then each other."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.norm_cross = nn.LayerNorm(channels)
        self.norm_voxels = nn.LayerNorm(channels)
        self.cross = Attention(channels, heads)
        self.norm_self = nn.LayerNorm(channels)
        self.among = Attention(channels, heads)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(self, anchors: Tensor, voxels: Tensor, bias: Tensor) -> Tensor:
        anchors = anchors + self.cross(self.norm_cross(anchors), self.norm_voxels(voxels), bias)
        normed = self.norm_self(anchors)
        anchors = anchors + self.among(normed, normed, None)
        return anchors + self.feed(self.norm_feed(anchors))
