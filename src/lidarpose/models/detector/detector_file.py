"""The detector's file: opened by ONNX Runtime, with what its header says of scores. No torch."""

import os
from pathlib import Path
from typing import Any

from lidarpose.io.files import file_error
from lidarpose.models import weights_file
from lidarpose.models.detector.detector_config import INPUTS, OUTPUT, DetectorConfig
from lidarpose.models.onnx import check_names, open_network


def detector_path() -> Path:
    """Where the package keeps the bundled detector."""
    return weights_file("detector.onnx")


def open_detector(path: str | os.PathLike | None = None, *, threads: int | None = None) -> tuple[Any, dict]:
    """The session of a detector (None: the bundled one), and its header: "version", and the card of its training, with
    "calibration" ([logits], [probabilities]), "default_score" and "verification" once it is calibrated.

    Raises InputError, one line, for a file that is damaged, something else, or another network's.
    """
    path = detector_path() if path is None else path
    session, header = open_network(path, threads=threads)
    if not isinstance(header.config, DetectorConfig):
        raise file_error(path, f"expected a detector, got a network of the kind {header.network}: leave it away")
    check_names(path, session, INPUTS, (OUTPUT,))
    return session, {"version": header.version, **header.card}
