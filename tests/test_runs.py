"""Runs that can be killed and taken up again, numbered folders, several processes."""

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

import numpy as np
import pytest
import torch
from motion_files import a_clip, write_amass
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from training_runs import FEW, few_to_validate_on, refused, train_until_killed  # noqa: F401 - a fixture

from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.models import weights_path
from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.models.config import preset
from lidarpose.models.posenet import PoseNet
from lidarpose.train import loop, run_dir, setup
from lidarpose.train.data_loader import BATCHES, SyntheticSource, lanes_of
from lidarpose.train.loop import Interrupted, StopRequest
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import optimizers, rate_factor
from lidarpose.train.recipes import Finetune, Pretrain, recipe
from lidarpose.train.validation import Validation

# three chunks of `BATCHES` batches
RECIPE = Pretrain(
    scene="paper", people=3 * BATCHES * 2, batch=2, workers=0, seed=5, easy=0.15, pictures=0, validate=1000
)
TINY = preset("tiny")


def log_of(folder):
    lines = [json.loads(line) for line in (folder / run_dir.LOG).read_text().splitlines()]
    for line in lines:
        assert line.pop("seconds") >= 0
    return lines


def assert_same_run(a, b):
    left, right = log_of(a), log_of(b)
    assert [line["people"] for line in left] == [line["people"] for line in right] == [16, 32, 48]
    for x, y in zip(left, right, strict=True):
        assert x == pytest.approx(y, abs=2e-4)
    for name in (run_dir.MODEL, run_dir.STATE):
        one, other = load_file(a / name), load_file(b / name)
        assert one.keys() == other.keys()
        for key in one:
            torch.testing.assert_close(one[key], other[key], atol=1e-5, rtol=1e-4)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "whole"
    assert loop.train(RECIPE, folder) == folder / run_dir.MODEL
    return folder


def test_what_is_saved_is_the_running_mean_of_the_weights(unbroken, tmp_path):
    loop.train(replace(RECIPE, ema=0.0), tmp_path / "run")
    for line, other in zip(log_of(unbroken), log_of(tmp_path / "run"), strict=True):
        assert line["joints"] == pytest.approx(other["joints"], abs=2e-4)
    mean, last = (load_file(folder / run_dir.MODEL) for folder in (unbroken, tmp_path / "run"))
    assert max((mean[name] - last[name]).abs().max() for name in mean) > 1e-3


@pytest.mark.parametrize("clip, moves", [(0.0, True), (1.0, True), (1e-12, False)])
def test_gradients_are_clipped(clip, moves, tmp_path):
    """Adam divides by the gradient's size, but not by less than its epsilon."""
    recipe = replace(RECIPE, init="tiny", people=16, clip=clip, muon_rate=0.0, decay=0.0, ema=0.0)
    loop.train(recipe, tmp_path / "run")
    before, after = (load_file(path) for path in (weights_path("tiny"), tmp_path / "run" / run_dir.MODEL))
    moved = max((after[name].float() - before[name].float()).abs().max() for name in before)
    assert moved > 1e-3 if moves else moved < 1e-5


def test_an_unbroken_run(unbroken):
    names = [run_dir.BEST, run_dir.CONFIG, run_dir.LOG, run_dir.MODEL, run_dir.STATE]
    assert sorted(p.name for p in unbroken.iterdir()) == sorted(names)
    config = json.loads((unbroken / run_dir.CONFIG).read_text())
    assert config["schema"] == run_dir.SCHEMA and config["kind"] == "pretrain"
    assert config["recipe"] == json.loads(json.dumps(RECIPE.to_dict()))
    _, header = load_checkpoint(unbroken / run_dir.MODEL)
    assert header.card["people_seen"] == 48 and header.card["recipe"]["seed"] == 5
    lines = log_of(unbroken)
    assert lines[-1]["vote"] < lines[0]["vote"]
    # at the end at the latest
    assert lines[-1]["validation_mm"] == header.card["validation_mm"] > 0 and "validation_mm" not in lines[0]


