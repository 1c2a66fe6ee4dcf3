"""The paper's laser-level mask: patches of the laser grid go missing, as behind something in the foreground."""

import numpy as np


def laser_mask(columns: int, rows: int, *, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(columns, rows) bool: which beams of the effective window survive.

    Paper: section "Laser-level masking". The window is cut into square patches of s_p beams,
    s_p = floor(min(columns, rows) / 8), at least 1 (the released code divides by zero on windows of under 8 beams);
    a share 1 - keep of all patches is masked.
    """
    patch = max(min(columns, rows) // 8, 1)
    across, down = -(-columns // patch), -(-rows // patch)
    kept = np.zeros(across * down, bool)
    kept[rng.permutation(across * down)[: int(across * down * keep)]] = True
    return kept.reshape(across, down).repeat(patch, 0).repeat(patch, 1)[:columns, :rows]
