"""Speed and memory of the network, compared with a plain transformer, a PointNet++ and the package's first draft.

    python benchmarks/network.py                  # about half an hour on two cores; Markdown on standard output
    python benchmarks/network.py --quick          # a quick trial of everything, minutes
    python benchmarks/network.py --device cuda    # training in bfloat16; no ONNX, no baselines

Legend: B people per call, n points per person, J joints.

All compared networks run in one process and take turns, round after round; cells give the best round and the median.
Quote ratios: they also hold on other machines, and mostly on busy ones. Timed are:

- latency: one person, from centered points to joints, including the computation of the tables (voxels, groups);
- forward: the same for B people, and also the network alone;
- training: a step on tables computed before, as other processes do in the training loop: forward, losses, backward,
  gradient clipping, optimizers, running mean of the weights. Baselines and the paper's network use AdamW on the mean
  distance of the joints (for the paper's: of all heads that predict joints, plus the loss of the parts).

People are from the generator's scene `wild`, resampled to exactly n points; "crops" are people with their own number of
points, 170 in the median, sorted into batches as in training. Weights are random, since times do not depend on them.
"""

import argparse
import json
import math
import multiprocessing
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from network_report import CROPS, Key, Report, Times
from runners import (
    BATCH,
    DRAFT,
    NETWORKS,
    PAPER_BATCH,
    Example,
    Runner,
    Session,
    batches,
    crops,
    of_points,
    reason,
    runner,
    runners_of,
    say,
)
from threadpoolctl import threadpool_limits

from lidarpose.train.data_loader import BATCHES

SECTIONS = ("latency", "forward", "training", "scaling", "memory")
POINTS, SCALING_POINTS = (128, 256, 512, 1024), (128, 256, 512, 1024, 2048)
SCALING_PEOPLE, SCALING_PEOPLE_CUDA = (1, 4, 16, 64), (1, 16, 64, 256, 1024)
# duration of a turn, s, maximum number of calls in it, and pause between turns, s, in which other threads become idle
TURN, MOST_TIMES, REST = 0.15, 20, 0.02
# s; jobs that take longer are run only every second round
SLOW = 5.0
# number of people for the latency, one after the other, since people differ in voxels
ALONE = 8


@dataclass(frozen=True)
class Job:
    """A job to time: `run` returns the seconds of the network alone."""

    key: Key
    runner: Runner
    run: Callable[[], float]


def forward_job(section: str, one: Runner, points: int | str, calls: list[list[Example]]) -> Job:
    def run() -> float:
        network_seconds = 0.0
        for people in calls:
            tables = one.tables(people)
            start = time.perf_counter()
            one.joints(tables)
            network_seconds += time.perf_counter() - start
        return network_seconds

    return Job(Key(section, one.name, points, sum(map(len, calls))), one, run)


def training_job(section: str, one: Runner, points: int | str, calls: list[list[Example]]) -> Job:
    lessons = [one.lesson(people) for people in calls]

    def run() -> float:
        start = time.perf_counter()
        for lesson in lessons:
            one.step(lesson)
        return time.perf_counter() - start

    return Job(Key(section, one.name, points, sum(map(len, calls))), one, run)


def measure(jobs: list[Job], rounds: int, left_out: list[str]) -> Times:
    """Seconds of each job's calls, in total and of the network alone; in each round all jobs take turns."""
    repeats, slow_keys, times = {}, set(), defaultdict(list)
    for number, job in enumerate(jobs):
        say(f"warming up {job.key.section} {number + 1}/{len(jobs)}: {job.key.network}, {job.key.points}")
        try:
            # the first call allocates memory, so the second one is timed
            first = _turn(job, 1)[0][0]
            seconds = first if first > 1 else _turn(job, 1)[0][0]
            repeats[job.key] = min(max(math.ceil(TURN / seconds), 1), MOST_TIMES)
            if seconds > SLOW:
                slow_keys.add(job.key)
        except Exception as error:
            left_out.append(f"{job.key.section} of {job.key.network} at {job.key.points}: {reason(error)}")
    for number in range(rounds):
        say(f"{jobs[0].key.section if jobs else 'nothing'}: round {number + 1} of {rounds}")
        for job in jobs:
            if job.key in repeats and not (job.key in slow_keys and number % 2):
                # with several calls, the first is dropped: the caches still hold data of another network
                num_extra = repeats[job.key] > 1
                times[job.key] += _turn(job, repeats[job.key] + num_extra)[num_extra:]
    return dict(times)


def _turn(job: Job, calls: int) -> list[tuple[float, float]]:
    job.runner.train(job.key.section.endswith("training"))
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        network_seconds = job.run()
        times.append((time.perf_counter() - start, network_seconds))
    job.runner.rest()
    time.sleep(REST)
    return times


