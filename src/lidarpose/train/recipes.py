"""Recipes: complete configurations of training runs, by name; the command line only overrides their fields.

A field's help is its help text on the command line, so this module imports nothing heavy.
"""

from dataclasses import Field, asdict, dataclass, field, fields
from operator import index
from os import fspath
from typing import Any, ClassVar, TypeVar

from lidarpose.errors import InputError, check_finite, check_name
from lidarpose.io.files import listed
from lidarpose.models import DEFAULT

# rise, stay, fall to zero; rise and fall along a cosine; constant; or reduced when the loss stops improving
SCHEDULES = ("plateau", "cosine", "constant", "reduce-on-plateau")
OPTIMIZERS = ("adamw", "adam")
PRECISIONS = ("auto", "float32", "bf16")
# the paper's network, and smaller ones of the same design for CPUs: two of three levels, one of five, as published
PAPER, SMALL_PAPER, TINY_PAPER, DEEP_PAPER = "paper", "paper-small", "paper-tiny", "paper-deep"
# the networks of --model and their sizes; the first size is the default
MODELS: dict[str, tuple[str, ...]] = {
    "ours": ("tiny", "small", "base"),
    "dapt": (PAPER, SMALL_PAPER, TINY_PAPER, DEEP_PAPER),
    # as published, and narrower ones for CPUs
    **{name: (name, f"{name}-small", f"{name}-tiny") for name in ("prn", "lpformer", "lidarcap", "ne")},
}
# value of --init for random initial weights
RANDOM = "random"
# what the paper's network learns: coordinates of joints (in pre-training parts, too), or heatmaps
HEADS = ("coordinates", "heatmaps")
# settings that change no sample: a resumed run may change them
FREE = ("workers", "validate", "pictures", "precision")
# shares that must be below 1
_BELOW_ONE = ("ema", "mix", "hold_out", "objects", "whole_scans")
_MODEL = "ours, dapt, prn, lpformer, lidarcap or ne"
_OPTIONS = "options of a baseline or the paper's network: grid=32, stale_convolution=true, ... (docs/train.md)"
_LEAST = {"batch": 1, "people": 1, "scenes": 1, "uses": 1}


def _to_bool(value: Any) -> bool:
    # checked by name: numpy's bool is accepted without importing numpy
    if type(value).__name__ not in ("bool", "bool_"):
        raise TypeError
    return bool(value)


# by type of a setting: a converter, so that numpy's numbers and path objects are accepted and can be stored; the
# expected value, for errors; and the placeholder of the value in the command's help
TYPES: dict[Any, tuple] = {
    int: (index, "a whole number", "N"),
    float: (float, "a number", "X"),
    bool: (_to_bool, "true or false", "true|false"),
    str: (fspath, "text", "NAME"),
    float | None: (lambda value: None if value is None else float(value), "a number", "X"),
    str | None: (lambda value: None if value is None else fspath(value), "text", "FILE"),
    tuple[str, ...]: (lambda value: tuple(fspath(path) for path in listed(value)), "a list of texts", "A,B"),
    tuple[float, ...]: (lambda value: tuple(map(float, value)), "a list of numbers", "X,Y"),
}


def _setting(default: Any, help_text: str, metavar: str = "") -> Any:
    """A field with its help text and the placeholder of its value, by default that of its type; SHARE: from 0 to 1."""
    return field(default=default, metadata={"help": help_text, "metavar": metavar})


