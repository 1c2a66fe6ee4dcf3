"""The paper's tables 1 to 4 and figures 5, 7, 8 as data: rows, columns, and for each cell the steps that fill it.

With prepared real sets the commands follow the paper's protocol. Without, synthesized people stand in: pre-training
uses the scene `paper` (one simulated LiDAR), and the target is the scene `wild` with another seed and other sensors.
All methods are trained on the same people of it and scored on the same other people.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from lidarpose.data.dataset_card import CARD, read_card
from lidarpose.data.readers.lidarhuman26m import POSE_FOLDER
from lidarpose.data.splits import split_rule
from lidarpose.errors import InputError, check_name
from lidarpose.paper.steps import Step
from lidarpose.train.recipes import MODELS, PAPER, SMALL_PAPER, TINY_PAPER

# protocol of the paper's scores
PROTOCOL = "dapt"
# real sets that are columns of a table, and other data that a row may read
REAL = ("waymo", "humanm3", "lidarhuman26m", "sloper4d")
CORPORA = ("lipd", "freemotion", "noisemotion")
POSES = ("freemotion-poses", "lidarhuman26m-poses")
# the option for the poses of the paper's pre-training
_POSES_OF_PAPER = "lidarhuman26m-poses=DIR"
# the user's SMPL file, the body of people that are synthesized from those poses
SMPL = "smpl"
# on real sets all methods are trained on the crops, and about the centers, that the protocol scores with
_RELEASED, _RELEASED_CLIPS = ("--augment", "paper"), ("--options", "trans_center=true")
# the stand-in has few clips, so they are rotated, as the people of other rows are there
_TURNED = ("--augment", "turn")
# the stand-in's people: maximum numbers for training and for scoring, and their seeds, which are used nowhere else
_TRAIN, _TEST = 10_000, 2_000
_SEEDS = {"train": 1_000_003, "test": 1_000_033}
# sensors of the stand-in's target, none of them used in pre-training
_SENSORS = "waymo-top,os1-128,hdl-64e,vlp-32c"
_CLIP = 16
# the published rates and schedules are meant for the full sizes and for many more steps
_FASTER = ("--rate", "2e-3")
_ONE_CYCLE = (*_FASTER, "--schedule", "cosine", "--warmup", "0.04")
# an Adam step moves a weight by about the learning rate, and logits of narrow heatmaps are large (docs/log.md)
_HEATMAP_RATE = ("--heatmap-rate", "10")
# necks and heads that make the paper's network one without heatmaps
_NO_HEATMAPS = {"prn", "coordinates"}
_KEPT = ("0.5", "0.6", "0.7", "0.8", "0.9")
# r_keep of the recipe, for which no option is given
_RECIPE_KEEP = "0.6"


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
        return "--recipe" in self.finetune and not _NO_HEATMAPS & set(self.finetune)


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
    rows = table.rows(options)
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


# ---- rows


def _paper(options: Options, *words: str) -> tuple[str, ...]:
    """Options of a training of the paper's network. On synthesized people, fine-tuning centers on the points, as all
    methods do there; the paper's own fine-tuning centers on labels."""
    return ("--recipe", "paper", *(() if options.size == PAPER else _FASTER), *words)


def _pretrained(
    options: Options, *words: str, motion: tuple[str, ...] | None = None, changes: tuple[str, ...] = ()
) -> tuple[str, ...]:
    """Options of the paper's pre-training; changes: fields of its scene."""
    poses = _motion(options) if motion is None else motion
    return _paper(options, "--size", options.size, *poses, *words, *_scene(options, *changes))


def _scene(options: Options, *changes: str) -> tuple[str, ...]:
    """Changes of the scene `paper`. For real sets it is the paper's exactly: bodies without clothes, and the window of
    Eq. 3 over body and ground."""
    exact = ("ground_window=1", "clothes=0") if options.real else ()
    return ("--set", ",".join((*exact, *changes))) if (*exact, *changes) else ()


def _motion(options: Options) -> tuple[str, ...]:
    """Options for the poses of pre-training: LiDARHuman26M's if available, else those of the first motion file."""
    if "lidarhuman26m-poses" in options.data:
        return _corpus(options, "lidarhuman26m-poses")
    return _captured(options.motion[0], options.subjects) if options.motion else ()


def _corpus(options: Options, name: str) -> tuple[str, ...]:
    """Options for the poses of one corpus alone, on the user's SMPL body if available."""
    source = options.data.get(name, "")
    subjects = _learned(source) if source and name == "lidarhuman26m-poses" else ""
    body = ("--body", options.data[SMPL]) if SMPL in options.data else ()
    return (*_captured(source, subjects), *body)


