"""A detector without weights: real proposals, scored by height and width."""

import numpy as np

from lidarpose.models.detector.candidates import CELL
from lidarpose.models.detector.detector import Detector

HEADER = {"version": "fake", "default_score": 0.85, "calibration": [[-6, 0, 6], [0.01, 0.5, 0.99]]}
# slices from 0.2 to 2.1 m above the ground; distance of a cell's center from the candidate's axis, m
BODY = slice(7, 26)
AXIS = (np.arange(24) - 11.5) * CELL
NEAR = np.hypot(*np.meshgrid(AXIS, AXIS, indexing="ij")) < 0.9


def score(arrays):
    """Network outputs (K, 6): columns as tall as a person with free space around them get a high score."""
    filled = (arrays["fine"][:, BODY] > 0) & NEAR
    outputs = np.zeros((len(filled), 6))
    for row, cells in zip(outputs, filled, strict=True):
        z, x, y = np.nonzero(cells)
        tall = (z.max() - z.min()) * CELL + 0.3 if len(z) else 0
        wide = max(AXIS[x].std(), AXIS[y].std()) if len(z) else 0
        row[0] = 4 - 8 * max(0, 1.3 - tall) - 30 * max(0, wide - 0.33)
    outputs[:, 4], outputs[:, 5] = 1.75, -9
    return outputs


class FakeDetector(Detector):
    """Records its calls."""

    def __init__(self):
        super().__init__(score)
        self.header, self.calls = HEADER, []

    def detect(self, points, origin, **options):
        self.calls.append({"points": points, "origin": origin, **options})
        return super().detect(points, origin, **options)
