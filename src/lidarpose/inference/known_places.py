"""What the frames of a recording before say of where people are, and are not, in a scan.

Legend: D detections, K people who need no verification, M tracks, R places.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.sample import Box

# a detection so near to where somebody is expected is that person, m, if no other is expected within the second
# distance
_EXPECTED, _ALONE = 0.5, 1.0
# a place that held nobody is not looked at again for a while, so far about it, m
_SAME_PLACE = 0.3
# the least score where a track is expected
WEAK_SCORE = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownPlaces:
    """What the frames before say of a scan, in its frame.

    boxes: of the K people who need no verification, where they are expected, with the scores they had when they were
    verified; pelvises (K, 3) m; tracks (M, 3) m: where anybody is expected, the K first, within reach (M,) m: who is
    not found there is searched for among detections of `WEAK_SCORE` or more; rejected (R, 3) m: places of detections
    that were nobody.
    """

    boxes: Sequence[Box]
    pelvises: np.ndarray
    tracks: np.ndarray
    reach: np.ndarray
    rejected: np.ndarray

    def level(self, R_level_input: np.ndarray) -> "KnownPlaces":
        """In the scan's level frame."""
        level_points = {name: getattr(self, name) @ R_level_input.T for name in ("pelvises", "tracks", "rejected")}
        return replace(
            self, boxes=[replace(box, center=R_level_input @ box.center) for box in self.boxes], **level_points
        )

    def index_of(self, centers: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
        """Of each detection at centers (D, 3) m, those that are sure enough, which of the K people it is: (D,) int,
        -1: none."""
        known_index = np.full(len(centers), -1)
        sure_rows = np.flatnonzero(is_sure)
        if len(sure_rows) and self.boxes:
            count = len(self.boxes)
            distances = _apart(centers[sure_rows], self.tracks[:count])
            is_alone = (_apart(self.tracks, self.tracks) < _ALONE).sum(0)[:count] == 1
            nearest_rows = distances.argmin(0)
            for k in np.flatnonzero(is_alone & (distances.min(0) < _EXPECTED)):
                known_index[sure_rows[nearest_rows[k]]] = k
        return known_index

    def least_scores(self, centers: np.ndarray, known_index: np.ndarray, least_score: float) -> np.ndarray:
        """(D,): what the score of detections at centers (D, 3) m must be: less where a known person is missed, infinite
        where it turned out to be nobody."""
        thresholds = np.full(len(centers), least_score)
        is_missed = ~np.isin(np.arange(len(self.tracks)), known_index)
        is_near = (_apart(centers, self.tracks[is_missed]) < self.reach[is_missed]).any(1)
        thresholds[is_near] = min(least_score, WEAK_SCORE)
        is_nobody = (_apart(centers, self.rejected) < _SAME_PLACE).any(1)
        thresholds[is_nobody & ~is_near & (known_index < 0)] = np.inf
        return thresholds


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Level distances of a (A, 2+) from b (B, 2+): (A, B) m."""
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)
