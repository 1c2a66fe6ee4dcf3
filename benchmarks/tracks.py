"""Consistency of track ids: streets of ten people for ten seconds, scanned at 10 Hz by a moving sensor.

    pip install trackeval                                      # the authors' implementation of HOTA, IDF1, MOTA
    python benchmarks/tracks.py --streets 10 --seed 2 --cache runs/tracks --json docs/scores/tracks.json

People walk, stop for a while, cross each other's paths and occlude each other; scans are ray-cast, so occlusions are
realistic. Boxes are the true boxes of visible people with noise, and detections. A person counts in frames with at
least ten points on them; a box belongs to a person within 0.5 m. The tracker is compared with a plain tracker, which
assigns each box to the nearest last position of a track, and with the upper bound for the boxes, in which each box has
its person's true id.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import trackeval
from stored import digest, is_stored, write_note

from lidarpose.eval.detector.detection_scores import LEAST_POINTS, MATCH_RADIUS
from lidarpose.geometry import rotation_about
from lidarpose.inference.single_scan import detect
from lidarpose.io.atomic import write_atomic
from lidarpose.lidar.presets import sensor as named_sensor
from lidarpose.models import DEFAULT, VERIFIER, weights_file
from lidarpose.models.detector.detector import Detector
from lidarpose.sample import Box
from lidarpose.synth import street as streets
from lidarpose.synth.environment.mesh import union
from lidarpose.synth.place import Place
from lidarpose.tracking.assignment import assign
from lidarpose.tracking.tracker import Tracker

PEOPLE, FRAMES, HZ = 10, 100, 10.0
# m; minimum distance of people from each other and from the sensor, and maximum distance from the sensor at the start
APART, CLEAR, NEAR = 0.5, 1.2, 18.0
SENSORS = ("os1-128", "os1-64", "vlp-32c", "hdl-64e", "os0-128")
# score thresholds of stored boxes, and of boxes that may continue a track
LEAST_SCORE, WEAK_SCORE = 0.02, 0.1
# weight files used to detect people
_WEIGHTS = ("detector.onnx", "proposals.npz", f"{VERIFIER}.onnx", f"{DEFAULT}.onnx")
# m; people farther from the sensor do not count
RANGE = 40.0


def sensor_path(plan, rng):
    """(F, 3): x, y m and yaw rad of the sensor, which moves along the street with some lateral and yaw oscillation."""
    time = np.arange(FRAMES) / HZ
    speed, sway, phase = rng.uniform(0.3, 2.0) * rng.choice([-1, 1]), rng.uniform(0, 0.3), rng.uniform(0, 6)
    x, y = speed * time, 0.1 * (np.sin(time + phase) - np.sin(phase))
    yaw = sway * (np.sin(0.8 * time + phase) - np.sin(phase))
    c, s = np.cos(plan.turn), np.sin(plan.turn)
    return np.stack([c * x - s * y, s * x + c * y, yaw], 1)


def with_stop(bodies, rng):
    """The bodies, with a stop of one to three seconds for half of the people."""
    frames = np.arange(FRAMES)
    if rng.random() < 0.5:
        start, pause = rng.integers(10, 60), rng.integers(10, 30)
        frames = np.where(frames < start, frames, np.maximum(start, frames - pause))
    rows = {name: getattr(bodies, name)[frames] for name in ("vertices", "joints")}
    heading = tuple(np.array(bodies.heading)[frames].tolist())
    return replace(bodies, **rows, heading=heading, moved=lambda frame: bodies.moved(int(frames[frame])))


def walkers_of(plan, path, rng):
    """People with crossing paths: of the starts that keep each person at a distance from the others, the one whose path
    comes closest to the others' is chosen."""
    walkers, walks = [], []
    while len(walkers) < PEOPLE:
        bodies = streets._draw_pedestrian(FRAMES, rng)
        if bodies.kinds[0] == "idle" and rng.random() < 0.7:
            continue
        bodies, best_walker, best_distance = with_stop(bodies, rng), None, np.inf
        for _ in range(60):
            place, _ = streets._draw_start(plan, bodies, rng)
            walk = streets._path((bodies, place))
            distance = min((np.linalg.norm(walk - other, axis=1).min() for other in walks), default=0.6)
            is_clear = np.linalg.norm(walk - path[:, :2], axis=1).min() > CLEAR and np.linalg.norm(walk[0]) < NEAR
            if is_clear and APART < distance < best_distance:
                best_walker, best_distance = (bodies, place), distance
        if best_walker:
            walkers.append(best_walker)
            walks.append(streets._path(best_walker))
    return walkers


