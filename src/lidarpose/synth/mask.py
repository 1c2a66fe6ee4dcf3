"""The paper's laser-level mask: patches of the laser grid go missing, as behind something in the foreground."""

import numpy as np

# Paper: section "Laser-level masking": the shorter side of the window is this many patches
_PATCHES = 8


def laser_mask(columns: int, rows: int, *, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(columns, rows) bool: which beams of the effective window survive.

    Paper: section "Laser-level masking". The window is cut into square patches of s_p beams,
    s_p = floor(min(columns, rows) / 8), at least 1 (the released code divides by zero on windows of under 8 beams);
    a share 1 - keep of all patches is masked.
    """
    patch = max(min(columns, rows) // _PATCHES, 1)
    across, down = -(-columns // patch), -(-rows // patch)
    kept = _some(across * down, keep, rng)
    return kept.reshape(across, down).repeat(patch, 0).repeat(patch, 1)[:columns, :rows]


def direction_mask(directions: np.ndarray, *, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) bool: the same for beams without a grid, such as a rosette's. directions (n, 3): the beams of the window,
    of any length > 0, for instance the points they hit.

    The window is what the directions span in azimuth and elevation; patches are squares of an eighth of its shorter
    side. A share 1 - keep of all patches is masked.
    """
    if len(directions) == 0:
        return np.zeros(0, bool)
    x, y, z = np.asarray(directions, np.float32).T
    c, s = x.mean(), y.mean()
    # azimuths about the window's own middle: no seam
    azimuth = np.arctan2(c * y - s * x, c * x + s * y)
    elevation = np.arctan2(z, np.sqrt(x * x + y * y))
    azimuth -= azimuth.min()
    elevation -= elevation.min()
    wide, tall = float(azimuth.max()), float(elevation.max())
    # a window that is a line has no shorter side
    patch = max(min(wide, tall) / _PATCHES, max(wide, tall) / _LONGEST, 1e-6)
    across, up = int(wide / patch) + 1, int(tall / patch) + 1
    cell = (azimuth / np.float32(patch)).astype(np.int32) * up + (elevation / np.float32(patch)).astype(np.int32)
    return _some(across * up, keep, rng)[np.minimum(cell, across * up - 1)]


# at most so many patches along the longer side
_LONGEST = 64


def _some(patches: int, keep: float, rng: np.random.Generator) -> np.ndarray:
    """(patches,) bool: a share `keep` of them, rounded down, drawn at random."""
    kept = np.zeros(patches, bool)
    kept[rng.permutation(patches)[: int(patches * keep)]] = True
    return kept