def _checked(f: Field, value: Any) -> Any:
    """A value converted to the type of its field. Raises InputError for an invalid value."""
    convert, expected, _ = TYPES[f.type]
    try:
        value = convert(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{f.name} must be {expected}, got {value!r}") from None
    if f.type in (int, float, float | None) and value is not None:
        least, is_below_one = _LEAST.get(f.name, 0), f.name in _BELOW_ONE
        if not value >= least:
            raise InputError(f"{f.name} must be at least {least}, got {value:g}")
        check_finite(f.name, value)
        if f.metadata["metavar"] == "SHARE" and (value > 1 or is_below_one and value == 1):
            raise InputError(f"{f.name} must be a share, {'below' if is_below_one else 'at most'} 1, got {value}")
    return value


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings that all kinds of training share. Raises InputError for an invalid value.

    kind: the command.
    """

    kind: ClassVar[str]

    batch: int = _setting(64, "batch size, over all processes; each frame of a clip counts as one")
    rate: float = _setting(2e-3, "peak learning rate of AdamW", "RATE")
    decay: float = _setting(0.01, "weight decay")
    optimizer: str = _setting("adamw", "adamw or adam, where Muon is off")
    betas: tuple[float, ...] = _setting((), "betas of AdamW or Adam (default: by network)")
    schedule: str = _setting(
        "plateau",
        "plateau (warm-up, constant, decay), cosine, constant, or in fine-tuning reduce-on-plateau (rate x 0.9 when "
        "two epochs improve by less than 1 %% each)",
    )
    warmup: float = _setting(0.02, "share of the run for warm-up", "SHARE")
    cool: float = _setting(0.3, "share of the run, at its end, in which a plateau's rate decays to 0", "SHARE")
    ema: float = _setting(0.999, "decay of the exponential moving average of the weights; 0: none", "SHARE")
    clip: float = _setting(1.0, "gradient clipping, maximum norm; 0: none")
    precision: str = _setting("auto", "auto (bf16 on a GPU), float32 or bf16")
    validate: int = _setting(0, "people between validations; 0: twenty validations")
    seed: int = _setting(0, "random seed")
    workers: int = _setting(1, "data loader processes, per training process")

    def __post_init__(self):
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(f, getattr(self, f.name)))
        check_name("optimizer", self.optimizer, OPTIMIZERS)
        if self.betas and not (len(self.betas) == 2 and all(0 <= beta < 1 for beta in self.betas)):
            raise InputError(f"betas must be two numbers from 0 to below 1, got {self.betas}")
        check_name("schedule", self.schedule, SCHEDULES)
        if self.schedule == "reduce-on-plateau" and self.kind != "finetune":
            raise InputError(
                f"{self.schedule} needs epochs, and only fine-tuning has epochs: choose another --schedule"
            )
        if self.schedule == "reduce-on-plateau" and not self.rate:
            raise InputError(f"{self.schedule} lowers the rate: give a --rate above 0")
        check_name("precision", self.precision, PRECISIONS)

    def to_dict(self) -> dict:
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class PoseRecipe(Recipe):
    """Settings that pre-training and fine-tuning share."""

    muon_rate: float = _setting(0.02, "peak learning rate of Muon for hidden matrices; 0: AdamW for all", "RATE")
    heatmap_rate: float = _setting(
        1.0, "paper's network: learning rate of the heatmaps' last layer, as a multiple of --rate"
    )
    bone: float = _setting(0.0, "loss weight of bone lengths")
    symmetry: float = _setting(0.0, "loss weight of left-right bone symmetry")
    pictures: int = _setting(6, "people drawn at every validation")


def _size_of(model: str, size: str) -> str:
    """The size of a model, by default its first. Raises InputError for an unknown model or another model's size."""
    check_name("model", model, MODELS)
    if size and size not in MODELS[model]:
        raise InputError(f"the model {model} has the size {' or '.join(MODELS[model])}, got {size}")
    return size or MODELS[model][0]


@dataclass(frozen=True, kw_only=True)
class Pretrain(PoseRecipe):
    """Pre-training on synthesized people, made during training or read from shards."""

    kind: ClassVar[str] = "pretrain"

    model: str = _setting("", f"{_MODEL} (default: by --size)")
    size: str = _setting(
        "", "network size: tiny (default), small, base; paper, paper-small, ...; prn, prn-small, ... (lidarpose models)"
    )
    options: tuple[str, ...] = _setting((), _OPTIONS)
    neck: str = _setting("mde", "paper's network: mde, finest or prn (docs/train.md)")
    head: str = _setting("coordinates", "paper's network: coordinates (and parts), or heatmaps alone, in one stage")
    drop_path: float | None = _setting(
        None, "paper's network: stochastic depth, drop rate of the last block; linearly less in earlier ones"
    )
    init: str = _setting("", "initial weights, of this size or smaller: bundled, or a checkpoint", "NAME|FILE")
    scene: str = _setting("wild", "wild, wide, paper or reference")
    set: tuple[str, ...] = _setting(
        (), "overrides of the scene's fields; keep=R (laser mask), recorded=1 (positions as captured)", "A=X,B=Y"
    )
    people: int = _setting(300_000, "number of training people")
    easy: float = _setting(
        0.05, "share of the run in which the maximum difficulty rises to 1; not for stored people", "SHARE"
    )
    captured: float = _setting(0.5, "share of poses from --motion", "SHARE")
    motion: str | None = _setting(None, "captured motion for poses: a file or a folder")
    subjects: tuple[str, ...] = _setting((), "clips of --motion to use, by the first part of their names")
    body: str | None = _setting(
        None, "your SMPL, SMPL+H or SMPL-X file instead of the shipped body, with the shapes of motion where it has any"
    )
    strays: float = _setting(0.2, "probability of stray points around a person", "SHARE")
    noise: float = _setting(0.15, "probability of Gaussian noise on all points, 0.5 to 8 cm", "SHARE")
    objects: float = _setting(
        0.0, "share of crops without a person; the network then predicts whether there is one", "SHARE"
    )
    whole_scans: float = _setting(
        0.0, "share of people cropped from whole synthesized scans by detected boxes", "SHARE"
    )
    shards: tuple[str, ...] = _setting(
        (), "train on folders that `lidarpose synth` wrote; scene and motion then define validation people", "DIR,DIR"
    )

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "size", self.size or "tiny" if not self.model else _size_of(self.model, self.size))
        check_name("head", self.head, HEADS)
        if self.subjects and not self.motion:
            raise InputError("subjects select captured clips: give their file by motion too")
        if self.captured not in (0, type(self).captured) and not self.motion:
            raise InputError("captured is the share of captured poses: give their file by motion too")


