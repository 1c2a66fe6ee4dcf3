"""Speed of the generator in people per second, from pose to packed points, and its memory.

    python benchmarks/generator.py [--people 2048] [--rounds 3] [--scenes paper wild]

Each scene is timed in one process, then in two concurrent processes that generate different people of the same seed;
the rounds alternate. Figures are people per second of wall time in the best round; "x one" is the rate of two processes
divided by that of one. Each process uses one core: BLAS and numba are limited to one thread. The first block of each
process is the warm-up.
"""

import argparse
import multiprocessing
import os
import resource
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from lidarpose.synth.generator import BLOCK, Generator  # noqa: E402 - after the threads are limited
from lidarpose.synth.scene import scene_config  # noqa: E402


def work(scene, first, people, ready, go, out):
    generator = Generator(scene=scene_config(scene), measure=False)
    for index in range(BLOCK):
        generator.person(0, index)
    ready.release()
    go.wait()
    start = time.perf_counter()
    points = sum(len(generator.person(0, index).sample.points) for index in range(first, first + people))
    stop = time.perf_counter()
    # ru_maxrss is in kilobytes on Linux
    out.put((start, stop, points, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def rate(scene, people, processes):
    """People per second of all processes together, mean points per person, MiB of the largest process."""
    context = multiprocessing.get_context("spawn")
    ready, go, out = context.Semaphore(0), context.Event(), context.Queue()
    workers = [
        context.Process(target=work, args=(scene, BLOCK + k * people, people, ready, go, out)) for k in range(processes)
    ]
    for process in workers:
        process.start()
    for _ in workers:
        ready.acquire()
    go.set()
    results = [out.get() for _ in workers]
    for process in workers:
        process.join()
    # perf_counter is the same clock in all processes of the machine
    seconds = max(result[1] for result in results) - min(result[0] for result in results)
    return (
        processes * people / seconds,
        sum(result[2] for result in results) / (processes * people),
        max(result[3] for result in results),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=2048, help="a process")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scenes", nargs="+", default=["paper", "wild"])
    arguments = parser.parse_args()
    best = {}
    for _ in range(arguments.rounds):
        for scene in arguments.scenes:
            for processes in (1, 2):
                result = rate(scene, arguments.people, processes)
                if result[0] > best.get((scene, processes), (0,))[0]:
                    best[scene, processes] = result
    print(f"{'scene':10s}{'one core':>12s}{'ms':>8s}{'two cores':>12s}{'x one':>8s}{'points':>9s}{'MiB':>7s}")
    for scene in arguments.scenes:
        (one, points, memory), (two, _, _) = best[scene, 1], best[scene, 2]
        print(f"{scene:10s}{one:10,.0f}/s{1e3 / one:8.2f}{two:10,.0f}/s{two / one:8.2f}{points:9.0f}{memory:7.0f}")


if __name__ == "__main__":
    main()
