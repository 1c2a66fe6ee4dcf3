"""The caster in torch, for GPUs: `raycast_people.scan_people`, all people at once, on the device of the vertices.

The same steps as in `raycast`, each as an operation over a list: triangles that survive, their crossings with columns
(triangle, column), the beams between two crossings (triangle, column, row). The nearest hit of a beam is a maximum
over those, so the result does not depend on the order in which a device works. People that are too near or reach
around the sensor are left to `raycast.scan`.

Letters: B people, V vertices and F faces with what stands around, M triangles kept, K crossings, H beams met.
"""

from dataclasses import dataclass

import numpy as np
import torch

from lidarpose.errors import InputError
from lidarpose.lidar.sensor import Sensor

# m: nearer people, and those with vertices beyond this tangent of azimuth or elevation (80 deg), are cast one by one
_NEAR, _STEEP = 1.0, 5.67
# of azimuth that the columns of a window may span
_WIDEST = np.radians(92.0)
# as in `raycast_kernels`: triangles wider than this in Y are not dropped by row, narrower ones by a bound of their sag
_NARROW = 0.04
_SAG = 1 / np.cos(_NARROW / 2) - 1
# of rows' bounds and of a triangle's orientation, against the rounding of either type
_ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-9}
_EDGE_ON = {torch.float32: 1e-3, torch.float64: 1e-9}


@dataclass(frozen=True, kw_only=True)
class TorchHits:
    """`raycast_people.PeopleHits` as tensors: points (n, 3) float32; face, column, ring (n,), start (B + 1,) and
    windows (B, 4) int64."""

    points: torch.Tensor
    face: torch.Tensor
    column: torch.Tensor
    ring: torch.Tensor
    start: torch.Tensor
    windows: torch.Tensor


@torch.no_grad()
def scan_people_torch(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    sensor: Sensor,
    *,
    extra: tuple[torch.Tensor, torch.Tensor] | None = None,
    margin: float = 0.0,
    cull: torch.Tensor | bool | None = None,
) -> TorchHits:
    """`scan_people` on any device: the same hits but for rounding, the same again on every run.

    vertices (B, V, 3) float32 or float64 m, the type that crossings are computed in: float32 misses ranges by some
    1e-5 m; faces (F, 3); extra (vertices (B, X, 3), faces (G, 3)), margin and cull as in `scan_people`. People nearer
    than 1 m or seen, with their extra, over more than 80 deg to a side need numba. Raises InputError.
    """
    joined, faces, body, culled = _checked(vertices, faces, extra, margin, cull)
    if sensor.heads:
        raise InputError(f"{sensor.name} has beams of several origins: cast people one by one, with raycast.scan")
    device, kind = joined.device, joined.dtype
    exact = joined.double()
    windows = _windows(exact[:, :body], sensor, margin)
    column0, columns, row0, rows = windows.T.contiguous()
    # whole numbers become float32 in torch, unless told otherwise
    middle = (column0 + (columns.double() - 1) / 2) * sensor.azimuth_step + sensor.azimuth_start
    alone = _alone(exact, middle, columns, sensor)
    rows = torch.where(alone, 0, rows)
    cell0 = torch.cumsum(columns * rows, 0) - columns * rows
    met = []
    for shift, rings in sensor.shift_groups:
        rings = torch.as_tensor(rings, device=device)
        seen = _project(exact, middle + shift).to(kind)
        met.append(_rasterize(seen, faces, culled, columns, row0, rows, cell0, rings, sensor))
    cell, value, face = (torch.cat(part) for part in zip(*met, strict=True))
    best = torch.zeros(int((columns * rows).sum()), dtype=kind, device=device)
    best = best.scatter_reduce(0, cell, value, "amax")
    # of equally near faces the first, as everywhere
    nearest = torch.full(best.shape, len(faces), device=device)
    nearest = nearest.scatter_reduce(0, cell, torch.where(value == best[cell], face, len(faces)), "amin")
    hits = _collect(best, nearest, windows, rows, cell0, sensor)
    return _with_those_alone(hits, alone.nonzero()[:, 0].tolist(), joined, faces, body, culled, sensor, margin, windows)


