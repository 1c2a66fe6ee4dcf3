"""Training runs: killed and resumed runs, numbered run folders, several processes."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from motion_files import a_clip, write_amass
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from training_runs import BATCHES, FEW, few_to_validate_on, refused, train_until_killed  # noqa: F401 - a fixture

from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.io.atomic import LOCK
from lidarpose.models import weights_path
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.config import SIZES
from lidarpose.models.posenet import PoseNet
from lidarpose.train import loop, run_dir, setup
from lidarpose.train.data_loader import SyntheticSource, lanes_of
from lidarpose.train.loop import Interrupted, StopRequest
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import optimizers, rate_factor
from lidarpose.train.recipes import Finetune, Pretrain, TrainVerifier, recipe as recipe_of
from lidarpose.train.setup import make_setup

# people per chunk; a run has three chunks
CHUNK = BATCHES * 2
RECIPE = Pretrain(scene="paper", people=3 * CHUNK, batch=2, workers=0, seed=5, easy=0.15, pictures=0, validate=1000)
TINY = SIZES["tiny"]


def log_of(folder):
    lines = [json.loads(line) for line in (folder / run_dir.LOG).read_text().splitlines()]
    for line in lines:
        assert line.pop("seconds") >= 0
    return lines


def people_of(folder):
    return [line["people"] for line in log_of(folder)]


def assert_close(a, b, names=(run_dir.MODEL, run_dir.STATE), losses=None, weights=None):
    """Two runs have the same losses and the same weights."""
    left, right = log_of(a), log_of(b)
    assert [line["people"] for line in left] == [line["people"] for line in right]
    for x, y in zip(left, right, strict=True):
        assert x == pytest.approx(y, **(losses or {"abs": 2e-4}))
    for name in names:
        first, second = load_file(a / name), load_file(b / name)
        assert first.keys() == second.keys()
        for key in first:
            torch.testing.assert_close(first[key], second[key], **(weights or {"atol": 1e-5, "rtol": 1e-4}), msg=key)


def assert_resumes_to(unbroken, folder):
    loop.train(RECIPE, folder, resume=True)
    assert_close(folder, unbroken)


@pytest.fixture
def copy(tmp_path, unbroken):
    """A copy of a finished run that tests may change."""
    return shutil.copytree(unbroken, tmp_path / "run")


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "whole"
    assert loop.train(RECIPE, folder) == folder / run_dir.MODEL
    return folder


def test_saved_weights_are_running_mean(unbroken, tmp_path):
    loop.train(replace(RECIPE, ema=0.0), tmp_path / "run")
    for line, other in zip(log_of(unbroken), log_of(tmp_path / "run"), strict=True):
        assert line["joints"] == pytest.approx(other["joints"], abs=2e-4)
    mean, last = (load_file(folder / run_dir.MODEL) for folder in (unbroken, tmp_path / "run"))
    assert max((mean[name] - last[name]).abs().max() for name in mean) > 1e-3


@pytest.mark.long
@pytest.mark.parametrize("clip, moves", [(0.0, True), (1.0, True), (1e-12, False)])
def test_gradients_are_clipped(clip, moves, tmp_path):
    """Adam divides by the gradient's size, but not by less than its epsilon."""
    recipe = replace(RECIPE, init="tiny", people=16, clip=clip, muon_rate=0.0, decay=0.0, ema=0.0)
    loop.train(recipe, tmp_path / "run")
    before, after = (load_file(path) for path in (weights_path("tiny"), tmp_path / "run" / run_dir.MODEL))
    # the run has no objects, so the head for them is left out
    assert after.keys() == {name for name in before if not name.startswith("person.")}
    moved = max((after[name].float() - before[name].float()).abs().max() for name in after)
    assert moved > 1e-3 if moves else moved < 1e-5


