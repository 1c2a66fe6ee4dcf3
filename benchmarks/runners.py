"""Inputs and networks for `benchmarks/network.py`: people with given numbers of points, and a common interface.

Legend: B people per call, n points per person, J joints.

A runner splits its work into two parts, the first of which is not part of the network. For a forward pass these are the
tables, then the joints. For training they are a lesson, which a loader prepares in another process, then a step on it.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from backbones import Draft, GroupedViT, PointNet2, count
from torch import nn

from lidarpose.models.config import SIZES
from lidarpose.models.onnx import voxelize_people
from lidarpose.models.posenet import Batch, PoseNet
from lidarpose.skeleton import BODY26
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import Example, example
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import average, optimizers
from lidarpose.train.recipes import Pretrain

NETWORKS = ("tiny", "small", "base", "paper")
# median points per person of crops as in training
CROP_POINTS = 170
# people per batch; the paper's network is a hundred times as large
BATCH, PAPER_BATCH = 64, 8
# m; standard deviation of the shift of duplicated points
SPREAD = 0.01
DRAFT = "draft"
RECIPE = Pretrain()


def crops(number: int, rng: np.random.Generator) -> list[Example]:
    """`number` people as in training, with dense ones left out so that the median is `CROP_POINTS`."""
    generator = Generator(scene=scene_config(RECIPE.scene), measure=False)
    halves: tuple[list, list] = [], []
    index = 0
    while min(map(len, halves)) < number // 2:
        person = example(generator.person(1, index, hard=math.sqrt(rng.random())).sample, rng)
        halves[len(person.points) > CROP_POINTS].append(person)
        index += 1
    return halves[0][: number // 2] + halves[1][: number // 2]


def of_points(people: list[Example], n: int, number: int, rng: np.random.Generator) -> list[Example]:
    """The `number` people whose numbers of points are closest to n, resampled to exactly n points."""
    nearest_people = sorted(people, key=lambda e: abs(math.log(len(e.points) / n)))[:number]
    nearest_people = [nearest_people[k % len(nearest_people)] for k in rng.permutation(number)]
    return [_resampled(person, n, rng) for person in nearest_people]


def _resampled(person: Example, n: int, rng: np.random.Generator) -> Example:
    num_points = len(person.points)
    kept_rows = rng.permutation(num_points)[:n]
    repeated_rows = rng.integers(num_points, size=n - len(kept_rows))
    repeated_points = person.points[repeated_rows] + rng.normal(0, SPREAD, (len(repeated_rows), 3)).astype(np.float32)
    return replace(
        person,
        points=np.concatenate([person.points[kept_rows], repeated_points]),
        part=person.part[np.concatenate([kept_rows, repeated_rows])],
    )


def batches(people: list[Example], size: int, number: int) -> list[list[Example]]:
    """`number` batches of `size`, sorted by voxels as `train.data_loader` sorts a chunk; surplus people are evenly
    left out."""
    order = sorted(people, key=lambda e: len(np.unique(np.floor(e.points * 10), axis=0)))
    selected_people = [order[k * len(order) // (size * number)] for k in range(size * number)]
    return [selected_people[k * size : (k + 1) * size] for k in range(number)]


class Runner:
    """A network to time. tables, joints: the two parts of a forward pass; lesson, step: those of a training step."""

    batch = BATCH
    trains = True

    def __init__(self, name: str, network: nn.Module | None, device: str = "cpu"):
        self.name = name
        self.device = device
        self.network = None if network is None else network.to(device)
        self.optimizer = None
        self.parameters = 0 if network is None else count(network)

    def tables(self, people: list[Example]) -> object:
        """The network's input for people, on its device."""
        raise NotImplementedError

    def joints(self, tables: object) -> np.ndarray:
        """Joints (B, J, 3) m."""
        raise NotImplementedError

    def lesson(self, people: list[Example]) -> object:
        """The input that a loader would pass to the training step."""
        raise NotImplementedError

    def loss(self, lesson: object) -> torch.Tensor:
        raise NotImplementedError

    def step(self, lesson: object) -> None:
        """A whole training step, including waiting for the device."""
        if self.optimizer is None:
            self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=1e-3, weight_decay=0.01, fused=True)
        self.optimizer.zero_grad(set_to_none=True)
        with self.precision():
            loss = self.loss(lesson)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), RECIPE.clip)
        self.optimizer.step()
        self.wait()

    def precision(self) -> torch.autocast:
        return torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.device != "cpu")

    def wait(self) -> None:
        if self.device != "cpu":
            torch.cuda.synchronize()

    def train(self, mode: bool) -> None:
        if self.network is not None:
            self.network.train(mode)

    def rest(self) -> None:
        """Frees the gradients, so that the next runner starts with the same memory as this one."""
        if self.network is not None:
            self.network.zero_grad(set_to_none=True)


