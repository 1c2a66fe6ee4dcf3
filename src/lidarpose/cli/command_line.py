"""The parser of all commands, and how a command ends. Heavy imports stay inside the commands."""

import argparse
import difflib
import os
import re
import sys
import warnings
from contextlib import suppress
from typing import Any

import lidarpose.cli.datasets as datasets
import lidarpose.cli.evaluating as evaluating
import lidarpose.cli.paper as paper
import lidarpose.cli.predicting as predicting
import lidarpose.cli.recordings as recordings
import lidarpose.cli.training as training
import lidarpose.cli.weights as weights
from lidarpose._version import __version__
from lidarpose.cli.terminal import tell
from lidarpose.errors import InputError, LidarPoseError, missing_extra
from lidarpose.io.files import one_line
from lidarpose.progress import is_quiet, set_quiet

# options whose value may start with a minus sign, which argparse would take for another option
_SIGNED = ("--sensor-origin", "--up")


def run(arguments: list[str] | None = None) -> int:
    """As `lidarpose.cli.main`."""
    parser = make_parser()
    words = _joined(sys.argv[1:] if arguments is None else arguments)
    options, unknown = parser.parse_known_args(words)
    if unknown:
        # the error points to the command's own help, which lists its options
        parser.prog = " ".join(filter(None, (parser.prog, options.command)))
        hint = _hint(options.command, unknown, words) or _likely_option(parser, options.command, unknown)
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    if options.command is None:
        parser.print_help()
        return 0
    set_quiet(options.quiet)
    warnings.formatwarning = _warning_line
    with suppress(AttributeError, ValueError):
        # file names may contain invalid text, and terminals may lack characters; stderr escapes them by default
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        options.run(options)
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        # the reader of the output closed the pipe, e.g. head
        _drop_output()
    except ModuleNotFoundError as error:
        extra = "export" if options.command == "export" else None
        extra_error = missing_extra(error, f"`lidarpose {options.command}`", extra)
        if not isinstance(extra_error, LidarPoseError):
            raise
        return _failed(extra_error)
    except LidarPoseError as error:
        return _failed(error)
    except OSError as error:
        if error.filename is not None or not error.strerror:
            return _failed(error)
        # errors of files have a file name, so this one is of the standard output
        _drop_output()
        return _failed(InputError(f"cannot write the output ({error.strerror}): redirect it elsewhere"))
    except MemoryError as error:
        reason = f" ({error})" if str(error) else ""
        return _failed(InputError(f"out of memory{reason}: give less at once, such as fewer points or people"))
    except KeyboardInterrupt as interrupt:
        # training puts into the message how to resume
        return _ended(str(interrupt) or "stopped", getattr(interrupt, "status", 130))
    return 0


def _hint(command: str | None, unknown: list[str], words: list[str]) -> str:
    """What to do instead about names of pictures and pages, and about options before the command, "" for other
    arguments. words: all arguments."""
    if command in words and unknown[0] in words[: words.index(command)]:
        return f": options come after the command, lidarpose {command} {unknown[0]}"
    if command != "predict" or any(os.path.splitext(word)[1].lower() not in (".png", ".html") for word in unknown):
        return ""
    return ": --picture and --html take no file name, they are named as --out, NAME.png beside NAME.json or NAME.jsonl"


def _likely_option(parser: argparse.ArgumentParser, command: str | None, unknown: list[str]) -> str:
    """The command's option that the first unknown one may be meant for, as a hint; "" if there is none."""
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    word = next((word for word in unknown if word.startswith("--")), "")
    names = commands.choices[command]._option_string_actions if command and word else ()
    likely = difflib.get_close_matches(word.partition("=")[0].replace("_", "-"), names, 1, 0.7)
    return f", did you mean {likely[0]}?" if likely else ""


def _warning_line(message: Warning | str, *place: object, **line: object) -> str:
    """A warning as the commands print theirs, in place of Python's two lines of our source code."""
    return "" if is_quiet() else f"lidarpose: warning: {one_line(str(message))}\n"


def _drop_output() -> None:
    """What is left of the output goes nowhere, so that python does not complain at exit."""
    with suppress(OSError, AttributeError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _ended(text: object, status: int) -> int:
    """Says why the command ends; of several processes of a training one is enough to say it. Returns the status."""
    if os.environ.get("RANK", "0") == "0":
        tell(f"lidarpose: {text}", error=True)
    return status


def _failed(error: Exception) -> int:
    return _ended(f"error: {error}", 2)


class _Parser(argparse.ArgumentParser):
    def __init__(self, **settings: Any):
        # otherwise --keep of another command would be accepted as an abbreviation of --keep-anchors
        super().__init__(**{"allow_abbrev": False} | settings)
        self.words: list[str] = []

    def parse_known_args(self, args=None, namespace=None):
        # a parser of a command gets its own words
        self.words = list(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str):
        """One line, as for every other wrong input."""
        if choice := re.search(r"(invalid choice: '(.*)') \(choose from (.*)\)", message):
            for likely in difflib.get_close_matches(choice[2], re.findall(r"[\w-]+", choice[3]), 1):
                message = f"{message[: choice.end(1)]}, did you mean {likely}?"
        lists = (option for action in self._actions if action.nargs == "+" for option in action.option_strings)
        if "are required" in message and (given := next((option for option in lists if option in self.words), None)):
            message += f": give them before {given}, which takes all values after it"
        self.exit(2, f"lidarpose: error: {message}; see {self.prog} --help\n")


def _joined(arguments: list[str]) -> list[str]:
    """`--sensor-origin -1,0,2` as `--sensor-origin=-1,0,2`, and `--up -y` as `--up=-y`."""
    words: list[str] = []
    for argument in arguments:
        if words and words[-1] in _SIGNED and argument.startswith("-") and argument[1:2] in tuple("0123456789.xyz"):
            words[-1] += f"={argument}"
        else:
            words.append(argument)
    return words


def make_parser() -> argparse.ArgumentParser:
    """The parser of `lidarpose` with all its commands."""
    parser = _Parser(prog="lidarpose", description="3D human pose from LiDAR.")
    parser.add_argument("--version", action="version", version=f"lidarpose {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND")
    for module in (predicting, recordings, datasets, training, evaluating):
        module.add(commands)
    paper.add(commands, run)
    weights.add(commands)
    return parser