def _checked(vertices, faces, extra, margin, cull):
    """vertices with extra (B, V, 3), faces (F, 3) int64, how many vertices are the person's, culled (F,) or None."""
    vertices, faces = torch.as_tensor(vertices), torch.as_tensor(faces)
    parts, triangles = [vertices], [faces]
    if extra is not None:
        parts.append(torch.as_tensor(extra[0]))
        triangles.append(torch.as_tensor(extra[1]))
    for name, part in zip(("vertices", "the vertices of extra"), parts, strict=False):
        if part.ndim != 3 or part.shape[2] != 3 or part.dtype not in (torch.float32, torch.float64):
            raise InputError(f"{name} must be (B, V, 3) float32 or float64, got {tuple(part.shape)} {part.dtype}")
        if len(part) != len(vertices):
            raise InputError(f"extra must have as many people as vertices, {len(vertices)}, got {len(part)}")
        if not bool(torch.isfinite(part).all()):
            person = int((~torch.isfinite(part).reshape(len(part), -1).all(1)).nonzero()[0])
            raise InputError(f"{name} must be finite, but those of person {person} are not")
    start = 0
    for i, (part, triangle) in enumerate(zip(parts, triangles, strict=True)):
        if triangle.ndim != 2 or triangle.shape[1] != 3 or triangle.dtype.is_floating_point:
            raise InputError(f"faces must be (F, 3) integers, got {tuple(triangle.shape)} {triangle.dtype}")
        triangle = triangle.to(vertices.device, torch.int64)
        if triangle.numel() and not bool(((triangle >= 0) & (triangle < part.shape[1])).all()):
            raise InputError(
                f"faces must index the {part.shape[1]} vertices from 0, got {triangle.min()} to {triangle.max()}"
            )
        triangles[i] = triangle + start
        start += part.shape[1]
    if not np.isfinite(margin):
        raise InputError(f"margin must be a finite angle in radians, got {margin}")
    faces = torch.cat(triangles)
    if cull is None or cull is False:
        culled = None
    else:
        culled = torch.as_tensor(cull, device=vertices.device)
        if culled.dtype != torch.bool or culled.shape not in ((), (len(faces),)):
            raise InputError(f"cull must be True, False or ({len(faces)},) bool, one a face, got {tuple(culled.shape)}")
        culled = culled.expand(len(faces))
    return torch.cat([part.to(vertices) for part in parts], 1), faces, vertices.shape[1], culled


def _windows(vertices: torch.Tensor, sensor: Sensor, margin: float) -> torch.Tensor:
    """(B, 4) int64: column0, columns, row0, rows, as `raycast.find_window`."""
    if not vertices.shape[1]:
        return torch.zeros((len(vertices), 4), dtype=torch.int64, device=vertices.device)
    x, y, z = vertices.unbind(-1)
    center = torch.atan2(y.sum(1), x.sum(1))
    c, s = torch.cos(center)[:, None], torch.sin(center)[:, None]
    azimuth = torch.atan2(c * y - s * x, c * x + s * y)
    elevation = torch.atan2(z, torch.sqrt(x * x + y * y))
    left, right = azimuth.amin(1), azimuth.amax(1)
    low, high = elevation.amin(1), elevation.amax(1)
    around = right - left >= np.pi
    left, right = torch.where(around, -np.pi, left), torch.where(around, np.pi, right)
    low, high = torch.where(around, -np.pi / 2, low) - margin, torch.where(around, np.pi / 2, high) + margin
    shifts = sensor.azimuth_shifts
    first = torch.ceil((center + left - margin - sensor.azimuth_start - shifts.max()) / sensor.azimuth_step).long()
    last = torch.floor((center + right + margin - sensor.azimuth_start - shifts.min()) / sensor.azimuth_step).long()
    count = (last - first + 1).clamp(min=0)
    whole = count >= sensor.columns
    first, count = torch.where(whole, 0, first), torch.where(whole, sensor.columns, count)
    elevations = torch.as_tensor(sensor.elevations.copy(), device=vertices.device)
    row0, end = torch.searchsorted(elevations, low), torch.searchsorted(elevations, high, right=True)
    return torch.stack([first % sensor.columns, count, row0, (end - row0).clamp(min=0)], 1)


