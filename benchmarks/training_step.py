"""Parts of the training time in milliseconds: generating a person, and forward, backward and optimizers of a step,
alternately in float32 and bf16.

    python benchmarks/training_step.py --threads 1 --size small

Quote ratios within one run, not absolute times.
"""

import argparse
import time

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from lidarpose.models.config import SIZES
from lidarpose.models.posenet import Batch, PoseNet, Targets
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.train.augment import example
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import PoseNetObjective, losses
from lidarpose.train.optim import optimizers
from lidarpose.train.recipes import Pretrain

ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--people", type=int, default=64)
    parser.add_argument("--size", choices=SIZES, default="tiny")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    config = SIZES[options.size]
    generator = Generator(scene=scene_config("wild"), measure=False)
    generator.person(0, 0)
    times_by_threads: dict[int, list[float]] = {1: [], 2: []}
    for seed in range(1, ROUNDS + 1):
        for blas, times in times_by_threads.items():
            with threadpool_limits(limits=blas, user_api="blas"):
                start = time.perf_counter()
                people = [generator.person(10 * seed + blas, i) for i in range(options.people)]
                times.append((time.perf_counter() - start) / len(people) * 1e3)
    for blas, times in times_by_threads.items():
        print(f"a person made, {blas} BLAS threads: {np.median(times):.2f} ms")
    rng = np.random.default_rng(0)
    arrays = PoseNetObjective(config=config).collate([example(person.sample, rng) for person in people])
    batch = Batch.from_arrays(arrays)
    targets = Targets.from_arrays(arrays)
    networks = {}
    for precision in ("float32", "bf16"):
        network = PoseNet(config)
        networks[precision] = network, optimizers(network, Pretrain(size=options.size))
    rows: dict[str, list[np.ndarray]] = {precision: [] for precision in networks}
    for _ in range(ROUNDS + 1):
        for precision, (network, network_optimizers) in networks.items():
            times = [time.perf_counter()]
            with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
                loss = total(losses(network(batch), targets))
            times.append(time.perf_counter())
            loss.backward()
            times.append(time.perf_counter())
            for optimizer in network_optimizers:
                optimizer.step()
                times.append(time.perf_counter())
                optimizer.zero_grad()
            rows[precision].append(np.diff(times) * 1e3)
    names = ["forward and loss", "backward", *(type(optimizer).__name__ for optimizer in network_optimizers)]
    # the first round is the warm-up
    best_times = {precision: np.min(values[1:], axis=0) for precision, values in rows.items()}
    for name, single, half in zip(names, *best_times.values(), strict=True):
        print(f"{name}: {single:.1f} ms a step of {options.people} people, {half:.1f} in bf16")
    single, half = (values.sum() for values in best_times.values())
    print(f"a step in float32 takes {single / half:.2f} times as long as in bf16")


if __name__ == "__main__":
    main()
