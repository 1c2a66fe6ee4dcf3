"""Steps: lidarpose commands that make one folder each, from the folders of other steps.

A step's folder is OUT/runs/NAME. NAME follows from the command alone, so tables share the steps that they have in
common, and no step is run twice. OUT/runs/NAME.json records that a step is done; an unfinished step is run again, a
training with --resume.
"""

import hashlib
import io
import json
import math
import os
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from lidarpose.errors import InputError, LidarPoseError
from lidarpose.io.atomic import exclusive_lock, write_atomic, write_error
from lidarpose.io.files import read_json
from lidarpose.train.recipes import Finetune, Pretrain
from lidarpose.train.run_dir import CONFIG, LENGTHS, MODEL, read_config, read_log

# subfolders of the output folder: the steps, and the results of finished cells
RUNS, CELLS = "runs", "cells"
# the file of an evaluation that is put in place last
POSES = "poses.parquet"
# recipe classes of the training commands
KINDS: dict[str, type[Pretrain] | type[Finetune]] = {"pretrain": Pretrain, "finetune": Finetune}
# a training's speed is measured over this many seconds, or over this share of its hours if that is less
_WATCH, _WATCH_SHARE = 120.0, 0.05
# from the second line of its log on; from the first one, if that took this share of its hours
_FIRST_SHARE = 0.25
_POLL = 0.5
# a shortened run sees at least this many times as many people as it has seen so far
_MORE = 1.1
# options whose values appear in a folder's name
_TELLING: dict[Any, str] = {"--keep": "keep"} | dict.fromkeys(
    ("--model", "--size", "--neck", "--head", "--set", "-n"), ""
)
# runs a command, as `lidarpose.cli.main` does, and returns its exit status
Execute = Callable[[list[str]], int]


@dataclass(frozen=True)
class Step:
    """A command. words: the command and its options, where a step stands for its product; hours: a training that would
    take longer is shortened, including its schedule; None: no limit."""

    words: tuple["str | Step", ...]
    hours: float | None = None

    @property
    def kind(self) -> str:
        """synth, pretrain, finetune or evaluate."""
        return str(self.words[0])

    @cached_property
    def name(self) -> str:
        """The folder's name: the command, its most distinctive options, and a digest of all its words."""
        words = [word.name if isinstance(word, Step) else word for word in self.words]
        if "--workers" in words:
            # does not affect the result
            index = words.index("--workers")
            words[index : index + 2] = []
        digest = hashlib.sha256(json.dumps([words, self.hours]).encode()).hexdigest()[:8]
        label = "".join(c if c.isalnum() or c in ".-" else "-" for c in self._about)
        return "-".join(filter(None, (self.kind, label, digest)))

    @property
    def _about(self) -> str:
        """Values of the most distinctive options of this step, or else of a training that it needs."""
        pairs = zip(self.words, self.words[1:], strict=False)
        option_values = [f"{_TELLING[option]}{value}" for option, value in pairs if option in _TELLING]
        return "-".join(option_values) or next((need._about for need in self.needs if need.kind in KINDS), "")

    @property
    def needs(self) -> tuple["Step", ...]:
        """The steps whose folders the command reads."""
        return tuple(word for word in self.words if isinstance(word, Step))

    def all(self) -> Iterator["Step"]:
        """This step and all steps that it needs, in the order in which they run."""
        for step in self.needs:
            yield from step.all()
        yield self

    def folder(self, out: Path) -> Path:
        return out / RUNS / self.name

    def product(self, out: Path) -> Path:
        """What other steps read: the weights of a training, else the folder."""
        return self.folder(out) / MODEL if self.kind in KINDS else self.folder(out)

    def command(self, out: Path) -> list[str]:
        """The words after `lidarpose`."""
        words = [str(word.product(out)) if isinstance(word, Step) else word for word in self.words]
        folder = str(self.folder(out))
        return [words[0], folder, *words[1:]] if self.kind == "pretrain" else [*words, "--out", folder]

    def line(self, out: Path) -> str:
        """The command as typed in a shell."""
        return shlex.join(["lidarpose", *self.command(out)])


