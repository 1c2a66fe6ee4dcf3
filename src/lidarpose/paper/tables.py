"""The rows of the paper's tables 1 to 4 and of its figures 5, 7 and 8: each method's options of training."""

from dataclasses import replace
from pathlib import Path

from lidarpose.data.readers.lidarhuman26m import POSE_FOLDER
from lidarpose.data.splits import split_rule
from lidarpose.errors import InputError
from lidarpose.paper.cells import CORPORA, NO_HEATMAPS, REAL, SMPL, Options, Row, Table
from lidarpose.train.recipes import DEEP_PAPER, PAPER, TINY_PAPER

# the option for the poses of the paper's pre-training
_POSES_OF_PAPER = "lidarhuman26m-poses=DIR"
# on real sets all methods are trained on the crops, and about the centers, that the protocol scores with
_RELEASED, _RELEASED_CLIPS = ("--augment", "paper"), ("--options", "trans_center=true")
# the stand-in has few clips, so they are rotated, as the people of other rows are there
_TURNED = ("--augment", "turn")
# the published rates and schedules are meant for the full sizes and for many more steps: others on synthesized people,
# and at full width smaller batches, since it sees few people there
_FASTER, _FASTER_WIDE = ("--rate", "2e-3"), ("--rate", "1e-3", "--batch", "32")
_ONE_CYCLE = (*_FASTER, "--schedule", "cosine", "--warmup", "0.04")
# likewise baselines at full width: steps of 2 clips, of NE 1, and LPFormer with an eighth of its cells
_WIDE_BASELINES = {"lidarcap": ("--batch", "32"), "ne": ("--batch", "16"), "lpformer": ("--options", "grid=32")}
# an Adam step moves a weight by about the learning rate, and logits of narrow heatmaps are large (docs/log.md)
_HEATMAP_RATE = ("--heatmap-rate", "10")
_KEPT = ("0.5", "0.6", "0.7", "0.8", "0.9")
# r_keep of the recipe, for which no option is given
_RECIPE_KEEP = "0.6"


def _paper(options: Options, *words: str) -> tuple[str, ...]:
    """Options of a training of the paper's network. On synthesized people, fine-tuning centers on the points, as all
    methods do there; the paper's own fine-tuning centers on labels."""
    wide = () if options.real else _FASTER_WIDE
    return ("--recipe", "paper", *(wide if options.size == PAPER else _FASTER), *words)


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
    is_published = options.size == PAPER and options.real
    heatmap_rate = () if is_published or NO_HEATMAPS & set(words) else _HEATMAP_RATE
    return _paper(options, *heatmap_rate, *(() if options.real else ("--augment", "default")), *words)


def _random(options: Options, *words: str) -> tuple[str, ...]:
    return _tuned(options, "--size", options.size, *words)


def _published(*values: float | None) -> dict[str, float]:
    return {name: value for name, value in zip(REAL, values, strict=False) if value is not None}


def _methods(options: Options) -> list[Row]:
    """Table 1."""
    prn, size = ("--neck", "prn"), "tiny" if options.size in (TINY_PAPER, DEEP_PAPER) else "small"
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
    wide = () if options.real else _WIDE_BASELINES.get(model, ())
    changes = wide if options.size == PAPER else _ONE_CYCLE
    width = (TINY_PAPER if options.size == DEEP_PAPER else options.size).removeprefix(PAPER)
    return ("--model", model, "--size", model + width, *changes, *words)


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
