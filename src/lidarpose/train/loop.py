"""The training loop: examples in, a run folder out (see `run_dir`), in one process or several.

A run that is killed at any moment can be resumed and reaches the same losses. Processes are started by Accelerate's or
torch's launcher; each makes its share of every batch, and together they take the same steps as a single one, except
for batch norms, dropout, and the detector's candidates of high score, which each process picks among its own.
"""

import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from types import FrameType
from typing import Any, cast

import numpy as np
import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lidarpose.arrays import evenly_spaced
from lidarpose.errors import InputError, check_name
from lidarpose.io.atomic import write_atomic
from lidarpose.models.checkpoint import save_checkpoint
from lidarpose.progress import Progress
from lidarpose.synth.scene import RandomStream
from lidarpose.train import run_dir
from lidarpose.train.data_loader import BATCHES, Chunks, chunks_of, lanes_of, loader
from lidarpose.train.objectives.objective import LOGGED, PoseObjective, total
from lidarpose.train.optim import average, optimizers, plateau_factor, rate_factor, set_rates
from lidarpose.train.recipes import PoseRecipe, Recipe
from lidarpose.train.run_dir import BEST, LOG, MODEL, STATE
from lidarpose.train.setup import TrainSetup, check_prn_batch, make_setup
from lidarpose.train.validation import Draw, batch_norms, update_batch_norms

# Accelerate's trackers that are known to work with a run's folder
TRACKERS = ("tensorboard", "wandb")
# seconds between two saved states
SAVE_EVERY = 120
# number of validations in a run if the recipe sets no interval
_VALIDATIONS = 20


