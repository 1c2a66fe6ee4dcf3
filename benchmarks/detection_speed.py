"""Time for detecting people in a scan, optionally compared with an earlier version of the package.

    python benchmarks/detection_speed.py [--before REF] [--rounds 8] [--million] [SCAN ...]

Scans are files of points around a sensor at 0, 0, 0; by default a generated street scanned with 128 beams, about
100,000 points, and with --million the same street repeated ten times with 1 cm of noise. One thread. Each row is a
step:

- detector: from points to scored places: thinning, leveling, proposals and scorer;
- detect: `lidarpose.detect`, with verification and the poses of the detections;
- predict: `lidarpose.predict` of the ten highest-scoring people with `small` and `tta=1`, including detection.

Versions take turns, scan by scan, each in its own process; cells are CPU milliseconds of the best round (the median).
Compare ratios, since a busy machine slows down all versions equally. --before: a git reference, checked out into a
temporary folder.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

# set before numpy starts its threads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
STEPS = ("detector", "detect", "predict")


def street(times: int) -> np.ndarray:
    """(n, 3) m: a street scanned with 128 beams, repeated `times` times."""
    from lidarpose.synth.street import street

    points = street(3, 2, sensor="os1-128").frames[0].points
    rng = np.random.default_rng(0)
    return np.concatenate([points, *(points + rng.normal(0, 0.01, points.shape) for _ in range(times - 1))])


def worker(file: str) -> None:
    """Times one step for each line on the standard input, with the package on Python's path."""
    import lidarpose
    from lidarpose.inference import detection, verification
    from lidarpose.inference.backend import OnnxBackend
    from lidarpose.inference.scan import Scan
    from lidarpose.models import weights_file
    from lidarpose.models.detector.detector import Detector

    points = np.load(file)
    detector, predictor = Detector(threads=1), lidarpose.load("small", threads=1, tta=1)
    # replaces the package's own detector and verifiers, which use all processors
    detection._detector = lambda: detector
    backend = cache(lambda name: OnnxBackend(weights_file(f"{name}.onnx"), threads=1))
    # for versions without a separate verification network
    verification.bundled_backend = backend
    verification._verifier = lambda: backend(verification.VERIFIER)
    origin = np.zeros(3)

    def predict():
        boxes = lidarpose.detect(points, sensor_origin=origin, min_score=0.0, max_people=10)
        return predictor.predict(points, boxes=boxes, sensor_origin=origin)

    steps = {
        "detector": lambda: detection.detect_places(Scan(points=points, origin=origin), detection.Search()),
        "detect": lambda: lidarpose.detect(points, sensor_origin=origin),
        "predict": predict,
    }
    for line in sys.stdin:
        start = time.process_time()
        steps[line.strip()]()
        print(time.process_time() - start, flush=True)


def start(source: Path, file: Path) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(source / "src")}
    command = [sys.executable, __file__, "--worker", str(file)]
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def timed(process: subprocess.Popen, step: str) -> float:
    process.stdin.write(step + "\n")
    process.stdin.flush()
    return float(process.stdout.readline()) * 1e3


def measure(sources: dict[str, Path], file: Path, rounds: int) -> dict[str, dict[str, list[float]]]:
    """ms by step and source, without the first round."""
    workers = {name: start(source, file) for name, source in sources.items()}
    times = {step: {name: [] for name in sources} for step in STEPS}
    for _ in range(rounds + 1):
        for step in STEPS:
            for name, process in workers.items():
                times[step][name].append(timed(process, step))
    for process in workers.values():
        process.stdin.close()
        process.wait()
    return {step: {name: values[1:] for name, values in source_times.items()} for step, source_times in times.items()}


def report(title: str, times: dict[str, dict[str, list[float]]]) -> None:
    names = list(times[STEPS[0]])
    print(f"\n{title}\n\n| step | {' | '.join(names)} |{' ratio |' * (len(names) > 1)}")
    print("|---" * (len(names) + 1 + (len(names) > 1)) + "|")
    for step, source_times in times.items():
        cells = [f"{min(values):.0f} ({statistics.median(values):.0f})" for values in source_times.values()]
        if len(names) > 1:
            cells.append(f"{min(source_times[names[0]]) / min(source_times[names[1]]):.2f}")
        print(f"| {step} | {' | '.join(cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="*", metavar="SCAN")
    parser.add_argument("--before", metavar="REF")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--million", action="store_true")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.worker)
        return
    from lidarpose.inference.scan import Scan, read_scan

    empty = Scan(points=np.zeros((0, 3)), origin=np.zeros(3))
    clouds = {Path(scan).name: read_scan(empty, scan, None).points for scan in options.scans}
    clouds = clouds or {"street": street(1)}
    if options.million:
        clouds["street, ten times"] = street(10)
    with tempfile.TemporaryDirectory() as folder:
        sources = {"now": ROOT}
        if options.before:
            sources = {"before": Path(folder) / "before", "now": ROOT}
            git = ["git", "-C", str(ROOT), "worktree"]
            subprocess.run(
                [*git, "add", "--detach", str(sources["before"]), options.before], check=True, capture_output=True
            )
        try:
            for name, points in clouds.items():
                file = Path(folder) / "points.npy"
                np.save(file, points)
                report(f"{name}: {len(points):,} points", measure(sources, file, options.rounds))
        finally:
            if options.before:
                subprocess.run([*git, "remove", "--force", str(sources["before"])], check=True)


if __name__ == "__main__":
    main()