@pytest.mark.parametrize(
    "name, call, saved",
    [
        ("_step", 2, 0),  # before the first chunk is done: nothing saved yet
        ("_step", BATCHES + 2, 1),  # within the second chunk
        ("save_state", 1, 1),  # the second chunk is in the log but not in the state
        ("_save", 1, 1),  # a validation may have been told
        ("save_state", 2, 2),
    ],
)
def test_a_killed_run_goes_on_to_the_same_end(tmp_path, unbroken, name, call, saved):
    folder = tmp_path / "run"
    train_until_killed(RECIPE, folder, name, call)
    assert (folder / run_dir.STATE).exists() == bool(saved)
    with open(folder / run_dir.LOG, "a") as log:
        # half a line is no obstacle
        log.write('{"people": 32, "sec')
    loop.train(RECIPE, folder, resume=True)
    assert_same_run(folder, unbroken)


def test_a_finished_run_stays_as_it_is(tmp_path, unbroken):
    before = {p.name: p.read_bytes() for p in unbroken.iterdir()}
    assert loop.train(RECIPE, unbroken, resume=True) == unbroken / run_dir.MODEL
    assert before == {p.name: p.read_bytes() for p in unbroken.iterdir()}
    with pytest.raises(InputError, match="expected a new or empty folder"):
        loop.train(RECIPE, unbroken)
    assert before == {p.name: p.read_bytes() for p in unbroken.iterdir()}


def test_what_a_run_begins_with_may_have_been_moved(tmp_path):
    """The weights it was begun with are read again: it could not go on without them."""
    begun = Pretrain(init=str(tmp_path / "old/model.safetensors"))
    run_dir.check_same(tmp_path, begun, replace(begun, init=str(tmp_path / "new/model.safetensors")))
    for other in (str(tmp_path / "new/best.safetensors"), ""):
        with pytest.raises(InputError, match="the run has init = .* a run keeps its recipe"):
            run_dir.check_same(tmp_path, begun, replace(begun, init=other))


@pytest.mark.parametrize("change", [{"seed": 6}, {"batch": 16}, {"rate": 1e-3}, {"scene": "wild"}, {"muon_rate": 0.0}])
def test_a_run_keeps_its_recipe(unbroken, change):
    with pytest.raises(InputError, match=f"the run has {next(iter(change))} = .* a run keeps its recipe"):
        loop.train(replace(RECIPE, **change), unbroken, resume=True)


def test_a_run_may_become_shorter_and_longer(tmp_path):
    folder = tmp_path / "run"
    train_until_killed(RECIPE, folder, "_step", BATCHES)
    loop.train(replace(RECIPE, people=28, workers=1), folder, resume=True)
    assert [line["people"] for line in log_of(folder)] == [16, 28]
    loop.train(replace(RECIPE, people=48), folder, resume=True)
    assert [line["people"] for line in log_of(folder)][-1] == 48
    with pytest.raises(InputError, match="the run has seen 48 people already, got 16 in all"):
        loop.train(replace(RECIPE, people=16), folder, resume=True)
    assert [line["people"] for line in log_of(folder)][-1] == 48


def test_a_longer_run_sees_everybody(monkeypatch, tmp_path):
    """Those of the last, short chunk of the shorter run too."""
    folder, seen = tmp_path / "run", []
    original = SyntheticSource.example
    monkeypatch.setattr(SyntheticSource, "example", lambda self, index: seen.append(index) or original(self, index))
    monkeypatch.setattr(setup, "VALIDATION", 0)
    loop.train(replace(RECIPE, people=6), folder)
    assert sorted(set(seen)) == list(range(6))
    loop.train(replace(RECIPE, people=32), folder, resume=True)
    assert set(seen) >= set(range(32))
    assert [line["people"] for line in log_of(folder)] == [16, 32]


