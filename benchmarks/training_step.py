"""Where the time of training goes: a person made, and a step's forward, backward and optimizer, in milliseconds.

    python benchmarks/training_step.py --threads 1

Quote ratios of one run, not the times themselves.
"""

import argparse
import time

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from lidarpose.models.config import preset
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
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    recipe, config = Pretrain(), preset("tiny")
    generator = Generator(scene=scene_config("wild"), measure=False)
    generator.person(0, 0)
    made_in: dict[int, list[float]] = {1: [], 2: []}
    for seed in range(1, ROUNDS + 1):
        for blas, times in made_in.items():
            with threadpool_limits(limits=blas, user_api="blas"):
                started = time.perf_counter()
                people = [generator.person(10 * seed + blas, i) for i in range(options.people)]
                times.append((time.perf_counter() - started) / len(people) * 1e3)
    for blas, times in made_in.items():
        print(f"a person made, {blas} BLAS threads: {np.median(times):.2f} ms")
    rng = np.random.default_rng(0)
    arrays = PoseNetObjective(config=config).collate([example(person.sample, rng) for person in people])
    batch = Batch.from_arrays(arrays)
    targets = Targets.from_arrays(arrays)
    network = PoseNet(config)
    made = optimizers(network, recipe)
    rows = []
    for _ in range(ROUNDS + 1):
        times = [time.perf_counter()]
        loss = total(losses(network(batch), targets))
        times.append(time.perf_counter())
        loss.backward()
        times.append(time.perf_counter())
        for optimizer in made:
            optimizer.step()
            times.append(time.perf_counter())
            optimizer.zero_grad()
        rows.append(np.diff(times) * 1e3)
    names = ["forward and loss", "backward", *(type(optimizer).__name__ for optimizer in made)]
    # the first round warms up
    for name, value in zip(names, np.min(rows[1:], axis=0), strict=True):
        print(f"{name}: {value:.1f} ms a step of {options.people} people")


if __name__ == "__main__":
    main()