class StepFailed(LidarPoseError):
    """A command that ended with an error; its message is the command's error message."""


class _Saved(KeyboardInterrupt):
    """A training that was asked to stop, and has saved its state."""


def is_done(step: Step, out: Path) -> bool:
    """Whether the step's command has finished successfully."""
    return _state(step, out).get("done", False)


def run_steps(step: Step, out: Path, execute: Execute, tell: Callable[[str], None]) -> None:
    """Runs the unfinished steps among a step and those that it needs; waits for steps that another process is running.

    Raises:
        StepFailed: a command failed; has its error message.
        KeyboardInterrupt: a command was interrupted.
    """
    for part in step.all():
        if is_done(part, out):
            continue
        waiting = f"{part.name}: another process is running it, waiting for its end"
        (out / RUNS).mkdir(parents=True, exist_ok=True)
        with exclusive_lock(out / RUNS / f".{part.name}.lock", partial(tell, waiting)):
            if not is_done(part, out):
                tell(part.line(out))
                _run(part, out, execute, tell)
                _note(part, out, done=True, command=part.line(out))


def _state(step: Step, out: Path) -> dict[str, Any]:
    path = out / RUNS / f"{step.name}.json"
    return read_json(path, expected="the state of a step") if path.is_file() else {}


def _note(step: Step, out: Path, **entries: Any) -> None:
    content = _state(step, out) | entries
    write_atomic(out / RUNS / f"{step.name}.json", json.dumps(content, indent=1) + "\n")


def _run(step: Step, out: Path, execute: Execute, tell: Callable[[str], None]) -> None:
    folder = step.folder(out)
    if step.kind == "evaluate":
        if (folder / POSES).is_file():
            # put in place last: the process ended before it could record that the step is done
            return
        # remove what a killed process left behind: the command needs an empty folder
        shutil.rmtree(folder, ignore_errors=True)
    words = step.command(out)
    if step.kind in KINDS and (folder / CONFIG).is_file():
        folder_words = [str(folder)] if step.kind == "pretrain" else ["--out", str(folder)]
        workers = words[words.index("--workers") :][:2] if "--workers" in words else []
        words = [step.kind, *folder_words, "--resume", *length_of(step, out), *workers]
    if step.hours is None or step.kind not in KINDS or "length" in _state(step, out):
        _execute(words, execute)
        return
    with _Watch(folder, step.hours, tell) as watch:
        try:
            _execute(words, execute)
        except _Saved:
            # any other interruption is the user's, also of the saving that the watch asked for
            if not watch.fit:
                raise
    if watch.fit:
        length = _shortened(step, folder, watch.fit)
        _note(step, out, length=length)
        tell(f"shortened to fit {step.hours:.3g} hours: goes on with {' '.join(length)}")
        _run(step, out, execute, tell)


def _execute(words: list[str], execute: Execute) -> None:
    last_line = _LastLine(sys.stderr)
    with redirect_stderr(last_line):
        try:
            status = execute(words)
        except SystemExit as exit_error:
            # raised by the parser for an invalid command line
            status = exit_error.code if isinstance(exit_error.code, int) else 2
    if status >= 128:
        # the command itself said how far it came
        has_saved = last_line.line.startswith("lidarpose: stopped after")
        raise (_Saved if has_saved else KeyboardInterrupt)("the same lidarpose paper command goes on here")
    if status:
        raise StepFailed(last_line.line.removeprefix("lidarpose: error: ") or f"ended with status {status}")


class _LastLine(io.TextIOBase):
    """Passes text on and remembers its last line that is not blank."""

    def __init__(self, to: Any):
        self._to, self.line = to, ""

    def write(self, text: str) -> int:
        self.line = next((line for line in reversed(text.splitlines()) if line.strip()), self.line)
        return self._to.write(text)

    def flush(self) -> None:
        self._to.flush()

    def isatty(self) -> bool:
        return self._to.isatty()


