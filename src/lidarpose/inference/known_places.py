"""Positions in a scan where people are expected, or were rejected, according to earlier frames of a recording.

Legend: D detections, K people who need no verification, M tracks, R places.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.sample import Box

# maximum distance, m, between a detection and the expected position of the known person that it is matched to, if no
# other person is expected within the second distance
_EXPECTED, _ALONE = 0.5, 1.0
# radius, m, around a rejected position in which detections are not verified again for a while
_SAME_PLACE = 0.3
# score threshold near the expected position of a track
WEAK_SCORE = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownPlaces:
    """Knowledge from earlier frames about a scan, in the frame of the scan.

    boxes: expected boxes of the K people who need no verification, with the scores of their last verification;
    pelvises (K, 3) m: of these people; tracks (M, 3) m: expected positions of all tracks, the K people first;
    reach (M,) m: search radius around them: for a track that is not matched, detections of `WEAK_SCORE` or more within
    it are accepted; rejected (R, 3) m: positions of detections that the verifier rejected.
    """

    boxes: Sequence[Box]
    pelvises: np.ndarray
    tracks: np.ndarray
    reach: np.ndarray
    rejected: np.ndarray

    def level(self, R_level_input: np.ndarray) -> "KnownPlaces":
        """The same places in the scan's level frame."""
        level_points = {name: getattr(self, name) @ R_level_input.T for name in ("pelvises", "tracks", "rejected")}
        return replace(
            self, boxes=[replace(box, center=R_level_input @ box.center) for box in self.boxes], **level_points
        )

    def index_of(self, centers: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
        """(D,) int: for each detection at centers (D, 3) m, the index of the known person (of K) that it is matched to,
        or -1. is_sure (D,) bool: detections that may be matched."""
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
        """(D,): score thresholds for detections at centers (D, 3) m: lower near a track without a matched detection,
        infinite where the verifier rejected a detection in an earlier frame."""
        thresholds = np.full(len(centers), least_score)
        is_missed = ~np.isin(np.arange(len(self.tracks)), known_index)
        is_near = (_apart(centers, self.tracks[is_missed]) < self.reach[is_missed]).any(1)
        thresholds[is_near] = min(least_score, WEAK_SCORE)
        is_nobody = (_apart(centers, self.rejected) < _SAME_PLACE).any(1)
        thresholds[is_nobody & ~is_near & (known_index < 0)] = np.inf
        return thresholds


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A, B) m: horizontal distances between a (A, 2+) and b (B, 2+)."""
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)
