"""Slow reference implementations of the detector's inputs and suppression, with loops over points and candidates."""

import math

import numpy as np

from lidarpose.models.detector.candidates import Candidates


def fine_reference(points: np.ndarray) -> np.ndarray:
    """The input "fine" (28, 24, 24) of points (n, 3) m in the view frame."""
    count = np.zeros((28, 24, 24))
    for x, y, z in points:
        cell = (math.floor(10 * z + 5), math.floor(10 * x) + 12, math.floor(10 * y) + 12)
        if all(0 <= i < n for i, n in zip(cell, count.shape, strict=True)):
            count[cell] += 1
    return np.where(count > 0, 0.5 + 0.125 * np.log2(1 + count), 0)


def context_reference(points: np.ndarray, heights: np.ndarray, center: np.ndarray, yaw: float) -> np.ndarray:
    """The input "context" (4, 20, 20) of points (n, 3) m with heights (n,) m above the ground. Cell edges are
    multiples of 0.5 m."""
    context = np.zeros((4, 20, 20))
    for i in range(20):
        for j in range(20):
            x, y = (i - 9.5) / 2, (j - 9.5) / 2
            place = center[:2] + [math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y]
            inside = (np.floor(2 * points[:, :2]) == np.floor(2 * place)).all(1)
            h = heights[inside]
            if len(h):
                filled = {math.floor((v - 0.3) / 0.3) for v in h if 0.3 < v < 2.1}
                near = np.count_nonzero(np.abs(h) < 0.2)
                logs = [min(0.125 * math.log2(1 + n), 1) for n in (len(h), near)]
                context[:, i, j] = [min(max(h.max() / 4, 0), 1), len(filled) / 6, *logs]
    return context


def suppress_near_reference(centers: np.ndarray, strength: np.ndarray, radius: float) -> list[int]:
    kept: list[int] = []
    for k in sorted(range(len(centers)), key=lambda k: -strength[k]):
        if all(math.dist(centers[k][:2], centers[other][:2]) >= radius for other in kept):
            kept.append(k)
    return kept


def range_reference(points: np.ndarray, origin: np.ndarray, chosen: Candidates, k: int) -> np.ndarray:
    """(28, 24) bool: directions of candidate k's range view that contain a return, from angles instead of tables."""
    seen = np.zeros((28, 24), bool)
    away, distance = points - origin, chosen.distance[k]
    for x, y, z in away:
        turn = (math.atan2(y, x) - chosen.yaw[k] + math.pi) % (2 * math.pi) - math.pi
        if abs(turn) < 1.5:
            lateral = distance * math.tan(turn)
            slant = math.hypot(distance, lateral)
            height = z / math.hypot(x, y) * slant - (chosen.centers[k, 2] - origin[2])
            i, j = math.floor(10 * height + 5), math.floor(10 * lateral) + 12
            if 0 <= i < 28 and 0 <= j < 24:
                seen[i, j] = True
    return seen
