"""Run folders: numbered, never overwritten, and what a run is taken up from.

A run folder holds config.json (the recipe and the command), log.jsonl (a line a chunk and a line a validation),
state.safetensors (to go on from), model.safetensors (the mean weights, to use), best.safetensors (those of the best
validation) and pictures/.
"""

import json
import re
from pathlib import Path

from lidarpose._version import __version__
from lidarpose.data.files import file_error, read_bytes, write_atomic
from lidarpose.errors import InputError
from lidarpose.train.recipes import FREE, Recipe

# where numbered runs go
RUNS = "runs"
STATE, MODEL, BEST = "state.safetensors", "model.safetensors", "best.safetensors"
CONFIG, LOG, PICTURES = "config.json", "log.jsonl", "pictures"
SCHEMA = "lidarpose.run/2"
# how a run's length is called: a run may become longer, its schedule follows
LENGTHS = ("people", "epochs")


def numbered(kind: str, parent: str | Path = RUNS) -> Path:
    """A new folder KIND-001, -002, ... in `parent`, made here and now, so that two runs never share one."""
    number = max([0, *_numbers(Path(parent), kind)])
    while True:
        number += 1
        folder = Path(parent) / f"{kind}-{number:03d}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
        except OSError as error:
            raise file_error(folder, f"cannot be made ({error.strerror}); name a folder for the run") from None


def latest(kind: str, parent: str | Path = RUNS) -> Path:
    """The numbered folder that was begun last. Raises InputError where there is none."""
    numbers = _numbers(Path(parent), kind)
    if not numbers:
        raise InputError(f"{parent} has no run {kind}-... to resume: name its folder")
    return Path(parent) / f"{kind}-{max(numbers):03d}"


def _numbers(parent: Path, kind: str) -> list[int]:
    names = (re.fullmatch(rf"{re.escape(kind)}-(\d{{3,}})", path.name) for path in parent.glob(f"{kind}-*"))
    return [int(name[1]) for name in names if name]


def begin(folder: Path, recipe: Recipe, command: str) -> None:
    """Writes the config of a new run. Raises InputError where the folder holds anything."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder}: expected a new or empty folder for the run; add --resume to go on with what is there"
        )
    config = {"schema": SCHEMA, "version": __version__, "kind": type(recipe).__name__.lower(), "command": command}
    write_atomic(folder / CONFIG, json.dumps(config | {"recipe": recipe.to_dict()}, indent=1) + "\n")


def stored_recipe(folder: Path, kind: type[Recipe]) -> Recipe:
    """The recipe of a run. Raises InputError where the folder is no run of this kind."""
    path = folder / CONFIG
    if not path.is_file():
        raise InputError(f"{folder}: nothing to resume, it has no {CONFIG}: leave --resume away to start a run")
    try:
        config = json.loads(read_bytes(path, expected="the configuration of a run"))
        if config["schema"] != SCHEMA:
            raise file_error(
                path,
                f"is of {config['schema']}, this lidarpose goes on with {SCHEMA}: use lidarpose {config['version']}",
            )
        if config["kind"] != kind.__name__.lower():
            raise file_error(path, f"is of a run of `lidarpose {config['kind']}`: resume it by that command")
        return kind(**config["recipe"])
    except InputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise file_error(path, f"expected the recipe of a run, but it is damaged ({error}): start a new run") from None


def check_same(folder: Path, stored: Recipe, wanted: Recipe) -> None:
    """Raises InputError unless a run may go on with the wanted recipe: as it began, or longer."""
    ours, theirs = wanted.to_dict(), stored.to_dict()
    for name, value in ours.items():
        if name not in (*LENGTHS, *FREE) and value != theirs[name]:
            raise InputError(
                f"{folder / CONFIG}: the run has {name} = {theirs[name]!r}, got {value!r}: a run keeps its recipe"
            )


def read_log(folder: Path) -> list[dict]:
    """The whole lines of a run's log; a kill may leave half a line at the end."""
    path = folder / LOG
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


def cut_log(folder: Path, people: int) -> None:
    """Lines behind the saved state belong to steps that will be taken again."""
    if (folder / LOG).exists():
        kept = [line for line in read_log(folder) if line["people"] <= people]
        write_atomic(folder / LOG, "".join(json.dumps(line) + "\n" for line in kept))
