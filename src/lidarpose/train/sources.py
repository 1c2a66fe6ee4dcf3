"""Where people to learn from come from: made as they are needed, or read from shards and shown anew each time.

A source is a function of a person's number in the run alone, so any process makes any of them, in any order.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import floor
from typing import Protocol

import numpy as np

from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import Augmentation, augmented, disturbed
from lidarpose.train.example import REFINED, Example, example
from lidarpose.train.labeled_dataset import InMemoryDataset

# scenes whose every person is as the paper says, masked always
_OF_ONE_DIFFICULTY = ("paper", "reference")
# first words of generators' seeds: 1 is the synthetic person's own
_SYNTHETIC, _STORED, _ORDER = 2, 5, 6


class Source(Protocol):
    """People by their number in a run. May be pickled."""

    def example(self, index: int) -> Example: ...


@dataclass(frozen=True, kw_only=True)
class SyntheticSource:
    """People of a scene whose difficulty rises.

    easy: how many people it takes to rise from nothing to full; below the ceiling every difficulty goes on being seen,
    the harder ones more often, but for the paper's scenes, which know one difficulty; motion, subjects, captured,
    strays, noise: see `recipes.Pretrain`; refined: see `example`. Raises InputError, at once, for an unknown scene and
    for clips that cannot be read.
    """

    scene: str
    seed: int
    easy: float = 0.0
    motion: str | None = None
    subjects: tuple[str, ...] = ()
    captured: float = 0.0
    strays: float = 0.0
    noise: float = 0.0
    refined: float = REFINED

    def __post_init__(self):
        # here, not in a worker, whose errors come wrapped in a traceback
        self._generator  # noqa: B018

    def __getstate__(self) -> dict:
        # each process reads the clips itself
        return {name: value for name, value in vars(self).items() if name != "_generator"}

    @cached_property
    def _generator(self) -> Generator:
        bank = PoseBank.from_clips(self.motion, self.subjects) if self.motion else None
        captured = self.captured if bank is not None else 0.0
        return Generator(scene=scene_config(self.scene), bank=bank, captured=captured, measure=False)

    def example(self, index: int) -> Example:
        rng = np.random.default_rng([self.seed, _SYNTHETIC, index])
        hard = min(index / self.easy, 1.0) if self.easy else 1.0
        if self.scene not in _OF_ONE_DIFFICULTY:
            hard *= np.sqrt(rng.random())
        sample = self._generator.person(self.seed, index, hard=hard).sample
        return example(disturbed(sample, strays=self.strays, noise=self.noise, rng=rng), rng, refined=self.refined)


@dataclass(frozen=True, kw_only=True)
class StoredSource:
    """The people of datasets, all of them once an epoch in an order of the epoch's own, each time augmented anew.

    dataset: see `InMemoryDataset.load`; strays, noise: see `disturbed`.
    """

    dataset: InMemoryDataset
    seed: int
    augmentation: Augmentation
    strays: float = 0.0
    noise: float = 0.0

    def example(self, index: int) -> Example:
        epoch, place = divmod(index, len(self.dataset))
        row = int(_order(self.seed, epoch, len(self.dataset))[place])
        rng = np.random.default_rng([self.seed, _STORED, index])
        person = self.dataset.sample(row)
        if self.strays or self.noise:
            person = disturbed(person, strays=self.strays, noise=self.noise, rng=rng)
        return augmented(person, self.augmentation, rng)


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    """(count,) int: whom an epoch shows, one after the other."""
    return np.random.default_rng([seed, _ORDER, epoch]).permutation(count)


@dataclass(frozen=True, kw_only=True)
class MixedSource:
    """People of `main` in their order, and evenly spread among them people of `other`, so that these are a `share` in
    [0, 1) of all."""

    main: Source
    other: Source
    share: float

    def example(self, index: int) -> Example:
        before, after = floor(index * self.share), floor((index + 1) * self.share)
        return self.other.example(before) if after > before else self.main.example(index - before)