@dataclass(frozen=True, kw_only=True)
class Finetune(PoseRecipe):
    """Fine-tuning on datasets that `lidarpose prepare` wrote."""

    kind: ClassVar[str] = "finetune"

    rate: float = _setting(5e-4, "peak learning rate of AdamW", "RATE")
    muon_rate: float = _setting(5e-3, "peak learning rate of Muon for hidden matrices; 0: AdamW for all", "RATE")
    data: tuple[str, ...] = _setting((), "folders of the datasets")
    model: str = _setting("", f"{_MODEL}: the network of --init (default: that of the checkpoint)")
    options: tuple[str, ...] = _setting((), _OPTIONS)
    init: str = _setting(DEFAULT, "initial weights: bundled, a checkpoint, or random", "NAME|FILE")
    size: str = _setting("", "with --init random: network size, as for pretrain")
    neck: str = _setting("mde", "with --init random: neck of the paper's network, as for pretrain")
    epochs: float = _setting(20.0, "number of epochs")
    split: str = _setting("train", "split to train on; all: every split")
    interval: int = _setting(1, "use every N-th frame, as published recipes do")
    augment: str = _setting("default", "data augmentation: default, paper, lidarhmr, turn or none")
    mix: float = _setting(0.25, "share of synthesized people in training, below 1", "SHARE")
    scene: str = _setting("wild", "scene of the synthesized people: wild, wide, paper or reference")
    set: tuple[str, ...] = _setting((), "overrides of the fields of that scene; keep=R: laser mask", "A=X,B=Y")
    hold_out: float = _setting(
        0.1, "share of sequences held out for validation if the dataset has no split val", "SHARE"
    )
    validation_split: str = _setting(
        "", "split to validate on (default: val, or held-out sequences); test: chooses best.safetensors by it"
    )
    shift_windows: bool = _setting(False, "clips: shift windows by a random 0 to 15 frames each epoch")
    keep_anchors: bool = _setting(
        True, "paper's network: keep pre-trained anchors and heads of joints of the same name"
    )
    head: str = _setting("heatmaps", "paper's network: heatmaps or coordinates")

    def __post_init__(self):
        super().__post_init__()
        check_name("head", self.head, HEADS)
        if self.model and (self.init == RANDOM or self.size):
            object.__setattr__(self, "size", _size_of(self.model, self.size))
        elif self.model:
            check_name("model", self.model, MODELS)
        if not self.mix and (self.set or self.scene != type(self).scene):
            raise InputError(
                "--scene, --set and --keep change the people that are mixed in: give --mix X, or omit them"
            )
        if any(change.startswith("recorded=") for change in self.set):
            raise InputError("recorded needs captured motion, and fine-tuning mixes in people without it: omit it")
        if not self.data:
            raise InputError("fine-tuning needs a dataset: give a folder that lidarpose prepare wrote")
        if not self.epochs > 0 or self.interval < 1:
            raise InputError(f"epochs must be above 0 and interval at least 1, got {self.epochs} and {self.interval}")
        if self.neck != "mde" and self.init != RANDOM:
            raise InputError(f"a checkpoint has its own neck: omit --neck, or give --init {RANDOM}")
        if (self.init == RANDOM) != bool(self.size):
            raise InputError(
                f"random weights need a size, a checkpoint has its own: give --init {RANDOM} --size NAME, or no --size"
            )
        if not self.init:
            raise InputError(
                "the paper's fine-tuning starts from a checkpoint of pretrain --recipe paper: give it by --init"
            )


