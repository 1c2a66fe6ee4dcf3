"""A run is a function that returns a complete configuration; the command line only overrides its fields.

A field's help is what the command line says of it; this module stays light for that.
"""

from dataclasses import Field, asdict, dataclass, field, fields
from operator import index
from os import fspath
from typing import Any, TypeVar

from lidarpose.errors import InputError, check_finite, check_name
from lidarpose.io.files import listed
from lidarpose.models import DEFAULT

# rises, stays, falls to nothing; or rises and falls as a cosine
SCHEDULES = ("plateau", "cosine")
PRECISIONS = ("auto", "float32", "bf16")
# the paper's network, and one of the same design for CPUs, besides the sizes of the package's own
PAPER, SMALL_PAPER = "paper", "paper-small"
# instead of weights: fine-tuning begins with none
RANDOM = "random"
# what changes no sample: a resumed run may have others
FREE = ("workers", "validate", "pictures", "precision")
# shares of a whole that cannot be all of it
_BELOW_ONE = ("ema", "mix", "hold_out")
_LEAST = {"batch": 1, "people": 1}


def _to_bool(value: Any) -> bool:
    # by name: numpy's is one too, and is not loaded for that
    if type(value).__name__ not in ("bool", "bool_"):
        raise TypeError
    return bool(value)


# by type of a setting: what makes one of a value, so that numpy's numbers and paths are as good as Python's and can be
# stored; what is expected; and what stands for the value in the command's help
TYPES: dict[Any, tuple] = {
    int: (index, "a whole number", "N"),
    float: (float, "a number", "X"),
    bool: (_to_bool, "true or false", "true|false"),
    str: (fspath, "text", "NAME"),
    str | None: (lambda value: None if value is None else fspath(value), "text", "FILE"),
    tuple[str, ...]: (lambda value: tuple(fspath(path) for path in listed(value)), "a list of texts", "A,B"),
}


def _setting(default: Any, words: str, metavar: str = "") -> Any:
    """A field with its help and what stands for its value there, by default that of its type; SHARE: from 0 to 1."""
    return field(default=default, metadata={"help": words, "metavar": metavar})


