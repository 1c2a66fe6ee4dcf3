"""Synthetic people as batches: the generator, the person's frame, the plan, the targets. No network here.

Chunk c holds people c * CHUNK ... of the seed, whatever the number of workers, so a run can be taken up at any chunk.
A chunk is sorted by voxels before it is cut into batches: padding is what a small network spends its time on.
"""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lidarpose.model.plan import Plan, plan, view_features
from lidarpose.model.presets import NetworkConfig
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generate import Generator, SyntheticPerson
from lidarpose.synth.scene import scene_config
from lidarpose.train.recipes import Pretrain

# batches a chunk
BATCHES = 8
# half of the people are centered as a user's cloud is, half about a guess of the pelvis, as in a second pass
_REFINED, _PELVIS_ERROR = 0.5, 0.06
# how often the sensor's place is kept from the network
_BLIND = 0.3
# a joint of which the body's surface is seen within this distance is visible, m: hips lie 12 cm deep
SEEN = 0.18
# most fine voxels a person in training
MAX_VOXELS = 224


@dataclass(frozen=True, kw_only=True)
class Example:
    """One person in their own frame: points (n, 3) m, part (n,), joints (26, 3) m, view (5,)."""

    points: np.ndarray
    part: np.ndarray
    joints: np.ndarray
    view: np.ndarray


def example(person: SyntheticPerson, rng: np.random.Generator) -> Example:
    """A person as training shows them: about one of two kinds of center, with or without the sensor's place."""
    sample = person.sample
    center = sample.center
    if rng.random() < _REFINED:
        center = sample.pose.joints[BODY26.index("pelvis")] + rng.normal(0, _PELVIS_ERROR, 3)
    origin = None if rng.random() < _BLIND else np.zeros(3)
    return Example(
        points=(sample.points - center).astype(np.float32),
        part=sample.part,
        joints=(sample.pose.joints - center).astype(np.float32),
        view=view_features(center, origin),
    )


def collate(examples: list[Example], config: NetworkConfig, rng: np.random.Generator | None) -> dict[str, np.ndarray]:
    """Examples as the arrays of a plan, and the arrays of `Targets`."""
    tables = plan(
        np.concatenate([e.points for e in examples]),
        np.array([len(e.points) for e in examples]),
        grid=config.grid,
        max_voxels=MAX_VOXELS,
        view=np.stack([e.view for e in examples]),
        rng=rng,
        neighbours=config.convolution,
    )
    part = np.concatenate([e.part for e in examples])
    arrays = tables.arrays()
    del arrays["point_voxel"]
    return arrays | {
        "joints": np.stack([e.joints for e in examples]),
        "known": np.ones((len(examples), len(BODY26)), bool),
        "visible": np.stack([seen(e.joints, e.points[e.part > 0]) for e in examples]),
        "part": _majority(tables, part, config.parts),
    }


def seen(joints: np.ndarray, points: np.ndarray) -> np.ndarray:
    """joints (J, 3) m, points (n, 3) m on the body -> (J,) bool: some point lies within `SEEN` of the joint."""
    if not len(points):
        return np.zeros(len(joints), bool)
    square = (joints**2).sum(1)[:, None] + (points**2).sum(1) - 2 * joints @ points.T
    return square.min(1) < SEEN**2


def _majority(tables: Plan, part: np.ndarray, parts: int) -> np.ndarray:
    shape = tables.fine.valid.shape
    inside = tables.point_voxel >= 0
    votes = np.bincount(tables.point_voxel[inside] * parts + part[inside], minlength=shape[0] * shape[1] * parts)
    most = votes.reshape(-1, parts).argmax(1).reshape(shape)
    return np.where(tables.fine.valid, most, -1)


def generator_of(recipe: Pretrain) -> Generator:
    """The people a recipe learns from. Raises InputError for an unknown scene and for clips that cannot be read."""
    scene = scene_config(recipe.scene)
    bank = PoseBank.from_clips(recipe.motion, recipe.subjects) if recipe.motion else None
    return Generator(scene=scene, bank=bank, captured=recipe.captured if bank is not None else 0.0, measure=False)


@dataclass(frozen=True, kw_only=True)
class Chunks(IterableDataset):
    """The chunks of a run from `start` to `stop`, each a list of `BATCHES` batches of arrays."""

    recipe: Pretrain
    network: NetworkConfig
    start: int
    stop: int

    def __iter__(self):
        worker = get_worker_info()
        first, stride = (0, 1) if worker is None else (worker.id, worker.num_workers)
        generator = generator_of(self.recipe)
        for chunk in range(self.start + first, self.stop, stride):
            # products of a few thousand numbers: threads of BLAS only get in each other's way
            with threadpool_limits(limits=1, user_api="blas"):
                batches = self._chunk(generator, chunk)
            yield batches

    def _chunk(self, generator: Generator, chunk: int) -> list[dict[str, np.ndarray]]:
        recipe = self.recipe
        rng = np.random.default_rng([recipe.seed, 2, chunk])
        size = BATCHES * recipe.batch
        examples = []
        for index in range(chunk * size, (chunk + 1) * size):
            # the ceiling rises to full; below it every difficulty goes on being seen, the harder ones more often
            ceiling = min(index / max(recipe.easy * recipe.people, 1), 1.0)
            hard = ceiling * np.sqrt(rng.random())
            examples.append(example(generator.person(recipe.seed, index, hard=hard), rng))
        # cells of 10 cm stand for voxels: what matters is that like comes to like
        examples.sort(key=lambda e: len(np.unique(np.floor(e.points * 10), axis=0)))
        order = rng.permutation(BATCHES)
        return [collate(examples[k * recipe.batch : (k + 1) * recipe.batch], self.network, rng) for k in order]


def loader(recipe: Pretrain, network: NetworkConfig, *, start: int, stop: int) -> DataLoader:
    """Chunks `start` ... `stop` - 1 in order, made by `recipe.workers` processes (0: by this one)."""
    return DataLoader(
        Chunks(recipe=recipe, network=network, start=start, stop=stop),
        batch_size=None,
        num_workers=recipe.workers,
        prefetch_factor=4 if recipe.workers else None,
    )