@dataclass(frozen=True, kw_only=True)
class TrainDetector(Recipe):
    """Training of the detector on synthesized scans."""

    kind: ClassVar[str] = "train-detector"

    batch: int = _setting(4, "scans per batch, over all processes")
    rate: float = _setting(4e-3, "peak learning rate of AdamW", "RATE")
    validate: int = _setting(0, "scans between validations; 0: twenty validations")
    scenes: int = _setting(20_000, "number of synthesized scans")
    uses: int = _setting(4, "times each scan is used, with new augmentation")
    init: str = _setting("", "initial weights: detector (the bundled one), or a checkpoint", "NAME|FILE")


@dataclass(frozen=True, kw_only=True)
class TrainVerifier(Recipe):
    """Training of the verifier, which tells people from false positives, on detections in synthesized scans."""

    kind: ClassVar[str] = "train-verifier"

    batch: int = _setting(4, "scans per batch, over all processes")
    rate: float = _setting(1e-3, "peak learning rate of AdamW", "RATE")
    schedule: str = _setting("cosine", "plateau (rise, stay, fall), cosine or constant")
    warmup: float = _setting(0.1, "share of the run for warm-up", "SHARE")
    validate: int = _setting(0, "scans between validations; 0: twenty validations")
    scenes: int = _setting(5_000, "number of synthesized scans")
    uses: int = _setting(3, "times each scan is used, with new augmentation")
    init: str = _setting("tiny", "initial weights", "NAME|FILE")


