"""`lidarpose synth` and torch datasets: same bytes and people for any number of workers and after interruptions."""

import glob
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from motion_files import a_clip, write_amass
from shard_files import write_shard
from torch.utils.data import DataLoader

from lidarpose.cli import main
from lidarpose.data.shards import open_dataset, read_rows
from lidarpose.errors import InputError
from lidarpose.lidar.presets import listing
from lidarpose.synth import shard_job, street
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.synth.shard_job import Maker, SynthesisJob, write_dataset
from lidarpose.synth.street import Street
from lidarpose.train.torch_dataset import SyntheticPeople

COUNT, PER_SHARD = 60, 10
WORDS = ["-n", str(COUNT), "--per-shard", str(PER_SHARD), "--sensor", "os1-64,vlp-16", "--seed", "5"]


def synth(out, *words):
    return main(["synth", "--out", str(out), *map(str, words)])


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def one_line(capsys):
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("lidarpose: error: "), captured.err
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth") / "people"
    assert synth(folder, *WORDS) == 0
    return folder


def test_dataset_contains_people_of_generator(dataset):
    scene = scene_config("wild")
    assert sorted(content(dataset)) == ["dataset.json", *(f"people-{k:05d}.parquet" for k in range(6))]
    rows = list(open_dataset(dataset).rows())
    assert [row["index"] for row in rows] == list(range(COUNT))
    assert {row["sensor"] for row in rows} == {"os1-64", "vlp-16"}
    made = SyntheticPeople(scene=replace(scene, sensors=("os1-64", "vlp-16")), seed=5, start=17, stop=18)
    np.testing.assert_array_equal(next(iter(made)).points, rows[17]["points"].reshape(-1, 3))


def command(out, *words):
    settings = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([sys.executable, "-m", "lidarpose", "synth", "--out", str(out), *WORDS, *words], **settings)


def shard_names(folder):
    try:
        return [name for name in os.listdir(folder) if name.startswith("people-")]
    except FileNotFoundError:
        # the command creates the folder and may remove it again while it checks its permissions
        return []


@pytest.mark.long
@pytest.mark.parametrize("workers", ["1", "2"])
def test_killed_synth_command_resumes(dataset, tmp_path, workers):
    out = tmp_path / "killed"
    child = command(out, "--workers", workers)
    # killed as soon as the first shard exists, before all are written
    until = time.monotonic() + 60
    while not shard_names(out) and child.poll() is None and time.monotonic() < until:
        time.sleep(0.002)
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    left = content(out)
    assert "dataset.json" in left and len([name for name in left if name.startswith("people")]) < 6
    # leftovers of a writer that was killed within a shard; no process has such a high id
    (out / ".99999999-3-people-00004.parquet").write_bytes(b"PAR1")
    (out / "people-00002.parquet").write_bytes(b"PAR1 half a shard")
    assert synth(out, *WORDS) == 0
    until = time.monotonic() + 10
    while content(out) != content(dataset) and time.monotonic() < until:
        # a worker of the killed process may still write a file
        time.sleep(0.2)
        assert synth(out, *WORDS) == 0
    assert content(out) == content(dataset)


@pytest.mark.long
def test_workers_write_same_bytes(dataset, tmp_path, capsys):
    assert synth(tmp_path / "two", *WORDS, "--workers", 2) == 0
    assert content(tmp_path / "two") == content(dataset)
    assert "60 people made -> " in capsys.readouterr().err
    assert synth(tmp_path / "two", *WORDS, "--workers", 2) == 0
    assert "0 people made, 60 existed already" in capsys.readouterr().err