class Ours(Runner):
    """A network of this package."""

    def __init__(self, size: str, device: str = "cpu"):
        torch.manual_seed(0)
        self.config = SIZES[size]
        self.task = PoseNetObjective(config=self.config)
        super().__init__(size, PoseNet(self.config), device)
        self.mean = {name: value.detach().clone() for name, value in self.network.named_parameters()}
        self.made = None
        self.steps = 0

    def voxelize(self, people: list[Example]):
        view = np.stack([person.view for person in people])
        return voxelize_people([person.points for person in people], view, self.config)

    def tables(self, people):
        return Batch.from_arrays(self.voxelize(people).arrays(), self.device)

    @torch.inference_mode()
    def joints(self, tables):
        return self.network(tables).joints().cpu().numpy()

    def lesson(self, people):
        return self.task.collate(people)

    def step(self, lesson):
        if self.made is None:
            self.made = optimizers(self.network, RECIPE)
        for optimizer in self.made:
            optimizer.zero_grad(set_to_none=True)
        with self.precision():
            terms = self.task.terms(self.network, lesson, device=self.device)
        total(terms).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), RECIPE.clip)
        for optimizer in self.made:
            optimizer.step()
        average(self.mean, self.network, self.steps, RECIPE.ema)
        self.steps += 1
        self.wait()