def measured(made: list[Runner], options: argparse.Namespace, left_out: list[str]) -> Times:
    """All requested times."""
    if not made:
        return {}
    rng = np.random.default_rng(0)
    max_batch = max(timed_runner.batch for timed_runner in made)
    number = 2 if options.quick else BATCHES
    say("making people")
    with threadpool_limits(limits=1, user_api="blas"):
        pool = crops(max_batch * number, rng)
    clouds = {n: of_points(pool, n, max_batch, rng) for n in sorted({*options.points, *options.scaling_points})}
    times: Times = {}
    if "latency" in options.sections:
        jobs = [
            forward_job("latency", timed_runner, n, [[person] for person in clouds[n][:ALONE]])
            for n in options.points
            for timed_runner in made
        ]
        times |= measure(jobs, 2 * options.rounds, left_out)
    if "forward" in options.sections:
        jobs = []
        for n in (*options.points, CROPS):
            for timed_runner in made:
                if timed_runner.batch > 1 and not isinstance(timed_runner, Session):
                    calls = (
                        batches(pool, timed_runner.batch, number) if n == CROPS else [clouds[n][: timed_runner.batch]]
                    )
                    jobs.append(forward_job("forward", timed_runner, n, calls))
        times |= measure(jobs, options.rounds, left_out)
    if "training" in options.sections:
        jobs = []
        for n in (*options.points, CROPS):
            for timed_runner in made:
                if timed_runner.trains:
                    calls = (
                        batches(pool, timed_runner.batch, number) if n == CROPS else [clouds[n][: timed_runner.batch]]
                    )
                    jobs.append(training_job("training", timed_runner, n, calls))
        times |= measure(jobs, options.rounds, left_out)
    if "scaling" in options.sections and made and made[0].name == "tiny":
        for section, make in (("scaling forward", forward_job), ("scaling training", training_job)):
            jobs = [
                make(section, made[0], n, [[clouds[n][k % max_batch] for k in range(people)]])
                for n in options.scaling_points
                for people in options.scaling_people
            ]
            times |= measure(jobs, options.rounds, left_out)
    return times


def memory(options: argparse.Namespace, left_out: list[str]) -> list[dict]:
    """Peak memory of training steps in bytes, each network in its own process."""
    names = [name for size in options.sizes for name in ([size, DRAFT] if size == "small" else [size])]
    names = names if options.device == "cpu" else [name for name in names if name != DRAFT]
    rng = np.random.default_rng(0)
    number = 2 if options.quick else BATCHES
    pool = crops(BATCH * number, rng)
    rows = []
    context = multiprocessing.get_context("spawn")
    for name in names:
        batch = PAPER_BATCH if name == "paper" and options.device == "cpu" else BATCH
        # for crops, the batch with the most voxels
        people_by_points = {n: of_points(pool, n, batch, rng) for n in options.points[-2:]}
        people_by_points[CROPS] = batches(pool, batch, number)[-1]
        for points, people in people_by_points.items():
            say(f"memory of {name}, {points}")
            queue = context.SimpleQueue()
            process = context.Process(target=_memory_of_steps, args=(name, people, options, queue))
            process.start()
            process.join()
            if queue.empty():
                left_out.append(f"memory of {name} at {points}: its process ended with {process.exitcode}")
                continue
            result = queue.get()
            if "error" in result:
                left_out.append(f"memory of {name} at {points}: {result['error']}")
            else:
                rows.append({"network": name, "points": points, "people": len(people)} | result)
    return rows


def _memory_of_steps(name: str, people: list[Example], options: argparse.Namespace, queue) -> None:
    """Runs three training steps; puts the bytes before the network is created and at the peak into the queue."""
    torch.set_num_threads(options.threads)
    try:
        bytes_before = resident()
        timed_runner = runner(name, options.device)
        lesson = timed_runner.lesson(people)
        timed_runner.train(True)
        for _ in range(3):
            timed_runner.step(lesson)
        memory_bytes = {"before": bytes_before, "peak": peak()}
        if options.device != "cpu":
            memory_bytes |= {"device_peak": torch.cuda.max_memory_allocated()}
        queue.put(memory_bytes)
    except Exception as error:
        queue.put({"error": reason(error)})


def resident() -> int:
    """Resident bytes of this process now, or the peak if the system does not report it."""
    return _status("VmRSS") or peak()


def peak() -> int:
    """Peak resident bytes of this process.

    Read from /proc if available, since getrusage on Linux also counts the process that started this one.
    """
    kilobytes = 1 if sys.platform == "darwin" else 1024
    return _status("VmHWM") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobytes


def _status(entry: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{entry}:")), 0)


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=_whole, default=2, help="of torch and ONNX Runtime (default 2)")
    parser.add_argument("--rounds", type=_whole, help="turns of everything (default 5)")
    parser.add_argument("--quick", action="store_true", help="2 rounds, 128 and 512 points, fewer crops: a trial")
    parser.add_argument("--sizes", nargs="+", choices=NETWORKS, default=list(NETWORKS), help="networks to measure")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--no-onnx", action="store_true", help="without ONNX, whose export takes a minute")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write medians and best rounds, as `results.py` reads them"
    )
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no such device here")
    if options.json is not None and not options.json.resolve().parent.is_dir():
        parser.error(f"--json: the folder {options.json.resolve().parent} does not exist")
    # each size once, in the order of NETWORKS
    options.sizes = [size for size in NETWORKS if size in options.sizes]
    options.rounds = options.rounds or (2 if options.quick else 5)
    options.points = (128, 512) if options.quick else POINTS
    options.scaling_points = (128, 512) if options.quick else SCALING_POINTS
    options.scaling_people = SCALING_PEOPLE if options.device == "cpu" else SCALING_PEOPLE_CUDA
    return options


def _whole(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def main() -> None:
    options = parsed()
    torch.set_num_threads(options.threads)
    left_out: list[str] = []
    # memory first, while this process is small and none of its threads is busy
    memory_rows = memory(options, left_out) if "memory" in options.sections else []
    with tempfile.TemporaryDirectory() as folder:
        runners = runners_of(options, Path(folder), left_out)
        times = measured(runners, options, left_out) if set(options.sections) - {"memory"} else {}
    report = Report(options, runners, times, memory_rows, left_out)
    if options.json is not None:
        options.json.write_text(json.dumps(report.to_json(), default=str, indent=1) + "\n")
    print(report.write())


if __name__ == "__main__":
    main()