def recording(seed, index):
    """The frames of a street: points (n, 3) m and people in the sensor frame, and the sensor's x, y, yaw."""
    rng = np.random.default_rng([seed, index])
    device = named_sensor(SENSORS[index % len(SENSORS)])
    plan = streets._draw_plan(device, rng)
    scenery = union(streets._scenery(plan, rng)).moved((0, 0, 0), plan.turn)
    path = sensor_path(plan, rng)
    walkers = walkers_of(plan, path, rng)
    normals = rng.standard_normal(256, np.float32)
    for frame, (x, y, yaw) in enumerate(path):
        R_sensor_world = rotation_about("z", -yaw)
        sensor_position = np.array([x, y, 0.0])
        placed_walkers = [
            (b, Place(feet=R_sensor_world @ (p.feet - sensor_position), yaw=p.yaw - yaw, distance=p.distance))
            for b, p in walkers
        ]
        scene = scenery.moved(-R_sensor_world @ sensor_position, -yaw)
        yield streets._scan_turn(device, scene, placed_walkers, frame, normals, rng), (x, y, yaw)


def to_world(boxes, pose):
    """Boxes in the sensor frame -> in the world frame."""
    x, y, yaw = pose
    R_world_sensor = rotation_about("z", yaw)
    return [replace(b, center=R_world_sensor @ b.center + [x, y, 0], yaw=b.yaw + yaw) for b in boxes]


def to_sensor(boxes, pose):
    x, y, yaw = pose
    R_sensor_world = rotation_about("z", -yaw)
    return [replace(b, center=R_sensor_world @ (b.center - [x, y, 0]), yaw=b.yaw - yaw) for b in boxes]


def stored(seed, index, cache):
    """Frames of a street in the world frame: the people, the number of points on each, and the detected boxes."""
    path = cache / f"{seed}-{index}.json"
    of = {name: digest(weights_file(name)) for name in _WEIGHTS}
    if not is_stored(path, of):
        frames = []
        for frame, pose in recording(seed, index):
            detected_boxes = detect(frame.points, min_score=LEAST_SCORE)
            points = np.bincount(frame.person[frame.person >= 0], minlength=PEOPLE).tolist()
            people, boxes = (
                [b.to_dict() | {"score": b.score} for b in to_world(group, pose)]
                for group in (frame.boxes, detected_boxes)
            )
            frames.append({"people": people, "points": points, "boxes": boxes, "sensor": list(map(float, pose))})
        write_note(path, of)
        write_atomic(path, json.dumps(frames))
    return json.loads(path.read_text())


def noisy(frame, rng):
    """The true boxes of visible people with errors as of a detector; people with fewer points are missed more often."""
    boxes = []
    for person, points in zip(frame["people"], frame["points"], strict=True):
        shift, turn, drop = rng.normal(0, [0.08, 0.08, 0.05]), rng.normal(0, 0.2), rng.random()
        if points >= 5 and drop < points / (points + 5):
            boxes.append(Box(center=person["center"] + shift, size=person["size"], yaw=person["yaw"] + turn))
    return boxes


def boxes_of_score(frame, least, below=1.1):
    return [Box(**box) for box in frame["boxes"] if least <= box["score"] < below]


def distances(frame, boxes):
    """(P, B) m: horizontal distances between people and boxes; of people without any point infinite, since these must
    not excuse a false positive."""
    people, centers = (
        np.reshape(places, (-1, 3))[:, None, :2]
        for places in ([p["center"] for p in frame["people"]], [b.center for b in boxes])
    )
    is_seen = np.array(frame["points"]) > 0
    return np.where(is_seen[:, None], np.linalg.norm(people - centers[:, 0], axis=-1), np.inf)


class Nearest:
    """The plain tracker: each box in turn continues the track with the nearest last position within 1 m and 2 s."""

    def __init__(self):
        self.tracks, self.next_id = {}, 0

    def update(self, time, boxes, weak_boxes):
        ids = []
        for number, box in enumerate([*boxes, *weak_boxes]):
            distance_by_id = {
                i: np.linalg.norm(box.center[:2] - place)
                for i, (last_time, place) in self.tracks.items()
                if i not in ids and time - last_time <= 2
            }
            best_id = min(distance_by_id, key=distance_by_id.get, default=-1)
            if best_id < 0 or distance_by_id[best_id] > 1:
                is_weak = number >= len(boxes)
                best_id, self.next_id = (-1 if is_weak else self.next_id), self.next_id + (not is_weak)
            ids.append(best_id)
            if best_id >= 0:
                self.tracks[best_id] = (time, box.center[:2])
        return ids


def evaluated(frames, boxes, ids):
    """The input of trackeval for a street: boxes within 0.5 m of people who do not count are left out."""
    number_of_id = {name: k for k, name in enumerate(sorted({i for frame_ids in ids for i in frame_ids}))}
    gt_ids, tracker_ids, similarities = [], [], []
    for frame, frame_boxes, own_frame_ids in zip(frames, boxes, ids, strict=True):
        places = np.array([p["center"][:2] for p in frame["people"]])
        is_near = np.linalg.norm(places - frame["sensor"][:2], axis=1) < RANGE
        is_counted = is_near & (np.array(frame["points"]) >= LEAST_POINTS)
        distance = distances(frame, frame_boxes)
        # people who count are assigned first
        person, box = assign(
            np.where(distance < MATCH_RADIUS, distance - MATCH_RADIUS - 10.0 * is_counted[:, None], np.inf)
        )
        kept_boxes = np.setdiff1d(np.arange(len(frame_boxes)), box[~is_counted[person]])
        gt_ids.append(np.flatnonzero(is_counted))
        tracker_ids.append(np.array([number_of_id[own_frame_ids[k]] for k in kept_boxes], int))
        similarities.append(np.maximum(1 - distance[is_counted][:, kept_boxes] / (2 * MATCH_RADIUS), 0))
    return {
        "num_timesteps": len(frames), "num_gt_ids": PEOPLE, "num_tracker_ids": len(number_of_id),
        "num_gt_dets": sum(map(len, gt_ids)), "num_tracker_dets": sum(map(len, tracker_ids)),
        "gt_ids": gt_ids, "tracker_ids": tracker_ids, "similarity_scores": similarities,
    }  # fmt: skip


