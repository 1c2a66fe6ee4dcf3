"""Run folders: numbered, never overwritten, and the state that a run resumes from.

A run folder holds config.json (the recipe and the command), log.jsonl (a line a chunk and a line a validation),
state.safetensors (to resume from), model.safetensors (the mean weights, to use), best.safetensors (those of the best
validation) and pictures/.
"""

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from types import NoneType

import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError
from safetensors.torch import load
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.files import TEMPORARY, file_error, read_bytes, write_atomic
from lidarpose.train.optim import Muon
from lidarpose.train.recipes import FREE, AnyRecipe, Recipe

# where numbered runs go
RUNS = "runs"
STATE, MODEL, BEST = "state.safetensors", "model.safetensors", "best.safetensors"
CONFIG, LOG, PICTURES = "config.json", "log.jsonl", "pictures"
# held by the process that writes into the folder
LOCK = ".lock"
# seconds that the workers of a killed process, who hold it too, may take to end
LOCK_WAIT = 10.0
SCHEMA = "lidarpose.run/2"
# settings that are files or folders, which may have been moved
PATHS = ("data", "shards", "motion", "init")
# what `files.atomic_path` leaves of a process that was killed
_LEFT = re.compile(rf"{TEMPORARY}.+")
# how a run's length is called: a run may become longer, its schedule follows
LENGTHS = ("people", "epochs")
# progress of a run besides tensors: steps taken, seconds, error of the best and of the last validation in mm or None
_ERROR = (int, float, NoneType)
_PROGRESS = {"steps": (int,), "seconds": (int, float), "best": _ERROR, "validation": _ERROR}
# entries that an optimizer cannot go on without
MEMORY = {torch.optim.AdamW: ("step", "exp_avg", "exp_avg_sq"), Muon: ("momentum_buffer",)}


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
    """The numbered folder of the run that was started last. Raises InputError where there is none."""
    folders = [Path(parent) / f"{kind}-{number:03d}" for number in sorted(_numbers(Path(parent), kind))]
    started = [folder for folder in folders if (folder / CONFIG).is_file()]
    if not started:
        raise InputError(f"{parent} has no run {kind}-... to resume: name its folder")
    return started[-1]


def _numbers(parent: Path, kind: str) -> list[int]:
    names = (re.fullmatch(rf"{re.escape(kind)}-(\d{{3,}})", path.name) for path in parent.glob(f"{kind}-*"))
    return [int(name[1]) for name in names if name]


def check_new(folder: Path) -> None:
    """Raises InputError where the folder holds anything but what a killed run left of a file."""
    if folder.is_dir():
        if all(_LEFT.fullmatch(path.name) or path.name == LOCK for path in folder.iterdir()):
            return
    elif not folder.exists():
        return
    more = "; add --resume to go on with what is there" if (folder / CONFIG).is_file() else ""
    raise InputError(f"{folder}: expected a new or empty folder for the run{more}")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keeps other processes out of the run's folder, which is made. Raises InputError where one is in it; one that was
    killed is not, once its workers have seen it."""
    lock = FileLock(folder / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=LOCK_WAIT)
    except Timeout:
        raise InputError(f"{folder}: another process trains there: stop it, or wait for its end") from None
    except (OSError, NotImplementedError) as error:
        raise file_error(folder, f"cannot be made or locked ({error}): name a folder on a local disk") from None
    try:
        yield
    finally:
        # Windows does not let go of a file that is open
        with suppress(OSError):
            (folder / LOCK).unlink()
        lock.release()


def clean(folder: Path) -> None:
    """Removes what a killed run left of files that it was writing."""
    for path in (*folder.glob(".*"), *(folder / PICTURES).glob(".*")):
        if _LEFT.fullmatch(path.name):
            path.unlink(missing_ok=True)


def begin(folder: Path, recipe: Recipe, command: str) -> None:
    """Writes the config of a new run. Raises InputError as `check_new`."""
    check_new(folder)
    clean(folder)
    config = {"schema": SCHEMA, "version": __version__, "kind": type(recipe).__name__.lower(), "command": command}
    write_atomic(folder / CONFIG, json.dumps(config | {"recipe": recipe.to_dict()}, indent=1) + "\n")


def stored_recipe(folder: Path, kind: type[AnyRecipe]) -> AnyRecipe:
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
        try:
            return kind(**config["recipe"])
        except InputError as error:
            raise file_error(path, error) from None
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise file_error(path, f"expected the recipe of a run, but it is damaged ({error}): start a new run") from None


def stored_command(folder: Path) -> str:
    """The command that began a run; the folder's config has been read by `stored_recipe`."""
    # as bytes, of which json knows every Unicode encoding
    return str(json.loads((folder / CONFIG).read_bytes()).get("command", ""))


