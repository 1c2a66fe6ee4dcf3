"""What is installed: `lidarpose info`."""

import platform
from importlib import metadata
from importlib.util import find_spec

from lidarpose._version import __version__
from lidarpose.models import BUNDLED, DEFAULT, bundled_path
from lidarpose.models.checkpoint import parameter_count, read_header, runs_of
from lidarpose.models.onnx import usable_threads


def lines() -> list[str]:
    """Versions, backends, device, and of each bundled checkpoint its size, parameters, training and score."""
    import onnxruntime

    out = [
        f"lidarpose  {__version__}",
        f"python     {platform.python_version()}",
        f"onnx       ONNX Runtime {onnxruntime.__version__}, cpu, {usable_threads()} threads: the default backend",
        _torch_line(),
    ]
    for name in BUNDLED:
        path = bundled_path(name)
        header = read_header(path)
        card = header.card
        exported = bundled_path(name, ".onnx").stat().st_size / 1e6
        out += [
            f"weights    {name}: {path.stat().st_size / 1e6:.2f} MB, {parameter_count(path):,} parameters, "
            f"as ONNX {exported:.2f} MB{', the default' if name == DEFAULT else ''}",
            f"  trained  {card.get('command', 'unknown')}",
            f"           {_seen(card)}",
        ]
        out += [f"           {card['note']}"] if "note" in card else []
        out += [f"  score    {key}: {value}" for key, value in card.get("scores", {}).items()]
    return out


def _seen(card: dict) -> str:
    """People and hours of the run, and of those before it."""
    runs = runs_of(card)
    people, hours = ([run.get(name, 0) for run in runs] for name in ("people_seen", "hours"))
    line = f"{people[0]:,} people, {hours[0]:.2f} hours"
    if len(runs) == 1:
        return line
    return f"{line}; with the runs before it {sum(people):,} people, {sum(hours):.2f} hours"


def _torch_line() -> str:
    if find_spec("torch") is None:
        return "torch      not installed, training and --device need it: in the clone, pip install '.[train]'"
    try:
        # torch may be installed and still fail to load its libraries
        import torch

        device = (
            torch.cuda.get_device_name() if torch.cuda.is_available() else f"cpu, {torch.get_num_threads()} threads"
        )
    except (ImportError, OSError, RuntimeError) as error:
        return f"torch      {metadata.version('torch')}, which cannot be used ({' '.join(str(error).split())[:120]})"
    return f"torch      {torch.__version__}, device {device}"