def target_text(table: Table, options: Options) -> str:
    """What a table is scored on and, for real sets, the poses of pre-training where they are not the paper's."""
    if not options.real:
        return "stand-in: synthesized people"
    protocol = "real sets, the paper's protocol"
    if "lidarhuman26m-poses" in options.data or table.rows is _corpora:
        return protocol
    source = Path(options.motion[0]).name if options.motion else "the procedural prior"
    return f"{protocol}; poses of pre-training: {source}, not LiDARHuman26M as in the paper (--data {_POSES_OF_PAPER})"


def _captured(source: str, subjects: str) -> tuple[str, ...]:
    """Options for captured motion alone, of the given subjects; "" for all."""
    return ("--motion", source, *(("--subjects", subjects) if subjects else ()), "--captured", "1")


def _learned(raw: str) -> str:
    """The training sequences in LiDARHuman26M's raw folder, as subjects. Raises InputError if there is none."""
    sequences = sorted(path.name for path in (Path(raw) / POSE_FOLDER).glob("*") if path.is_dir())
    rule = split_rule("lidarhuman26m", Path(raw))
    subjects = [f"{POSE_FOLDER}/{name}" for name in sequences if rule and rule.of_part(name) == "train"]
    if not subjects:
        expected = f"the root of the raw dataset, with its training sequences in {POSE_FOLDER}"
        raise InputError(f"--data lidarhuman26m-poses={raw}: expected {expected}, got {', '.join(sequences) or 'none'}")
    return ",".join(subjects)


def _tuned(options: Options, *words: str) -> tuple[str, ...]:
    """Options of the paper's fine-tuning, with heatmaps unless `words` names a neck or head without them."""
    heatmap_rate = () if options.size == PAPER or _NO_HEATMAPS & set(words) else _HEATMAP_RATE
    return _paper(options, *heatmap_rate, *(() if options.real else ("--augment", "default")), *words)


def _random(options: Options, *words: str) -> tuple[str, ...]:
    return _tuned(options, "--size", options.size, *words)


def _published(*values: float | None) -> dict[str, float]:
    return {name: value for name, value in zip(REAL, values, strict=False) if value is not None}


def _methods(options: Options) -> list[Row]:
    """Table 1."""
    prn, size = ("--neck", "prn"), "tiny" if options.size == TINY_PAPER else "small"
    released_options = _RELEASED if options.real else ()
    # the other recipes neither mix in synthesized people nor hold people out
    equal_people = ("--mix", "0", "--hold-out", "0") if options.real else ()
    lpformer = _baseline(options, "lpformer", *released_options)
    return [
        _of_clips(options, "LiDARCap", 79.31, 101.89),
        _of_clips(options, "NE", 72.23, 96.80),
        Row(name="LPFormer", finetune=lpformer, published=_published(61.60, 83.69, 95.72, 49.31)),
        Row(name="PRN as published", finetune=_baseline(options, "prn", *released_options)),
        Row(name="PRN", finetune=_random(options, *prn), published=_published(68.48, 70.56, 80.01, 48.76)),
        _dapt(options, _published(51.59, 59.76, 73.47, 28.01)),
        Row(
            name="ours",
            finetune=(*released_options, *equal_people),
            pretrain=("--size", size, "--scene", "paper", *_motion(options), *_scene(options)),
        ),
    ]


def _baseline(options: Options, model: str, *words: str) -> tuple[str, ...]:
    """Options of a baseline's training, at the width that matches the size of the paper's network. Reduced sizes use
    the same learning-rate cycle as the paper's network."""
    cycle = () if options.size == PAPER else _ONE_CYCLE
    return ("--model", model, "--size", model + options.size.removeprefix(PAPER), *cycle, *words)


def _of_clips(options: Options, name: str, *published: float) -> Row:
    mpjpe_by_dataset = _published(None, None, *published)
    clip_options = _RELEASED_CLIPS if options.real else _TURNED
    return Row(
        name=name, finetune=_baseline(options, name.lower(), *clip_options), clips=True, published=mpjpe_by_dataset
    )


def _dapt(options: Options, published: dict[str, float], name: str = "DAPT") -> Row:
    return Row(name=name, finetune=_tuned(options), pretrain=_pretrained(options), published=published)


