"""Run folders: numbered, never overwritten, and the state that a run resumes from.

A run folder holds config.json (the recipe and the command), log.jsonl (one line per chunk, with the validation error if
there was one), state.safetensors (to resume from), model.safetensors (the mean weights, for inference),
best.safetensors (those of the best validation) and pictures/.
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
from safetensors.torch import load, save as to_bytes
from torch import Tensor, nn

from lidarpose._version import __version__
from lidarpose.errors import InputError
from lidarpose.io.atomic import is_unused, locked, write_atomic
from lidarpose.io.files import file_error, read_bytes
from lidarpose.models.checkpoint import SafetensorsFile, with_digest
from lidarpose.train.optim import Muon
from lidarpose.train.recipes import FREE, AnyRecipe, Recipe

# folder of numbered runs
RUNS = Path("runs")
STATE, MODEL, BEST = "state.safetensors", "model.safetensors", "best.safetensors"
CONFIG, LOG, PICTURES = "config.json", "log.jsonl", "pictures"
# pattern of the names of a run's files; names of temporary files end with it
_NAMES = r"(?:config\.json|log\.jsonl|\w+\.safetensors|people-\d+\.png)"
# seconds to wait for the workers of a killed process to end, since they hold the lock, too
LOCK_WAIT = 10.0
SCHEMA = "lidarpose.run/2"
# settings that are paths of files or folders, which may have been moved
PATHS = ("data", "shards", "motion", "body", "init")
# settings of a run's length: a resumed run may be longer, and its schedule is stretched
LENGTHS = ("people", "epochs", "scenes")
# progress of a run besides tensors, with types: steps taken, seconds, errors of the best and of the last validation in
# mm (detector and verifier: %) or None
_ERROR = (int, float, NoneType)
_PROGRESS = {"steps": (int,), "seconds": (int, float), "best": _ERROR, "validation": _ERROR}
# state entries that an optimizer needs to resume
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
MEMORY = {torch.optim.AdamW: _MOMENTS, torch.optim.Adam: _MOMENTS, Muon: ("momentum_buffer",)}


def numbered(kind: str) -> Path:
    """A new folder KIND-001, -002, ... in `RUNS`, created immediately, so that two runs never share one."""
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
            raise file_error(folder, f"cannot be created ({error.strerror}); give a folder for the run") from None


def latest(kind: str) -> Path:
    """The numbered folder of the run that was started last. Raises InputError if there is none."""
    folders = [RUNS / f"{kind}-{number:03d}" for number in sorted(_numbers(kind))]
    runs = [folder for folder in folders if (folder / CONFIG).is_file()]
    if not runs:
        raise InputError(f"{RUNS} has no run {kind}-... to resume: give its folder")
    return runs[-1]


def _numbers(kind: str) -> list[int]:
    matches = (re.fullmatch(rf"{re.escape(kind)}-(\d{{3,}})", path.name) for path in RUNS.glob(f"{kind}-*"))
    return [int(match[1]) for match in matches if match]


def check_new(folder: Path) -> None:
    """Raises InputError if the folder holds anything but partly written files of a killed run."""
    if not is_unused(folder, _NAMES):
        hint = "; add --resume to continue the run there" if (folder / CONFIG).is_file() else ""
        raise InputError(f"{folder}: expected a new or empty folder for the run{hint}")


def lock(folder: Path) -> AbstractContextManager[None]:
    """Locks the run's folder against other processes, see `atomic.locked`."""
    return locked(folder, _NAMES, busy="another process trains there: stop it, or wait for its end", wait=LOCK_WAIT)


def begin(folder: Path, recipe: Recipe, command: str) -> None:
    """Writes the config of a new run. Raises InputError like `check_new`."""
    check_new(folder)
    config = {"schema": SCHEMA, "version": __version__, "kind": recipe.kind, "command": command}
    write_atomic(folder / CONFIG, json.dumps(config | {"recipe": recipe.to_dict()}, indent=1) + "\n")