# the released OneCycle schedule, AdamW for all parameters, no mean of weights, no clipping
_RELEASED = {"muon_rate": 0.0, "decay": 0.005, "schedule": "cosine", "warmup": 0.04, "ema": 0.0, "clip": 0.0}
# LiDAR-HMR's recipe of PRN and of its LPFormer: a constant rate, no mean of weights, no clipping
_LIDARHMR = {"muon_rate": 0.0, "rate": 5e-4, "schedule": "constant", "warmup": 0.0, "ema": 0.0, "clip": 0.0}
_PRN = _LIDARHMR | {"model": "prn", "optimizer": "adam", "decay": 0.0}
# the weight decay is torch's default
_LPFORMER = _LIDARHMR | {"model": "lpformer", "betas": (0.85, 0.95), "batch": 16}
# 50 epochs on all training sequences only, from random weights
_LIDARHMR_DATA = {"init": RANDOM, "epochs": 50.0, "augment": "lidarhmr", "mix": 0.0, "hold_out": 0.0}
# AdamW for all parameters in one cycle, at a rate at which the small network learns within 100,000 people
_ONE_CYCLE = {"rate": 2e-3, "muon_rate": 0.0, "schedule": "cosine", "warmup": 0.1, "ema": 0.0, "clip": 35.0}
# LiDARCap's and NE's recipe
_CLIPS = {"muon_rate": 0.0, "rate": 1e-4, "schedule": "constant", "warmup": 0.0, "ema": 0.0, "clip": 0.0}
# a batch of 128 frames is 8 clips
_CLIPS |= {"optimizer": "adam", "decay": 1e-4, "batch": 128}
_CLIPS_SHARDS = _CLIPS | {"easy": 0.0, "strays": 0.0, "noise": 0.0}
_CLIPS_DATA = _CLIPS | {"init": RANDOM, "epochs": 200.0, "augment": "none", "mix": 0.0, "hold_out": 0.0}
_CLIPS_DATA |= {"schedule": "reduce-on-plateau"}
# by kind and name, differences from the recipe of the bundled weights. Paper: implementation details
RECIPES: dict[type[Recipe], dict[str, dict[str, Any]]] = {
    Pretrain: {
        "default": {},
        # 50 epochs; an epoch is 50,000 people here: the paper's follow frames of LiDARHuman26M, whereas every pose is
        # new here. The paper's noise model is part of the scene
        "paper": _RELEASED
        | {"size": PAPER, "scene": "paper", "rate": 3e-4, "people": 2_500_000, "easy": 0.0}
        | {"strays": 0.0, "noise": 0.0},
        # people as for our own network: the published baselines are not pre-trained
        "prn": _PRN,
        "lpformer": _LPFORMER,
        # heatmaps in a single stage: see docs/log.md for its accuracy
        "paper-one-stage": _ONE_CYCLE
        | {"size": SMALL_PAPER, "head": "heatmaps", "drop_path": 0.05, "scene": "paper", "people": 100_000}
        | {"easy": 0.0, "strays": 0.0, "noise": 0.0},
        "lidarcap": _CLIPS_SHARDS | {"model": "lidarcap"},
        "ne": _CLIPS_SHARDS | {"model": "ne"},
    },
    Finetune: {
        # anchors and heads are kept, joint by joint of the same name, and synthesized people are mixed in
        "default": {},
        # 50 epochs on all training sequences only; anchors and heads are new
        "paper": _RELEASED
        | {"init": "", "epochs": 50.0, "augment": "paper", "mix": 0.0, "hold_out": 0.0, "keep_anchors": False},
        "prn": _PRN | _LIDARHMR_DATA,
        "lpformer": _LPFORMER | _LIDARHMR_DATA,
        # starts from a network of the pre-training recipe of that name, including its heads
        "paper-one-stage": _ONE_CYCLE | {"init": "", "rate": 5e-4, "mix": 0.0},
        "lidarcap": _CLIPS_DATA | {"model": "lidarcap"},
        "ne": _CLIPS_DATA | {"model": "ne"},
    },
    TrainDetector: {"default": {}},
    TrainVerifier: {"default": {}},
}
# networks of --model whose recipe has another name
_RECIPE_OF_MODEL = {"dapt": PAPER}
AnyRecipe = TypeVar("AnyRecipe", bound=Recipe)


def model_of_size(size: str) -> str:
    """The network of `MODELS` with a size of this name, "" if none."""
    return next((model for model, sizes in MODELS.items() if size in sizes), "")


def recipe_of_model(kind: type[Recipe], model: str) -> str:
    """The name of the recipe that trains a network of `MODELS` as published, else "default"."""
    name = _RECIPE_OF_MODEL.get(model, model)
    return name if name in RECIPES[kind] else "default"


def recipe(kind: type[AnyRecipe], name: str = "default", **changes: Any) -> AnyRecipe:
    """A named recipe of a kind of training, with changes of its fields."""
    check_name("recipe", name, RECIPES[kind])
    return kind(**(RECIPES[kind][name] | changes))
