"""Thin out a closed triangle mesh by half-edge collapses, so that the vertices that stay keep their identity."""

import heapq

import numpy as np

# edges in flat places collapse short ones first: this share of squared length is added to the squared error
LENGTH_SHARE = 2e-3
# no collapse may turn a face further than this cosine, make it more of a sliver (1 is an equilateral triangle), or
# give a vertex more neighbors
MIN_COSINE = 0.3
MIN_ROUNDNESS = 0.12
MAX_VALENCE = 12


def collapse(
    shapes: np.ndarray, faces: np.ndarray, factor: np.ndarray, *, target: int, pinned: int
) -> tuple[np.ndarray, np.ndarray]:
    """Half-edge collapses by quadric error (Garland and Heckbert 1997) until `target` vertices are left.

    shapes (K, V, 3) m: the same mesh in K shapes, errors are summed over them; faces (F, 3); factor (V,) scales
    lengths of error; the vertex `pinned` stays. Returns kept vertex indices (target,) in rising order and faces
    (2 target - 4, 3) into them. A closed surface stays closed.
    """
    mesh = _Mesh(faces, shapes.mean(0))
    quadric = _quadrics(shapes, faces, factor)
    point = np.concatenate([shapes, np.ones(shapes.shape[:2] + (1,))], -1).swapaxes(0, 1)
    stamp = np.zeros(len(point), int)
    alive = np.ones(len(point), bool)

    def entries(gone, stays):
        """Heap entries of collapses of `gone` (E,) into `stays` (E,); stamps tell whether they are still true."""
        total = quadric[gone] + quadric[stays]
        error = np.einsum("eki,ekij,ekj->e", point[stays], total, point[stays])
        length = ((mesh.position[gone] - mesh.position[stays]) ** 2).sum(-1)
        cost = error + LENGTH_SHARE * np.einsum("ekii->e", total[..., :3, :3]) * length
        return list(zip(*(x.tolist() for x in (cost, gone, stays, stamp[gone], stamp[stays])), strict=True))

    # in a closed surface each edge is run along once in each direction
    heap = entries(faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel())
    heapq.heapify(heap)
    left = len(point)
    while left > target:
        _, gone, stays, gone_stamp, stays_stamp = heapq.heappop(heap)
        if not (alive[gone] and alive[stays]) or stamp[gone] != gone_stamp or stamp[stays] != stays_stamp:
            continue
        if gone == pinned or not mesh.allows(gone, stays):
            continue
        mesh.collapse(gone, stays)
        alive[gone] = False
        quadric[stays] += quadric[gone]
        stamp[stays] += 1
        left -= 1
        around = np.array(sorted(mesh.neighbors(stays)))
        same = np.full(len(around), stays)
        for entry in entries(same, around) + entries(around, same):
            heapq.heappush(heap, entry)
    kept = np.flatnonzero(alive)
    return kept, np.searchsorted(kept, mesh.faces())


def _quadrics(shapes: np.ndarray, faces: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """(V, K, 4, 4) sums of squared distance to the planes around each vertex, weighted by area and factor."""
    a, b, c = np.moveaxis(shapes[:, faces], 2, 0)
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=-1, keepdims=True)
    normal = cross / np.maximum(area, 1e-15)
    plane = np.concatenate([normal, -(normal * a).sum(-1, keepdims=True)], -1)
    weight = area * (factor[faces].mean(1) ** 2)[:, None]
    scaled = weight[..., None] * plane[..., :, None] * plane[..., None, :]
    quadric = np.zeros((shapes.shape[1], len(shapes), 4, 4))
    for corner in faces.T:
        np.add.at(quadric, corner, scaled.swapaxes(0, 1))
    return quadric


class _Mesh:
    """Triangles that know their neighbors."""

    def __init__(self, faces: np.ndarray, position: np.ndarray):
        self.position = position
        self.triangles = [tuple(face) for face in faces.tolist()]
        self.around = [set() for _ in position]
        for f, face in enumerate(self.triangles):
            for v in face:
                self.around[v].add(f)

    def neighbors(self, v: int) -> set[int]:
        return {w for f in self.around[v] for w in self.triangles[f]} - {v}

    def allows(self, gone: int, stays: int) -> bool:
        """Whether the surface stays closed, unfolded, and without slivers."""
        near_gone, near_stays = self.neighbors(gone), self.neighbors(stays)
        if len(near_gone & near_stays) != 2 or len(near_gone | near_stays) - 2 > MAX_VALENCE:
            return False
        for f in self.around[gone] - self.around[stays]:
            old = np.array(self.triangles[f])
            p, q = self.position[old], self.position[np.where(old == gone, stays, old)]
            a, b = np.cross(p[1] - p[0], p[2] - p[0]), np.cross(q[1] - q[0], q[2] - q[0])
            size, sides = np.linalg.norm(b), ((q - q[[1, 2, 0]]) ** 2).sum()
            if a @ b < MIN_COSINE * np.linalg.norm(a) * size or 2 * np.sqrt(3) * size < MIN_ROUNDNESS * sides:
                return False
        return True

    def collapse(self, gone: int, stays: int) -> None:
        for f in list(self.around[gone]):
            face = self.triangles[f]
            if stays in face:
                for v in face:
                    self.around[v].discard(f)
            else:
                self.triangles[f] = tuple(stays if v == gone else v for v in face)
                self.around[stays].add(f)
        self.around[gone].clear()

    def faces(self) -> np.ndarray:
        return np.array([self.triangles[f] for f in sorted(set().union(*self.around))])
