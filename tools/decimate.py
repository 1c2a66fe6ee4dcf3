"""Decimates a closed triangle mesh by half-edge collapses: the remaining vertices are unchanged original ones."""

import heapq

import numpy as np

# in flat regions short edges collapse first: this fraction of the squared length is added to the squared error
LENGTH_SHARE = 2e-3
# limits of a collapse: minimum cosine of a face's rotation, minimum roundness of a face (1 is an equilateral triangle),
# and maximum number of a vertex's neighbors
MIN_COSINE = 0.3
MIN_ROUNDNESS = 0.12
MAX_VALENCE = 12


def collapse(
    shapes: np.ndarray, faces: np.ndarray, factor: np.ndarray, *, target: int, pinned: int
) -> tuple[np.ndarray, np.ndarray]:
    """Half-edge collapses by quadric error (Garland and Heckbert 1997) until `target` vertices remain.

    shapes (K, V, 3) m: the same mesh in K shapes, over which errors are summed; faces (F, 3); factor (V,) scales error
    distances; the vertex `pinned` is not removed. Returns the indices of the kept vertices (target,) in ascending order
    and the faces (2 target - 4, 3) as indices into these. A closed surface stays closed.
    """
    mesh = _Mesh(faces, shapes.mean(0))
    quadric = _quadrics(shapes, faces, factor)
    point = np.concatenate([shapes, np.ones(shapes.shape[:2] + (1,))], -1).swapaxes(0, 1)
    stamp = np.zeros(len(point), int)
    is_alive = np.ones(len(point), bool)

    def entries(source, destination):
        """Heap entries of collapses of `source` (E,) into `destination` (E,); stamps show whether they are current."""
        total = quadric[source] + quadric[destination]
        error = np.einsum("eki,ekij,ekj->e", point[destination], total, point[destination])
        length = ((mesh.position[source] - mesh.position[destination]) ** 2).sum(-1)
        cost = error + LENGTH_SHARE * np.einsum("ekii->e", total[..., :3, :3]) * length
        return list(
            zip(*(x.tolist() for x in (cost, source, destination, stamp[source], stamp[destination])), strict=True)
        )

    # in a closed surface the faces contain each edge once in each direction
    heap = entries(faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel())
    heapq.heapify(heap)
    remaining = len(point)
    while remaining > target:
        _, source, destination, source_stamp, destination_stamp = heapq.heappop(heap)
        if (
            not (is_alive[source] and is_alive[destination])
            or stamp[source] != source_stamp
            or stamp[destination] != destination_stamp
        ):
            continue
        if source == pinned or not mesh.allows(source, destination):
            continue
        mesh.collapse(source, destination)
        is_alive[source] = False
        quadric[destination] += quadric[source]
        stamp[destination] += 1
        remaining -= 1
        neighbors = np.array(sorted(mesh.neighbors(destination)))
        destinations = np.full(len(neighbors), destination)
        for entry in entries(destinations, neighbors) + entries(neighbors, destinations):
            heapq.heappush(heap, entry)
    kept_vertices = np.flatnonzero(is_alive)
    return kept_vertices, np.searchsorted(kept_vertices, mesh.faces())


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
    """Triangles with their adjacency."""

    def __init__(self, faces: np.ndarray, position: np.ndarray):
        self.position = position
        self.triangles = [tuple(face) for face in faces.tolist()]
        self.around = [set() for _ in position]
        for f, face in enumerate(self.triangles):
            for v in face:
                self.around[v].add(f)

    def neighbors(self, v: int) -> set[int]:
        return {w for f in self.around[v] for w in self.triangles[f]} - {v}

    def allows(self, source: int, destination: int) -> bool:
        """Whether after the collapse the surface is still closed, not folded, and without slivers."""
        source_neighbors, destination_neighbors = self.neighbors(source), self.neighbors(destination)
        if (
            len(source_neighbors & destination_neighbors) != 2
            or len(source_neighbors | destination_neighbors) - 2 > MAX_VALENCE
        ):
            return False
        for f in self.around[source] - self.around[destination]:
            corners = np.array(self.triangles[f])
            p, q = self.position[corners], self.position[np.where(corners == source, destination, corners)]
            a, b = np.cross(p[1] - p[0], p[2] - p[0]), np.cross(q[1] - q[0], q[2] - q[0])
            size, sides = np.linalg.norm(b), ((q - q[[1, 2, 0]]) ** 2).sum()
            if a @ b < MIN_COSINE * np.linalg.norm(a) * size or 2 * np.sqrt(3) * size < MIN_ROUNDNESS * sides:
                return False
        return True

    def collapse(self, source: int, destination: int) -> None:
        for f in list(self.around[source]):
            face = self.triangles[f]
            if destination in face:
                for v in face:
                    self.around[v].discard(f)
            else:
                self.triangles[f] = tuple(destination if v == source else v for v in face)
                self.around[destination].add(f)
        self.around[source].clear()

    def faces(self) -> np.ndarray:
        return np.array([self.triangles[f] for f in sorted(set().union(*self.around))])
