"""Networks, and the weights that ship with them: their names, and where they lie. No torch, no numpy here."""

import os
from importlib import resources
from pathlib import Path

from lidarpose.errors import InputError, check_name

BUNDLED = ("tiny", "small")
# what is taken where nothing is named: the best whose two files are at most 6 MB
DEFAULT = "small"
# the same, for help texts
NAMES = ", ".join(f"{name} (default)" if name == DEFAULT else name for name in BUNDLED)


def bundled_path(name: str = DEFAULT, suffix: str = ".safetensors") -> Path:
    """Where the package keeps a bundled checkpoint, or with the suffix .onnx its exported twin."""
    check_name("bundled weights", name, BUNDLED)
    return Path(str(resources.files("lidarpose.models") / "weights" / f"{name}{suffix}"))


def weights_path(weights: str | os.PathLike) -> Path:
    """The file that a name of bundled weights or a path means. Raises InputError for an unknown name."""
    try:
        name = os.fsdecode(weights)
    except TypeError:
        kind = type(weights).__name__
        raise InputError(f"expected weights as {', '.join(BUNDLED)} or the path of a file, got {kind}") from None
    is_path = not isinstance(weights, str) or "/" in name or name.endswith((".safetensors", ".onnx"))
    is_path = name not in BUNDLED and (is_path or os.path.isfile(name))
    return Path(name) if is_path else bundled_path(name)
