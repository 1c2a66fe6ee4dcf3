"""`lidarpose info`, `export` and `import`."""

import argparse
import platform
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import cast

from lidarpose._version import __version__
from lidarpose.cli.terminal import add_command, tell
from lidarpose.models import BUNDLED, DEFAULT, bundled_path


def add(commands) -> None:
    """Adds the commands to the parser's."""
    info = add_command(commands, "info", "show versions, device, bundled weights and their scores", "lidarpose info")
    info.set_defaults(run=_info)

    export = add_command(
        commands,
        "export",
        "write weights as ONNX or as a torch.export program",
        "lidarpose export mine.safetensors",
        description="Converts a checkpoint to one file of another format, for any number of people and points. A file "
        "of the same name is replaced.",
    )
    export.set_defaults(run=_export)
    export.add_argument("weights", nargs="?", default=DEFAULT, metavar="NAME|FILE", help=f"default {DEFAULT}")
    export.add_argument("--format", default="onnx", metavar="NAME", help="onnx (default) or torch (a .pt2 program)")
    export.add_argument("--out", metavar="FILE", help="default STEM.onnx or STEM.pt2, in the current folder")

    take = add_command(
        commands,
        "import",
        "convert released DAPT weights to a checkpoint",
        "lidarpose import dapt_waymo.safetensors waymo.safetensors --config waymo",
        description="Converts weights that DAPT's authors released, saved as safetensors, to a checkpoint for predict.",
    )
    take.set_defaults(run=_import)
    take.add_argument("file", help="the released weights, as .safetensors")
    take.add_argument("out", metavar="OUT", help="the checkpoint to write (.safetensors)")
    take.add_argument(
        "--config",
        metavar="NAME",
        help="waymo, humanm3, lidarhuman26m, sloper4d, pretrain or paper (default: as the file says)",
    )


def _info(options: argparse.Namespace) -> None:
    print("\n".join(info_lines()))


def info_lines() -> list[str]:
    """Versions, backends, device, and of each bundled checkpoint its size, parameters, training and score."""
    import onnxruntime

    from lidarpose.models.checkpoint import parameter_count, read_header
    from lidarpose.models.onnx import usable_threads

    lines = [
        f"lidarpose  {__version__}",
        f"python     {platform.python_version()}",
        f"onnx       ONNX Runtime {onnxruntime.__version__}, cpu, {usable_threads()} threads: the default backend",
        _torch_line(),
    ]
    for name in BUNDLED:
        path = bundled_path(name)
        card = read_header(path).card
        exported = bundled_path(name, ".onnx").stat().st_size / 1e6
        lines += [
            f"weights    {name}: {path.stat().st_size / 1e6:.2f} MB, {parameter_count(path):,} parameters, "
            f"as ONNX {exported:.2f} MB{', the default' if name == DEFAULT else ''}",
            f"  trained  {card.get('command', 'unknown')}",
            f"           {_people_and_hours(card)}",
        ]
        lines += [f"           {card['note']}"] if "note" in card else []
        lines += [f"  score    {key}: {value}" for key, value in card.get("scores", {}).items()]
    return lines


def _people_and_hours(card: dict) -> str:
    """People and hours of the run, and of those before it."""
    from lidarpose.models.checkpoint import runs_of

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


def _export(options: argparse.Namespace) -> None:
    from lidarpose.models import weights_path
    from lidarpose.models.export import FORMATS, export

    path = weights_path(options.weights)
    out = options.out or path.stem + FORMATS.get(options.format, "")
    export(path, out, format=options.format)
    tell(f"{path.name} -> {out} ({Path(out).stat().st_size / 1e6:.2f} MB)")


def _import(options: argparse.Namespace) -> None:
    from lidarpose.models.dapt.dapt_config import DaptConfig
    from lidarpose.models.dapt.import_weights import import_released

    header = import_released(options.file, options.out, config=options.config)
    tell(f"{cast(DaptConfig, header.config).name}, joints of {header.skeleton.name} -> {options.out}")
