"""Trains several sizes of the package's own network at once on one GPU, for a given time, each from given weights.

    python tools/train_on_gpu.py OUT --minutes 9 --sizes base small --init small --motion wide_motion.npz --workers 15

`lidarpose pretrain` starts thousands of small kernels one by one in every step, and a GPU waits for them most of the
time. Here the forward and backward pass are CUDA graphs, one for each padded shape, and all sizes learn from the same
batches. Batches also stay in the GPU's memory: if the workers have no new one ready, an older one is shown again,
turned by a quarter turn and mirrored at random, which is exact on the voxel grid. The rates fall to zero at the end of
the given time, so the number of steps depends on the machine. OUT receives SIZE.safetensors (float16), the mean of the
weights, and log.jsonl. `--check` compares the graphs with ordinary steps and measures their times instead.
"""

import argparse
import itertools
import json
import queue
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from lidarpose.models import weights_path
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.config import SIZES
from lidarpose.models.expand import expand_weights
from lidarpose.models.posenet import PoseNet
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import FLIP_PART
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import average, optimizers, rate_factor, set_rates
from lidarpose.train.recipes import Pretrain
from lidarpose.train.scan_people import draw_person, populated_scan

# padded numbers of fine, mid and coarse voxels of a batch; a batch takes the first shape that holds it
SHAPES = (
    *((64, 32, 24), (104, 48, 32), (152, 64, 40), (216, 88, 56), (224, 104, 56), (224, 128, 72), (224, 160, 88)),
    *((224, 208, 128), (224, 224, 224)),
)
# peak rates of AdamW by size
RATES = {"base": 1e-3, "small": 8e-4, "tiny": 8e-4}
# batches of a chunk, whose people are sorted by size; the uses of a whole scan; whole scans that a worker keeps
CHUNK, SCAN_USES, SCANS_KEPT = 8, 24, 64
# batches kept on the GPU, and how many must be there before one is shown again
MOST_KEPT, LEAST_KEPT = 5000, 60


def layout(shape: tuple[int, int, int], people: int) -> list[tuple[str, np.dtype, tuple[int, ...]]]:
    """Name, type and shape of a packed batch's arrays, four-byte types first, so that all are aligned."""
    fine, mid, coarse = ((people, count) for count in shape)
    rows: list[tuple[str, Any, tuple[int, ...]]] = []
    for name, level in (("fine", fine), ("mid", mid), ("coarse", coarse)):
        rows += [(f"{name}.position", np.float32, (*level, 3)), (f"{name}.log_count", np.float32, level)]
        rows += [(f"{name}.parent", np.int16, level), (f"{name}.valid", np.uint8, level)]
        rows += [(f"{name}.neighbors", np.int16, (*level, 27))] if name != "fine" else []
    rows += [(name, np.float32, (*fine, 3)) for name in ("deviation", "offset")]
    rows += [("view", np.float32, (people, 5)), ("joints", np.float32, (people, 26, 3))]
    rows += [("visible", np.float32, (people, 26)), ("person", np.float32, (people, 2)), ("part", np.int16, fine)]
    rows.sort(key=lambda row: -np.dtype(row[1]).itemsize)
    return [(name, np.dtype(kind), size) for name, kind, size in rows]


def pack(arrays: dict[str, np.ndarray], people: int) -> tuple[int, Tensor]:
    """The index of a batch's padded shape, and its arrays in one block of bytes."""
    counts = tuple(arrays[f"{name}.valid"].shape[1] for name in ("fine", "mid", "coarse"))
    index = next(k for k, shape in enumerate(SHAPES) if all(a <= b for a, b in zip(counts, shape, strict=True)))
    parts = []
    for name, kind, shape in layout(SHAPES[index], people):
        value = arrays[name]
        if name.endswith("neighbors"):
            value = np.where(value == value.shape[1], shape[1], value)
        fill = {"part": -1}.get(name, shape[1] if name.endswith("neighbors") else 0)
        padded = np.full(shape, fill, kind)
        padded[tuple(slice(n) for n in value.shape)] = value
        parts.append(padded.reshape(-1).view(np.uint8))
    return index, torch.from_numpy(np.concatenate(parts))


