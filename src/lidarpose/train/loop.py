"""The training loop: synthetic people in, a run folder out.

A run folder holds config.json (the recipe), log.jsonl (one line a chunk), state.safetensors (to go on from) and
model.safetensors (the mean weights, to use). A run killed at any moment goes on with `resume`, to the same losses.
"""

import json
import os
import sys
import time
from pathlib import Path

import torch
from tqdm import tqdm

from lidarpose._version import __version__
from lidarpose.data.files import write_atomic
from lidarpose.errors import InputError
from lidarpose.model.batch import Batch, Targets
from lidarpose.model.checkpoint import save_checkpoint
from lidarpose.model.network import PoseNet
from lidarpose.model.presets import preset
from lidarpose.train.feed import BATCHES, generator_of, loader
from lidarpose.train.losses import losses, total
from lidarpose.train.muon import Muon
from lidarpose.train.optimize import average, optimizers, rate_factor
from lidarpose.train.recipes import Pretrain
from lidarpose.train.state import load_state, save_state

STATE, MODEL, CONFIG, LOG = "state.safetensors", "model.safetensors", "config.json", "log.jsonl"
# largest norm of a step's gradient
CLIP = 1.0
# seconds between two saved states
SAVE_EVERY = 120


def pretrain(recipe: Pretrain, folder: str | Path, *, resume: bool = False, command: str = "") -> Path:
    """Trains as the recipe says and returns the path of model.safetensors.

    folder: a new one, or with `resume` that of a run with the same recipe (its length may differ). Raises InputError
    where the folder does not fit, or where the loss stops being finite: the last good state then stays.
    """
    folder = Path(folder)
    network, mean, made, chunk, seen_seconds = _begin(recipe, folder, resume)
    size = BATCHES * recipe.batch
    chunks = -(-recipe.people // size)
    network.train()
    started = saved = time.monotonic()
    bar = tqdm(
        total=recipe.people, initial=min(chunk * size, recipe.people), unit=" people", disable=not sys.stderr.isatty()
    )
    with open(folder / LOG, "a") as log, bar:
        for batches in loader(recipe, network.config, start=chunk, stop=chunks):
            terms = [_step(network, mean, made, recipe, arrays, chunk, k, chunks) for k, arrays in enumerate(batches)]
            means = {name: float(torch.stack([t[name] for t in terms]).mean()) for name in terms[0]}
            if not all(map(_finite, means.values())):
                raise InputError(f"the loss is not finite at people {chunk * size}: lower --rate; {STATE} is kept")
            chunk += 1
            elapsed = seen_seconds + time.monotonic() - started
            line = {"people": chunk * size, "seconds": round(elapsed, 1)} | {k: round(v, 5) for k, v in means.items()}
            log.write(json.dumps(line) + "\n")
            log.flush()
            bar.update(size)
            bar.set_postfix(mpjpe_mm=f"{means['mpjpe'] * 1e3:.0f}")
            if time.monotonic() - saved > SAVE_EVERY or chunk == chunks:
                # the state last: killed between the two, a run goes on from the older one and writes both again
                _save_model(folder, recipe, mean, chunk * size, elapsed, command)
                save_state(folder / STATE, network, mean, made, {"chunk": chunk, "seconds": elapsed})
                saved = time.monotonic()
    return folder / MODEL


def _begin(recipe: Pretrain, folder: Path, resume: bool):
    # here, not in a worker, whose errors come wrapped in a traceback
    generator_of(recipe)
    torch.manual_seed(recipe.seed)
    network = PoseNet(preset(recipe.size))
    mean = {name: value.detach().clone() for name, value in network.named_parameters()}
    made = optimizers(network, recipe)
    config = {"schema": "lidarpose.run/1", "version": __version__, "recipe": recipe.to_dict()}
    if resume:
        if not (folder / CONFIG).is_file():
            raise InputError(f"{folder}: nothing to resume, it has no {CONFIG}: leave --resume away to start a run")
        _same_recipe(folder / CONFIG, config["recipe"])
        if not (folder / STATE).is_file():
            # killed before its first state was saved: it begins again
            _cut_log(folder / LOG, 0)
            return network, mean, made, 0, 0.0
        progress = load_state(folder / STATE, network, mean, made)
        _cut_log(folder / LOG, progress["chunk"] * BATCHES * recipe.batch)
        return network, mean, made, progress["chunk"], progress["seconds"]
    if folder.exists() and any(folder.iterdir()):
        raise InputError(
            f"{folder}: expected a new or empty folder for the run; add --resume to go on with what is there"
        )
    write_atomic(folder / CONFIG, json.dumps(config, indent=1) + "\n")
    return network, mean, made, 0, 0.0


def _same_recipe(path: Path, recipe: dict) -> None:
    try:
        stored = dict(json.loads(path.read_text())["recipe"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: expected the recipe of a run, but it is damaged ({error}): start a new run"
        ) from None
    # length and workers change no person; the schedule follows the new length
    for name in recipe:
        if name not in ("people", "workers") and json.loads(json.dumps(recipe[name])) != stored.get(name):
            raise InputError(
                f"{path}: the run has {name} = {stored.get(name)!r}, got {recipe[name]!r}: a run keeps its recipe"
            )


def _cut_log(path: Path, people: int) -> None:
    """Lines behind the saved state belong to steps that will be taken again."""
    if path.exists():
        # a kill may leave half a line at the end
        whole = [line for line in path.read_text().splitlines() if line.endswith("}")]
        kept = [line for line in whole if json.loads(line)["people"] <= people]
        write_atomic(path, "".join(line + "\n" for line in kept))


def _step(network, mean, made, recipe: Pretrain, arrays: dict, chunk: int, k: int, chunks: int) -> dict:
    step = chunk * BATCHES + k
    factor = rate_factor(step / (chunks * BATCHES))
    for optimizer in made:
        rate = recipe.muon_rate if isinstance(optimizer, Muon) else recipe.rate
        for group in optimizer.param_groups:
            group["lr"] = rate * factor
        optimizer.zero_grad(set_to_none=True)
    targets = Targets.from_arrays(arrays)
    terms = losses(network(Batch.from_arrays(arrays)), targets)
    total(terms).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
    for optimizer in made:
        optimizer.step()
    average(mean, network, step)
    return {name: value.detach() for name, value in terms.items()}


def _save_model(folder: Path, recipe: Pretrain, mean: dict, people: int, seconds: float, command: str) -> None:
    network = PoseNet(preset(recipe.size))
    network.load_state_dict(mean)
    card = {
        "command": command or "lidarpose.train.loop.pretrain",
        "recipe": recipe.to_dict() | {"motion": None if recipe.motion is None else os.path.basename(recipe.motion)},
        "people_seen": people,
        "hours": round(seconds / 3600, 3),
    }
    save_checkpoint(folder / MODEL, network, card=card)


def _finite(value: float) -> bool:
    return value == value and abs(value) != float("inf")