class _Watch:
    """Stops the training in this process, by SIGINT, once its log shows that it will take longer than its hours.

    fit: how many people can be seen in these hours; None as long as it has not stopped the training.
    """

    def __init__(self, folder: Path, hours: float, tell: Callable[[str], None]):
        self.fit: float | None = None
        self._folder, self._seconds, self._tell, self._over = folder, 3600 * hours, tell, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "_Watch":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        try:
            self._stop_in_time()
        except Exception as error:
            # an exception ends a thread without anybody noticing
            self._tell(f"warning: --hours has no effect on {self._folder.name} ({type(error).__name__}: {error})")

    def _stop_in_time(self) -> None:
        while not self._over.wait(_POLL):
            entries = read_log(self._folder)
            if not entries or entries[-1]["seconds"] < min(_WATCH, _WATCH_SHARE * self._seconds):
                continue
            entry, first = entries[-1], {"people": 0, "seconds": 0.0}
            if len(entries) > 1:
                # in the first lines' time, processes start and memory is touched for the first time
                first = entries[0]
            elif entry["seconds"] < _FIRST_SHARE * self._seconds:
                continue
            speed = (entry["people"] - first["people"]) / max(entry["seconds"] - first["seconds"], 1e-3)
            fit = entry["people"] + (self._seconds - entry["seconds"]) * speed
            if max(fit, _MORE * entry["people"]) >= _people(self._folder):
                return
            # the number of a `StopRequest`: None before a resumed training runs, 0 until the user stops it. A second
            # signal would abort the saving
            if getattr(getattr(signal.getsignal(signal.SIGINT), "__self__", None), "number", None) == 0:
                self.fit = fit
                if os.name == "nt":
                    # os.kill would end the process
                    signal.raise_signal(signal.SIGINT)
                else:
                    # also wakes the main thread
                    os.kill(os.getpid(), signal.SIGINT)
                return


def last_entry(folder: Path) -> dict[str, Any] | None:
    """The last complete line of a run's log; None before the first."""
    lines = read_log(folder)
    return lines[-1] if lines else None


def _people(folder: Path) -> int:
    """The number of samples that the whole run sees."""
    from lidarpose.train.setup import make_setup

    kind = KINDS[read_json(folder / CONFIG, expected="the configuration of a run")["kind"]]
    return make_setup(read_config(folder, kind)[0]).people


def _shortened(step: Step, folder: Path, fit: float) -> list[str]:
    """The options that shorten a run to `fit` people, or to slightly more than it has seen already."""
    # a run cannot be made shorter than what it has seen
    people_seen = (last_entry(folder) or {}).get("people", 0)
    share = min(max(fit, _MORE * people_seen) / _people(folder), 1.0)
    recipe = read_config(folder, KINDS[step.kind])[0].to_dict()
    name = next(name for name in LENGTHS if name in recipe)
    length = recipe[name] * share
    # rounded up, so that it stays above what the run has seen
    return [f"--{name}", str(math.ceil(length) if name == "people" else math.ceil(1e4 * length) / 1e4)]


def length_of(step: Step, out: Path) -> tuple[str, ...]:
    """The options that shortened a training to its hours; empty if it was not shortened."""
    return tuple(_state(step, out).get("length", ()))


def begin_out(out: Path) -> None:
    """Creates the folder at once, since another process may start another table in it. Raises as `check_out`."""
    check_out(out)
    try:
        (out / RUNS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out / RUNS, out, error) from None


def check_out(out: Path) -> None:
    """Raises InputError if the folder holds other files than those of lidarpose paper."""
    is_paper_folder = any((out / name).is_dir() for name in (RUNS, CELLS))
    if out.is_file() or out.is_dir() and any(out.iterdir()) and not is_paper_folder:
        raise InputError(f"{out}: expected a new or empty folder, or one of lidarpose paper: give another by --out")
