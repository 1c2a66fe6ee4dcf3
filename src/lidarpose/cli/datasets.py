"""`lidarpose demo`, `synth`, `prepare`, `sensors` and `view`."""

import argparse

from lidarpose.cli.terminal import KEEP, add_command, names, scene_changes, tell
from lidarpose.errors import InputError
from lidarpose.models import DEFAULT, NAMES
from lidarpose.progress import Progress

_WORKERS = "--workers N = 1  number of processes, at most one per shard (default 1)"
_DEMO = f"""
show people as three LiDARs see them, with true and predicted poses
Synthesizes people, predicts their poses and writes an interactive 3D report.
$ lidarpose demo --out demo
--out DIR = lidarpose-demo  folder (default lidarpose-demo)
--seed N = 7  random seed (default 7)
--weights NAME|FILE = {DEFAULT}  {NAMES}, or a checkpoint
"""
_SYNTH = f"""
write synthesized people as Parquet shards
Writes DIR/dataset.json and Parquet shards of people with their true poses. After an interruption the same command
 continues; the same settings give the same bytes.
$ lidarpose synth --out people -n 20000 --workers 4
$ lidarpose synth --out streets -n 20 --scenes --sensor os1-128
--out DIR = REQUIRED  a new folder, or the one of an interrupted run
-n,--count N = REQUIRED  number of people, clips or streets
[scene]
--scene NAME = wild  wild (default), wide, paper or reference
--sensor A,B  names of sensors or sensor files (default: the scene's); see lidarpose sensors
--seed N = 0  random seed (default 0)
--hard H = 1  difficulty from 0 (easy) to 1 (default)
{KEEP}
--set:set_set A=X,B=Y  overrides of the scene's fields (docs/synthesis.md); recorded=1 keeps the positions of --motion
--clips  write clips of 16 frames at 10 Hz instead of single people
--scenes  write whole streets with several walking people
[poses and bodies]
--motion FILE  take poses from captured motion: a file or a folder
--subjects A,B  subjects to use: the first part of a clip's name
--captured SHARE  share of poses taken from the clips (default 0.5)
--body FILE  your SMPL, SMPL+H or SMPL-X file instead of the shipped body, with the shapes of --motion where it has any
[work]
{_WORKERS}
--per-shard N  people (2000), clips (125) or streets (2) per file
"""
_PREPARE = f"""
write a real dataset's people as Parquet shards
Reads the raw files of a public dataset and writes DIR/dataset.json and Parquet shards. After an interruption the same
 command continues.
$ lidarpose prepare waymo RAW waymo
$ lidarpose prepare sloper4d RAW sloper4d --smpl SMPL_NEUTRAL.pkl
<dataset> NAME  humanm3, lidarhuman26m, sloper4d, waymo, itop, lipd, freemotion or noisemotion
<root> RAW  folder of the dataset's raw files
<out> DIR  a new folder, or the one of an interrupted run
--split NAME  write one split only: train, val or test
--split-by NAME  a published split (default: RAW/train.txt, val.txt and test.txt if present, else the most used one)
--smpl FILE|DIR  your SMPL model, for lidarhuman26m, sloper4d, freemotion, noisemotion
--no-level  lidarhuman26m: keep the release's frame, as the LiDAR was mounted
{_WORKERS}
"""
_VIEW = """
draw people of a dataset
Draws a contact sheet of a dataset that synth or prepare wrote; streets from above. A file of the same name is replaced.
$ lidarpose view people
$ lidarpose view people --html --out people.html
<folder> DIR  a dataset's folder
-n,--count N = 24  number of people, or at most 12 streets, evenly spaced (default 24)
--html  write an interactive 3D page instead of a picture
--out FILE  default DIR.png or DIR.html, in the current folder
"""


def add(commands) -> None:
    """Adds the commands to the parser's."""
    add_command(commands, "demo", _demo, _DEMO)
    add_command(commands, "synth", _synth, _SYNTH)
    add_command(commands, "prepare", _prepare, _PREPARE)
    add_command(commands, "sensors", _sensors, "list the simulated sensors\n$ lidarpose sensors")
    add_command(commands, "view", _view, _VIEW)


def _demo(options: argparse.Namespace) -> None:
    from lidarpose.cli.demo import run

    run(options.out, seed=options.seed, weights=options.weights)


def _synth(options: argparse.Namespace) -> None:
    from lidarpose.data.dataset_card import content_count
    from lidarpose.synth.shard_job import SynthesisJob, write_dataset

    if options.clips and options.scenes:
        raise InputError("--clips and --scenes are different datasets: give one of them")
    fields = ("count", "scene", "seed", "hard", "motion", "captured", "body", "per_shard")
    job = SynthesisJob(
        what="clips" if options.clips else "streets" if options.scenes else "people",
        sensors=None if options.sensor is None else names(options.sensor),
        subjects=None if options.subjects is None else names(options.subjects),
        set=scene_changes(options) or (),
        **{name: getattr(options, name) for name in fields},
    )
    with Progress(job.count, unit=job.what) as bar:
        num_written = write_dataset(
            job, options.out, workers=options.workers, progress=lambda count, _: bar.update(count)
        )
    note = "" if num_written == job.count else f", {job.count - num_written:,} existed already"
    tell(f"{content_count(num_written, job.what)} made{note} -> {options.out}")


def _prepare(options: argparse.Namespace) -> None:
    from lidarpose.data.prepare import prepare, summary_lines

    paths = options.dataset, options.root, options.out
    choices = {name: getattr(options, name) for name in ("split", "split_by", "smpl", "workers")}
    summary = prepare(*paths, level=not options.no_level, **choices)
    for line in summary_lines(summary):
        tell(line)


def _sensors(options: argparse.Namespace) -> None:
    from lidarpose.lidar.presets import listing

    print("\n".join(listing()))


def _view(options: argparse.Namespace) -> None:
    from lidarpose.viz.contact_sheet import draw_dataset

    print(draw_dataset(options.folder, count=options.count, html=options.html, out=options.out))
