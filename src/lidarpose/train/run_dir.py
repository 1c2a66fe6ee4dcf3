"""Run folders: numbered, never overwritten, and the state that a run resumes from.

A run folder holds config.json (the recipe and the command), log.jsonl (a line a chunk and a line a validation),
state.safetensors (to resume from), model.safetensors (the mean weights, to use), best.safetensors (those of the best
validation) and pictures/.
"""

import json
import re
from collections.abc import Iterable
from contextlib import AbstractContextManager
from math import inf
from pathlib import Path
from types import NoneType

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from safetensors.torch import save as to_bytes
from torch import Tensor, nn

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, is_unused, locked, read_bytes, write_atomic
from lidarpose.models.checkpoint import SafetensorsFile, with_digest
from lidarpose.train.optim import Muon
from lidarpose.train.recipes import FREE, AnyRecipe, Recipe

# where numbered runs go
RUNS = Path("runs")
STATE, MODEL, BEST = "state.safetensors", "model.safetensors", "best.safetensors"
CONFIG, LOG, PICTURES = "config.json", "log.jsonl", "pictures"
# of the files in a run's folder, the last part of a long name
_NAMES = r"(?:config\.json|log\.jsonl|\w+\.safetensors|people-\d+\.png)"
# seconds that the workers of a killed process, who hold the lock too, may take to end
LOCK_WAIT = 10.0
SCHEMA = "lidarpose.run/2"
# settings that are files or folders, which may have been moved
PATHS = ("data", "shards", "motion", "body", "init")
# how a run's length is called: a run may become longer, its schedule follows
LENGTHS = ("people", "epochs", "scenes")
# progress of a run besides tensors: steps taken, seconds, error of the best and of the last validation in mm (of a
# detector %) or None
_ERROR = (int, float, NoneType)
_PROGRESS = {"steps": (int,), "seconds": (int, float), "best": _ERROR, "validation": _ERROR}
# entries that an optimizer cannot go on without
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
MEMORY = {torch.optim.AdamW: _MOMENTS, torch.optim.Adam: _MOMENTS, Muon: ("momentum_buffer",)}


def numbered(kind: str) -> Path:
    """A new folder KIND-001, -002, ... in `RUNS`, made here and now, so that two runs never share one."""
    number = max([0, *_numbers(kind)])
    while True:
        number += 1
        folder = RUNS / f"{kind}-{number:03d}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
        except OSError as error:
            raise file_error(folder, f"cannot be made ({error.strerror}); name a folder for the run") from None


def latest(kind: str) -> Path:
    """The numbered folder of the run that was started last. Raises InputError where there is none."""
    folders = [RUNS / f"{kind}-{number:03d}" for number in sorted(_numbers(kind))]
    runs = [folder for folder in folders if (folder / CONFIG).is_file()]
    if not runs:
        raise InputError(f"{RUNS} has no run {kind}-... to resume: name its folder")
    return runs[-1]


def _numbers(kind: str) -> list[int]:
    matches = (re.fullmatch(rf"{re.escape(kind)}-(\d{{3,}})", path.name) for path in RUNS.glob(f"{kind}-*"))
    return [int(match[1]) for match in matches if match]


def check_new(folder: Path) -> None:
    """Raises InputError where the folder holds anything but what a killed run left of a file."""
    if not is_unused(folder, _NAMES):
        hint = "; add --resume to go on with what is there" if (folder / CONFIG).is_file() else ""
        raise InputError(f"{folder}: expected a new or empty folder for the run{hint}")


def lock(folder: Path) -> AbstractContextManager[None]:
    """Keeps other processes out of the run's folder, see `files.locked`."""
    return locked(folder, _NAMES, busy="another process trains there: stop it, or wait for its end", wait=LOCK_WAIT)


def begin(folder: Path, recipe: Recipe, command: str) -> None:
    """Writes the config of a new run. Raises InputError as `check_new`."""
    check_new(folder)
    config = {"schema": SCHEMA, "version": __version__, "kind": recipe.kind, "command": command}
    write_atomic(folder / CONFIG, json.dumps(config | {"recipe": recipe.to_dict()}, indent=1) + "\n")