def unpack(block: Tensor, index: int, people: int) -> dict[str, Tensor]:
    """Views into a block."""
    kinds = {"float32": torch.float32, "int16": torch.int16, "uint8": torch.uint8}
    arrays, start = {}, 0
    for name, kind, shape in layout(SHAPES[index], people):
        end = start + int(np.prod(shape)) * kind.itemsize
        arrays[name] = block[start:end].view(kinds[kind.name]).view(shape)
        start = end
    return arrays


class People(IterableDataset):
    """Packed batches without end. Worker w of W makes the people w, w + W, ... of the seed."""

    def __init__(self, options: argparse.Namespace):
        self.batch, self.seed, self.share = options.batch, options.seed, options.whole_scans
        self.source = SyntheticSource(
            scene="wide", seed=options.seed, motion=options.motion, captured=0.6, strays=0.2, noise=0.15, objects=0.08
        )
        self.objective = PoseNetObjective(config=replace(SIZES["small"], person=True))

    def __iter__(self) -> Iterator[tuple[int, Tensor]]:
        info = torch.utils.data.get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        rng = np.random.default_rng([self.seed, worker, 17])
        numbers, scan_numbers = itertools.count(worker, workers), itertools.count(worker, workers)
        scans: list = []
        people = CHUNK * self.batch
        from_scans = round(self.share * people)
        with threadpool_limits(limits=1, user_api="blas"):
            while True:
                for _ in range(-(-from_scans // SCAN_USES)):
                    scans.append(populated_scan(self.seed, next(scan_numbers)))
                del scans[: max(len(scans) - SCANS_KEPT, 0)]
                examples = [draw_person(scans[rng.integers(len(scans))], rng) for _ in range(from_scans)]
                examples += [self.source.example(next(numbers)) for _ in range(people - from_scans)]
                examples.sort(key=lambda e: e.size)
                for k in rng.permutation(CHUNK):
                    batch = examples[k * self.batch : (k + 1) * self.batch]
                    yield pack(self.objective.collate(batch), self.batch)


# ---- quarter turns about z, and a mirror at the plane of x and z: the eight symmetries of the grid


@cache
def symmetries(device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Matrices (8, 3, 3), permutations (8, 27) of neighbors, (8, 26) of joints and (8, 26) of 1 + the part."""
    matrices, neighbors, joints, parts = [], [], [], []
    cells = np.stack(np.meshgrid(*3 * [np.arange(-1, 2)], indexing="ij"), -1).reshape(27, 3)
    for mirror in (1, -1):
        for turn in range(4):
            cos, sin = (1, 0, -1, 0)[turn], (0, 1, 0, -1)[turn]
            R = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.diag([1, mirror, 1])
            matrices.append(R)
            # the neighbor now at a cell was at the cell turned back
            neighbors.append(((cells @ R + 1) @ np.array([9, 3, 1])).astype(int))
            joints.append(list(BODY26.flip) if mirror < 0 else list(range(26)))
            parts.append(FLIP_PART.tolist() if mirror < 0 else list(range(-1, len(FLIP_PART) - 1)))
    return (
        torch.tensor(np.array(matrices), dtype=torch.float32, device=device),
        torch.tensor(np.array(neighbors), device=device),
        torch.tensor(joints, device=device),
        torch.tensor(parts, device=device),
    )


def transformed(arrays: dict[str, Tensor], which: Tensor) -> dict[str, Tensor]:
    """The batch with symmetry `which` (B,) of each person applied."""
    matrices, neighbors, joints, parts = (table[which] for table in symmetries(which.device))
    transposed = matrices.transpose(1, 2)
    out = dict(arrays)
    for name in ("fine.position", "mid.position", "coarse.position", "offset"):
        out[name] = arrays[name] @ transposed
    out["deviation"] = arrays["deviation"] @ transposed.abs()
    out["view"] = torch.cat([(arrays["view"][:, None, :3] @ transposed)[:, 0], arrays["view"][:, 3:]], 1)
    for name in ("mid.neighbors", "coarse.neighbors"):
        out[name] = arrays[name].gather(2, neighbors[:, None].expand(arrays[name].shape))
    turned = arrays["joints"] @ transposed
    out["joints"] = turned.gather(1, joints[..., None].expand(turned.shape))
    out["visible"] = arrays["visible"].gather(1, joints)
    out["part"] = parts.gather(1, arrays["part"].long() + 1)
    return out


class Inputs:
    """The tensors that the graphs of one shape read."""

    def __init__(self, index: int, people: int, device: torch.device):
        self.tensors: dict[str, Tensor] = {}
        for name, kind, shape in layout(SHAPES[index], people):
            dtype = torch.float32 if kind == np.float32 else torch.bool if kind == np.uint8 else torch.int64
            self.tensors[name] = torch.zeros(shape, dtype=dtype, device=device)
        self.tensors["known"] = torch.zeros((people, 26), dtype=torch.bool, device=device)

    def fill(self, arrays: dict[str, Tensor]) -> None:
        for name, value in arrays.items():
            self.tensors[name].copy_(value)
        self.tensors["known"].copy_(~arrays["joints"].isnan().any(-1))

    def fill_randomly(self) -> None:
        """Plausible values, to record graphs with."""
        for name, value in self.tensors.items():
            if value.dtype == torch.float32:
                value.uniform_(-0.9, 0.9)
            elif name.endswith("neighbors"):
                value.random_(0, value.shape[1] + 1)
            else:
                value.fill_(1)


class Student:
    """A network in training: its optimizers, the mean of its weights, and a graph for each shape."""

    def __init__(self, network: PoseNet, recipe: Pretrain, device: torch.device):
        self.network = network.to(device).train()
        self.objective = PoseNetObjective(config=network.config)
        self.parameters = list(self.network.parameters())
        self.mean = {name: value.detach().clone() for name, value in self.network.named_parameters()}
        self.recipe, self.optimizers = recipe, optimizers(self.network, recipe)
        self.graphs: dict[int, tuple[torch.cuda.CUDAGraph, list[Tensor], Tensor]] = {}
        self.names: list[str] = []
        self.steps = 0

    def gradients(self, inputs: Inputs) -> Tensor:
        """Computes the clipped gradients; returns the loss terms and the gradient's norm."""
        for parameter in self.parameters:
            parameter.grad = None
        terms = self.objective.terms(self.network, inputs.tensors, device=next(iter(inputs.tensors.values())).device)
        loss = total(terms)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.recipe.clip, foreach=True)
        self.names = [*terms, "gradient"]
        return torch.stack([value.detach().float() for value in terms.values()] + [norm.detach()])

    def record(self, index: int, inputs: Inputs, pool: Any) -> None:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(2):
                self.gradients(inputs)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        for parameter in self.parameters:
            parameter.grad = None
        with torch.cuda.graph(graph, pool=pool):
            terms = self.gradients(inputs)
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        assert len(gradients) == len(self.parameters)
        self.graphs[index] = graph, gradients, terms

    def step(self, index: int, inputs: Inputs, factor: float) -> Tensor:
        """Takes a step at a share `factor` of the peak rates; returns what `gradients` does."""
        if self.graphs:
            graph, gradients, terms = self.graphs[index]
            graph.replay()
            for parameter, gradient in zip(self.parameters, gradients, strict=True):
                parameter.grad = gradient
        else:
            terms = self.gradients(inputs)
        set_rates(self.optimizers, self.recipe, factor)
        for optimizer in self.optimizers:
            optimizer.step()
        average(self.mean, self.network, self.steps, self.recipe.ema)
        self.steps += 1
        return terms

    def save(self, path: Path, card: dict) -> None:
        network = PoseNet(self.network.config)
        network.load_state_dict({k: v.cpu() for k, v in (self.network.state_dict() | self.mean).items()})
        save_checkpoint(path, network, card=card, half=True)


class Feeder(threading.Thread):
    """Copies the workers' batches to the GPU."""

    def __init__(self, batches: Iterator[tuple[int, Tensor]], device: torch.device):
        super().__init__(daemon=True)
        self.batches, self.device = batches, device
        self.ready: queue.Queue = queue.Queue(maxsize=64)

    def run(self) -> None:
        stream = torch.cuda.Stream() if self.device.type == "cuda" else None
        for index, block in self.batches:
            if stream is None:
                self.ready.put((index, block))
                continue
            with torch.cuda.stream(stream):
                copied = block.to(self.device)
                stream.synchronize()
            self.ready.put((index, copied))


def options_of(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=9.0, help="time of training, the recording of graphs included")
    parser.add_argument("--sizes", nargs="+", default=["base", "small"], choices=RATES)
    parser.add_argument(
        "--rates", nargs="+", type=float, help=f"of AdamW, for each size (default: {RATES}); Muon has ten times them"
    )
    parser.add_argument("--init", default="small")
    parser.add_argument("--motion")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--whole-scans", type=float, default=0.3)
    parser.add_argument("--cool", type=float, default=0.9)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=15)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args(words)
    if options.rates is None:
        options.rates = [RATES[size] for size in options.sizes]
    if len(options.rates) != len(options.sizes):
        parser.error(f"--rates needs one number for each of {len(options.sizes)} sizes, got {len(options.rates)}")
    return options


def command_of(options: argparse.Namespace) -> str:
    """The command of a run, without paths of this machine."""
    values = {
        name: value for name, value in vars(options).items() if name not in ("out", "check") and value is not None
    }
    values |= {name: Path(values[name]).name for name in ("motion", "init") if name in values}
    words = [
        f"--{name.replace('_', '-')} {' '.join(map(str, value)) if isinstance(value, list) else value}"
        for name, value in values.items()
    ]
    return " ".join(["python tools/train_on_gpu.py OUT", *words])


def main() -> None:
    options = options_of()
    began = time.monotonic()
    options.out.mkdir(parents=True, exist_ok=True)
    device = torch.device(options.device)
    torch.set_float32_matmul_precision("high")
    torch.manual_seed(options.seed)
    # the workers begin before the GPU is used
    people = People(options)
    batches = iter(
        DataLoader(
            people, batch_size=None, num_workers=options.workers, prefetch_factor=12 if options.workers else None
        )
    )
    trained, header = load_checkpoint(weights_path(options.init))
    recipes = [
        Pretrain(size=size, rate=rate, muon_rate=10 * rate, cool=options.cool)
        for size, rate in zip(options.sizes, options.rates, strict=True)
    ]
    students = [
        Student(expand_weights(trained, replace(SIZES[recipe.size], person=True)), recipe, device) for recipe in recipes
    ]
    inputs = [Inputs(index, options.batch, device) for index in range(len(SHAPES))]
    if options.check:
        check(students, inputs, batches, options, device)
        return
    if device.type == "cuda":
        record(students, inputs)
    print(f"ready after {time.monotonic() - began:.0f} s", flush=True)
    feeder = Feeder(batches, device)
    feeder.start()
    train(students, inputs, feeder, options, device, began, header.card)


def record(students: list[Student], inputs: list[Inputs]) -> None:
    pool = torch.cuda.graph_pool_handle()
    # the largest first: the others then fit into its memory
    for index in reversed(range(len(SHAPES))):
        inputs[index].fill_randomly()
        for student in students:
            student.record(index, inputs[index], pool)
    torch.cuda.synchronize()


def train(
    students: list[Student],
    inputs: list[Inputs],
    feeder: Feeder,
    options: argparse.Namespace,
    device: torch.device,
    began: float,
    init_card: dict,
) -> None:
    rng = np.random.default_rng(options.seed)
    kept: list[tuple[int, Tensor]] = []
    fresh = step = 0
    start, end = time.monotonic(), began + 60 * options.minutes
    sums: list[Tensor] = []
    save_time = log_time = start
    with open(options.out / "log.jsonl", "a") as log:
        while (now := time.monotonic()) < end:
            try:
                index, block = feeder.ready.get(block=len(kept) < LEAST_KEPT)
                fresh += 1
                if len(kept) < MOST_KEPT:
                    kept.append((index, block))
                else:
                    place = int(rng.integers(len(kept)))
                    if device.type == "cuda":
                        kept[place][1].record_stream(torch.cuda.current_stream())
                    kept[place] = index, block
            except queue.Empty:
                index, block = kept[int(rng.integers(len(kept)))]
            arrays = unpack(block, index, options.batch)
            which = torch.randint(8, (options.batch,), device=device)
            inputs[index].fill(transformed(arrays, which))
            # the share of the time that has passed stands for the share of the run
            factor = rate_factor((now - start) / (end - start), students[0].recipe)
            terms = [student.step(index, inputs[index], factor).clone() for student in students]
            sums.append(
                torch.stack([t[student.names.index("mpjpe")] for t, student in zip(terms, students, strict=True)])
            )
            step += 1
            if step % 100 == 0:
                errors = (torch.stack(sums).mean(0) * 1e3).tolist()
                sums = []
                if not np.isfinite(errors).all():
                    sys.exit(f"the loss is not finite after {step} steps")
                entry = {"steps": step, "seconds": round(now - start, 1), "fresh": fresh, "factor": round(factor, 4)}
                entry |= {f"mpjpe_{size}": round(error, 2) for size, error in zip(options.sizes, errors, strict=True)}
                log.write(json.dumps(entry) + "\n")
                log.flush()
                if now - log_time > 10:
                    print(json.dumps(entry), flush=True)
                    log_time = now
            if now - save_time > 120:
                save(students, options, step, fresh, now - start, init_card)
                save_time = now
    save(students, options, step, fresh, time.monotonic() - start, init_card)
    print(f"{step} steps, {fresh * options.batch:,} people, {time.monotonic() - began:.0f} s", flush=True)


def save(
    students: list[Student], options: argparse.Namespace, step: int, fresh: int, seconds: float, init_card: dict
) -> None:
    recipe = {"seed": options.seed, "batch": options.batch}
    card = {"command": command_of(options), "recipe": recipe, "people_seen": fresh * options.batch}
    card |= {
        "shown": step * options.batch,
        "hours": round(seconds / 3600, 3),
        "motion": Path(options.motion or "").name,
    }
    for size, student in zip(options.sizes, students, strict=True):
        own = {"recipe": recipe | {"size": size, "init": options.init}, "init_card": init_card}
        student.save(options.out / f"{size}.safetensors", card | own)


def check(
    students: list[Student], inputs: list[Inputs], batches: Iterator, options: argparse.Namespace, device: torch.device
) -> None:
    """Prints the times of steps with and without graphs, their differences, and the workers' speed."""
    start = time.monotonic()
    seen: dict[int, Tensor] = {}
    counts = [0] * len(SHAPES)
    while sum(counts) < 3 * CHUNK:
        index, block = next(batches)
        counts[index] += 1
        seen[index] = block
    print(f"first chunks after {time.monotonic() - start:.1f} s, batches of each shape {counts}", flush=True)
    identity = torch.zeros(options.batch, dtype=torch.int64, device=device)
    ordinary: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def fill(index: int) -> None:
        inputs[index].fill(transformed(unpack(seen[index].to(device), index, options.batch), identity))

    for index in seen:
        fill(index)
        for s, student in enumerate(students):
            student.gradients(inputs[index])
            torch.cuda.synchronize()
            start = time.perf_counter()
            terms = student.gradients(inputs[index]).clone()
            torch.cuda.synchronize()
            milliseconds = 1e3 * (time.perf_counter() - start)
            ordinary[s, index] = terms, torch.cat([p.grad.flatten() for p in student.parameters])
            print(f"shape {index} {options.sizes[s]}: ordinary {milliseconds:.1f} ms, {terms.tolist()}", flush=True)
    start = time.monotonic()
    record(students, inputs)
    print(f"recorded in {time.monotonic() - start:.1f} s, {torch.cuda.max_memory_allocated() / 1e9:.1f} GB", flush=True)
    for index in seen:
        for s, student in enumerate(students):
            fill(index)
            graph, gradients, terms = student.graphs[index]
            graph.replay()
            torch.cuda.synchronize()
            start = time.perf_counter()
            for _ in range(5):
                graph.replay()
            torch.cuda.synchronize()
            milliseconds = 200 * (time.perf_counter() - start)
            old_terms, old_gradient = ordinary[s, index]
            gradient = torch.cat([g.flatten() for g in gradients])
            difference = float((gradient - old_gradient).norm() / old_gradient.norm())
            terms_difference = float((terms - old_terms).abs().max())
            print(
                f"shape {index} {options.sizes[s]}: graph {milliseconds:.1f} ms, "
                f"difference of terms {terms_difference:.2e}, of gradients {difference:.2e}",
                flush=True,
            )
    for s, student in enumerate(students):
        index = next(iter(seen))
        student.step(index, inputs[index], 0.0)
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(10):
            student.step(index, inputs[index], 0.0)
        queued = time.perf_counter() - start
        torch.cuda.synchronize()
        total_time = time.perf_counter() - start
        print(f"{options.sizes[s]}: a step takes {100 * total_time:.1f} ms, {100 * queued:.1f} to queue", flush=True)
    start, count = time.monotonic(), 0
    while time.monotonic() - start < 15:
        next(batches)
        count += 1
    print(f"workers: {count * options.batch / (time.monotonic() - start):.0f} people a second", flush=True)


if __name__ == "__main__":
    main()