def check_same(folder: Path, stored: Recipe, wanted: Recipe) -> None:
    """Raises InputError unless a run may go on with the wanted recipe: as it began, or longer."""
    ours, theirs = wanted.to_dict(), stored.to_dict()
    for name, value in ours.items():
        if name in PATHS and _named(value) == _named(theirs[name]):
            continue
        if name not in (*LENGTHS, *FREE) and value != theirs[name]:
            raise InputError(
                f"{folder / CONFIG}: the run has {name} = {theirs[name]!r}, got {value!r}: a run keeps its recipe"
            )


def _named(value: str | tuple[str, ...] | None) -> list[str] | None:
    """Files and folders by their names."""
    return None if not value else folder_names((value,) if isinstance(value, str) else value)


def folder_names(folders: Iterable[str]) -> list[str]:
    """The names by which an evaluation knows folders, be they given by a link or as "."."""
    return [Path(folder).resolve().name for folder in folders]


def read_log(folder: Path) -> list[dict]:
    """The whole lines of a run's log; a kill or a power cut may leave others."""
    path = folder / LOG
    lines = [_line(line) for line in path.read_text("utf-8", "replace").splitlines()] if path.exists() else []
    return [line for line in lines if line is not None]


def _line(text: str) -> dict | None:
    try:
        line = json.loads(text)
    except ValueError:
        return None
    return line if isinstance(line, dict) and isinstance(line.get("people"), int) else None


def cut_log(folder: Path, people: int) -> None:
    """Lines behind the saved state belong to steps that will be taken again."""
    if (folder / LOG).exists():
        kept = [line for line in read_log(folder) if line["people"] <= people]
        write_atomic(folder / LOG, "".join(json.dumps(line) + "\n" for line in kept))


def save_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer], progress: dict
) -> None:
    """Writes all of it whole or not at all; the last state stays until the new one is complete."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"mean.{name}": value for name, value in mean.items()}
    for k, optimizer in enumerate(optimizers):
        for index, memory in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{k}.{index}.{name}": torch.as_tensor(value) for name, value in memory.items()}
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    write_atomic(path, to_bytes(tensors, metadata={"progress": json.dumps(progress)}))


def load_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer]
) -> dict:
    """Fills network, mean and optimizers in place and returns the progress. Raises InputError where it does not fit."""
    try:
        # read, not mapped: a mapped file that is cut off meanwhile would end the process
        content = path.read_bytes()
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        progress = json.loads(header["__metadata__"]["progress"])
        # states of 0.1 lack the last validation
        progress.setdefault("validation", None)
        for entry, types in _PROGRESS.items():
            value = progress.get(entry)
            if entry not in progress or type(value) not in types or value is not None and not 0 <= value < inf:
                raise ValueError(f"its {entry} is {value!r}")
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: expected the state of a run, but it is damaged ({error}): start a new run") from None
    stored_mean = _part(tensors, "mean.")
    try:
        network.load_state_dict(_part(tensors, "network."))
        for name, value in mean.items():
            value.copy_(stored_mean[name])
    except (RuntimeError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: the state is not of this network ({reason}): start a new run") from None
    for k, optimizer in enumerate(optimizers):
        optimizer.load_state_dict(optimizer.state_dict() | {"state": _memory(path, tensors, k, optimizer)})
    return progress


def _memory(
    path: Path, tensors: dict[str, Tensor], k: int, optimizer: torch.optim.Optimizer
) -> dict[int, dict[str, Tensor]]:
    """The state of optimizer k by parameter. Raises InputError where an entry lacks or has another shape."""
    memory: dict[int, dict[str, Tensor]] = {}
    try:
        for name, value in _part(tensors, f"optimizer.{k}.").items():
            number, _, entry = name.partition(".")
            memory.setdefault(int(number), {})[entry] = value
        for index, parameter in enumerate(p for group in optimizer.param_groups for p in group["params"]):
            # a parameter without a gradient so far has no memory
            for kind in MEMORY[type(optimizer)] if index in memory else ():
                shape = memory[index][kind].shape
                if kind != "step" and shape != parameter.shape:
                    raise ValueError(f"{kind} of parameter {index} has the shape {tuple(shape)}")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: the optimizer's memory is damaged ({error}): start a new run") from None
    return memory


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
