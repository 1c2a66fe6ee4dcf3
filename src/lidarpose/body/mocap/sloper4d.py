"""SLOPER4D: <sequence>_labels.pkl with the SMPL poses of the recording person and of the one who is recorded.

`framerate`, and for `first_person` and `second_person` `pose` (n, 72) rad and `trans` (n, 3) m, world, z up; where
there are `opt_pose` and `opt_trans`, which are refined, those are read, as the data set's own loader does.
Source: SLOPER4D (Dai et al. 2023), its published loader.
"""

import os
from pathlib import Path

import numpy as np

from lidarpose.body.mocap.motion import Motion, join
from lidarpose.body.mocap.smpl_poses import smpl_motion
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle

_PEOPLE = ("first_person", "second_person")


def load_sloper4d(path: str | os.PathLike, *, up: str | None = None, fps: float | None = None) -> Motion:
    """The motion of a label file: a clip for each person that has poses, NAME_first and NAME_second."""
    labels = load_pickle(path)
    if not isinstance(labels, dict):
        raise file_error(path, f"expected SLOPER4D's labels, a dict, got {type(labels).__name__}")
    people = [p for p in _PEOPLE if isinstance(labels.get(p), dict) and _poses(labels[p]) is not None]
    if not people:
        found = ", ".join(map(str, labels)) or "nothing"
        raise file_error(path, f"expected second_person with pose (n, 72) and trans (n, 3), got {found}")
    if fps is None:
        try:
            fps = float(np.asarray(labels["framerate"]).item())
        except (KeyError, TypeError, ValueError):
            raise file_error(path, "does not say its frame rate (framerate); give load_motion fps=") from None
    motions = [
        smpl_motion(
            path,
            *_poses(labels[person]),
            name=f"{Path(path).stem}_{person.removesuffix('_person')}",
            fps=fps,
            up=up,
            kind="SLOPER4D",
        )
        for person in people
    ]
    return join(motions, source=f"SLOPER4D: {path}")


def _poses(person: dict) -> tuple[object, object] | None:
    for prefix in ("opt_", ""):
        if person.get(f"{prefix}pose") is not None and person.get(f"{prefix}trans") is not None:
            return person[f"{prefix}pose"], person[f"{prefix}trans"]
    return None
