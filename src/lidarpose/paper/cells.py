"""Cells of the paper's tables: a row, that is a method, in a column, that is a dataset, and the steps that fill it.

With prepared real sets the commands follow the paper's protocol. Without, synthesized people stand in: pre-training
uses the scene `paper` (one simulated LiDAR), and the target is the scene `wild` with another seed and other sensors.
All methods are trained on the same people of it and scored on the same other people.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from lidarpose.data.dataset_card import CARD, read_card
from lidarpose.errors import InputError, check_name
from lidarpose.paper.steps import Step
from lidarpose.train.recipes import MODELS, SMALL_PAPER

# protocol of the paper's scores
PROTOCOL = "dapt"
# real sets that are columns of a table, and other data that a row may read
REAL = ("waymo", "humanm3", "lidarhuman26m", "sloper4d")
CORPORA = ("lipd", "freemotion", "noisemotion")
POSES = ("freemotion-poses", "lidarhuman26m-poses")
# the user's SMPL file, the body of people that are synthesized from those poses
SMPL = "smpl"
# the stand-in's people: maximum numbers for training and for scoring, and their seeds, which are used nowhere else
_TRAIN, _TEST = 10_000, 2_000
_SEEDS = {"train": 1_000_003, "test": 1_000_033}
# sensors of the stand-in's target, none of them used in pre-training
_SENSORS = "waymo-top,os1-128,hdl-64e,vlp-32c"
_CLIP = 16
# necks and heads that make the paper's network one without heatmaps
NO_HEATMAPS = {"prn", "coordinates"}


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of a run. people: budget of one training stage; hours: limit for all training of a row; size: of the
    paper's network, which also determines the baselines' widths, published or reduced; seeds; data: name -> folder, see
    `REAL`, `CORPORA`, `POSES` and `SMPL`; motion: files of captured motion; subjects of the first one for training, and
    held_out ones for the target; workers: of each command."""

    people: int = 200_000
    hours: float | None = None
    size: str = SMALL_PAPER
    seeds: int = 1
    data: dict[str, str] = field(default_factory=dict)
    motion: tuple[str, ...] = ()
    subjects: str = ""
    held_out: str = ""
    workers: int = 1

    def __post_init__(self):
        if self.people < 1 or self.seeds < 1 or self.workers < 1 or self.hours is not None and not self.hours > 0:
            raise InputError("expected --people, --seeds and --workers of at least 1 and --hours above 0")
        check_name("size of the paper's network", self.size, MODELS["dapt"])
        for name, folder in self.data.items():
            check_name("dataset", name, (*REAL, *CORPORA, *POSES, SMPL))
            if name not in (*POSES, SMPL):
                _check_prepared(name, folder)
        if (self.subjects or self.held_out) and not self.motion:
            raise InputError("--subjects and --held-out select captured motion: give its file by --motion")
        if self.data and not self.real:
            raise InputError(f"--data needs a dataset to score on, one of {', '.join(REAL)}")
        if SMPL in self.data and not set(POSES) & set(self.data):
            raise InputError(
                f"--data {SMPL}=FILE is the body of people with given poses: give {' or '.join(POSES)} too"
            )

    @property
    def real(self) -> tuple[str, ...]:
        """The real sets that are available."""
        return tuple(name for name in REAL if name in self.data)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A column: training and test data, each a step or a folder; learn, score: options of finetune and evaluate; clips:
    whether it has consecutive frames with rotations; thinned: options of finetune for networks of single frames."""

    name: str
    title: str
    train: Step | str
    test: Step | str
    learn: tuple[str, ...]
    score: tuple[str, ...]
    clips: bool
    thinned: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A row in a column. evaluation: its last step, None if it cannot be run; why: the reason; published: MPJPE mm in
    the paper."""

    row: str
    column: str
    seed: int
    evaluation: Step | None = None
    why: str = ""
    published: float | None = None
    target: Target

    @property
    def training(self) -> tuple[Step, ...]:
        """Its training steps, in order."""
        steps = self.evaluation.all() if self.evaluation else ()
        return tuple(step for step in steps if step.kind in ("pretrain", "finetune"))

    @property
    def size(self) -> str:
        """The named width of its network."""
        words = self.training[0].words
        return str(words[words.index("--size") + 1])


@dataclass(frozen=True)
class Table:
    """name; title; columns: its real sets; rows: (options) -> rows; reference: the row that the others are compared
    with; score: options of evaluate; single: the stand-in has no clips."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Callable[[Options], "Sequence[Row]"]
    reference: str
    score: tuple[str, ...] = ()
    single: bool = False


@dataclass(frozen=True, kw_only=True)
class Row:
    """A method. pretrain: options of its pre-training, None for none; finetune: its options besides --init; why: the
    reason why it cannot be run, "" if it can; clips: it needs clips; published: MPJPE mm by real set."""

    name: str
    finetune: tuple[str, ...]
    pretrain: tuple[str, ...] | None = None
    why: str = ""
    clips: bool = False
    published: dict[str, float] = field(default_factory=dict)

    @property
    def heatmaps(self) -> bool:
        """Whether it is the paper's network with its own head."""
        return "--recipe" in self.finetune and not NO_HEATMAPS & set(self.finetune)