def read_config(folder: Path, kind: type[AnyRecipe]) -> tuple[AnyRecipe, str]:
    """The recipe of a run, and the command that began it. Raises InputError where the folder is no run of this kind."""
    path = folder / CONFIG
    if not path.is_file():
        raise InputError(f"{folder}: nothing to resume, it has no {CONFIG}: leave --resume away to start a run")
    # as bytes, of which json knows every Unicode encoding
    content = read_bytes(path, expected="the configuration of a run")
    try:
        config = json.loads(content)
        if config["schema"] != SCHEMA:
            problem = f"is of {config['schema']}, this lidarpose goes on with {SCHEMA}"
            raise InputError(f"{problem}: use lidarpose {config['version']}")
        if config["kind"] != kind.kind:
            raise InputError(f"is of a run of `lidarpose {config['kind']}`: resume it by that command")
        return kind(**config["recipe"]), str(config.get("command", ""))
    except InputError as error:
        raise file_error(path, error) from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise file_error(path, f"expected the recipe of a run, but it is damaged ({error}): start a new run") from None


def check_resumable(folder: Path, stored: Recipe, wanted: Recipe) -> None:
    """Raises InputError unless a run may go on with the wanted recipe: as it began, or longer."""
    settings = stored.to_dict()
    for name, value in wanted.to_dict().items():
        if name in PATHS and _file_names(value) == _file_names(settings[name]):
            continue
        if name not in (*LENGTHS, *FREE) and value != settings[name]:
            raise InputError(
                f"{folder / CONFIG}: the run has {name} = {settings[name]!r}, got {value!r}: a run keeps its recipe"
            )


def _file_names(value: str | tuple[str, ...] | None) -> list[str] | None:
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
        lines = [line for line in read_log(folder) if line["people"] <= people]
        write_atomic(folder / LOG, "".join(json.dumps(line) + "\n" for line in lines))


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
    write_atomic(path, with_digest(to_bytes(tensors, metadata={"progress": json.dumps(progress)})))


def load_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer]
) -> dict:
    """Fills network, mean and optimizers in place and returns the progress. Raises InputError where it does not fit."""
    problem = "expected the state of a run, but it is damaged"
    try:
        # read, not mapped: a mapped file that is cut off meanwhile would end the process
        content = path.read_bytes()
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        SafetensorsFile(path=path, header=header, content=content).check_digest()
        # states of 0.1 lack the last validation
        progress = {"validation": None} | json.loads(header["__metadata__"]["progress"])
        for entry, types in _PROGRESS.items():
            value = progress[entry]
            if type(value) not in types or value is not None and not 0 <= value < inf:
                raise ValueError(f"its {entry} is {value!r}")
        problem = "the state is not of this network"
        network.load_state_dict(_part(tensors, "network."))
        stored_mean = _part(tensors, "mean.")
        for name, value in mean.items():
            value.copy_(stored_mean[name])
        problem = "the optimizer's memory is damaged"
        for k, optimizer in enumerate(optimizers):
            memory = _memory(_part(tensors, f"optimizer.{k}."), optimizer)
            optimizer.load_state_dict(optimizer.state_dict() | {"state": memory})
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: {problem} ({reason}): start a new run") from None
    return progress


def _memory(tensors: dict[str, Tensor], optimizer: torch.optim.Optimizer) -> dict[int, dict[str, Tensor]]:
    """The state of an optimizer by parameter. Raises KeyError or ValueError where an entry lacks or has another
    shape."""
    memory: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        number, _, entry = name.partition(".")
        memory.setdefault(int(number), {})[entry] = value
    for index, parameter in enumerate(p for group in optimizer.param_groups for p in group["params"]):
        # a parameter without a gradient so far has no memory
        for kind in MEMORY[type(optimizer)] if index in memory else ():
            value = memory[index][kind]
            if value.shape != (() if kind == "step" else parameter.shape):
                raise ValueError(f"{kind} of parameter {index} has the shape {tuple(value.shape)}")
            if kind == "step" and not 0 <= value.item() < inf:
                raise ValueError(f"step of parameter {index} is {value.item()}")
    return memory


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
