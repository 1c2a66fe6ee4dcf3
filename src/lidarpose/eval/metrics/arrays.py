"""Arrays and nested lists of anyone's poses, checked: shapes, finite numbers, labels."""

import numpy as np

from lidarpose.errors import InputError


def numbers(name: str, value: np.ndarray) -> np.ndarray:
    """An array of floats; raises InputError where it holds something else, or lists of unequal length."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{name} must hold numbers, in lists of equal length") from None


def flags(name: str, value: np.ndarray, shape: tuple[int, ...], *, of: str = "joint") -> np.ndarray:
    """bool of a shape, one a joint or another thing, from bool or 0 and 1; raises InputError otherwise."""
    given = numbers(name, value)
    if given.shape != shape:
        raise InputError(f"{name} must be {shape}, one a {of}, got {given.shape}")
    if not ((given == 0) | (given == 1)).all():
        raise InputError(f"{name} must be bool, or 0 and 1; of other codes pass a comparison, such as codes > 0")
    return given == 1


def checked_poses(pred, true, visible, trailing=("joints", "3")) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """pred, true (n, ..., 3), labelled (n, ...) bool of their own, where the dots are as many as `trailing` says."""
    pred, true = numbers("pred", pred), numbers("true", true)
    if pred.shape != true.shape or pred.ndim < len(trailing) or pred.shape[-1] != 3 or not pred.shape[-2]:
        wanted = ", ".join(("...", *trailing))
        raise InputError(f"pred and true must both be ({wanted}), got {pred.shape} and {true.shape}")
    if not np.isfinite(pred).all():
        joints = int((~np.isfinite(pred).all(-1)).sum())
        raise InputError(f"pred must be finite, got NaN or infinity in {joints} joints: predict every joint")
    if np.isinf(true).any():
        raise InputError("true must be finite, or NaN where a joint has no label; got infinity")
    labelled = ~np.isnan(true).any(-1)
    if visible is not None:
        labelled &= flags("visible", visible, labelled.shape)
    keep = pred.shape[-len(trailing) :]
    people = int(np.prod(pred.shape[: -len(trailing)]))
    return pred.reshape(people, *keep), true.reshape(people, *keep), labelled.reshape(people, *keep[:-1])