def test_killed_for_good_with_workers_and_taken_up(tmp_path):
    """SIGKILL: nothing is tidied, and the workers end by themselves."""
    recipe = replace(RECIPE, workers=1, people=40 * BATCHES * 2)
    code = (
        "import sys, json, torch; torch.set_num_threads(1)\n"
        "from lidarpose.train import loop, setup; from lidarpose.train.recipes import Pretrain\n"
        f"loop.SAVE_EVERY, setup.VALIDATION = -1.0, {FEW}\n"
        "loop.train(Pretrain(**json.loads(sys.argv[1])), sys.argv[2])"
    )
    words = [sys.executable, "-c", code, json.dumps(recipe.to_dict()), str(tmp_path / "run")]
    process = subprocess.Popen(words, env=os.environ | {"OMP_NUM_THREADS": "1"}, start_new_session=True)
    deadline = time.monotonic() + 120
    while len(run_dir.read_log(tmp_path / "run")) < 2:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    # the group has no process left once its workers have seen that their parent is gone
    while True:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        assert time.monotonic() < deadline, "a worker lives on"
        time.sleep(0.1)
    done = max(line["people"] for line in run_dir.read_log(tmp_path / "run"))
    longer = replace(recipe, people=max(done + 2 * BATCHES * 2, 48), workers=0)
    loop.train(longer, tmp_path / "run", resume=True)
    assert not [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]
    assert [line["people"] for line in log_of(tmp_path / "run")] == list(range(16, longer.people + 1, 16))


def test_what_a_kill_leaves_is_no_obstacle(tmp_path, unbroken):
    folder = tmp_path / "run"
    folder.mkdir()
    # killed while the very first file was written
    (folder / ".123-0-config.json").write_text('{"schema"')
    loop.train(RECIPE, folder)
    assert_same_run(folder, unbroken)
    assert not (folder / ".123-0-config.json").exists()
    # a power cut may leave zeros in the log, and half of a file
    with open(folder / run_dir.LOG, "ab") as log:
        log.write(b"\0\0\0\0" + b'{"people": 12}\n[1]\n{"seconds": 3}\n')
    (folder / ".123-1-model.safetensors").write_bytes(b"half")
    loop.train(RECIPE, folder, resume=True)
    assert_same_run(folder, unbroken)
    assert not (folder / ".123-1-model.safetensors").exists()


@pytest.mark.parametrize(("where", "name"), [(loop, "loader"), (PoseNetObjective, "terms")])
def test_a_dead_worker_is_one_line(tmp_path, monkeypatch, where, name):
    """It is noticed while batches are waited for, or in the middle of a step."""

    def lost(*_, **__):
        raise RuntimeError("DataLoader worker (pid 12) is killed by signal: Killed.")

    monkeypatch.setattr(where, name, lost)
    with refused("a process that makes people was killed"):
        loop.train(RECIPE, tmp_path / "run")


def test_a_run_has_one_process_at_a_time(monkeypatch, tmp_path, unbroken):
    monkeypatch.setattr(run_dir, "LOCK_WAIT", 0.0)
    folder = shutil.copytree(unbroken, tmp_path / "run")
    longer = replace(RECIPE, people=RECIPE.people + 2 * BATCHES * 2)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with run_dir.held(folder):
        with pytest.raises(InputError, match="another process trains there: stop it") as caught:
            loop.train(longer, folder, resume=True)
        assert "\n" not in str(caught.value)
        assert before == {p.name: p.read_bytes() for p in folder.iterdir() if p.name != run_dir.LOCK}
    loop.train(longer, folder, resume=True)
    assert log_of(folder)[-1]["people"] == longer.people
    # that of a process that was killed is no obstacle
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / run_dir.LOCK).touch()
    loop.train(RECIPE, tmp_path / "other")
    assert_same_run(tmp_path / "other", unbroken)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with refused("run: cannot be made or locked"):
        loop.train(RECIPE, tmp_path / "file" / "run")