def _check_prepared(name: str, folder: str) -> None:
    """Raises InputError unless the folder holds this dataset in prepared form."""
    if not (Path(folder) / CARD).is_file():
        raise InputError(f"{name}={folder} is not a prepared dataset: run lidarpose prepare first")
    content = read_card(folder).settings.get("dataset", "synthetic people")
    if content != name:
        raise InputError(f"--data {name}={folder}: expected {name} as prepared, got {content}: give its own folder")


def row_key(name: str) -> str:
    """A row's name as given to --rows; for a corpus synthesized from poses alone (with a dagger) it ends in -poses."""
    name = name.lower().replace("†", " poses")
    return "-".join("".join(c if c.isalnum() or c == "." else " " for c in name).split())


def cells(table: Table, options: Options, chosen: Sequence[str] = ()) -> list[Cell]:
    """The cells of a table in the chosen rows, by default in all. Raises InputError for an unknown row."""
    rows, chosen = table.rows(options), [row_key(name) for name in chosen]
    for key in chosen:
        check_name(f"row of {table.name}", key, [row_key(row.name) for row in rows])
    rows = [row for row in rows if not chosen or row_key(row.name) in chosen]
    targets = _targets(table, options)
    places = product(rows, targets, range(options.seeds))
    return [_cell(row, target, seed, table.score, options) for row, target, seed in places]


def _cell(row: Row, target: Target, seed: int, score: tuple[str, ...], options: Options) -> Cell:
    why = row.why or ("needs clips of consecutive frames with rotations" if row.clips and not target.clips else "")
    published = row.published.get(target.name)
    cell = Cell(row=row.name, column=target.name, seed=seed, target=target, why=why, published=published)
    if why:
        return cell
    stages = 1 + (row.pretrain is not None)
    hours = None if options.hours is None else options.hours / stages
    run_words = ("--seed", str(seed), "--workers", str(options.workers))
    init: tuple[Step | str, ...] = ("--init", "random")
    if row.pretrain is not None:
        pretraining = Step(("pretrain", *row.pretrain, "--people", str(options.people), *run_words), hours)
        init = ("--init", pretraining)
    learn = target.learn if row.clips else (*target.learn, *target.thinned)
    finetuning = Step(("finetune", target.train, *row.finetune, *init, *learn, *run_words), hours)
    # the released code decodes heatmaps in this way
    decoding = ("--decode", "dark") if options.real and row.heatmaps else ()
    words = ("evaluate", finetuning, target.test, *target.score, *decoding, *score)
    return replace(cell, evaluation=Step(words))


# ---- columns


def _targets(table: Table, options: Options) -> list[Target]:
    if options.real:
        targets = [_real(name, options.data[name]) for name in options.real if name in table.columns]
        if not targets:
            raise InputError(f"{table.name} is scored on {' or '.join(table.columns)}: give one by --data")
        return targets
    targets = [_stand_in("people", "synthesized people", options)]
    if not table.single and {"lidarhuman26m", "sloper4d"} <= set(table.columns):
        targets.append(_stand_in("clips", "synthesized clips", options))
    return targets


def _real(name: str, folder: str) -> Target:
    """Paper: implementation details. HumanM3 and LiDARHuman26M are thinned out to every fifth frame."""
    thinned = ("--interval", "5") if name in ("humanm3", "lidarhuman26m") else ()
    clips = name in ("lidarhuman26m", "sloper4d")
    score = ("--protocol", PROTOCOL)
    return Target(name=name, title=name, train=folder, test=folder, learn=(), thinned=thinned, score=score, clips=clips)


def _stand_in(name: str, title: str, options: Options) -> Target:
    clips = name == "clips"
    train_count = min(options.people, _TRAIN)
    counts = {"train": train_count, "test": min(max(train_count // 4, 1), _TEST)}
    poses: tuple[str, ...] = ()
    if options.motion:
        poses = ("--motion", options.motion[0], *(("--subjects", options.held_out) if options.held_out else ()))
    steps = {}
    for part, count in counts.items():
        number = -(-count // _CLIP) if clips else count
        words = ("synth", *(("--clips",) if clips else ()), "-n", str(number), "--scene", "wild")
        words += ("--sensor", _SENSORS, "--seed", str(_SEEDS[part]), "--workers", str(options.workers), *poses)
        steps[part] = Step(words)
    people = -(-train_count // _CLIP) * _CLIP if clips else train_count
    learn = ("--split", "all", "--mix", "0", "--epochs", f"{options.people / people:.6g}")
    return Target(name=name, title=title, train=steps["train"], test=steps["test"], learn=learn, score=(), clips=clips)
