"""Import of scripts of benchmarks/, examples/ and tools/ as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def load_script(path: Path | str) -> ModuleType:
    """path: absolute, or relative to the root of the repository."""
    path = Path(__file__).parents[1] / path
    spec = importlib.util.spec_from_file_location(path.stem, path)
    # dataclasses look up their module in sys.modules
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