def _checked(f: Field, value: Any) -> Any:
    """A setting as its field declares it. Raises InputError for what is none."""
    convert, expected, _ = TYPES[f.type]
    try:
        value = convert(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{f.name} must be {expected}, got {value!r}") from None
    if f.type in (int, float):
        least, below = _LEAST.get(f.name, 0), f.name in _BELOW_ONE
        if not value >= least:
            raise InputError(f"{f.name} must be at least {least}, got {value:g}")
        check_finite(f.name, value)
        if f.metadata["metavar"] == "SHARE" and (value > 1 or below and value == 1):
            raise InputError(f"{f.name} must be a share, {'below' if below else 'at most'} 1, got {value}")
    return value


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What pre-training and fine-tuning have in common. Raises InputError for a value that cannot be."""

    batch: int = _setting(64, "people a step, in all processes together")
    rate: float = _setting(2e-3, "peak learning rate of AdamW", "RATE")
    muon_rate: float = _setting(0.02, "peak learning rate of Muon for hidden matrices; 0: AdamW for all", "RATE")
    decay: float = _setting(0.01, "weight decay")
    schedule: str = _setting("plateau", "plateau (rise, stay, fall) or cosine")
    warmup: float = _setting(0.02, "share of the run in which the rate rises", "SHARE")
    cool: float = _setting(0.3, "share of the run in which a plateau's rate falls to nothing", "SHARE")
    ema: float = _setting(0.999, "how much the running mean of the weights keeps each step; 0: no mean", "SHARE")
    clip: float = _setting(1.0, "largest norm of a step's gradient; 0: any")
    bone: float = _setting(0.0, "weight of the error of bones' lengths")
    symmetry: float = _setting(0.0, "weight of the difference of left and right bones")
    precision: str = _setting("auto", "auto (bf16 on a GPU), float32 or bf16")
    validate: int = _setting(0, "people between two validations; 0: twenty in the run")
    pictures: int = _setting(6, "validation people drawn at every validation")
    seed: int = _setting(0, "of all that is random")
    workers: int = _setting(1, "processes that make people, of each process that trains")

    def __post_init__(self):
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(f, getattr(self, f.name)))
        check_name("schedule", self.schedule, SCHEDULES)
        check_name("precision", self.precision, PRECISIONS)

    @property
    def kind(self) -> str:
        """The command, "pretrain" or "finetune"."""
        return type(self).__name__.lower()

    def to_dict(self) -> dict:
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class Pretrain(Recipe):
    """Pre-training on synthesized people, made while the network learns, or read from shards."""

    size: str = _setting("tiny", "of the network: tiny, small, base; paper or paper-small for the paper's design")
    init: str = _setting("", "weights to begin with, of this size or smaller: bundled, or a checkpoint", "NAME|FILE")
    scene: str = _setting("wild", "wild, paper or reference")
    set: tuple[str, ...] = _setting(
        (), "changes of the scene: its numbers, keep=R (laser mask), recorded=1 (places of the motion)", "A=X,B=Y"
    )
    people: int = _setting(300_000, "seen in all")
    easy: float = _setting(
        0.05, "share of the run in which the largest difficulty rises to full; that of shards is what it is", "SHARE"
    )
    captured: float = _setting(0.5, "share of poses from captured motion, where clips are given", "SHARE")
    motion: str | None = _setting(None, "captured motion to take poses from: a file or a folder")
    subjects: tuple[str, ...] = _setting((), "those of its clips to learn from, by the first part of names")
    strays: float = _setting(0.2, "how often stray points are about a person", "SHARE")
    noise: float = _setting(0.15, "how often all points are blurred, by 0.5 to 8 cm", "SHARE")
    shards: tuple[str, ...] = _setting(
        (),
        "folders that `lidarpose synth` wrote, to learn from; scene and motion then choose validation people",
        "DIR,DIR",
    )

    def __post_init__(self):
        super().__post_init__()
        if self.subjects and not self.motion:
            raise InputError("subjects are of captured clips: name their file by motion too")


@dataclass(frozen=True, kw_only=True)
class Finetune(Recipe):
    """Fine-tuning on datasets that `lidarpose prepare` wrote."""

    rate: float = _setting(5e-4, "peak learning rate of AdamW", "RATE")
    muon_rate: float = _setting(5e-3, "peak learning rate of Muon for hidden matrices; 0: AdamW for all", "RATE")
    data: tuple[str, ...] = _setting((), "their folders")
    init: str = _setting(DEFAULT, "weights to begin with: bundled, a checkpoint, or random", "NAME|FILE")
    size: str = _setting("", "with --init random, of the network, as of pretrain")
    epochs: float = _setting(20.0, "how often each sample is seen")
    split: str = _setting("train", "samples to learn from; all: of every split")
    interval: int = _setting(1, "only every so many frames, as published recipes thin out")
    augment: str = _setting("default", "what happens to people: default, paper or none")
    mix: float = _setting(0.25, "share of synthesized people, below 1", "SHARE")
    scene: str = _setting("wild", "of the synthesized people: wild, paper or reference")
    hold_out: float = _setting(
        0.1, "share of sequences kept for validation where the dataset has no split val", "SHARE"
    )
    keep_anchors: bool = _setting(True, "of the paper's network: go on with pre-trained anchors and heads")

    def __post_init__(self):
        super().__post_init__()
        if not self.data:
            raise InputError("fine-tuning needs a dataset: name a folder that lidarpose prepare wrote")
        if not self.epochs > 0 or self.interval < 1:
            raise InputError(f"epochs must be above 0 and interval at least 1, got {self.epochs} and {self.interval}")
        if (self.init == RANDOM) != bool(self.size):
            raise InputError(
                f"random weights need a size, and others have theirs: give --init {RANDOM} --size NAME, or no --size"
            )
        if not self.init:
            raise InputError(
                "the paper's fine-tuning goes on from a checkpoint of pretrain --recipe paper: name it by --init"
            )


# the released OneCycle schedule, AdamW on everything, neither mean of weights nor clipping
_RELEASED = {"muon_rate": 0.0, "decay": 0.005, "schedule": "cosine", "warmup": 0.04, "ema": 0.0, "clip": 0.0}
# by kind and name, what differs from the recipe of the bundled weights. Paper: implementation details
RECIPES: dict[type[Recipe], dict[str, dict[str, Any]]] = {
    Pretrain: {
        "default": {},
        # 50 epochs; an epoch is here 50,000 people, since the paper's follow frames of LiDARHuman26M, and every pose is
        # new. Its law of noise is the scene's
        "paper": _RELEASED
        | {"size": PAPER, "scene": "paper", "rate": 3e-4, "people": 2_500_000, "easy": 0.0}
        | {"strays": 0.0, "noise": 0.0},
    },
    Finetune: {
        # anchors and heads stay, every joint has its name, synthesized people are mixed in
        "default": {},
        # 50 epochs on all training sequences and no others; anchors and heads anew
        "paper": _RELEASED
        | {"init": "", "epochs": 50.0, "augment": "paper", "mix": 0.0, "hold_out": 0.0, "keep_anchors": False},
    },
}
AnyRecipe = TypeVar("AnyRecipe", bound=Recipe)


def recipe(kind: type[AnyRecipe], name: str = "default", **changes: Any) -> AnyRecipe:
    """A named recipe of `Pretrain` or `Finetune`, some of its fields changed."""
    check_name("recipe", name, RECIPES[kind])
    return kind(**(RECIPES[kind][name] | changes))