def test_nothing_to_resume(tmp_path):
    with pytest.raises(InputError, match="nothing to resume"):
        loop.train(RECIPE, tmp_path, resume=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(
    "change, message",
    [
        ({"scene": "moon"}, "unknown scene 'moon'"),
        ({"size": "huge"}, "unknown network size 'huge'"),
        ({"motion": "/no/clips.npz", "subjects": ("a",)}, "no such file"),
    ],
)
def test_a_recipe_that_cannot_be_is_one_line_and_leaves_no_folder(tmp_path, workers, change, message):
    with refused(message):
        loop.train(replace(RECIPE, workers=workers, **change), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", [run_dir.STATE, run_dir.CONFIG])
@pytest.mark.parametrize("content", [b"", b"rubbish", b"{}", b"[1]", None])
def test_a_damaged_run_says_so(tmp_path, unbroken, name, content):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(InputError, match="damaged") as caught:
        loop.train(RECIPE, folder, resume=True)
    assert "\n" not in str(caught.value) and str(folder / name) in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_config_in_another_unicode_encoding_is_read(tmp_path, unbroken, encoding):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    text = (folder / run_dir.CONFIG).read_text("utf-8")
    (folder / run_dir.CONFIG).write_bytes(text.encode(encoding))
    loop.train(RECIPE, folder, resume=True)
    assert_same_run(folder, unbroken)


@pytest.mark.parametrize("change", [{"steps": None}, {"steps": 1.5}, {"seconds": -1}, {"best": "low"}, []])
def test_damaged_progress_of_a_state_is_one_line(tmp_path, unbroken, change):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    progress = {"steps": 16, "seconds": 1.0, "best": None, "validation": None}
    progress = change if change == [] else progress | change
    save_file(load_file(folder / run_dir.STATE), folder / run_dir.STATE, metadata={"progress": json.dumps(progress)})
    with refused(f"{re.escape(str(folder / run_dir.STATE))}: .*damaged"):
        loop.train(RECIPE, folder, resume=True)


@pytest.mark.parametrize("entry", ["step", "exp_avg"])
def test_a_state_whose_optimizer_lacks_an_entry_is_refused(tmp_path, unbroken, entry):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    with safe_open(folder / run_dir.STATE, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(folder / run_dir.STATE)
    del tensors[next(name for name in tensors if name.endswith(f".{entry}"))]
    save_file(tensors, folder / run_dir.STATE, metadata=metadata)
    with pytest.raises(InputError, match=f"optimizer's memory is damaged .*{entry}"):
        loop.train(RECIPE, folder, resume=True)


@pytest.mark.parametrize(("entry", "value"), [("batch", None), ("rate", "fast"), ("seed", -1)])
def test_a_damaged_recipe_names_its_file(tmp_path, unbroken, entry, value):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    config = json.loads((folder / run_dir.CONFIG).read_text())
    config["recipe"][entry] = value
    (folder / run_dir.CONFIG).write_text(json.dumps(config))
    with refused(f"{re.escape(str(folder / run_dir.CONFIG))}: {entry} must be"):
        loop.train(RECIPE, folder, resume=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_told_to_stop_saves_and_goes_on_to_the_same_losses(monkeypatch, tmp_path, unbroken, number):
    folder, original = tmp_path / "run", PoseNetObjective.terms

    def interrupted(*args, **kwargs):
        # once
        monkeypatch.setattr(PoseNetObjective, "terms", original)
        os.kill(os.getpid(), number)
        return original(*args, **kwargs)

    monkeypatch.setattr(PoseNetObjective, "terms", interrupted)
    message = f"stopped after 16 samples, saved: go on with lidarpose pretrain {re.escape(str(folder))} --resume"
    with pytest.raises(Interrupted, match=message) as stop:
        loop.train(RECIPE, folder)
    assert stop.value.status == 128 + number and signal.getsignal(number) is not None
    assert [line["people"] for line in log_of(folder)] == [16]
    loop.train(RECIPE, folder, resume=True)
    assert_same_run(folder, unbroken)


def test_a_second_request_stops_at_once():
    with pytest.raises(KeyboardInterrupt), StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.number == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_run_without_a_state_says_that_it_starts_over(tmp_path, unbroken, capsys):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    (folder / run_dir.STATE).unlink()
    loop.train(RECIPE, folder, resume=True)
    assert "the run starts over" in capsys.readouterr().err
    assert_same_run(folder, unbroken)


def test_the_state_of_another_network_is_refused(tmp_path, unbroken):
    folder = shutil.copytree(unbroken, tmp_path / "run")
    (folder / run_dir.STATE).write_bytes((folder / run_dir.MODEL).read_bytes())
    with pytest.raises(InputError, match="damaged"):
        loop.train(RECIPE, folder, resume=True)
    other = replace(TINY, channels=(32, 32, 32))
    network = PoseNet(other)
    mean = dict(network.named_parameters())
    progress = {"steps": 8, "seconds": 0.0, "best": None}
    loop.save_state(folder / run_dir.STATE, network, mean, optimizers(network, RECIPE), progress)
    with refused("not of this network"):
        loop.train(RECIPE, folder, resume=True)


# of a value of 0: its slope is infinite, its value is not
def steep(value):
    return (value - value).abs().sqrt()


@pytest.mark.parametrize(
    "step, poison",
    [(BATCHES + 4, lambda value: value * float("nan")), *((k, steep) for k in (BATCHES + 3, 2 * BATCHES, 3 * BATCHES))],
)
def test_what_is_not_finite_stops_the_run_and_never_reaches_what_is_saved(tmp_path, unbroken, step, poison):
    """Neither a loss nor a gradient, not even that of the last step of a chunk, or of the run, whose loss is good."""
    folder, calls, original = tmp_path / "run", [], PoseNetObjective.terms

    def poisoned(*args, **kwargs):
        terms = original(*args, **kwargs)
        calls.append(1)
        return terms | {"vote": terms["vote"] + poison(terms["vote"])} if len(calls) == step else terms

    chunk, batch = divmod(step - 1, BATCHES)
    message = (
        f"its gradient is not finite in batch {batch} of the 8 from person {16 * chunk} on: start in another folder "
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseNetObjective, "terms", poisoned)
        patch.setattr(loop, "SAVE_EVERY", -1.0)
        with refused(f"{message}with a lower --rate; state.safetensors is kept"):
            loop.train(RECIPE, folder)
    assert [line["people"] for line in log_of(folder)] == [16, 32][:chunk]
    for name in (run_dir.STATE, run_dir.MODEL):
        assert all(value.isfinite().all() for value in load_file(folder / name).values() if value.is_floating_point())
    # the state is as good as new
    loop.train(RECIPE, folder, resume=True)
    assert_same_run(folder, unbroken)


def test_an_absurd_rate_stops_the_run(tmp_path):
    with pytest.raises(InputError, match="not finite in batch [0-9] of the 8 from person 0 on"):
        loop.train(replace(RECIPE, rate=1e30), tmp_path / "run")


def test_the_command_line_trains_and_goes_on(tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["pretrain", str(folder), "--people", "8", "--batch", "2", "--scene", "paper", "--workers", "0"]
    assert not main(words)
    assert str(folder / run_dir.MODEL) in capsys.readouterr().out
    command = load_checkpoint(folder / run_dir.MODEL)[1].card["command"]
    assert command == "lidarpose pretrain --batch 2 --workers 0 --scene paper --people 8"
    assert main(words) == 2
    assert "expected a new or empty folder" in capsys.readouterr().err
    # what is not said again stays as it was
    assert not main(["pretrain", str(folder), "--resume", "--people", "32"])
    assert not capsys.readouterr().err
    longer = load_checkpoint(folder / run_dir.MODEL)[1].card["command"]
    assert longer == f"{command}; then lidarpose pretrain --people 32 --resume"
    assert main(["pretrain", str(folder), "--resume", "--batch", "4"]) == 2
    assert "the run has batch = 2, got 4" in capsys.readouterr().err
    assert main(["pretrain", str(folder), "--resume", "--recipe", "paper"]) == 2
    assert "leave --recipe away" in capsys.readouterr().err
    assert main(["finetune", "some", "--out", str(folder), "--resume"]) == 2
    assert "`lidarpose pretrain`" in capsys.readouterr().err
    pictures = sorted(path.name for path in (folder / run_dir.PICTURES).iterdir())
    assert pictures and all(name.endswith(".png") for name in pictures)


def test_runs_without_a_name_are_numbered(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["pretrain", "--people", "4", "--batch", "2", "--scene", "paper", "--workers", "0", "--pictures", "0"]
    assert not main(words) and not main(words)
    assert sorted(path.name for path in (tmp_path / run_dir.RUNS).iterdir()) == ["pretrain-001", "pretrain-002"]
    assert run_dir.latest("pretrain").name == "pretrain-002"
    assert not main(["pretrain", "--resume"])
    assert capsys.readouterr().out.split()[-1] == str(run_dir.Path(run_dir.RUNS) / "pretrain-002" / run_dir.MODEL)
    with pytest.raises(InputError, match="has no run finetune-... to resume"):
        run_dir.latest("finetune")
    # a name that is taken meanwhile is passed over
    (tmp_path / run_dir.RUNS / "pretrain-003").mkdir()
    assert run_dir.numbered("pretrain").name == "pretrain-004"


@pytest.mark.parametrize(
    "words, told",
    [
        (["--people", "many"], "--people: expected a whole number, got 'many'"),
        (["--rate", "fast"], "--rate: expected a number, got 'fast'"),
        (["--recipe", "best"], "unknown recipe 'best'"),
        (["--schedule", "steps"], "unknown schedule 'steps'"),
        (["--shards", "nowhere"], "is no dataset"),
        (["--cool", "1.5"], "cool must be a share"),
        (["--rate", "inf"], "rate must be a finite number"),
        (["--size", "paper", "--bone", "1"], "bone and symmetry are terms of the package's own networks"),
        (["--tracker", "paper"], "unknown tracker 'paper'"),
        (["--device", "moon"], "unknown device to train on 'moon'"),
    ],
)
def test_wrong_words_are_one_line_and_leave_no_folder(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    assert main(["pretrain", "--people", "4", "--batch", "2", "--workers", "0", *words]) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_named_recipes():
    assert recipe(Pretrain) == Pretrain()
    paper = recipe(Pretrain, "paper", people=5)
    # Paper: AdamW, cosine, batch 64, 3e-4 and 5e-4, 50 epochs
    assert (paper.size, paper.scene, paper.batch, paper.rate, paper.people) == ("paper", "paper", 64, 3e-4, 5)
    assert paper.schedule == "cosine" and not (paper.muon_rate or paper.ema or paper.clip)
    with pytest.raises(InputError, match="name it by --init"):
        recipe(Finetune, "paper", data=("a",))
    fine = recipe(Finetune, "paper", data=("a",), init="first.safetensors")
    assert (fine.rate, fine.epochs, fine.mix, fine.augment, fine.keep_anchors) == (5e-4, 50, 0, "paper", False)
    # the paper's figures are of networks that learned from every training sequence
    assert fine.hold_out == 0
    with pytest.raises(InputError, match="fine-tuning needs a dataset"):
        recipe(Finetune)


SHARED = replace(RECIPE, people=64, batch=4, seed=3, rate=2e-4, muon_rate=2e-3)


def launched(recipe, folder, processes):
    """Trains as torch's and Accelerate's launchers would have it."""
    code = (
        "import sys, json, torch; torch.set_num_threads(1)\n"
        "from lidarpose.train import setup; from lidarpose.train.loop import train\n"
        f"from lidarpose.train.recipes import Pretrain; setup.VALIDATION = {FEW}\n"
        "train(Pretrain(**json.loads(sys.argv[1])), sys.argv[2])"
    )
    common = os.environ | {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": str(processes)}
    common |= {"MASTER_PORT": str(29000 + os.getpid() % 3000), "ACCELERATE_USE_CPU": "true"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code, json.dumps(recipe.to_dict()), str(folder)],
            env=common | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(processes)
    ]
    for process in started:
        _, error = process.communicate(timeout=240)
        assert process.returncode == 0, error


def test_two_processes_take_the_same_steps_as_one(tmp_path):
    launched(SHARED, tmp_path / "two", 2)
    loop.train(SHARED, tmp_path / "one")
    one, two = (log_of(tmp_path / name) for name in ("one", "two"))
    assert [line["people"] for line in two] == [line["people"] for line in one] == [32, 64]
    for a, b in zip(one, two, strict=True):
        assert b == pytest.approx(a, rel=2e-3, abs=2e-4)
    weights = [load_file(tmp_path / name / run_dir.MODEL) for name in ("one", "two")]
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, atol=3e-4, rtol=1e-2, msg=name)


def test_a_batch_that_cannot_be_shared_out_is_refused():
    assert lanes_of(64, 1) == lanes_of(64, 2) == lanes_of(64, 8) == 8 and lanes_of(12, 4) == 4 and lanes_of(3) == 1
    for batch, ranks, fit in ((64, 3, "1, 2, 4, 8"), (64, 16, "1, 2, 4, 8"), (15, 2, "1")):
        told = f"a batch of {batch} can be shared out among {fit} processes, got {ranks}: change --batch"
        with pytest.raises(InputError, match=told):
            lanes_of(batch, ranks)


def test_the_card_s_command_is_as_it_was_typed(tmp_path, monkeypatch):
    motion = write_amass(tmp_path / "My Walk_poses.npz", *a_clip(40))
    monkeypatch.chdir(tmp_path)
    words = ["--batch", "2", "--workers", "0", "--scene", "paper", "--people", "2", "--motion", str(motion)]
    assert not main(["pretrain", "run", *words, "--subjects", "My Walk"])
    config = json.loads((tmp_path / "run" / run_dir.CONFIG).read_text())
    typed = shlex.split(config["command"])
    assert typed[typed.index("--motion") + 1] == motion.name and typed[typed.index("--subjects") + 1] == "My Walk"


def test_a_run_s_rates_follow_its_schedule(monkeypatch, tmp_path):
    rates, step = [], loop._Run._step

    def told(self, arrays, k):
        terms = step(self, arrays, k)
        rates.append([group["lr"] for optimizer in self.optimizers for group in optimizer.param_groups])
        return terms

    monkeypatch.setattr(loop._Run, "_step", told)
    monkeypatch.setattr(Validation, "run", lambda *_: None)
    loop.train(RECIPE, tmp_path / "run")
    due = [rate_factor(k / 24, RECIPE) for k in range(24)]
    np.testing.assert_allclose(rates, np.outer(due, [RECIPE.rate, RECIPE.muon_rate]))


def test_the_best_validation_is_kept_across_a_resume(monkeypatch, tmp_path):
    errors = [50.0, 40.0, 60.0, 45.0]

    def run(self, network, people, device):
        self.last = errors.pop(0)
        return self.last

    monkeypatch.setattr(Validation, "run", run)
    folder = tmp_path / "run"

    def best():
        card = load_checkpoint(folder / run_dir.BEST)[1].card
        return card["validation_mm"], card["people_seen"]

    often = replace(RECIPE, validate=16)
    loop.train(often, folder)
    assert best() == (40.0, 32)
    loop.train(replace(often, people=often.people + 16), folder, resume=True)
    assert not errors and best() == (40.0, 32)


def test_another_seed_begins_with_other_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(Validation, "run", lambda *_: None)

    def begun(seed):
        recipe = replace(RECIPE, people=2, seed=seed, rate=0.0, muon_rate=0.0)
        return load_file(loop.train(recipe, tmp_path / str(seed)))

    a, b = begun(1), begun(2)
    assert max((a[name] - b[name]).abs().max() for name in a) > 0.01