class Interrupted(KeyboardInterrupt):
    """Raised when a run was asked to stop and has saved its state. `status` is the exit status for a shell."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        # 0: another process received the signal
        self.status = 128 + (number or signal.SIGTERM)


class StopRequest:
    """Records the first SIGINT or SIGTERM inside its `with` block; a second one stops at once, as without this class.

    Python delivers signals to the main thread only: in any other thread nothing is recorded.
    """

    number: int = 0

    def __enter__(self) -> "StopRequest":
        numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
        self._before = {number: signal.signal(number, self._note) for number in numbers}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number
        print("lidarpose: finishing these batches and saving; once more to stop at once", file=sys.stderr)


def train(
    recipe: Recipe,
    folder: str | Path | None = None,
    *,
    setup: TrainSetup | None = None,
    job: TrainSetup | None = None,
    resume: bool = False,
    command: str = "",
    device: str | None = None,
    tracker: str | None = None,
    draw: Draw | None = None,
) -> Path:
    """Trains according to a recipe and returns the path of model.safetensors.

    setup: samples or a network of your own instead of the recipe's (`setup.make_setup`); it also sets the run's length.
    job: the old name of `setup`. folder: a new one (None: the next number in `runs`), or with `resume` that of a run
    with the same recipe. Its length and the settings in `recipes.FREE` may differ; of data, shards, motion, body and
    init only the last part of each path is compared, not the contents. device: "cpu", or None for what Accelerate
    finds; tracker: "tensorboard" or "wandb", which must be installed; draw: draws pictures of validation people, None
    for none. Raises InputError if the folder or the recipe does not fit, or if the loss stops being finite: the last
    good state is then kept. Raises `Interrupted` after SIGINT or SIGTERM, once the state is saved.
    """
    _check(device, tracker)
    if resume:
        folder = run_dir.latest(recipe.kind) if folder is None else Path(folder)
        stored_recipe, earlier_command = run_dir.read_config(folder, type(recipe))
        run_dir.check_resumable(folder, stored_recipe, recipe)
        command = "; then ".join(filter(None, (earlier_command, command)))
    elif folder is not None:
        run_dir.check_new(Path(folder))
    elif int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError("several processes need the run's folder: give it")
    on_cpu = device == "cpu" or not torch.cuda.is_available()
    setup = setup or job or make_setup(recipe, on_cpu=on_cpu)
    if recipe.schedule == "reduce-on-plateau" and not setup.epoch:
        raise InputError("reduce-on-plateau needs epochs, and this setup has none (epoch = 0): choose another schedule")
    accelerator = _accelerator(recipe, on_cpu, tracker)
    if recipe.batch % setup.frames:
        raise InputError(f"batch counts frames, and a clip has {setup.frames}: give a multiple, got {recipe.batch}")
    lanes_of(recipe.batch // setup.frames, accelerator.num_processes)
    check_prn_batch(getattr(setup.objective, "config", None), recipe.batch // accelerator.num_processes)
    # every process must have checked the folder before the first one writes
    accelerator.wait_for_everyone()
    folder = run_dir.numbered(recipe.kind) if folder is None else Path(folder)
    accelerator.project_configuration.set_directories(str(folder))
    run = _Run(recipe, setup, folder, accelerator, command, draw)
    for warning in setup.warnings if run.is_main else ():
        _warn(warning)
    with run_dir.lock(folder) if run.is_main else nullcontext(), StopRequest() as stop:
        if resume:
            run.resume()
        elif run.is_main:
            run_dir.begin(folder, recipe, command)
        accelerator.wait_for_everyone()
        if tracker is not None:
            settings = {name: value for name, value in recipe.to_dict().items() if isinstance(value, int | float | str)}
            accelerator.init_trackers("lidarpose", config=settings)
        try:
            run.steps_until(stop)
        finally:
            if tracker is not None:
                accelerator.end_training()
    return folder / MODEL


def _warn(text: str) -> None:
    print(f"lidarpose: warning: {text}", file=sys.stderr)


def _accelerator(recipe: Recipe, on_cpu: bool, tracker: str | None) -> Accelerator:
    is_bf16 = recipe.precision == "bf16" or recipe.precision == "auto" and not on_cpu and torch.cuda.is_bf16_supported()
    try:
        return Accelerator(cpu=on_cpu, mixed_precision="bf16" if is_bf16 else "no", log_with=tracker)
    except ValueError as error:
        # the machine has no bf16, or the launcher asks for something that is not available
        reason, remedy = str(error).partition("\n")[0], "choose another --precision or --device"
        if "already been initialized" in reason:
            # Accelerate's settings are those of the process
            reason, remedy = "this Python process has trained in another precision", "start another one"
        raise InputError(f"cannot train like this ({reason}): {remedy}") from None


def _check(device: str | None, tracker: str | None) -> None:
    """Raises InputError for an unknown device or a tracker that is not installed."""
    if device is not None:
        check_name("device to train on", device, ("cpu", "cuda"))
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no GPU: install torch with CUDA, or train with --device cpu")
    if tracker is not None:
        check_name("tracker", tracker, TRACKERS)
        if find_spec(tracker) is None:
            raise InputError(f"--tracker {tracker} needs the package {tracker}: pip install {tracker}")


class _Run:
    """A run in progress: the network, the running mean of its weights, its optimizers and its progress.

    best, error: errors of the best and of the last validation, in the setup's unit; infinite and None before the first.
    """

    def __init__(
        self, recipe: Recipe, setup: TrainSetup, folder: Path, accelerator: Accelerator, command: str, draw: Draw | None
    ):
        self.recipe, self.setup, self.folder, self.command, self.draw = recipe, setup, folder, command, draw
        self.accelerator, self.is_main = accelerator, accelerator.is_main_process
        torch.manual_seed(_seed(recipe.seed, RandomStream.INITIAL_WEIGHTS))
        self.network: nn.Module = setup.network().to(accelerator.device).train()
        self.mean = {name: value.detach().clone() for name, value in self.network.named_parameters()}
        self.optimizers = optimizers(self.network, recipe)
        self.wrapped = accelerator.prepare(self.network) if accelerator.num_processes > 1 else self.network
        if isinstance(self.wrapped, DistributedDataParallel):
            # in every forward pass it would send the buffers of process 0, and the verifier's passes differ in number;
            # statistics of batch norms, the only buffers that change, are re-estimated before they are used
            self.wrapped.broadcast_buffers = False
        self.steps = -(-setup.people // recipe.batch)
        self.chunks = chunks_of(self.steps)
        self.chunk, self.seconds = 0, 0.0
        # this process's batches of the last completed chunk
        self._trained_on: list = []
        self.best = float("inf")
        self.error: float | None = None
        # for each completed chunk, the number of samples seen at its end, and its loss
        self._losses: list[tuple[int, float]] = []

    @cached_property
    def _watched(self) -> Sequence[Any]:
        """The samples to validate on."""
        return self.setup.validation()

    def resume(self) -> None:
        """Loads the state of the stopped run; starts from the beginning if none was saved yet."""
        if (self.folder / STATE).is_file():
            progress = run_dir.load_state(self.folder / STATE, self.network, self.mean, self.optimizers)
            steps, self.seconds = progress["steps"], progress["seconds"]
            if steps > self.steps:
                people_seen = steps * self.recipe.batch
                raise InputError(
                    f"{self.folder}: the run has seen {people_seen:,} people already, got a total of "
                    f"{self.setup.people:,}"
                )
            # a longer run repeats the last, partial chunk of a shorter one as a whole chunk
            self.chunk = self.chunks if steps == self.steps else steps // BATCHES
            self.best = float("inf") if progress["best"] is None else progress["best"]
            self.error = progress["validation"]
        elif self.is_main:
            _warn(f"{self.folder} has no {STATE}, it was stopped before the first one was saved: the run starts over")
        if self.is_main:
            run_dir.cut_log(self.folder, self.seen)
        entries = run_dir.read_log(self.folder)
        self._losses = [(entry["people"], _loss(entry)) for entry in entries if entry["people"] <= self.seen]

    @property
    def steps_done(self) -> int:
        """Number of steps of all completed chunks."""
        return min(self.chunk * BATCHES, self.steps)

    @property
    def seen(self) -> int:
        """Number of samples of all completed chunks."""
        return self.steps_done * self.recipe.batch

    def steps_until(self, stop: StopRequest) -> None:
        """Trains to the end of the run, or until `stop` is requested. Raises `Interrupted` in the latter case."""
        people, recipe = self.setup.people, self.recipe
        validate_every = recipe.validate or max(people // _VALIDATIONS, 1)
        start_time = save_time = time.monotonic()
        seconds_before = self.seconds
        with _dead_worker_named(), ExitStack() as stack:
            log = stack.enter_context(open(self.folder / LOG, "a")) if self.is_main else None
            bar = stack.enter_context(
                Progress(people, unit=self.setup.unit, done=min(self.seen, people), shown=self.is_main)
            )
            chunks = self._chunks(self.accelerator.process_index, self.accelerator.num_processes)
            for batches in loader(chunks, workers=recipe.workers):
                seen_before = self.seen
                terms, is_stopping = self._chunk(batches, stop)
                self._trained_on = batches
                self.seconds = seconds_before + time.monotonic() - start_time
                entry = {"people": self.seen, "seconds": round(self.seconds, 1)} | terms
                is_last = self.chunk == self.chunks
                if self.is_main and (is_last or self.seen // validate_every > seen_before // validate_every):
                    entry |= self._validated()
                self.accelerator.log({k: v for k, v in entry.items() if k != "people"}, step=self.seen)
                bar.update(min(self.seen, people), self._note(terms))
                if log is not None:
                    log.write(json.dumps(entry) + "\n")
                    log.flush()
                    if is_last or is_stopping or time.monotonic() - save_time > SAVE_EVERY:
                        # the log must be on disk before the state is
                        os.fsync(log.fileno())
                        self._save()
                        save_time = time.monotonic()
                if is_stopping and is_last:
                    # whoever runs several commands in turn must learn that the next one is not wanted
                    self.accelerator.wait_for_everyone()
                    raise Interrupted(f"stopped after all {self.seen:,} samples: the run is complete", stop.number)
                if is_stopping:
                    # all processes take this branch: the request was reduced together with the losses
                    folder_option = ("--out " if recipe.kind == "finetune" else "") + shlex.quote(str(self.folder))
                    remedy = f"go on with lidarpose {recipe.kind} {folder_option} --resume"
                    raise Interrupted(f"stopped after {self.seen:,} samples, saved: {remedy}", stop.number)
        self.accelerator.wait_for_everyone()

    def _chunks(self, rank: int = 0, ranks: int = 1) -> Chunks:
        """The remaining chunks of the run for process `rank` of `ranks`."""
        return Chunks(
            source=self.setup.source,
            objective=self.setup.objective,
            batch=self.recipe.batch // self.setup.frames,
            seed=self.recipe.seed,
            start=self.chunk,
            steps=self.steps,
            rank=rank,
            ranks=ranks,
        )

    def _note(self, terms: dict[str, float]) -> str:
        """The text of the progress bar."""
        metric = f"mpjpe {terms['mpjpe'] * 1e3:.0f} mm" if "mpjpe" in terms else f"AP {terms['ap']:.3f}"
        note = f"loss {_loss(terms):.3f}, {metric}"
        return note if self.error is None else f"{note}, validation {self.error:.0f} {self.setup.error_unit}"

    def _chunk(self, batches: list, stop: StopRequest) -> tuple[dict[str, float], bool]:
        """Takes the steps of a chunk. Returns the means over them of each term and of the gradient's norm, and whether
        any process was asked to stop. Raises InputError if a term is not finite."""
        plateau = self._plateau_factor()
        terms = [self._step(arrays, k, plateau) for k, arrays in enumerate(batches)]
        names = list(terms[0])
        values = torch.stack([torch.stack([t[name] for name in names]) for t in terms])
        flags = values.new_full((len(values), 1), float(stop.number > 0))
        values, flags = self.accelerator.reduce(torch.cat([values, flags], 1), "mean").cpu().split((len(names), 1), 1)
        bad_batches = (~values.isfinite().all(1)).nonzero().flatten().tolist()
        if bad_batches:
            state = f"{STATE} is kept" if (self.folder / STATE).is_file() else "nothing was saved before"
            raise InputError(
                f"the loss or its gradient is not finite in batch {bad_batches[0]} of the {len(batches)} that start at "
                f"person {self.seen}: start in another folder with a lower --rate; {state}"
            )
        self.chunk += 1
        means = {name: round(value, 5) for name, value in zip(names, values.mean(0).tolist(), strict=True)}
        self._losses.append((self.seen, _loss(means)))
        return means, bool(flags.any())

    def _plateau_factor(self) -> float:
        """Share of the peak rate, given the losses of all completed epochs."""
        if self.recipe.schedule != "reduce-on-plateau":
            return 1.0
        losses: list[list[float]] = [[] for _ in range(self.seen // self.setup.epoch)]
        for seen, loss in self._losses:
            # a chunk that ends in the next epoch may mostly lie in this one
            epoch = (seen - 1) // self.setup.epoch
            if epoch < len(losses):
                losses[epoch].append(loss)
        return plateau_factor([fmean(own_losses) for own_losses in losses if own_losses], self.recipe.rate)

    def _step(self, arrays: object, k: int, plateau: float) -> dict[str, Tensor]:
        step, recipe, accelerator = self.chunk * BATCHES + k, self.recipe, self.accelerator
        # random draws in the network (dropout) depend only on the step
        torch.manual_seed(_seed(recipe.seed, RandomStream.TRAINING_STEP, step, accelerator.process_index))
        set_rates(self.optimizers, recipe, plateau * rate_factor(step / self.steps, recipe))
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
        with accelerator.autocast():
            terms = self.setup.objective.terms(self.wrapped, arrays, device=accelerator.device, share=self._share)
        accelerator.backward(total(terms))
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip or float("inf"))
        for optimizer in self.optimizers:
            optimizer.step()
        average(self.mean, self.network, step, recipe.ema)
        return {name: value.detach() for name, value in terms.items()} | {"gradient": norm.detach()}

    def _share(self, count: Tensor) -> Tensor:
        return self.accelerator.reduce(count.detach().float(), "mean") if self.wrapped is not self.network else count

    def _averaged(self) -> nn.Module:
        """A network with the mean weights and batch statistics estimated for them, in evaluation mode."""
        network = self.setup.objective.network().to(self.accelerator.device)
        network.load_state_dict(self.network.state_dict() | self.mean)
        if batch_norms(network):
            # only pose networks have batch norms
            update_batch_norms(network, cast(PoseObjective, self.setup.objective), self._recent_batches())
        return network.eval()

    def _recent_batches(self) -> list:
        """All processes' batches of the last whole chunk; they depend only on the step."""
        chunk = max(self.steps_done // BATCHES, 1) - 1
        if chunk == self.chunk - 1 and self.accelerator.num_processes == 1:
            return self._trained_on
        # the last chunk may be a single batch, and other processes' batches are not available here: they are made again
        return self._chunks().batches_of(chunk)

    def _validated(self) -> dict[str, float]:
        """Validates, on the main process, and returns the log entries; saves the weights of the best validation."""
        if not self._watched:
            return {}
        network = self._averaged()
        pictures = self.recipe.pictures if isinstance(self.recipe, PoseRecipe) else 0
        batch = self.recipe.batch // self.setup.frames
        self.error, joints = self.setup.validate(self.setup.objective, network, self._watched, batch)
        if pictures and self.draw is not None and joints is not None and self.setup.joints is not None:
            rows = evenly_spaced(len(joints), pictures)
            frames = [frame for example in self._watched for frame in example.frames]
            examples = [frames[k] for k in rows]
            picture = self.draw(examples, joints[rows], self.setup.joints, f"after {self.seen:,} people")
            write_atomic(self.folder / run_dir.PICTURES / f"people-{self.seen:09d}.png", picture)
        if self.error < self.best:
            self.best = self.error
            self._save_weights(BEST, network)
        return self._error_entry(self.error)

    def _error_entry(self, error: float) -> dict[str, float]:
        """The entry of the log and the card for a validation error."""
        return {f"validation_{self.setup.error_unit}": round(error, 2)}

    def _save(self) -> None:
        # the state is written last: a run that is killed in between resumes from the older state and writes both again
        self._save_weights(MODEL, self._averaged())
        best = self.best if np.isfinite(self.best) else None
        progress = {"steps": self.steps_done, "seconds": self.seconds, "best": best, "validation": self.error}
        run_dir.save_state(self.folder / STATE, self.network, self.mean, self.optimizers, progress)

    def _save_weights(self, name: str, network: Any) -> None:
        recipe = self.recipe.to_dict()
        for field in run_dir.PATHS:
            if value := recipe.get(field):
                # file names without their folders
                recipe[field] = Path(value).name if isinstance(value, str) else run_dir.folder_names(value)
        card: dict[str, Any] = {"command": self.command or "lidarpose.train.loop.train", "recipe": recipe}
        card |= {f"{self.setup.unit}_seen": self.seen, "hours": round(self.seconds / 3600, 3)}
        if self.error is not None:
            card |= self._error_entry(self.error)
        save_checkpoint(self.folder / name, network, card=card | self.setup.card)


def _loss(entry: dict[str, float]) -> float:
    """The sum of the loss terms of a chunk, given its terms or its log entry."""
    others = ("people", "seconds", "gradient", *LOGGED)
    return sum(value for name, value in entry.items() if name not in others and not name.startswith("validation_"))


def _seed(*words: int) -> int:
    """A seed for torch derived from integers."""
    return int(np.random.SeedSequence(words).generate_state(1)[0])


@contextmanager
def _dead_worker_named() -> Iterator[None]:
    """Raises InputError if a loader worker was killed, which PyTorch may notice at any point of a step."""
    try:
        yield
    except RuntimeError as error:
        # errors raised in a worker are "in DataLoader worker process N"
        if "DataLoader worker (pid" not in str(error):
            raise
        raise InputError(
            "a data loader process was killed, perhaps because memory ran out: go on with --resume and fewer --workers"
        ) from None