def _project(vertices: torch.Tensor, center: torch.Tensor) -> torch.Tensor:
    """vertices (B, V, 3) -> Y, Z, I (B, V, 3) of a view along azimuth center (B,)."""
    c, s = torch.cos(center)[:, None], torch.sin(center)[:, None]
    x, y, z = vertices.unbind(-1)
    inverse = 1 / (c * x + s * y)
    return torch.stack([(c * y - s * x) * inverse, z * inverse, inverse], -1)


def _alone(vertices: torch.Tensor, middle: torch.Tensor, columns: torch.Tensor, sensor: Sensor) -> torch.Tensor:
    """(B,) bool: too near, too wide or too steep for one projection."""
    c, s = torch.cos(middle)[:, None], torch.sin(middle)[:, None]
    x, y, z = vertices.unbind(-1)
    ahead, aside = c * x + s * y, torch.maximum((c * y - s * x).abs(), z.abs())
    wide = columns.double() * sensor.azimuth_step > _WIDEST
    return wide | ((ahead < _NEAR) | (aside > ahead * _STEEP)).any(1)


def _rasterize(seen, faces, culled, columns, row0, rows, cell0, rings, sensor):
    """Beams of one group of rings that meet a triangle: their cells, 1/x and faces (H,), in no order.

    seen (B, V, 3): Y, Z, I. Cells are numbered person by person from cell0, column by column, row by row.
    """
    device, kind = seen.device, seen.dtype
    rounding = _ROUNDING[kind]
    # columns are a whole or half number of steps from the middle; those of half are the second table
    reach = int(_WIDEST / 2 / sensor.azimuth_step) + 1
    steps = torch.arange(-reach, reach + 1, dtype=torch.float64, device=device)
    angle = (torch.stack([steps, steps + 0.5]) * sensor.azimuth_step).clamp(-_WIDEST / 2, _WIDEST / 2)
    column_tan, column_cos = torch.tan(angle).to(kind), torch.cos(angle).to(kind)
    half = (columns + 1) % 2
    # a person's column k is this many entries behind its table's entry k
    first = reach - columns // 2
    row_tan = torch.as_tensor(sensor.tangents.copy(), device=device)[rings].to(kind)
    low, high = torch.searchsorted(rings, row0), torch.searchsorted(rings, row0 + rows)

    y, z, _ = seen.unbind(-1)
    column = torch.searchsorted(column_tan[half].contiguous(), y.contiguous()) - first[:, None]
    column = torch.minimum(column.clamp(min=0), columns[:, None])
    t = z / torch.sqrt(1 + y * y)
    down = torch.searchsorted(row_tan, (t + t.clamp(max=0) * _SAG - rounding).contiguous())
    up = torch.searchsorted(row_tan, (t + t.clamp(min=0) * _SAG + rounding).contiguous())
    down, up = torch.maximum(down, low[:, None]), torch.minimum(up, high[:, None])

    corner_column, corner_y = column[:, faces], y[:, faces]
    crosses = corner_column.amin(-1) < corner_column.amax(-1)
    reaches = down[:, faces].amin(-1) < up[:, faces].amax(-1)
    wide = corner_y.amax(-1) - corner_y.amin(-1) > _NARROW
    keep = crosses & (reaches | wide) & (high > low)[:, None]
    if culled is not None:
        a, b, d = seen[:, faces, :2].unbind(2)
        one, other = (b - a)[..., 0] * (d - a)[..., 1], (d - a)[..., 0] * (b - a)[..., 1]
        keep &= ~(culled & (one - other > _EDGE_ON[kind] * (one.abs() + other.abs())))
    person, face = keep.nonzero(as_tuple=True)

    # corners from right to left, equal ones by number: an edge has one order in both its triangles
    corner = faces[face]
    key, _ = torch.sort(column[person[:, None], corner] * seen.shape[1] + corner, 1)
    corner, turn = key % seen.shape[1], torch.div(key, seen.shape[1], rounding_mode="floor")
    count = turn[:, 2] - turn[:, 0]
    item, k = _spread(turn[:, 0], count)
    who = person[item]
    place = (half[who], k + first[who])
    line, cosine = column_tan[place], column_cos[place]
    a, b, d = seen[person[:, None], corner].unbind(1)
    second = (k >= turn[item, 1])[:, None]
    t0, i0 = _cross(a[item], d[item], line, cosine)
    t1, i1 = _cross(torch.where(second, b[item], a[item]), torch.where(second, d[item], b[item]), line, cosine)
    start = torch.maximum(torch.searchsorted(row_tan, torch.minimum(t0, t1)), low[who])
    stop = torch.minimum(torch.searchsorted(row_tan, torch.maximum(t0, t1)), high[who])
    beam, r = _spread(start, (stop - start).clamp(min=0))
    value = i0[beam] + (row_tan[r] - t0[beam]) / (t1[beam] - t0[beam]) * (i1[beam] - i0[beam])
    who = who[beam]
    return cell0[who] + k[beam] * rows[who] + rings[r] - row0[who], value, face[item][beam]


