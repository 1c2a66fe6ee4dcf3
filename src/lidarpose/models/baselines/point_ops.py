"""Neighborhoods within padded clouds, in plain torch: farthest points, balls, nearest neighbors.

Clouds are (B, N, 3) m with valid (B, N), False for padding. Distance matrices are dense: meant for thousands of points.
"""

import torch
from torch import Tensor

# squared distance of points that are not neighbors, m²
_FAR = 1e10


def gather_points(values: Tensor, index: Tensor) -> Tensor:
    """values (B, N, C), index (B, ...) -> (B, ..., C): rows of each cloud."""
    flat_index = index.flatten(1)
    rows = values.gather(1, flat_index[..., None].expand(-1, -1, values.shape[-1]))
    return rows.unflatten(1, index.shape[1:])


def square_distances(a: Tensor, b: Tensor) -> Tensor:
    """a (B, M, 3), b (B, N, 3) -> (B, M, N) m²; from differences, since a product of near points loses digits."""
    x, y, z = ((a[:, :, None, k] - b[:, None, :, k]).square() for k in range(3))
    return x + y + z


def farthest_points(points: Tensor, valid: Tensor, count: int, *, as_published: bool = False) -> Tensor:
    """(B, count) indices: each next point is the farthest from all previous ones; ties go to the first point.

    Args:
        points: (B, N, 3) m.
        valid: (B, N); a cloud with fewer points than `count` repeats its first choice.
        count: number of indices; if it is N and not `as_published`: all points, in their order.
        as_published: begin at point 0 and never choose a point within 3.2 cm of the origin, as the CUDA kernel of
            PointNet++ does; else begin at the point farthest from the mean, independent of the order of the points.
    """
    points, cloud = points.detach(), torch.arange(len(points), device=points.device)
    is_candidate = valid & (points.square().sum(-1) > 1e-3) if as_published else valid
    if as_published:
        index = torch.zeros(len(points), dtype=torch.long, device=points.device)
    else:
        weight = valid[..., None].to(points.dtype)
        mean = (points * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1)
        index = _masked(square_distances(points, mean)[..., 0], is_candidate).argmax(1)
        if count == points.shape[1]:
            return torch.where(valid, torch.arange(count, device=points.device), index[:, None])
    nearest_distance = torch.full(valid.shape, _FAR, dtype=points.dtype, device=points.device)
    nearest_distance = _masked(nearest_distance, is_candidate)
    indices = [index]
    for _ in range(count - 1):
        nearest_distance = torch.minimum(nearest_distance, (points - points[cloud, index][:, None]).square().sum(-1))
        # padding is below every distance; once every point is chosen, the first one is repeated
        index = torch.where(nearest_distance.amax(1) > 0, nearest_distance.argmax(1), indices[0])
        indices.append(index)
    return torch.stack(indices, 1)


def ball_query(
    centers: Tensor, points: Tensor, valid: Tensor, radius: float, count: int, *, as_published: bool = False
) -> Tensor:
    """(B, M, count) indices of the nearest points within `radius` m of centers (B, M, 3), padded with the nearest one.

    as_published: the first points in their order, padded with the first, as in the CUDA kernel.
    """
    distance = square_distances(centers, points)
    is_inside = (distance < radius * radius) & valid[:, None]
    if as_published:
        point_number = torch.arange(points.shape[1], device=points.device, dtype=points.dtype)
        distance = point_number.expand_as(distance)
    nearest_distance, index = distance.masked_fill(~is_inside, _FAR).topk(min(count, points.shape[1]), largest=False)
    index = torch.where(nearest_distance < _FAR, index, index[..., :1])
    return torch.cat([index, index[..., :1].expand(*index.shape[:-1], count - index.shape[-1])], -1)


def nearest_neighbors(points: Tensor, valid: Tensor, count: int) -> Tensor:
    """(B, N, count) indices of each point's nearest points, itself among them; -1 if a cloud has fewer."""
    distance = square_distances(points, points).masked_fill(~valid[:, None], _FAR)
    nearest_distance, index = distance.topk(min(count, points.shape[1]), largest=False)
    index = index.masked_fill((nearest_distance >= _FAR) | ~valid[..., None], -1)
    return torch.cat([index, index.new_full((*index.shape[:-1], count - index.shape[-1]), -1)], -1)


def _masked(values: Tensor, is_candidate: Tensor) -> Tensor:
    return values.masked_fill(~is_candidate, -1.0)