def read_config(folder: Path, kind: type[AnyRecipe]) -> tuple[AnyRecipe, str]:
    """The recipe of a run and the command that started it. Raises InputError if the folder is no run of this kind."""
    path = folder / CONFIG
    if not path.is_file():
        raise InputError(f"{folder}: nothing to resume, it has no {CONFIG}: omit --resume to start a run")
    # as bytes: json then detects the Unicode encoding
    content = read_bytes(path, expected="the configuration of a run")
    try:
        config = json.loads(content)
        if config["schema"] != SCHEMA:
            problem = f"has the schema {config['schema']}, and this lidarpose resumes {SCHEMA}"
            raise InputError(f"{problem}: use lidarpose {config['version']}")
        if config["kind"] != kind.kind:
            raise InputError(f"belongs to a run of `lidarpose {config['kind']}`: resume it with that command")
        return kind(**config["recipe"]), str(config.get("command", ""))
    except InputError as error:
        raise file_error(path, error) from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise file_error(path, f"expected the recipe of a run, but it is damaged ({error}): start a new run") from None


def check_resumable(folder: Path, stored: Recipe, wanted: Recipe) -> None:
    """Raises InputError unless a run can be resumed with the wanted recipe: unchanged except for its length, the
    settings in `recipes.FREE` and the folders of its paths."""
    settings = stored.to_dict()
    for name, value in wanted.to_dict().items():
        if name in PATHS and _file_names(value) == _file_names(settings[name]):
            continue
        if name not in (*LENGTHS, *FREE) and value != settings[name]:
            raise InputError(
                f"{folder / CONFIG}: the run has {name} = {settings[name]!r}, got {value!r}: a run keeps its recipe; "
                "another run is continued by its folder (of finetune: --out)"
            )


def _file_names(value: str | tuple[str, ...] | None) -> list[str] | None:
    return None if not value else folder_names((value,) if isinstance(value, str) else value)


def folder_names(folders: Iterable[str]) -> list[str]:
    """The names by which an evaluation identifies folders; links and "." are resolved."""
    return [Path(folder).resolve().name for folder in folders]


def read_log(folder: Path) -> list[dict]:
    """The complete lines of a run's log; a kill or a power cut may leave incomplete ones, which are skipped."""
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
    """Removes log lines after the saved state, with more than `people` samples: their steps will be taken again."""
    if (folder / LOG).exists():
        lines = [line for line in read_log(folder) if line["people"] <= people]
        write_atomic(folder / LOG, "".join(json.dumps(line) + "\n" for line in lines))


def save_state(
    path: Path, network: nn.Module, mean: dict[str, Tensor], optimizers: list[torch.optim.Optimizer], progress: dict
) -> None:
    """Writes the state atomically; the previous one is kept until the new one is complete."""
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
    """Fills network, mean and optimizers in place and returns the progress. Raises InputError if they do not fit."""
    problem = "expected the state of a run, but it is damaged"
    try:
        # read, not memory-mapped: truncation of a mapped file would kill the process
        content = path.read_bytes()
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        SafetensorsFile(path=path, header=header, content=content).check_digest()
        # states of version 0.1 lack the last validation
        progress = {"validation": None} | json.loads(header["__metadata__"]["progress"])
        for entry, types in _PROGRESS.items():
            value = progress[entry]
            if type(value) not in types or value is not None and not 0 <= value < inf:
                raise ValueError(f"its {entry} is {value!r}")
        problem = "the state belongs to another network"
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
    """The state of an optimizer by parameter. Raises KeyError or ValueError if an entry is missing or has the wrong
    shape."""
    memory: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        number, _, entry = name.partition(".")
        memory.setdefault(int(number), {})[entry] = value
    for index, parameter in enumerate(p for group in optimizer.param_groups for p in group["params"]):
        # a parameter that has had no gradient yet has no state
        for kind in MEMORY[type(optimizer)] if index in memory else ():
            value = memory[index][kind]
            if value.shape != (() if kind == "step" else parameter.shape):
                raise ValueError(f"{kind} of parameter {index} has the shape {tuple(value.shape)}")
            if kind == "step" and not 0 <= value.item() < inf:
                raise ValueError(f"step of parameter {index} is {value.item()}")
    return memory


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
