"""People per second of each network, in a training step and in inference, on people synthesized for training.

    python benchmarks/baselines.py prn lpformer dapt paper-small ours lidarcap ne --threads 1
    python benchmarks/baselines.py prn dapt lidarcap ne --precision bf16     # training steps as with `--precision bf16`

Names are model names or sizes. For networks that read clips, each frame counts as a person. Times are this process's
processor time, on which other programs have little influence; with several threads, time on the clock of a machine that
should have no other work. Quote ratios within one run.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from lidarpose.train.augment import ClipExample
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.networks import PRETRAINED
from lidarpose.train.objectives.objective import total
from lidarpose.train.optim import optimizers
from lidarpose.train.recipes import MODELS, Pretrain, model_of_size, recipe, recipe_of_model
from lidarpose.train.setup import objective_of

ROUNDS = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=list(MODELS), metavar="MODEL")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--people", type=int, default=16, help="a batch")
    parser.add_argument("--precision", choices=("float32", "bf16"), default="float32", help="of training steps")
    options = parser.parse_args()
    is_bf16 = options.precision == "bf16"
    torch.set_num_threads(options.threads)
    source = SyntheticSource(scene="wild", seed=0)
    # training sorts people by size, so the people of a batch have similar sizes
    people = sorted(map(source.example, range(4 * options.people)), key=lambda example: len(example.points))
    people = people[2 * options.people : 3 * options.people]
    print(f"{np.mean([len(example.points) for example in people]):.0f} points a person")
    for name in options.models:
        model = model_of_size(name) or name
        size = "" if model == name else name
        recipe_name = recipe_of_model(Pretrain, model)
        settings = recipe(Pretrain, recipe_name, model=model, size=size)
        config = PRETRAINED[settings.size][0]
        frames = getattr(config, "frames", 1)
        examples = people if frames == 1 else clips(source, options.people // frames)
        configs = [config, replace(config, grid=32)] if size == "" and model == "lpformer" else [config]
        for config in configs:
            objective = objective_of(config, settings)
            network = objective.network()
            network_optimizers, arrays = optimizers(network, settings), objective.collate(examples)

            def step(
                objective=objective, network=network, network_optimizers=network_optimizers, arrays=arrays
            ) -> None:
                with torch.autocast("cpu", torch.bfloat16, enabled=is_bf16):
                    loss = total(objective.terms(network.train(), arrays))
                loss.backward()
                for optimizer in network_optimizers:
                    optimizer.step()
                    optimizer.zero_grad()

            def inference(objective=objective, network=network, arrays=arrays) -> None:
                objective.joints(network.eval(), arrays)

            clock = time.process_time if options.threads == 1 else time.perf_counter
            rates = [len(examples) * frames / _seconds(task, clock) for task in (step, inference)]
            name = f"{settings.size}, {config.grid}^3" if model == "lpformer" else settings.size
            print(f"{name:20} training {rates[0]:8.2f} people/s, inference {rates[1]:8.2f}", flush=True)


def clips(source: SyntheticSource, count: int) -> list[ClipExample]:
    """`count` synthesized clips, at least one."""
    examples = [source.clip(index, trans_center=False) for index in range(max(count, 1))]
    points = [len(frame.points) for clip in examples for frame in clip.frames]
    print(f"{len(examples)} clips, {np.mean(points):.0f} points a frame")
    return examples


def _seconds(task: Callable[[], None], clock: Callable[[], float]) -> float:
    """Seconds of the fastest of `ROUNDS` rounds, after a warm-up."""
    task()
    times = []
    for _ in range(ROUNDS):
        start = clock()
        task()
        times.append(clock() - start)
    return min(times)


if __name__ == "__main__":
    main()
