"""How options are written, and how the command line speaks."""

import argparse
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError
from lidarpose.io.files import one_line
from lidarpose.progress import is_quiet


class _Help(argparse.HelpFormatter):
    """Wraps descriptions and keeps the lines of examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example") else super()._fill_text(text, width, indent)


# suffixes by which a name is taken for a file instead of a folder
_SUFFIXES = (
    "bin csv gz html jpg json jsonl las laz md mp4 npy npz onnx parquet pcd pdf pkl ply png pt safetensors tsv txt "
    "xlsx xml xyz yaml yml zip"
)


def is_file_name(text: str) -> bool:
    """Whether a path that is not there yet has a file's suffix and no / behind it."""
    # unlike Path, os.path.isdir returns False if a name is too long; that is reported when the file is written
    is_folder = text.endswith(("/", os.sep)) or os.path.isdir(text)
    return not is_folder and Path(text).suffix[1:].lower() in _SUFFIXES.split()


def folder(text: str) -> str:
    """An argument that is the name of a folder, there or to be made."""
    if is_file_name(text):
        raise argparse.ArgumentTypeError(f"expected a folder, got {text}: give a folder, or append / to it")
    return text


# type of an option by its metavar; all others are text
_TYPES: dict[str, Callable] = {"N": int, "K": int, "DIR": folder, "RUN": folder}
_TYPES |= dict.fromkeys(("P", "M", "S", "HZ", "H", "SHARE"), float)
# --keep is short for a change of the scene
KEEP = "--keep R  laser mask: share R of patches that each synthesized sample keeps (r_keep); same as --set keep=R"


def add_command(commands, name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
    """Adds a command that is written as its help reads.

    text: what the list of commands says; the description, by default the same; examples, `$ lidarpose ...`; arguments
    and options, see `add_options`. Lines that begin with a blank continue.
    """
    help, *lines = _lines(text)
    examples = [line[2:] for line in lines if line.startswith("$ ")]
    epilog = "\n  ".join([f"example{'s' * (len(examples) > 1)}:", *examples])
    description = " ".join(line for line in lines if line[0] not in "$<-[") or f"{help[0].upper()}{help[1:]}."
    parser = commands.add_parser(name, help=help, description=description, epilog=epilog, formatter_class=_Help)
    parser.add_argument(
        "-q", "--quiet", action="store_true", help="print results and errors only, no notes or progress"
    )
    parser.set_defaults(run=run)
    add_options(parser, "\n".join(line for line in lines if line[0] in "<-["))
    return parser


def add_options(parser, table: str) -> None:
    """Adds arguments and options to a parser or a group, a line each.

    `--name METAVAR = DEFAULT  help` is an option, None without a default; without a metavar it is on or off, `REQUIRED`
    says that it is; `--name:key` has another key in the namespace. `<name> METAVAR  help` is an argument. Behind a
    metavar argparse's `?`, `*` or `+` says how many values there are, `&` that the option may be repeated; `{a,b}` are
    choices. `[title]` begins a group.
    """
    target = parser
    for line in _lines(table):
        if line.startswith("["):
            target = parser.add_argument_group(line[1:-1])
            continue
        spec, words = line.split("  ", 1)
        spec, _, default = spec.partition(" = ")
        flags, *metavars = spec.split(" ")
        flags, _, key = flags.strip("<>").partition(":")
        style: dict[str, Any] = {"dest": key} if key else {}
        if not metavars:
            style["action"] = "store_true"
        elif metavars[0].startswith("{"):
            style["choices"] = metavars[0][1:-1].split(",")
        else:
            (metavar, count) = re.fullmatch(r"(.*?)([?*+&]?)", metavars[0]).groups()  # type: ignore[union-attr]
            style |= {"metavar": metavar, "type": _TYPES.get(metavar, str)}
            style |= {"action": "append"} if count == "&" else {"nargs": count} if count else {}
        if default:
            style |= {"required": True} if default == "REQUIRED" else {"default": style["type"](default)}
        target.add_argument(*flags.split(","), help=words.strip(), **style)


def flag(name: str) -> str:
    """The option of a key in the namespace."""
    return f"--{name.replace('_', '-')}"


def option_names(table: str) -> list[str]:
    """The options of a table by their keys in the namespace."""
    return [name.replace("-", "_") for name in re.findall(r"^--([\w-]+)", table, re.M)]


def _lines(text: str) -> list[str]:
    return [line for line in re.sub(r"\n +", " ", text).splitlines() if line]


def names(text: str) -> tuple[str, ...]:
    """The names in a list that commas part."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def scene_changes(options: argparse.Namespace) -> tuple[str, ...] | None:
    """The changes of the scene that `--keep` and `--set` ask for; None for none. Raises InputError if both set keep."""
    keep = () if options.keep is None else (f"keep={options.keep}",)
    changes = () if options.set_set is None else names(options.set_set)
    if keep and any(change.partition("=")[0].strip() == "keep" for change in changes):
        raise InputError(f"--keep {options.keep} is the same as --set keep={options.keep}, got both: give one of them")
    return keep + changes or None


def tell(text: str, *, error: bool = False) -> None:
    """One line for the user, on stderr; nowhere where that is closed, since stdout may be somebody's JSON. With
    --quiet only errors are printed."""
    if sys.stderr is not None and (error or not is_quiet()):
        print(one_line(text), file=sys.stderr)
