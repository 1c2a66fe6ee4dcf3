"""`lidarpose info`, `export` and `import`."""

import argparse
from pathlib import Path
from typing import cast

from lidarpose.cli.terminal import add_command, tell
from lidarpose.models import DEFAULT


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
    from lidarpose.inference.info import lines

    print("\n".join(lines()))


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