def _cross(p: torch.Tensor, q: torch.Tensor, line: torch.Tensor, cosine: torch.Tensor):
    """T and I where edges from p to q (K, 3) cross columns (K,)."""
    at = p + ((line - p[:, 0]) / (q[:, 0] - p[:, 0]))[:, None] * (q - p)
    return at[:, 1] * cosine, at[:, 2]


def _spread(start: torch.Tensor, count: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Item i becomes start[i], ..., start[i] + count[i] - 1: the items' numbers and these values."""
    item = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    before = torch.cumsum(count, 0) - count
    return item, torch.arange(len(item), device=count.device) - before[item] + start[item]


def _collect(best, nearest, windows, rows, cell0, sensor) -> TorchHits:
    """The hits of all windows, within the sensor's range."""
    device = best.device
    column0, columns, row0, _ = windows.T
    cell = (best > 0).nonzero()[:, 0]
    person = torch.searchsorted(cell0 + columns * rows, cell, right=True)
    inside = cell - cell0[person]
    k = torch.div(inside, rows[person], rounding_mode="floor")
    ring = inside % rows[person] + row0[person]
    shifts = torch.as_tensor(sensor.azimuth_shifts.copy(), device=device)
    relative = (k - (columns[person].double() - 1) / 2) * sensor.azimuth_step
    azimuth = sensor.azimuth_start + (column0[person] + k).double() * sensor.azimuth_step + shifts[ring]
    tangent = torch.as_tensor(sensor.tangents.copy(), device=device)[ring]
    horizontal = 1 / (torch.cos(relative) * best[cell].double())
    distance = horizontal * torch.sqrt(1 + tangent * tangent)
    keep = (distance >= sensor.range_min) & (distance <= sensor.range_max)
    points = horizontal[:, None] * torch.stack([torch.cos(azimuth), torch.sin(azimuth), tangent], -1)
    start = torch.searchsorted(person[keep], torch.arange(len(windows) + 1, device=device))
    return TorchHits(
        points=points[keep].float(),
        face=nearest[cell[keep]],
        column=k[keep],
        ring=ring[keep],
        start=start,
        windows=windows,
    )


def _with_those_alone(hits, alone, vertices, faces, body, culled, sensor, margin, windows) -> TorchHits:
    """The hits, with those of the people `alone` put in, who had none."""
    if not alone:
        return hits
    from lidarpose.lidar.raycast import scan

    names, counts = ("points", "face", "column", "ring"), hits.start.diff().tolist()
    parts = {name: list(getattr(hits, name).split(counts)) for name in names}
    windows = windows.clone()
    numpy_faces = faces.cpu().numpy()
    mask = None if culled is None else culled.cpu().numpy()
    for i in alone:
        mesh = vertices[i].cpu().numpy()
        one = scan(mesh, numpy_faces, sensor, window_vertices=mesh[:body], margin=margin, cull=mask)
        for name, part in parts.items():
            part[i] = torch.as_tensor(getattr(one, name)).to(part[i])
        windows[i] = torch.tensor([one.column0, one.columns, one.row0, one.rows])
    counts = torch.tensor([0] + [len(part) for part in parts["face"]], device=hits.start.device)
    return TorchHits(
        **{name: torch.cat(part) for name, part in parts.items()}, start=torch.cumsum(counts, 0), windows=windows
    )