class Onnx(Runner):
    """A network of this package in ONNX Runtime, as in the predictor: from voxels to decoded joints."""

    trains = False

    def __init__(self, ours: Ours, path: Path, threads: int):
        from lidarpose.inference import backend
        from lidarpose.models import decode, onnx

        super().__init__(f"{ours.name} ONNX", None)
        self.parameters = ours.parameters
        self.voxelize = ours.voxelize
        self.file, self.backend = onnx, backend
        self.session, self.threads = onnx.open_onnx(path)[0], threads
        self.decoder = decode.decoder("window")
        # the predictor does not need the parts, and outputs that are not requested are not computed
        self.outputs = [name for name in onnx.OUTPUTS if name != "part"]

    def tables(self, people):
        parts = [people[rows] for rows in self.backend.person_parts(len(people), self.threads)]
        pyramids = [self.voxelize(part).arrays() for part in parts]
        return [{self.file.input_name(name): array for name, array in arrays.items()} for arrays in pyramids]

    def joints(self, tables):
        return self.decode(self.run(tables))

    def run(self, tables: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
        values = self.file.map_in_threads(lambda arrays: self.session.run(self.outputs, arrays), tables, self.threads)
        return [np.concatenate(arrays) for arrays in zip(*values, strict=True)]

    def decode(self, values: list[np.ndarray]) -> np.ndarray:
        raw = self.backend.Raw.from_pose(dict(zip(self.outputs, values, strict=True)))
        return self.backend.estimates(raw, self.decoder, BODY26).joints


class Session(Onnx):
    """Only the ONNX session: the network time is that of the session's run."""

    def joints(self, tables):
        return self.run(tables)[0]


class Predict(Runner):
    """The public `predict` for one cloud: its checks, two passes, the choice among candidates."""

    trains = False
    batch = 1

    def __init__(self, name: str, predictor, parameters: int):
        super().__init__(name, None)
        self.predictor, self.parameters = predictor, parameters

    def tables(self, people):
        return [person.points for person in people]

    def joints(self, tables):
        return [self.predictor.predict(points) for points in tables]


class Paper(Runner):
    """The paper's network at full size."""

    def __init__(self, device: str = "cpu"):
        from lidarpose.models.dapt.dapt_config import named_config
        from lidarpose.models.dapt.dapt_net import DaptNet, to_tensors
        from lidarpose.models.dapt.voxel_tables import build_tables

        torch.manual_seed(0)
        self.config = named_config("paper")
        super().__init__("paper", DaptNet(self.config), device)
        self.batch = PAPER_BATCH if device == "cpu" else BATCH
        self.layout = "ragged" if device == "cpu" else "padded"
        self.build, self.tensors = build_tables, to_tensors
        self.order = self.config.order_in(BODY26)

    def _tables(self, people: list[Example]):
        return self.build([person.points for person in people], self.config, layout=self.layout)

    def tables(self, people):
        return self.tensors(self._tables(people), self.device)

    @torch.inference_mode()
    def joints(self, tables):
        return self.network(tables).joints().cpu().numpy()[:, self.order]

    def lesson(self, people):
        tables = self._tables(people)
        part = np.concatenate([person.part for person in people])[tables.kept]
        true = np.stack([person.joints for person in people])
        # inverts the order, which maps this skeleton's joints to the network's
        place = np.argsort(self.order)
        return tables, torch.as_tensor(true[:, place]), torch.as_tensor(part, dtype=torch.int64)

    def loss(self, lesson):
        tables, true, part = lesson
        true, part = true.to(self.device), part.to(self.device)
        outputs = self.network(self.tensors(tables, self.device))
        heads = (outputs.joints(), outputs.coordinates, outputs.inter)
        return sum(_distance(joints, true) for joints in heads) + nn.functional.cross_entropy(outputs.parts, part)


class Baseline(Runner):
    """A network of `backbones`."""

    def tables(self, people):
        return self.network.prepare([person.points for person in people])

    @torch.inference_mode()
    def joints(self, tables):
        return self.network(tables).numpy()

    def lesson(self, people):
        return self.tables(people), torch.as_tensor(np.stack([person.joints for person in people]))

    def loss(self, lesson):
        tables, true = lesson
        return _distance(self.network(tables), true)


def _distance(joints: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Mean distance, m, of joints (B, J, 3) m."""
    return (joints.float() - true).norm(dim=-1).mean()


def baselines(size: str) -> dict[str, Callable[[], nn.Module]]:
    """By name, the baselines for a size of our network, with about the same number of parameters."""
    kinds = {"ViT": GroupedViT, "PointNet++": PointNet2}
    parameters = count(PoseNet(SIZES[size]))
    factories = {
        f"{name} as {size}": (lambda kind=kind: kind.of_parameters(parameters)) for name, kind in kinds.items()
    }
    return {DRAFT if size == "small" else f"{DRAFT} as {size}": lambda: Draft.of_parameters(parameters)} | factories


def runner(name: str, device: str = "cpu") -> Runner:
    """A runner by name, except for ONNX and predictor runners. Raises ImportError if its code is missing."""
    if name in NETWORKS:
        return Paper(device) if name == "paper" else Ours(name, device)
    factories = baselines("tiny") | baselines("small")
    torch.manual_seed(0)
    return Baseline(name, factories[name](), device)


def runners_of(options: argparse.Namespace, folder: Path, left_out: list[str]) -> list[Runner]:
    """All runners; for those that cannot run, a reason is added to `left_out`."""
    names = []
    for size in options.sizes:
        names.append(size)
        if size in ("tiny", "small") and options.device == "cpu":
            names += baselines(size)
    runners = []
    for name in names:
        try:
            runners.append(runner(name, options.device))
        except ImportError as error:
            left_out.append(f"{name}: cannot be imported ({error})")
            continue
        if isinstance(runners[-1], Ours) and options.device == "cpu" and not options.no_onnx:
            runners += _from_files(runners[-1], folder, options.threads, left_out)
    return runners


def _from_files(ours: Ours, folder: Path, threads: int, left_out: list[str]) -> Iterator[Runner]:
    """The ONNX runners of a network, and for the smallest one those of the public predictors."""
    weights, path = folder / f"{ours.name}.safetensors", folder / f"{ours.name}.onnx"
    try:
        from lidarpose.models.checkpoint import save_checkpoint
        from lidarpose.models.export import export

        say(f"exporting {ours.name} to ONNX")
        save_checkpoint(weights, ours.network, card={})
        export(weights, path)
        onnx_runner, session_runner = Onnx(ours, path, threads), Session(ours, path, threads)
        session_runner.name += ", session"
        yield from (onnx_runner, session_runner)
    # an exporter or a runtime may raise any exception; the other rows are still useful
    except Exception as error:
        left_out.append(f"{ours.name} ONNX: {reason(error)}")
    if ours.name != "tiny":
        return
    options_by_backend: dict[str, dict] = {"torch": {}, "onnx": {"threads": threads}}
    for backend, options in options_by_backend.items():
        try:
            from lidarpose.inference.predictor import load

            predictor = load(weights, tta=1, backend=backend, **options)
            yield Predict(f"tiny predict(), {backend}", predictor, ours.parameters)
        except Exception as error:
            left_out.append(f"tiny predict(), {backend}: {reason(error)}")


def reason(error: Exception) -> str:
    """An error as text for one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"


def say(line: str) -> None:
    print(f"[{time.strftime('%H:%M:%S')}] {line}", file=sys.stderr, flush=True)