def _corpora(options: Options) -> list[Row]:
    """Table 2. The stand-in has no corpora: it uses poses of each motion file, and of the procedural prior."""
    finetune = _tuned(options)
    rows = [Row(name="w/o", finetune=_random(options), published=_published(59.2, None, 76.5))]
    if not options.real:
        rows.append(Row(name="procedural prior", finetune=finetune, pretrain=_pretrained(options, motion=())))
        for k, source in enumerate(options.motion):
            pretrain = _pretrained(options, motion=_captured(source, options.subjects if k == 0 else ""))
            rows.append(Row(name=f"poses of {Path(source).stem}", finetune=finetune, pretrain=pretrain))
        return rows
    for name, title, *mpjpe in (
        ("lipd", "LIPD", 58.7, None, 75.6),
        ("freemotion", "FreeMotion", 57.9, None, 74.3),
        ("noisemotion", "NoiseMotion", 59.0, None, 76.3),
        ("freemotion-poses", "FreeMotion†", 54.6, None, 73.2),
        ("lidarhuman26m-poses", "LiDARH26M†", 51.6, None, 73.4),
    ):
        folder, has_points = options.data.get(name, ""), name in CORPORA
        pose_options = ("--shards", folder) if has_points else _corpus(options, name)
        pretrain = _pretrained(options, motion=pose_options)
        requirement = (
            "as prepared, with --split train if it has a split" if has_points else "the raw files of its poses"
        )
        why = "" if folder else f"needs --data {name}=DIR, {requirement}"
        rows.append(Row(name=title, finetune=finetune, pretrain=pretrain, why=why, published=_published(*mpjpe)))
    return rows


def _components(options: Options) -> list[Row]:
    """Table 3."""
    pretrain, pretrain_finest = _pretrained(options), _pretrained(options, "--neck", "finest")
    finetune, finetune_coordinates = _tuned(options), _tuned(options, "--head", "coordinates")
    return [
        Row(name="PRN baseline", finetune=_random(options, "--neck", "prn"), published={"waymo": 68.5}),
        Row(name="anchors", finetune=finetune_coordinates, pretrain=pretrain_finest, published={"waymo": 54.3}),
        Row(name="anchors + MDE", finetune=finetune_coordinates, pretrain=pretrain, published={"waymo": 52.3}),
        Row(name="anchors + heatmaps", finetune=finetune, pretrain=pretrain_finest, published={"waymo": 53.8}),
        _dapt(options, {"waymo": 51.7}, "anchors + MDE + heatmaps"),
    ]


def _augmentations(options: Options) -> list[Row]:
    """Table 4a, and Table 4b, where r_keep 0.6 equals the last row of 4a."""
    finetune, motion = _tuned(options), _motion(options)
    pretrain_recorded = _pretrained(options, changes=("recorded=1", "keep=1"))
    pretrain_sampled = _pretrained(options, "--keep", "1")
    source = f"--data {_POSES_OF_PAPER}" if options.real else "--motion FILE"
    why = "" if motion else f"recorded positions need captured motion: give {source}"
    rows = [
        Row(name="scratch", finetune=_random(options), published={"waymo": 59.2}),
        Row(name="+ pre-training", finetune=finetune, pretrain=pretrain_recorded, why=why, published={"waymo": 52.9}),
        Row(name="+ scene sampling", finetune=finetune, pretrain=pretrain_sampled, published={"waymo": 52.4}),
        _dapt(options, {"waymo": 51.7}, "+ laser masking"),
    ]
    for keep, mpjpe in zip(_KEPT, (53.0, 51.7, 51.9, 52.5, 52.4), strict=True):
        keep_options = () if keep == _RECIPE_KEEP else ("--keep", keep)
        pretrain = _pretrained(options, *keep_options)
        rows.append(Row(name=f"r_keep {keep}", finetune=finetune, pretrain=pretrain, published={"waymo": mpjpe}))
    return rows


def _compared(options: Options) -> list[Row]:
    """Figures 7 and 8: the methods, and the paper's network with parts removed."""
    rows = {row.name: row for row in (*_components(options), *_augmentations(options), *_methods(options))}
    names = {"PRN": "PRN", "LPFormer": "LPFormer", "DAPT": "DAPT", "anchors + heatmaps": "DAPT without MDE"}
    names |= {"scratch": "DAPT without pre-training", "ours": "ours"}
    return [replace(rows[name], name=title, published={}) for name, title in names.items()]


def _side_by_side(options: Options) -> list[Row]:
    return [row for row in _methods(options) if not row.clips and row.name != "PRN as published"]


_ONE = ("waymo",)
TABLES = {
    table.name: table
    for table in (
        Table("table1", "Table 1: comparison with other methods", REAL, _methods, "DAPT"),
        Table("table2", "Table 2: pre-training corpora", ("waymo", "lidarhuman26m"), _corpora, "w/o"),
        Table("table3", "Table 3: components", _ONE, _components, "anchors + MDE + heatmaps"),
        Table("table4", "Table 4: synthesis, and r_keep", _ONE, _augmentations, "+ laser masking"),
        Table("fig5", "Figure 5: the hardest people", REAL, _side_by_side, "DAPT", single=True),
        Table("fig7", "Figure 7: stability", _ONE, _compared, "DAPT", ("--stability",), single=True),
        Table("fig8", "Figure 8: end joints", _ONE, _compared, "DAPT", ("--stability",), single=True),
    )
}
