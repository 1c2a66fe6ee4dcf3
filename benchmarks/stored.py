"""Stored results are used only with the options and weights they were made with, which RESULT.of.json records."""

import json
import sys
from pathlib import Path
from typing import Any

from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import content_digest


def digest(weights: Path) -> str:
    return content_digest(weights, expected="weights")[:8]


def is_stored(result: Path, of: dict[str, Any]) -> bool:
    """Whether the result exists; exits if it was made with other or unknown options."""
    if not result.is_file():
        return False
    note = _note(result)
    stored_of = json.loads(note.read_text()) if note.is_file() else "unknown options"
    if stored_of != of:
        sys.exit(f"{result} is of {stored_of}, asked for {of}: delete it")
    return True


def write_note(result: Path, of: dict[str, Any]) -> None:
    """Records the options of a result that is about to be stored."""
    write_atomic(_note(result), json.dumps(of) + "\n")


def _note(result: Path) -> Path:
    return result.with_name(f"{result.name}.of.json")
