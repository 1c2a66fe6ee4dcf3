"""How options are written, and how the command line speaks."""

import argparse
import re
import sys
from typing import Any

from lidarpose.io.files import one_line
from lidarpose.progress import is_quiet


class _Help(argparse.HelpFormatter):
    """Wraps descriptions and keeps the lines of examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example") else super()._fill_text(text, width, indent)


def add_command(
    commands, name: str, help: str, *examples: str, description: str | None = None
) -> argparse.ArgumentParser:
    """A command's parser. help: in the list of commands; examples: command lines, shown under its options."""
    lines = "\n".join(f"  {line}" for line in examples)
    epilog = f"example{'s' * (len(examples) > 1)}:\n{lines}"
    description = description or f"{help[0].upper()}{help[1:]}."
    parser = commands.add_parser(name, help=help, description=description, epilog=epilog, formatter_class=_Help)
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only, no notes and no progress")
    return parser


# the metavar of an option tells its type; others are text
_TYPES = {"N": int, "K": int} | dict.fromkeys(("P", "M", "S", "HZ", "H", "SHARE"), float)
# stands for a change of the scene
KEEP = "--keep R  laser mask: every sample keeps a share R of its patches, the paper's r_keep; as --set keep=R"


def add_options(parser, table: str) -> dict[str, Any]:
    """Adds options to a parser or a group, and returns their defaults by name.

    table: a line each, `--name METAVAR = DEFAULT  help`, which lines that begin with a blank continue; an option
    without a metavar is on or off, one without a default is None.
    """
    defaults: dict[str, Any] = {}
    for line in filter(None, re.sub(r"\n +", " ", table).splitlines()):
        spec, words = line.split("  ", 1)
        option, _, default = spec.partition(" = ")
        flags, *metavar = option.split(" ")
        style: dict[str, Any] = {"action": "store_true"}
        if metavar:
            kind = _TYPES.get(metavar[0], str)
            style = {"type": kind, "metavar": metavar[0], "default": kind(default) if default else None}
        action = parser.add_argument(*flags.split(","), help=words.strip(), **style)
        defaults[action.dest] = action.default
    return defaults


def names(text: str) -> tuple[str, ...]:
    """The names in a list that commas part."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def scene_changes(options: argparse.Namespace) -> tuple[str, ...] | None:
    """The changes of the scene that `--keep` and `--set` ask for; None for none."""
    keep = () if options.keep is None else (f"keep={options.keep}",)
    return keep + (() if options.set_set is None else names(options.set_set)) or None


def tell(text: str, *, error: bool = False) -> None:
    """One line for the user, on stderr; nowhere where that is closed, since stdout may be somebody's JSON. With
    --quiet only errors are printed."""
    if sys.stderr is not None and (error or not is_quiet()):
        print(one_line(text), file=sys.stderr)


def is_watched() -> bool:
    """Whether somebody sees stderr as it comes, so that a bar is worth drawing."""
    return sys.stderr is not None and sys.stderr.isatty() and not is_quiet()
