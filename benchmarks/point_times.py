"""What the times of points are worth in clouds of several scans: poses of all points, of the newest scan, and of both.

    python benchmarks/point_times.py DATA --json docs/scores/point_times.json

DATA: a folder with cmu_motion.npz, hdm05_motion.npz and idle_motion.npz. People, poses and conditions are drawn as for
bench-2 (tools/make_bench.py), with another seed; accumulated people have 2 to 5 scans at 10 Hz, integrated ones 2 or 5
frames of a rosette. The frozen bench has no times of points. MPJPE on the 15 joints of human15, with 95 % intervals.

Whole scans: streets of six to nine people, of which `FRAMES` turns of a sensor that stands still are one cloud. Points
have the times at which a beam has their azimuth; those of a rosette random ones within its frame. People with 20 points
and more in the newest turn, within 40 m, count; a person is found if a pose is within 1 m of the newest position. MPJPE
over people found in all three ways.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path

import numpy as np

from lidarpose.body.mocap import load_motion
from lidarpose.eval.metrics.aggregate import interval, paired_interval
from lidarpose.inference.newest import newest_points
from lidarpose.inference.predictor import Predictor, load
from lidarpose.io.atomic import write_atomic
from lidarpose.models import DEFAULT
from lidarpose.sample import Sample
from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.street import street

sys.path.append(str(Path(__file__).parents[1] / "tools"))
import make_bench as bench  # noqa: E402

CONDITIONS = ("clean", "accumulated", "integrated")
SEED = 940_000
SENSORS = ("os1-128", "vlp-16", "livox-mid360")
# of whole scans: turns in a cloud; minimum points of a person; m
FRAMES, LEAST_POINTS, FARTHEST, FOUND = 5, 20, 40.0, 1.0


def people(condition: str, data: Path, share: float) -> list[Sample]:
    """People of a condition: `share` times as many of each source as in bench-2."""
    samples: list[Sample] = []
    for source, num_people in bench.SOURCES.items():
        subjects = tuple(bench.SUBJECTS.get(source, ()))
        bank = PoseBank.of_motion(load_motion(data / f"{source}_motion.npz").of(subjects)) if subjects else None
        samples += islice(_drawn(condition, bank), round(share * num_people))
    return samples


def _drawn(condition: str, bank: PoseBank | None) -> Iterator[Sample]:
    scene = bench.conditions()[condition]
    generator = Generator(scene=scene, bank=bank, captured=0.0 if bank is None else 1.0, measure=False)
    for index in count():
        sample = generator.person(SEED, index).sample
        is_usable = bench.LEAST <= len(sample.points) <= bench.MOST
        has_condition = condition in (*sample.conditions, "clean")
        if is_usable and has_condition and np.count_nonzero(sample.part) >= bench.LEAST_BODY:
            yield sample


def errors(model: Predictor, samples: list[Sample], newest_clouds: list | None, clouds: list[np.ndarray]) -> np.ndarray:
    """(N, 15) mm; a person without a pose has NaN."""
    centers = np.stack([sample.box.center for sample in samples if sample.box is not None])
    poses = model.predict_in(
        clouds, np.zeros(3), BODY26, box_centers=centers, newest_clouds=newest_clouds, check_upside_down=False
    )
    table = np.full((len(samples), len(HUMAN15)), np.nan)
    for row, (sample, person) in enumerate(zip(samples, poses, strict=True)):
        if person.pose is not None and sample.pose is not None:
            table[row] = 1e3 * np.linalg.norm(person.pose.to(HUMAN15).joints - sample.pose.to(HUMAN15).joints, axis=-1)
    return table


def score(model: Predictor, samples: list[Sample]) -> dict:
    """Mean errors, mm, and their intervals, by the points that are used; differences to all points."""
    clouds = [sample.points.astype(float) for sample in samples]
    newest = [
        newest_points(cloud, sample.point_times, np.zeros(3)) for cloud, sample in zip(clouds, samples, strict=True)
    ]
    alone = [cloud if own is None else own for cloud, own in zip(clouds, newest, strict=True)]
    tables = {"all points": errors(model, samples, None, clouds)}
    if any(cloud is not None for cloud in newest):
        tables |= {"newest scan": errors(model, samples, None, alone), "both": errors(model, samples, newest, clouds)}
    posed = np.all([np.isfinite(table).all(1) for table in tables.values()], axis=0)
    tables = {name: table[posed] for name, table in tables.items()}
    result: dict = {"people": int(posed.sum()), "with a newest scan": sum(cloud is not None for cloud in newest)}
    for name, table in tables.items():
        own = interval(table, np.random.default_rng(0))
        difference = paired_interval(table, tables["all points"], np.random.default_rng(0))
        result[name] = {"value": round(float(table.mean()), 2), "low": round(own.low, 2), "high": round(own.high, 2)}
        if name != "all points":
            result[name]["change"] = [round(difference.low, 2), round(difference.high, 2)]
    return result


def _phases(points: np.ndarray, sensor: str, rng: np.random.Generator) -> np.ndarray:
    """(n,) in [0, 1): when each point is measured in a frame. Turns begin behind the sensor."""
    if sensor.startswith("livox"):
        return rng.random(len(points))
    return (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) % 1


def whole_scans(model: Predictor, sensor: str, count: int) -> dict:
    """People found, false ones, and MPJPE, by the points that are used."""
    ways = ("all points", "newest scan", "both")
    tables: list[np.ndarray] = []
    false = dict.fromkeys(ways, 0)
    for index in range(count):
        frames = street(SEED, index, sensor=sensor, people=(6, 9), frames=FRAMES).frames
        newest, points = frames[-1], np.concatenate([frame.points for frame in frames])
        rng = np.random.default_rng(index)
        times = np.concatenate([0.1 * (k + _phases(frame.points, sensor, rng)) for k, frame in enumerate(frames)])
        num_points = np.bincount(newest.person[newest.person >= 0], minlength=len(newest.boxes))
        distance = np.linalg.norm([box.center[:2] for box in newest.boxes], axis=1)
        is_counted = (num_points >= LEAST_POINTS) & (distance < FARTHEST)
        table = np.full((len(newest.boxes), len(ways)), np.nan)
        clouds = ((points, None), (newest.points, None), (points, times))
        for way, (cloud, point_times) in enumerate(clouds):
            poses = model.predict(cloud, find=True, point_times=point_times, skeleton=BODY26)
            joints = np.stack([person.joints for person in poses if person.has_pose] or [np.full((26, 3), np.inf)])
            apart = np.linalg.norm(joints[:, None, 0, :2] - newest.joints[None, :, 0, :2], axis=-1)
            false[ways[way]] += int((np.isfinite(joints).all((1, 2)) & (apart.min(1) > FOUND)).sum())
            for person in np.flatnonzero(is_counted):
                if apart[:, person].min() < FOUND:
                    difference = (joints[apart[:, person].argmin()] - newest.joints[person])[BODY26.map_to(HUMAN15)]
                    table[person, way] = 1e3 * np.linalg.norm(difference, axis=-1).mean()
        tables.append(table[is_counted])
    errors = np.concatenate(tables)
    is_found = np.isfinite(errors)
    in_all = errors[is_found.all(1)]
    return {"people": len(errors), "in all": len(in_all)} | {
        name: {"found": int(is_found[:, way].sum()), "false": false[name], "mpjpe": round(in_all[:, way].mean(), 1)}
        for way, name in enumerate(ways)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--share", type=float, default=2.0, help="people relative to those of bench-2")
    parser.add_argument("--streets", type=int, default=20, help="number of streets for each sensor")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args()
    model = load(options.weights)
    content: dict[str, dict] = {}
    for condition in CONDITIONS:
        content[condition] = score(model, people(condition, options.data, options.share))
        print(condition, json.dumps(content[condition]), flush=True)
    content["whole scans"] = {}
    for sensor in SENSORS:
        content["whole scans"][sensor] = whole_scans(model, sensor, options.streets)
        print(sensor, json.dumps(content["whole scans"][sensor]), flush=True)
    if options.json is not None:
        write_atomic(options.json, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