@pytest.mark.long
def test_second_synth_command_is_refused_during_first(tmp_path, capsys):
    out = tmp_path / "out"
    first = command(out)
    until = time.monotonic() + 60
    # unlike Path.glob, glob.glob tolerates folders that come and go
    while not glob.glob(f"{out}/.*-people-*") and first.poll() is None and time.monotonic() < until:
        time.sleep(0.002)
    assert synth(out, *WORDS) == 2
    assert "another process writes this dataset: wait for its end" in one_line(capsys)
    assert "Traceback" not in first.communicate()[1] and first.returncode == 0
    # the lock is removed
    assert synth(out, *WORDS) == 0 and sorted(content(out))[0] == "dataset.json"


def test_incomplete_shard_is_written_again(dataset, tmp_path):
    out = tmp_path / "short"
    shutil.copytree(dataset, out)
    # a valid file that lacks one person
    write_shard(out / "people-00003.parquet", "people", list(read_rows(out / "people-00003.parquet", "people"))[:-1])
    assert content(out) != content(dataset)
    told = []
    assert write_dataset(job(), out, progress=lambda *done: told.append(done)) == PER_SHARD
    assert content(out) == content(dataset)
    assert told[0] == (COUNT - PER_SHARD, COUNT) and told[-1] == (COUNT, COUNT) and told == sorted(told)


def job(**settings):
    """The job of `WORDS`."""
    return SynthesisJob(
        what="people", count=COUNT, per_shard=PER_SHARD, sensors=("os1-64", "vlp-16"), seed=5, **settings
    )


def test_synth_refuses_other_settings_by_name(dataset, capsys):
    before = content(dataset)
    words = [*WORDS[:-2], "--seed", "6", "--hard", "0.5"]
    assert synth(dataset, *words) == 2
    line = one_line(capsys)
    assert "hard is 1.0, requested is 0.5; seed is 5, requested is 6" in line and "count" not in line
    assert content(dataset) == before


def test_clips_contain_frames(tmp_path):
    assert synth(tmp_path / "clips", "-n", 2, "--clips", "--sensor", "os1-64") == 0
    rows = list(open_dataset(tmp_path / "clips").rows())
    assert [(row["index"], row["frame"]) for row in rows] == [(clip, frame) for clip in (0, 1) for frame in range(16)]
    joints = np.array([row["joints"].reshape(-1, 3) for row in rows[:16]])
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    assert step.max() < 1.5