def test_finished_run_folder_contents(unbroken):
    names = [run_dir.BEST, run_dir.CONFIG, run_dir.LOG, run_dir.MODEL, run_dir.STATE]
    assert sorted(p.name for p in unbroken.iterdir()) == sorted(names)
    config = json.loads((unbroken / run_dir.CONFIG).read_text())
    assert config["schema"] == run_dir.SCHEMA and config["kind"] == "pretrain"
    assert config["recipe"] == json.loads(json.dumps(RECIPE.to_dict()))
    _, header = load_checkpoint(unbroken / run_dir.MODEL)
    assert header.card["people_seen"] == RECIPE.people and header.card["recipe"]["seed"] == 5
    lines = log_of(unbroken)
    assert lines[-1]["vote"] < lines[0]["vote"]
    # validation runs at the end of the run at the latest
    assert lines[-1]["validation_mm"] == header.card["validation_mm"] > 0 and "validation_mm" not in lines[0]


@pytest.mark.long
@pytest.mark.parametrize(
    "name, call, saved",
    [
        ("_step", 2, 0),  # before the first chunk is done: nothing saved yet
        ("_step", BATCHES + 2, 1),  # within the second chunk
        ("save_state", 1, 1),  # the second chunk is in the log but not in the state
        ("_save", 1, 1),  # the validation may have been reported
        ("save_state", 2, 2),
    ],
)
def test_killed_run_resumes_to_same_result(tmp_path, unbroken, name, call, saved):
    folder = tmp_path / "run"
    train_until_killed(RECIPE, folder, name, call)
    assert (folder / run_dir.STATE).exists() == bool(saved)
    with open(folder / run_dir.LOG, "a") as log:
        # an incomplete line is ignored
        log.write('{"people": 32, "sec')
    assert_resumes_to(unbroken, folder)


def test_finished_run_is_not_changed(tmp_path, unbroken):
    before = {p.name: p.read_bytes() for p in unbroken.iterdir()}
    assert loop.train(RECIPE, unbroken, resume=True) == unbroken / run_dir.MODEL
    assert before == {p.name: p.read_bytes() for p in unbroken.iterdir()}
    with pytest.raises(InputError, match="expected a new or empty folder"):
        loop.train(RECIPE, unbroken)
    assert before == {p.name: p.read_bytes() for p in unbroken.iterdir()}


def test_resume_accepts_moved_input_files(tmp_path):
    """Input files may be in another folder, but must have the same names; the initial weights are read again."""
    with_body = Pretrain(body="/old/smpl.npz", motion="/old/motion.npz")
    run_dir.check_resumable(tmp_path, with_body, replace(with_body, body="/new/smpl.npz", motion="/new/motion.npz"))
    begun = Pretrain(init=str(tmp_path / "old/model.safetensors"))
    run_dir.check_resumable(tmp_path, begun, replace(begun, init=str(tmp_path / "new/model.safetensors")))
    for other in (str(tmp_path / "new/best.safetensors"), ""):
        with pytest.raises(InputError, match="the run has init = .* a run keeps its recipe"):
            run_dir.check_resumable(tmp_path, begun, replace(begun, init=other))


@pytest.mark.parametrize("change", [{"seed": 6}, {"batch": 16}, {"rate": 1e-3}, {"scene": "wild"}, {"muon_rate": 0.0}])
def test_resume_rejects_changed_recipe(unbroken, change):
    with refused(f"the run has {next(iter(change))} = .* a run keeps its recipe"):
        loop.train(replace(RECIPE, **change), unbroken, resume=True)


@pytest.mark.long
def test_resume_accepts_shorter_and_longer_runs(tmp_path):
    folder = tmp_path / "run"
    train_until_killed(RECIPE, folder, "_step", BATCHES)
    loop.train(replace(RECIPE, people=CHUNK + 4, workers=1), folder, resume=True)
    assert people_of(folder) == [CHUNK, CHUNK + 4]
    loop.train(RECIPE, folder, resume=True)
    with pytest.raises(InputError, match=f"the run has seen {RECIPE.people} people already, got a total of {CHUNK}"):
        loop.train(replace(RECIPE, people=CHUNK), folder, resume=True)
    assert people_of(folder)[-1] == RECIPE.people


