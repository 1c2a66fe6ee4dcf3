"""`lidarpose demo`, `synth`, `prepare`, `sensors` and `view`."""

import argparse

from lidarpose.cli.terminal import KEEP, add_command, add_options, names, scene_changes, tell
from lidarpose.models import DEFAULT, NAMES
from lidarpose.progress import Progress

_WORKERS = "--workers N = 1  number of processes, at most one a shard (default 1)"
_DEMO = f"""
--out DIR = lidarpose-demo  folder (default lidarpose-demo)
--seed N = 7  random seed (default 7)
--weights NAME|FILE = {DEFAULT}  {NAMES}, or a checkpoint
"""
_SCENE = f"""
--scene NAME = wild  wild (default), wide, paper or reference
--sensor A,B  names of sensors or sensor files (default: the scene's); see lidarpose sensors
--seed N = 0  random seed (default 0)
--hard H = 1  difficulty from 0 (easy) to 1 (default)
{KEEP}
"""
_SEVERAL = """
--clips  write clips of 16 frames at 10 Hz instead of single people
--scenes  write whole streets with several walking people
"""
_MOTION = """
--motion FILE  take poses from captured motion: a file or a folder
--subjects A,B  subjects to use: the first part of a clip's name
--captured SHARE  share of poses taken from the clips (default 0.5)
--body FILE  your SMPL, SMPL+H or SMPL-X file instead of the shipped body, with the shapes of --motion where it has any
"""
_WORK = f"""
{_WORKERS}
--per-shard N  people (2000), clips (125) or streets (2) per file
"""
_PREPARE = f"""
--split NAME  write only the people of train, val or test
--split-by NAME  a published split (default: RAW/train.txt, val.txt and test.txt if present, else the usual one)
--smpl FILE|DIR  your SMPL model, for lidarhuman26m, sloper4d, freemotion, noisemotion
--no-level  lidarhuman26m: keep the release's frame, as the LiDAR was mounted
{_WORKERS}
"""
_VIEW = """
-n,--count N = 24  people, or at most 12 streets, evenly spread (default 24)
--html  write an interactive 3D page instead of a picture
--out FILE  default DIR.png or DIR.html, in the current folder
"""


def add(commands) -> None:
    """Adds the commands to the parser's."""
    _add_demo(commands)
    _add_synth(commands)
    _add_prepare(commands)
    sensors = add_command(commands, "sensors", "list the simulated sensors", "lidarpose sensors")
    sensors.set_defaults(run=_sensors)
    _add_view(commands)


def _add_demo(commands) -> None:
    demo = add_command(
        commands,
        "demo",
        "show people seen by three LiDARs, true and predicted",
        "lidarpose demo --out demo",
        description="Synthesizes people, predicts their poses and writes an interactive 3D report.",
    )
    demo.set_defaults(run=_demo)
    add_options(demo, _DEMO)


def _add_synth(commands) -> None:
    synth = add_command(
        commands,
        "synth",
        "write synthesized people as Parquet shards",
        "lidarpose synth --out people -n 20000 --workers 4",
        "lidarpose synth --out streets -n 20 --scenes --sensor os1-128",
        description="Writes DIR/dataset.json and Parquet shards of people with their true poses. After an interruption "
        "the same command continues; the same settings give the same bytes.",
    )
    synth.set_defaults(run=_synth)
    synth.add_argument("--out", required=True, metavar="DIR", help="a new folder, or the one of an interrupted run")
    synth.add_argument("-n", "--count", type=int, required=True, metavar="N", help="number of people, clips or streets")
    scene = synth.add_argument_group("scene")
    add_options(scene, _SCENE)
    words = "changes of the scene: its numbers (docs/synthesis.md), recorded=1 keeps the places of --motion"
    scene.add_argument("--set", dest="set_set", metavar="A=X,B=Y", help=words)
    add_options(scene.add_mutually_exclusive_group(), _SEVERAL)
    add_options(synth.add_argument_group("poses and bodies"), _MOTION)
    add_options(synth.add_argument_group("work"), _WORK)


def _add_prepare(commands) -> None:
    prepare = add_command(
        commands,
        "prepare",
        "write a real dataset's people as Parquet shards",
        "lidarpose prepare waymo RAW waymo",
        "lidarpose prepare sloper4d RAW sloper4d --smpl SMPL_NEUTRAL.pkl",
        description="Reads the raw files of a public dataset and writes OUT/dataset.json and Parquet shards. After an "
        "interruption the same command continues.",
    )
    prepare.set_defaults(run=_prepare)
    known = "humanm3, lidarhuman26m, sloper4d, waymo, itop, lipd, freemotion or noisemotion"
    prepare.add_argument("dataset", metavar="NAME", help=known)
    prepare.add_argument("root", metavar="RAW", help="folder of the dataset's raw files")
    prepare.add_argument("out", metavar="OUT", help="a new folder, or the one of an interrupted run")
    add_options(prepare, _PREPARE)


def _add_view(commands) -> None:
    view = add_command(
        commands,
        "view",
        "draw people of a dataset",
        "lidarpose view people",
        "lidarpose view people --html --out people.html",
        description="Draws a contact sheet of a dataset that synth or prepare wrote; streets from above. A file of the "
        "same name is replaced.",
    )
    view.set_defaults(run=_view)
    view.add_argument("folder", metavar="DIR", help="a dataset's folder")
    add_options(view, _VIEW)


def _demo(options: argparse.Namespace) -> None:
    from lidarpose.cli.demo import run

    run(options.out, seed=options.seed, weights=options.weights)


def _synth(options: argparse.Namespace) -> None:
    from lidarpose.data.shards import counted
    from lidarpose.synth.shard_job import Job, write_dataset

    fields = ("count", "scene", "seed", "hard", "motion", "captured", "body", "per_shard")
    job = Job(
        what="clips" if options.clips else "streets" if options.scenes else "people",
        sensors=None if options.sensor is None else names(options.sensor),
        subjects=None if options.subjects is None else names(options.subjects),
        set=scene_changes(options) or (),
        **{name: getattr(options, name) for name in fields},
    )
    with Progress(job.count, unit=job.what) as bar:
        made = write_dataset(job, options.out, workers=options.workers, progress=lambda done, _: bar.update(done))
    there = "" if made == job.count else f", {job.count - made:,} were there"
    tell(f"{counted(made, job.what)} made{there} -> {options.out}")


def _prepare(options: argparse.Namespace) -> None:
    from lidarpose.data.prepare import prepare, summary_lines

    where = options.dataset, options.root, options.out
    choices = {name: getattr(options, name) for name in ("split", "split_by", "smpl", "workers")}
    summary = prepare(*where, level=not options.no_level, **choices)
    for line in summary_lines(summary):
        tell(line)


def _sensors(options: argparse.Namespace) -> None:
    from lidarpose.lidar.presets import listing

    print("\n".join(listing()))


def _view(options: argparse.Namespace) -> None:
    from lidarpose.viz.contact_sheet import draw_dataset

    print(draw_dataset(options.folder, count=options.count, html=options.html, out=options.out))