BAD = {
    "unreadable motion": (["-n", "5", "--motion", "../broken.npz"], "broken.npz"),
    "unreadable motion, workers": (["-n", "5", "--motion", "../broken.npz", "--workers", "2"], "broken.npz"),
    "short motion": (["-n", "2", "--clips", "--motion", "../short.npz"], "no clip lasts 1.6 s"),
    "nobody seen": (["-n", "3", "--sensor", "../near.json"], "sensors such as near"),
    "scene of streets": (["-n", "1", "--scenes", "--scene", "paper"], "their own scene"),
    "tempo": (["-n", "1", "--set", "tempo=0.5"], "tempo changes nothing without captured motion"),
    "tempo of single frames": (
        ["-n", "1", "--motion", "../short.npz", "--set", "tempo=0.5"],
        "of clips or accumulated frames: give --motion, and --clips or accumulated, too, or omit it",
    ),
    "tempo of no captured poses": (
        ["-n", "1", "--clips", "--motion", "../short.npz", "--captured", "0", "--set", "tempo=0.5"],
        "tempo changes nothing without captured motion",
    ),
    "clear limbs": (["-n", "1", "--set", "clear_limbs=1"], "clear_limbs changes nothing without captured poses"),
    "sigma": (
        ["-n", "1", "--scene", "reference", "--set", "sigma=0.5:1"],
        "sigma changes nothing without symmetric range noise: set dapt_compat=0",
    ),
    "double rate of clips": (
        ["-n", "1", "--clips", "--scene", "wide", "--set", "double_rate=0.5"],
        "double_rate changes nothing without merged clouds of people",
    ),
    "double rate": (["-n", "1", "--set", "double_rate=0.5"], "double_rate changes nothing without merged clouds"),
    "integration": (
        ["-n", "1", "--scene", "wide", "--sensor", "os1-64", "--set", "integration=1"],
        "integration changes nothing without rosettes: name one by --sensor, or omit it",
    ),
    "sparse": (["-n", "1", "--sensor", "os1-64", "--set", "sparse=1"], "sparse scans with sensors of its own: omit it"),
    "sensors twice": (["-n", "1", "--sensor", "os1-64", "--set", "sensors=vlp-16"], "expected --sensor or --set sens"),
    "difficulty twice": (["-n", "1", "--hard", "0.3", "--set", "hard=0.8"], "expected --hard or --set hard=..., got"),
    "clips": (
        ["-n", "1", "--clips", "--set", "merged=1,crowded=1"],
        "clips are scanned in one way only: omit merged, crowded",
    ),
    "none": (["-n", "0"], "the number of people must be a whole number of at least 1, got 0"),
    "negative": (["-n", "-3"], "got -3"),
    "sensor": (["-n", "5", "--sensor", "os1-129"], "did you mean os1-128"),
    "no sensor": (["-n", "5", "--sensor", ","], "expected the names of sensors"),
    "table": (["-n", "5", "--sensor", "none.json"], "none.json: no such file"),
    "scene": (["-n", "5", "--scene", "wilt"], "did you mean wild"),
    "hard": (["-n", "5", "--hard", "2"], "from 0 to 1"),
    "hard nan": (["-n", "5", "--hard", "nan"], "from 0 to 1"),
    "seed": (["-n", "5", "--seed", "-1"], "seed"),
    "workers": (["-n", "5", "--workers", "0"], "worker"),
    "motion": (["-n", "5", "--motion", "none.npz"], "none.npz"),
    "subjects": (["-n", "5", "--subjects", "a"], "--motion"),
    "no subject": (["-n", "5", "--motion", "none.npz", "--subjects", ","], "omit --subjects"),
    "both": (["-n", "5", "--clips", "--scenes"], "are different datasets"),
    "shard": (["-n", "5", "--per-shard", "0"], "--per-shard must be a whole number of at least 1, got 0"),
    "captured": (["-n", "5", "--captured", "0.3"], "--motion"),
    "share": (["-n", "5", "--motion", "none.npz", "--captured", "1.5"], "between 0 and 1, got 1.5"),
    "far too many": (["-n", "1000000000000"], "give a larger --per-shard"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("out", ["out", "."], ids=["new folder", "empty folder"])
def test_synth_rejects_invalid_options_and_writes_nothing(tmp_path, capsys, monkeypatch, case, out):
    words, message = BAD[case]
    (tmp_path / "broken.npz").write_bytes(b"PK no motion")
    (tmp_path / "near.json").write_text('{"elevations_deg": [-2, -1, 0], "range_max": 1.2}')
    write_amass(tmp_path / "short.npz", *a_clip(frames=16), fps=10.0)
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    try:
        code = synth(out, *words)
    except SystemExit as exit:
        code = exit.code
    assert code == 2 and message in one_line(capsys)
    assert not list(here.iterdir())


def test_synth_rejects_unusable_folders(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    for out, message in ((file, "is a file"), (file / "deep", "is a file"), (tmp_path, "holds other files")):
        assert synth(out, "-n", 5) == 2
        assert message in one_line(capsys)
    assert synth("/proc/nothing", "-n", 5) == 2
    assert "cannot write" in one_line(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and file.read_text() == "mine"


def test_synth_locks_folder_before_it_prepares(tmp_path, monkeypatch):
    job, out = SynthesisJob(what="people", count=1), tmp_path / "new" / "people"

    def generator(self):
        with pytest.raises(InputError, match="another process writes this dataset"):
            write_dataset(replace(job, seed=2), out)
        raise InputError("no clip")

    monkeypatch.setattr(SynthesisJob, "generator", generator)
    with pytest.raises(InputError, match="no clip"):
        write_dataset(job, out)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_full_disk_error_leaves_no_partial_shard(tmp_path):
    resource = pytest.importorskip("resource")
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (20000, {resource.RLIM_INFINITY}))"
    code = f"{limit}; from lidarpose.cli import main; raise SystemExit(main())"
    words = ["synth", "--quiet", "--out", str(tmp_path / "full"), *WORDS[:2], "--per-shard", str(COUNT)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("lidarpose: error: ") and done.stderr.count("\n") == 1, done.stderr
    assert "people-00000.parquet" in done.stderr
    # no folder either, since nothing was written
    assert not (tmp_path / "full").exists()


def test_sensor_file_is_compared_by_content(tmp_path, capsys):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "mine.json").write_text("[-10, -5, 0, 5, 10]")
    words = ["-n", 3, "--sensor"]
    assert synth(tmp_path / "d", *words, tmp_path / "a" / "mine.json") == 0
    assert str(tmp_path) not in (tmp_path / "d" / "dataset.json").read_text()
    # a moved file is the same sensor, a changed file another one
    assert synth(tmp_path / "d", *words, tmp_path / "b" / "mine.json") == 0
    capsys.readouterr()
    (tmp_path / "b" / "mine.json").write_text("[-10, -5, 0, 5, 11]")
    assert synth(tmp_path / "d", *words, tmp_path / "b" / "mine.json") == 2
    assert "tables" in one_line(capsys)
    # the same if the sensor is set as a field of the scene
    file = tmp_path / "a" / "mine.json"
    assert synth(tmp_path / "s", "-n", 3, "--set", f"sensors={file}") == 0
    settings = open_dataset(tmp_path / "s").card.settings
    assert settings["sensors"] == ["mine.json"] and "set" not in settings
    assert str(tmp_path) not in (tmp_path / "s" / "dataset.json").read_text()
    capsys.readouterr()
    file.write_text("[-10, -5, 0, 5, 11]")
    assert synth(tmp_path / "s", "-n", 3, "--set", f"sensors={file}") == 2
    assert "tables" in one_line(capsys)


def test_streets_contain_all_people_of_frames(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shard_job, "STREET_FRAMES", 2)
    assert synth(tmp_path / "s", "-n", 1, "--scenes", "--sensor", "vlp-16") == 0
    assert "1 street made -> " in capsys.readouterr().err
    data = open_dataset(tmp_path / "s")
    assert "scene" not in data.card.settings
    frames = list(data.rows("frames"))
    assert [frame["frame"] for frame in frames] == [0, 1] and frames[0]["sensor"] == "vlp-16"
    assert len(frames[0]["points"]) == 3 * len(frames[0]["person"]) > 10_000
    people = list(data.rows())
    assert people and {row["frame"] for row in people} <= {0, 1}
    for row, sample in zip(people, data, strict=True):
        frame = frames[row["frame"]]
        assert sample.box.id == row["track"] and sample.box.id in frame["track"]
        joints = frame["joints"].reshape(len(frame["track"]), -1, 3)[sample.box.id]
        np.testing.assert_array_equal(joints, sample.pose.joints)
        # the labeled box, unlike the sample's box with errors of a detector, contains the whole person
        center, size = np.split(frame["box"].reshape(-1, 7)[sample.box.id][:6], 2)
        assert np.linalg.norm(center - sample.box.center) < 0.5 and (size > 0.2).all()
        own = frame["points"].reshape(-1, 3)[frame["person"] == sample.box.id]
        assert np.linalg.norm(own.mean(0) - center) < 0.6


def test_sensors_command_lists_sensors(capsys):
    assert main(["sensors"]) == 0
    assert capsys.readouterr().out.splitlines() == listing()


@pytest.mark.long
def test_synth_does_not_import_torch(tmp_path):
    code = "import sys; from lidarpose.cli import main; main(); raise SystemExit('torch' in sys.modules)"
    words = ["synth", "--out", str(tmp_path / "a"), "-n", "2"]
    assert subprocess.run([sys.executable, "-c", code, *words], capture_output=True).returncode == 0


# ---- torch datasets

SCENE = scene_config("wild").eased(0.5)


def clouds(data, **settings):
    return [sample.points for batch in DataLoader(data, collate_fn=list, **settings) for sample in batch]


@pytest.mark.long
@pytest.mark.parametrize("workers", [2, 3])
@pytest.mark.parametrize("batch", [1, 4])
def test_people_are_the_same_for_any_number_of_workers(workers, batch):
    data = SyntheticPeople(scene=SCENE, seed=2, start=60, stop=70, batch=batch)
    alone = [sample.points for sample in data]
    assert len(alone) == 10
    found = clouds(data, batch_size=batch, num_workers=workers)
    assert len(found) == 10
    for a, b in zip(found, alone, strict=True):
        np.testing.assert_array_equal(a, b)


def test_synthetic_people_are_endless_and_check_settings():
    people = iter(SyntheticPeople(scene=SCENE, seed=2))
    assert len([next(people) for _ in range(3)]) == 3
    for wrong in ({"seed": -1}, {"start": 5, "stop": 2}, {"batch": 0}, {"hard": 3.0}, {"captured": 0.5}):
        with pytest.raises(InputError):
            SyntheticPeople(**{"scene": SCENE, "seed": 0} | wrong)


def test_hard_sets_difficulty_of_people(tmp_path):
    scene = replace(scene_config("wild"), sensors=("os1-64",))
    (sample,) = SyntheticPeople(scene=scene, seed=2, start=1, stop=2, hard=0.0)
    wanted = Generator(scene=scene, measure=False).person(2, 1, hard=0.0).sample
    np.testing.assert_array_equal(sample.points, wanted.points)
    write_dataset(SynthesisJob(what="people", count=3, hard=0.0, seed=2, sensors=("os1-64",)), tmp_path / "d")
    np.testing.assert_array_equal(list(open_dataset(tmp_path / "d"))[1].points, wanted.points)


def test_streets_alternate_between_sensors(monkeypatch, tmp_path):
    asked, box_draws = [], set()

    def made(seed, index, *, sensor, frames):
        asked.append((index, sensor))
        return Street(frames=(), sensor=sensor, height=1.7)

    monkeypatch.setattr(street, "street", made)
    monkeypatch.setattr(street, "samples", lambda scene, rng: box_draws.add(rng.random()) or [])
    job = SynthesisJob(what="streets", count=5, sensors=("os1-64", "vlp-16"))
    maker = Maker(job=job, card=job.card(), folder=tmp_path, generator=job.generator())
    for index in range(5):
        maker._street_rows(index)
    assert asked == [(k, ("os1-64", "vlp-16")[k % 2]) for k in range(5)]
    # each street has its own errors of boxes
    assert len(box_draws) == 5


def test_job_passes_scene_and_captured_share_to_generator(tmp_path):
    rotations, way = a_clip(40)
    path = write_amass(tmp_path / "walk_01.npz", rotations, way, fps=10.0)
    for settings, share in ((dict(), 0.0), (dict(motion=str(path)), 0.5), (dict(motion=str(path), captured=0.2), 0.2)):
        job = SynthesisJob(what="people", count=1, scene="paper", **settings)
        generator = job.generator()
        assert generator.scene == scene_config("paper") and generator.captured == share
        assert (generator.bank is None) == (not settings)


def test_sensors_are_named_by_option_or_as_field_of_scene():
    by_option, by_field = (
        SynthesisJob(what="people", count=1, scene="wide", **settings)
        for settings in (dict(sensors=("os1-64",)), dict(set=("sensors=os1-64",)))
    )
    assert by_option.card() == by_field.card() and by_option.generator() == by_field.generator()