def test_longer_run_sees_all_people(monkeypatch, tmp_path):
    """Including the people of the shorter run's last, incomplete chunk."""
    folder, seen = tmp_path / "run", []
    original = SyntheticSource.example
    monkeypatch.setattr(SyntheticSource, "example", lambda self, index: seen.append(index) or original(self, index))
    monkeypatch.setattr(setup, "VALIDATION", 0)
    loop.train(replace(RECIPE, people=6), folder)
    assert sorted(set(seen)) == list(range(6))
    loop.train(replace(RECIPE, people=2 * CHUNK), folder, resume=True)
    assert set(seen) >= set(range(2 * CHUNK))
    assert people_of(folder) == [CHUNK, 2 * CHUNK]


def started(recipe, folder, environment=None, *, first="", **options):
    """Starts a training process that saves after every chunk; first: a statement before."""
    code = (
        "import sys, json, torch; torch.set_num_threads(1)\n"
        "from lidarpose.train import data_loader, loop, recipes, setup\n"
        f"loop.SAVE_EVERY, setup.VALIDATION = -1.0, {FEW}; loop.BATCHES = data_loader.BATCHES = {BATCHES}\n"
        f"{first}\n"
        f"loop.train(recipes.{type(recipe).__name__}(**json.loads(sys.argv[1])), sys.argv[2])"
    )
    words = [sys.executable, "-c", code, json.dumps(recipe.to_dict()), str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | (environment or {})
    return subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.long
def test_run_with_workers_resumes_after_sigkill(tmp_path):
    """After SIGKILL nothing is cleaned up, and the workers exit on their own."""
    recipe = replace(RECIPE, workers=1, people=40 * CHUNK)
    process = started(recipe, tmp_path / "run", start_new_session=True)
    deadline = time.monotonic() + 120
    while len(run_dir.read_log(tmp_path / "run")) < 2:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    # the process group is empty once the workers have noticed that their parent is gone
    while True:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        assert time.monotonic() < deadline, "a worker lives on"
        time.sleep(0.1)
    done = max(line["people"] for line in run_dir.read_log(tmp_path / "run"))
    longer = replace(recipe, people=max(done + 2 * CHUNK, RECIPE.people), workers=0)
    loop.train(longer, tmp_path / "run", resume=True)
    assert not [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]
    assert people_of(tmp_path / "run") == list(range(CHUNK, longer.people + 1, CHUNK))


@pytest.mark.long
def test_leftover_files_of_killed_run_are_ignored(tmp_path, unbroken):
    folder = tmp_path / "run"
    folder.mkdir()
    # killed while writing the first file and holding the lock
    (folder / ".123-0-config.json").write_text('{"schema"')
    (folder / LOCK).touch()
    loop.train(RECIPE, folder)
    assert_close(folder, unbroken)
    # a power cut may leave zeros in the log, and an incomplete file
    with open(folder / run_dir.LOG, "ab") as log:
        log.write(b"\0\0\0\0" + b'{"people": 12}\n[1]\n{"seconds": 3}\n')
    (folder / ".123-1-model.safetensors").write_bytes(b"half")
    assert_resumes_to(unbroken, folder)
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize(("where", "name"), [(loop, "loader"), (PoseNetObjective, "terms")])
def test_killed_worker_raises_input_error(tmp_path, monkeypatch, where, name):
    """The error is raised while waiting for batches or within a step."""

    def lost(*_, **__):
        raise RuntimeError("DataLoader worker (pid 12) is killed by signal: Killed.")

    monkeypatch.setattr(where, name, lost)
    with refused("a data loader process was killed"):
        loop.train(RECIPE, tmp_path / "run")


def test_errors_in_workers_keep_their_message(tmp_path, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("Caught RuntimeError in DataLoader worker process 0.\nOriginal Traceback: a bug")

    monkeypatch.setattr(loop, "loader", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        loop.train(RECIPE, tmp_path / "run")


def test_another_precision_needs_another_process(monkeypatch):
    def initialized(**_):
        raise ValueError("AcceleratorState has already been initialized and cannot be changed, restart")

    monkeypatch.setattr(loop, "Accelerator", initialized)
    with refused("this Python process has trained in another precision.: start another one"):
        loop._accelerator(RECIPE, True, None)


def test_plateau_schedule_needs_epochs_and_a_rate(tmp_path):
    with refused("lowers the rate: give a --rate above 0"):
        recipe_of(Finetune, "lidarcap", data=("x",), rate=0.0)
    wanted = recipe_of(Finetune, "lidarcap", data=("x",), size="lidarcap-tiny")
    with refused("reduce-on-plateau needs epochs"):
        loop.train(wanted, tmp_path / "run", setup=replace(make_setup(RECIPE), epoch=0))
    assert not (tmp_path / "run").exists()


def test_run_folder_is_locked_for_other_processes(monkeypatch, copy):
    monkeypatch.setattr(run_dir, "LOCK_WAIT", 0.0)
    longer = replace(RECIPE, people=RECIPE.people + 2 * CHUNK)
    before = {p.name: p.read_bytes() for p in copy.iterdir()}
    with run_dir.lock(copy):
        with refused("another process trains there: stop it"):
            loop.train(longer, copy, resume=True)
        assert before == {p.name: p.read_bytes() for p in copy.iterdir() if p.name != LOCK}
    loop.train(longer, copy, resume=True)
    assert people_of(copy)[-1] == longer.people


def test_train_rejects_unusable_folders(tmp_path):
    (tmp_path / "file").write_text("")
    with refused("cannot write into the folder"):
        loop.train(RECIPE, tmp_path / "file" / "run")
    (tmp_path / "none").mkdir()
    with refused("nothing to resume"):
        loop.train(RECIPE, tmp_path / "none", resume=True)
    assert not list((tmp_path / "none").iterdir())


def written(content):
    return lambda path: path.write_bytes(content)


def rewritten(tensors=lambda tensors: tensors, progress=lambda progress: progress):
    """Returns a function that rewrites state.safetensors."""

    def rewrite(path):
        with safe_open(path, framework="pt") as file:
            known = json.loads(file.metadata()["progress"])
        save_file(tensors(load_file(path)), path, metadata={"progress": json.dumps(progress(known))})

    return rewrite


def without_one(ending):
    def without(tensors):
        first = next(name for name in tensors if name.endswith(ending))
        return {name: value for name, value in tensors.items() if name != first}

    return rewritten(without)


def with_steps(step):
    return rewritten(lambda tensors: tensors | {name: step.clone() for name in tensors if name.endswith(".step")})


def with_a_flipped_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 64
    path.write_bytes(content)


def with_recipe(**change):
    def rewrite(path):
        config = json.loads(path.read_text())
        path.write_text(json.dumps(config | {"recipe": config["recipe"] | change}))

    return rewrite


def of_another_network(path):
    network = PoseNet(replace(TINY, channels=(32, 32, 32)))
    progress = {"steps": 8, "seconds": 0.0, "best": None}
    run_dir.save_state(path, network, dict(network.named_parameters()), optimizers(network, RECIPE), progress)


BROKEN = (b"", b"rubbish", b"{}", b"[1]")
PROGRESS = ({"steps": None}, {"steps": 1.5}, {"seconds": -1}, {"best": "low"})
DAMAGE = [
    *((run_dir.CONFIG, written(content), "damaged|is empty") for content in BROKEN),
    *((run_dir.STATE, written(content), "damaged") for content in BROKEN),
    *(
        (name, lambda path: path.write_bytes(path.read_bytes()[:200]), "damaged")
        for name in (run_dir.CONFIG, run_dir.STATE)
    ),
    (run_dir.STATE, lambda path: shutil.copy(path.with_name(run_dir.MODEL), path), "damaged"),
    (run_dir.STATE, of_another_network, "the state belongs to another network"),
    (run_dir.STATE, rewritten(progress=lambda _: []), "damaged"),
    *(
        (run_dir.STATE, rewritten(progress=lambda known, change=change: known | change), "damaged")
        for change in PROGRESS
    ),
    *((run_dir.STATE, without_one(f".{name}"), f"memory is damaged .*{name}") for name in ("step", "exp_avg")),
    *(
        (run_dir.STATE, with_steps(step), "memory is damaged .*step of parameter 0 ")
        for step in (torch.zeros(3), torch.tensor(torch.nan))
    ),
    (run_dir.STATE, with_a_flipped_bit, "digest"),
    *(
        (run_dir.CONFIG, with_recipe(**{k: v}), f"{k} must be")
        for k, v in (("batch", None), ("rate", "fast"), ("seed", -1))
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "damage", "message"), DAMAGE)
def test_damaged_run_error_names_file(copy, name, damage, message):
    damage(copy / name)
    with refused(f"^{re.escape(str(copy / name))}: .*({message})"):
        loop.train(RECIPE, copy, resume=True)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_config_in_other_unicode_encoding_is_read(copy, unbroken, encoding):
    (copy / run_dir.CONFIG).write_bytes((copy / run_dir.CONFIG).read_text("utf-8").encode(encoding))
    assert_resumes_to(unbroken, copy)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_saves_and_resumes_to_same_losses(monkeypatch, tmp_path, unbroken, number):
    folder, original = tmp_path / "run", PoseNetObjective.terms

    def interrupted(*args, **kwargs):
        # only in the first call
        monkeypatch.setattr(PoseNetObjective, "terms", original)
        os.kill(os.getpid(), number)
        return original(*args, **kwargs)

    monkeypatch.setattr(PoseNetObjective, "terms", interrupted)
    message = f"stopped after {CHUNK} samples, saved: go on with lidarpose pretrain {re.escape(str(folder))} --resume"
    with pytest.raises(Interrupted, match=message) as stop:
        loop.train(RECIPE, folder)
    assert stop.value.status == 128 + number and signal.getsignal(number) is not None
    assert people_of(folder) == [CHUNK]
    assert_resumes_to(unbroken, folder)


@pytest.mark.long
def test_stop_request_in_last_chunk_finishes_run_and_is_reported(monkeypatch, tmp_path):
    """A command that runs several trainings must not begin the next one."""
    original = PoseNetObjective.terms

    def interrupted(*args, **kwargs):
        monkeypatch.setattr(PoseNetObjective, "terms", original)
        os.kill(os.getpid(), signal.SIGTERM)
        return original(*args, **kwargs)

    monkeypatch.setattr(PoseNetObjective, "terms", interrupted)
    recipe, folder = replace(RECIPE, people=CHUNK), tmp_path / "run"
    with pytest.raises(Interrupted, match=f"stopped after all {CHUNK} samples: the run is complete"):
        loop.train(recipe, folder)
    assert people_of(folder) == [CHUNK]
    # nothing is left to do
    assert loop.train(recipe, folder, resume=True) == folder / run_dir.MODEL
    assert people_of(folder) == [CHUNK]


@pytest.mark.parametrize(("people", "steps"), [(CHUNK, BATCHES), (CHUNK + 1, BATCHES + 1), (1, 1)])
def test_run_steps_are_rounded_up(people, steps, tmp_path):
    recipe = replace(RECIPE, people=people)
    run = loop._Run(recipe, setup.make_setup(recipe), tmp_path, loop.Accelerator(cpu=True), "", None)
    assert run.steps == steps


def test_second_stop_request_interrupts_immediately():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.number == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.long
def test_run_without_state_reports_restart(copy, unbroken, capsys):
    (copy / run_dir.STATE).unlink()
    assert_resumes_to(unbroken, copy)
    assert "the run starts over" in capsys.readouterr().err


# 0 with an infinite gradient
def steep(value):
    return (value - value).abs().sqrt()


@pytest.mark.long
@pytest.mark.parametrize(
    "step, poison",
    [(BATCHES + 2, lambda value: value * float("nan")), *((k, steep) for k in (BATCHES + 1, 2 * BATCHES, 3 * BATCHES))],
)
def test_non_finite_values_stop_run_and_are_not_saved(tmp_path, unbroken, step, poison):
    """Also if only the gradient in the last step of a chunk or of the run is not finite, and the loss is."""
    folder, calls, original = tmp_path / "run", [], PoseNetObjective.terms

    def poisoned(*args, **kwargs):
        terms = original(*args, **kwargs)
        calls.append(1)
        return terms | {"vote": terms["vote"] + poison(terms["vote"])} if len(calls) == step else terms

    chunk, batch = divmod(step - 1, BATCHES)
    where = f"batch {batch} of the {BATCHES} that start at person {CHUNK * chunk}"
    message = f"its gradient is not finite in {where}: start in another folder "
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseNetObjective, "terms", poisoned)
        patch.setattr(loop, "SAVE_EVERY", -1.0)
        with refused(f"{message}with a lower --rate; state.safetensors is kept"):
            loop.train(RECIPE, folder)
    assert people_of(folder) == [CHUNK, 2 * CHUNK][:chunk]
    for name in (run_dir.STATE, run_dir.MODEL):
        assert all(value.isfinite().all() for value in load_file(folder / name).values() if value.is_floating_point())
    # the saved state is intact
    assert_resumes_to(unbroken, folder)


def test_too_large_learning_rate_stops_run(tmp_path):
    with refused(f"not finite in batch [0-9] of the {BATCHES} that start at person 0"):
        loop.train(replace(RECIPE, rate=1e30), tmp_path / "run")


def test_pretrain_command_trains_and_resumes(tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["pretrain", str(folder), "--people", "8", "--batch", "2", "--scene", "paper", "--workers", "0"]
    assert not main(words)
    assert str(folder / run_dir.MODEL) in capsys.readouterr().out
    command = load_checkpoint(folder / run_dir.MODEL)[1].card["command"]
    assert command == "lidarpose pretrain --batch 2 --workers 0 --scene paper --people 8"
    # options that are not repeated keep their values
    go_on = ["pretrain", str(folder), "--resume"]
    assert not main([*go_on, "--people", "32"])
    assert "warning" not in capsys.readouterr().err
    longer = load_checkpoint(folder / run_dir.MODEL)[1].card["command"]
    assert longer == f"{command}; then lidarpose pretrain --people 32 --resume"
    for wrong, message in (
        (words, "expected a new or empty folder"),
        ([*go_on, "--batch", "4"], "the run has batch = 2, got 4"),
        ([*go_on, "--recipe", "paper"], "omit --recipe"),
        (["finetune", "some", "--out", str(folder), "--resume"], "`lidarpose pretrain`"),
    ):
        assert main(wrong) == 2
        assert message in capsys.readouterr().err
    pictures = sorted(path.name for path in (folder / run_dir.PICTURES).iterdir())
    assert pictures and all(name.endswith(".png") for name in pictures)


@pytest.mark.long
def test_unnamed_runs_get_numbered_folders(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["pretrain", "--people", "4", "--batch", "2", "--scene", "paper", "--workers", "0", "--pictures", "0"]
    assert not main(words) and not main(words)
    assert sorted(path.name for path in (tmp_path / run_dir.RUNS).iterdir()) == ["pretrain-001", "pretrain-002"]
    assert run_dir.latest("pretrain").name == "pretrain-002"
    assert not main(["pretrain", "--resume"])
    assert capsys.readouterr().out.split()[-1] == str(run_dir.Path(run_dir.RUNS) / "pretrain-002" / run_dir.MODEL)
    with pytest.raises(InputError, match="has no run finetune-... to resume"):
        run_dir.latest("finetune")
    # an existing name is skipped
    (tmp_path / run_dir.RUNS / "pretrain-003").mkdir()
    assert run_dir.numbered("pretrain").name == "pretrain-004"


@pytest.mark.parametrize(
    "words, message",
    [
        ("--people many", "people must be a whole number, got 'many'"),
        ("--rate fast", "rate must be a number, got 'fast'"),
        ("--recipe best", "unknown recipe 'best'"),
        ("--schedule steps", "unknown schedule 'steps'"),
        ("--shards nowhere", "is not a dataset"),
        ("--cool 1.5", "cool must be a share"),
        ("--rate inf", "rate must be a finite number"),
        ("--size paper --bone 1", "bone and symmetry are terms of the package's own networks"),
        ("--size paper --init tiny", "init is for the package's own networks"),
        ("--tracker paper", "unknown tracker 'paper'"),
        ("--device moon", "unknown device to train on 'moon'"),
        ("--scene moon", "unknown scene 'moon'"),
        ("--scene moon --workers 1", "unknown scene 'moon'"),
        ("--size huge", "unknown network size 'huge'"),
        ("--motion no.npz --subjects a", "no such file"),
        ("--motion no.npz --subjects a --workers 1", "no such file"),
    ],
)
def test_pretrain_rejects_invalid_options_and_leaves_no_folder(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["pretrain", "--quiet", "--people", "4", "--batch", "2", "--workers", "0", *words.split()]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_two_processes_match_single_process(tmp_path):
    """With the environment variables of torch's and Accelerate's launchers."""
    recipe = replace(RECIPE, people=4 * CHUNK, batch=4, seed=3, rate=2e-4, muon_rate=2e-3)
    port = str(29000 + os.getpid() % 3000)
    common = {"MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": "2", "MASTER_PORT": port, "ACCELERATE_USE_CPU": "true"}
    for process in [started(recipe, tmp_path / "two", common | {"RANK": k, "LOCAL_RANK": k}) for k in "01"]:
        _, error = process.communicate(timeout=240)
        assert process.returncode == 0, error
    loop.train(recipe, tmp_path / "one")
    within = {"losses": {"rel": 2e-3, "abs": 2e-4}, "weights": {"atol": 3e-4, "rtol": 1e-2}}
    assert_close(tmp_path / "two", tmp_path / "one", [run_dir.MODEL], **within)
    assert people_of(tmp_path / "two") == [2 * CHUNK, 4 * CHUNK]


@pytest.mark.slow
def test_processes_of_the_verifier_may_take_different_numbers_of_passes(tmp_path):
    """Passes are of 3 detections, and scans have up to 60."""
    recipe = TrainVerifier(scenes=16, uses=1, batch=4, workers=0, seed=3, validate=1000)
    port = str(29000 + os.getpid() % 3000)
    common = {"MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": "2", "MASTER_PORT": port, "ACCELERATE_USE_CPU": "true"}
    few = "from lidarpose.train.objectives import verifier_objective; verifier_objective._GROUP = 3"
    processes = [started(recipe, tmp_path / "two", common | {"RANK": k, "LOCAL_RANK": k}, first=few) for k in "01"]
    for process in processes:
        _, error = process.communicate(timeout=240)
        assert process.returncode == 0, error
    assert run_dir.read_log(tmp_path / "two")[-1]["people"] == 16


def test_prn_needs_two_people_in_each_process(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_accelerator", lambda *_: SimpleNamespace(num_processes=8))
    with pytest.raises(InputError, match="batch must be at least 2 for prn"):
        loop.train(recipe_of(Pretrain, "prn", model="prn", size="prn-tiny", batch=8, people=64), tmp_path / "run")


def test_lanes_of_rejects_batch_not_divisible_by_processes():
    assert lanes_of(64, 1) == lanes_of(64, 2) == lanes_of(64, 8) == 8 and lanes_of(12, 4) == 4 and lanes_of(3) == 1
    for batch, ranks, fit in ((64, 3, "1, 2, 4, 8"), (64, 16, "1, 2, 4, 8"), (15, 2, "1")):
        with refused(f"a batch of {batch} can be shared out among {fit} processes, got {ranks}: change --batch"):
            lanes_of(batch, ranks)


def test_card_stores_command_as_typed(tmp_path, monkeypatch):
    motion = write_amass(tmp_path / "My Walk_poses.npz", *a_clip(40))
    monkeypatch.chdir(tmp_path)
    words = ["--batch", "2", "--workers", "0", "--scene", "paper", "--people", "2", "--motion", str(motion)]
    assert not main(["pretrain", "run", *words, "--subjects", "My Walk"])
    config = json.loads((tmp_path / "run" / run_dir.CONFIG).read_text())
    typed = shlex.split(config["command"])
    assert typed[typed.index("--motion") + 1] == motion.name and typed[typed.index("--subjects") + 1] == "My Walk"


def test_learning_rates_mean_weights_and_seeds_follow_steps(monkeypatch, tmp_path):
    rates, seeds, means, step, average = [], [], [], loop._Run._step, loop.average

    def recorded(self, arrays, *of):
        terms = step(self, arrays, *of)
        rates.append([group["lr"] for optimizer in self.optimizers for group in optimizer.param_groups])
        seeds.append(torch.initial_seed())
        return terms

    def averaged(mean, network, step, ema):
        means.append((step, ema))
        average(mean, network, step, ema)

    monkeypatch.setattr(loop, "average", averaged)
    monkeypatch.setattr(loop._Run, "_step", recorded)
    monkeypatch.setattr(setup, "VALIDATION", 0)
    loop.train(RECIPE, tmp_path / "run")
    assert means == [(k, RECIPE.ema) for k in range(3 * BATCHES)]
    assert seeds == [loop._seed(RECIPE.seed, loop.RandomStream.TRAINING_STEP, k, 0) for k in range(3 * BATCHES)]
    due = [rate_factor(k / (3 * BATCHES), RECIPE) for k in range(3 * BATCHES)]
    np.testing.assert_allclose(rates, np.outer(due, [RECIPE.rate, RECIPE.muon_rate]))


@pytest.mark.long
def test_best_validation_is_kept_after_resume(monkeypatch, tmp_path):
    errors = [50.0, 40.0, 60.0, 45.0]

    def made(recipe, **settings):
        return replace(setup.make_setup(recipe, **settings), validate=lambda *_: (errors.pop(0), None))

    monkeypatch.setattr(loop, "make_setup", made)
    folder = tmp_path / "run"

    def best():
        card = load_checkpoint(folder / run_dir.BEST)[1].card
        return card["validation_mm"], card["people_seen"]

    often = replace(RECIPE, validate=CHUNK)
    loop.train(often, folder)
    assert best() == (40.0, 2 * CHUNK)
    loop.train(replace(often, people=often.people + CHUNK), folder, resume=True)
    assert not errors and best() == (40.0, 2 * CHUNK)


@pytest.mark.long
def test_seed_changes_initial_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "VALIDATION", 0)

    def begun(seed):
        recipe = replace(RECIPE, people=2, seed=seed, rate=0.0, muon_rate=0.0)
        return load_file(loop.train(recipe, tmp_path / str(seed)))

    a, b = begun(1), begun(2)
    assert max((a[name] - b[name]).abs().max() for name in a) > 0.01


@pytest.mark.parametrize(
    "command, words, name, optimizer",
    [
        ("pretrain", ["--size", "prn-small"], "prn", "adam"),
        ("pretrain", ["--size", "lpformer-tiny"], "lpformer", "adamw"),
        ("pretrain", ["--size", "paper-small"], "dapt", "adamw"),
        ("pretrain", ["--size", "base"], "ours", "adamw"),
        ("finetune", ["some", "--init", "random", "--size", "prn-small"], "prn", "adam"),
    ],
)
def test_size_selects_recipe_of_its_network(command, words, name, optimizer, monkeypatch):
    recipes = []
    monkeypatch.setattr("lidarpose.train.loop.train", lambda recipe, *_, **__: recipes.append(recipe) or "x")
    assert main([command, *words]) == 0 and main([command, *words, "--model", name]) == 0
    by_size, by_model = recipes
    assert by_size.optimizer == optimizer and replace(by_size, model=name) == by_model