def scored(sequences):
    """Figures over all streets."""
    figures = {}
    for name in ("Identity", "HOTA", "CLEAR"):
        metric = getattr(trackeval.metrics, name)({"PRINT_CONFIG": False})
        by_street = {str(k): metric.eval_sequence(sequence) for k, sequence in enumerate(sequences)}
        figures |= metric.combine_sequences(by_street)
    return {
        "idf1": figures["IDF1"], "hota": float(figures["HOTA"].mean()), "mota": figures["MOTA"],
        "recall": figures["CLR_Re"], "precision": figures["CLR_Pr"], "switches": int(figures["IDSW"]),
    }  # fmt: skip


def true_ids(frames, boxes):
    """Ids with which each box has its person's number, and each false positive a new one."""
    ids, next_id = [], PEOPLE
    for frame, frame_boxes in zip(frames, boxes, strict=True):
        distance = distances(frame, frame_boxes)
        person, box = assign(np.where(distance < MATCH_RADIUS, distance - MATCH_RADIUS, np.inf))
        frame_ids = next_id + np.arange(len(frame_boxes))
        frame_ids[box] = person
        next_id += len(frame_boxes)
        ids.append(frame_ids.tolist())
    return ids


def tracked(frames, boxes, weak, tracker, poses_known=True):
    """The evaluation input from a tracker's boxes and ids. If the sensor's poses are not known, the tracker gets boxes
    in the sensor frame."""
    track_boxes, ids = [], []
    for number, (frame_boxes, weak_boxes) in enumerate(zip(boxes, weak, strict=True)):
        tracker_boxes = (
            [frame_boxes, weak_boxes]
            if poses_known
            else [to_sensor(b, frames[number]["sensor"]) for b in (frame_boxes, weak_boxes)]
        )
        frame_ids = tracker.update(number / HZ, *tracker_boxes)
        pairs = [(box, k) for box, k in zip(frame_boxes + weak_boxes, frame_ids, strict=True) if k >= 0]
        track_boxes.append([box for box, _ in pairs])
        ids.append([k for _, k in pairs])
    return evaluated(frames, track_boxes, ids)


def figures(recordings):
    """Rows with the kind of boxes, the source of their ids, and the figures over all streets."""
    default_score = round(float(Detector().header["default_score"]), 2)
    rng = np.random.default_rng(0)
    no_boxes = [[[] for _ in frames] for frames in recordings]
    noisy_boxes = [[noisy(frame, rng) for frame in frames] for frames in recordings]
    sure_boxes = [[boxes_of_score(frame, default_score) for frame in frames] for frames in recordings]
    weak_boxes = [[boxes_of_score(frame, WEAK_SCORE, default_score) for frame in frames] for frames in recordings]
    rows = []
    for name, boxes, doubtful_boxes in (
        ("true, with noise and drop-outs", noisy_boxes, no_boxes),
        (f"found, score {default_score:g} and more", sure_boxes, no_boxes),
        (f"found, and down to {WEAK_SCORE:g} where a track goes on", sure_boxes, weak_boxes),
    ):
        sequences = list(zip(recordings, boxes, doubtful_boxes, strict=True))
        for numbering, tracker in (("nearest place", Nearest), ("tracker", Tracker)):
            rows.append(
                {"boxes": name, "by": numbering, **scored([tracked(*street, tracker()) for street in sequences])}
            )
        if doubtful_boxes is no_boxes:
            true_sequences = [
                evaluated(frames, street_boxes, true_ids(frames, street_boxes)) for frames, street_boxes, _ in sequences
            ]
            rows.append({"boxes": name, "by": "the truth", **scored(true_sequences)})
        else:
            sensor_sequences = [tracked(*street, Tracker(), poses_known=False) for street in sequences]
            rows.append({"boxes": name, "by": "tracker, the sensor's poses unknown", **scored(sensor_sequences)})
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, required=True, metavar="DIR", help="where found boxes are kept")
    parser.add_argument("--json", type=Path, help="where the figures go")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    recordings = [stored(options.seed, index, options.cache) for index in range(options.streets)]
    rows = figures(recordings)
    for row in rows:
        print(*(f"{value:.3f}" if isinstance(value, float) else value for value in row.values()), sep=" | ")
    if options.json:
        write_atomic(options.json, json.dumps({"streets": options.streets, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
