"""Speed of predicting recordings, from points in memory to joints: sweeps per second without and with tracks.

    python benchmarks/recording_speed.py --sweeps 1000

A generated street is scanned with an OS1-128, of which every second return is kept, about 100,000 per sweep; the frames
are repeated forwards and backwards. Printed are wall and processor time per sweep, the time of each part (the detector
runs in parallel, one frame ahead), people per sweep, tracks, and the memory after a tenth of the sweeps and after all.
On a busy machine, the processor time is more informative.
"""

import argparse
import resource
import time
from collections import Counter
from collections.abc import Iterator

import numpy as np

import lidarpose
from lidarpose.io.sources import Frame
from lidarpose.synth.street import street

RATE = 10.0


def clouds(seed: int, people: int, count: int) -> list[np.ndarray]:
    """Points (n, 3) m of `count` frames."""
    frames = street(seed, 0, people=(people, people), frames=count).frames
    return [frame.points[::2].astype(float) for frame in frames]


class ForthAndBack:
    """A source of `count` frames in chronological order, in which no person jumps."""

    name, warnings = "street", ()

    def __init__(self, points: list[np.ndarray], count: int):
        self.points, self.count = points, count

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def frames(self, first: int = 0) -> Iterator[Frame]:
        order = [*range(len(self.points)), *range(len(self.points) - 2, 0, -1)]
        for i in range(first, self.count):
            cloud = self.points[order[i % len(order)]]
            yield Frame(points=cloud, index=i, id=str(i), time=i / RATE, origin=np.zeros(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", type=int, default=200)
    parser.add_argument("--frames", type=int, default=20, help="different ones, repeated forth and back")
    parser.add_argument("--people", type=int, default=16, help="in the street, of whom some are hidden")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--weights", default="small")
    parser.add_argument("--threads", type=int, help="of ONNX Runtime, for the poses")
    options = parser.parse_args()
    points = clouds(options.seed, options.people, options.frames)
    model = lidarpose.load(options.weights, tta=1, threads=options.threads)
    print(f"{np.mean([len(cloud) for cloud in points]):,.0f} points a sweep, {model}")
    for track in (False, True):
        parts: Counter[str] = Counter()
        tracks: set = set()
        people = 0
        memory = []
        source = ForthAndBack(points, options.sweeps + 2)
        for result in lidarpose.predict_recording(source, track=track, model=model):
            # the first two frames compile and warm up
            if result.index == 1:
                wall, processor = time.perf_counter(), time.process_time()
                parts.clear()
                people = 0
                continue
            people += len(result.poses)
            parts.update({name: result.poses.timing_ms[name] for name in ("find", "crop", "predict")})
            tracks |= {person.id for person in result.poses}
            if result.index in (options.sweeps // 10, options.sweeps):
                memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)
        count = options.sweeps
        wall, processor = (time.perf_counter() - wall) / count, (time.process_time() - processor) / count
        times = ", ".join(f"{name} {value / count:.0f}" for name, value in parts.items())
        print(
            f"{'with tracks' if track else 'without tracks'}: {1 / wall:.1f} sweeps/s, {wall * 1e3:.0f} ms ({times}), "
            f"{processor * 1e3:.0f} ms of processors; {people / count:.1f} people a sweep"
            f"{f', {len(tracks)} tracks' if track else ''}; {' -> '.join(f'{size:.0f}' for size in memory)} MiB"
        )


if __name__ == "__main__":
    main()
