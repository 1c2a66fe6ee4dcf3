"""Errors of the network on synthetic people with poses from captured motion that was not used in training.

    python benchmarks/heldout.py --motion cmu_motion.npz --subjects 006,007
    python benchmarks/heldout.py --motion cmu_motion.npz --weights runs/tiny/model.safetensors --json scores.json

Full difficulty of the scene preset `wild` (occluders, masks, clutter, noise, jittered crop boxes, 14 sensors), at
least 50 points per person, centered using only the points: no box, no root joint; "box centers" adds the center of the
jittered box that cropped the points, as `lidarpose evaluate` does. MPJPE on the 15 joints of human15.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import cast

import numpy as np

from lidarpose.errors import InputError
from lidarpose.eval.dataset import facing
from lidarpose.geometry import rotation_about
from lidarpose.inference.predictor import load
from lidarpose.inference.results import Poses
from lidarpose.metrics import auroc, calibration_error, mpjpe, pa_mpjpe
from lidarpose.models import DEFAULT
from lidarpose.sample import CONFIDENCE_RADIUS, Box
from lidarpose.skeleton import HUMAN15, SMPL24, WAYMO14
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator, SyntheticPerson
from lidarpose.synth.scene import scene_config

# differs from the seeds of training runs, which count from 0
SEED = 90_001
PAIRED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")


def people(bank: PoseBank, count: int, least: int, seed: int) -> list[SyntheticPerson]:
    """The first `count` people of the seed with at least `least` points."""
    generator = Generator(scene=scene_config("wild"), bank=bank, captured=1.0)
    persons: list[SyntheticPerson] = []
    index = 0
    while len(persons) < count:
        person = generator.person(seed, index)
        index += 1
        if len(person.sample.points) >= least:
            persons.append(person)
    return persons


def score(predicted, persons: list[SyntheticPerson]) -> dict:
    """Figures, in millimeters or as shares."""
    pred = np.stack([p.pose.to(HUMAN15).joints for p in predicted])
    true = np.stack([p.sample.pose.to(HUMAN15).joints for p in persons])
    facts = [p.facts for p in persons]
    count = np.array([len(p.sample.points) for p in persons])
    plain = np.array([f.plain for f in facts])
    visible = np.array([f.visible for f in facts])
    clutter = np.array([f.clutter for f in facts])
    turn = np.abs((facing(pred, HUMAN15) - facing(true, HUMAN15) + np.pi) % (2 * np.pi) - np.pi)
    error = np.linalg.norm(pred - true, axis=-1)
    confidence = np.stack([p.pose.to(HUMAN15).confidence for p in predicted])
    spread = np.stack([p.pose.to(HUMAN15).spread for p in predicted])
    masks = {
        "all": np.ones(len(persons), bool),
        "upright, whole, uncluttered": plain,
        "under half visible": visible < 0.5,
        "clutter over 10 %": clutter > 0.1,
        "50-100 points": count < 100,
        "100-400 points": (count >= 100) & (count < 400),
        "400 points and more": count >= 400,
    }
    masks |= {name: np.array([f.sensor == name for f in facts]) for name in sorted({f.sensor for f in facts})}
    groups = {
        name: {
            "people": int(mask.sum()),
            "mpjpe": round(mpjpe(pred[mask], true[mask]), 1),
            "pa_mpjpe": round(pa_mpjpe(pred[mask], true[mask]), 1),
            "facing_45": round(float((turn[mask] < np.pi / 4).mean()), 3),
        }
        for name, mask in masks.items()
        if mask.any()
    }
    joints = {"head": ("head",), "neck": ("neck",), "pelvis": ("pelvis",)}
    joints |= {name: (f"left_{name}", f"right_{name}") for name in PAIRED}
    return {
        "groups": groups,
        "joints": {
            name: round(float(error[:, [HUMAN15.index(m) for m in members]].mean() * 1e3), 1)
            for name, members in joints.items()
        },
        "mpjpe_smpl24": round(_whole(predicted, persons, SMPL24), 1),
        "mpjpe_waymo14": round(_whole(predicted, persons, WAYMO14), 1),
        "calibration_error": round(calibration_error(confidence.ravel(), error.ravel() < CONFIDENCE_RADIUS), 3),
        "auroc": round(auroc(confidence.ravel(), error.ravel() < CONFIDENCE_RADIUS), 3),
        "spread_over_error": round(float(spread.mean() / error.mean()), 3),
    }


def _whole(predictions, persons: list[SyntheticPerson], skeleton) -> float:
    pred = np.stack([p.pose.to(skeleton).joints for p in predictions])
    return mpjpe(pred, np.stack([p.sample.pose.to(skeleton).joints for p in persons]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", required=True, help="npz of clips, see lidarpose.body.mocap.motion")
    parser.add_argument("--subjects", default="006,007", help="subjects kept out of training")
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--people", type=int, default=1000)
    parser.add_argument("--least", type=int, default=50, help="fewest points a person")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--json", help="also write the figures to this file")
    options = parser.parse_args()

    try:
        bank = PoseBank.from_clips(options.motion, tuple(options.subjects.split(",")))
    except InputError as error:
        parser.error(str(error))
    persons = people(bank, options.people, options.least, options.seed)
    model = load(options.weights, tta=1)
    clouds = [p.sample.points for p in persons]
    centers = np.stack([cast(Box, p.sample.box).center for p in persons])
    ways: dict[str, Callable[[], Poses]] = {
        "sensor known": lambda: model.predict(clouds, sensor_origin=(0, 0, 0), skeleton="body26"),
        "sensor known, box centers": lambda: model.predict_in(clouds, np.zeros(3), "body26", box_centers=centers),
        "sensor unknown": lambda: model.predict(clouds, sensor_origin=None, skeleton="body26"),
    }
    results = {}
    for name, predict in ways.items():
        start = time.perf_counter()
        predictions = predict()
        results[name] = score(predictions, persons)
        results[name]["ms_a_person"] = round((time.perf_counter() - start) * 1e3 / len(persons), 2)
    results["mean pose, true facing"] = {"mpjpe": round(_mean_pose_error(persons), 1)}
    for name, result in results.items():
        print(f"--- {name}")
        for group, figures in result.get("groups", {}).items():
            print(f"{group:<30}", "  ".join(f"{key} {value}" for key, value in figures.items()))
        print({key: value for key, value in result.items() if key != "groups"})
    if options.json:
        with open(options.json, "w") as file:
            json.dump(
                {"people": len(persons), "seed": options.seed, "subjects": options.subjects} | results, file, indent=1
            )


def _mean_pose_error(persons: list[SyntheticPerson]) -> float:
    """MPJPE of the mean pose at the center of each person's points, rotated to the person's true facing."""
    true = np.stack([p.sample.pose.to(HUMAN15).joints - p.sample.center for p in persons])
    R_world_person = rotation_about("z", facing(true, HUMAN15))
    local_joints = true @ R_world_person
    return mpjpe(local_joints.mean(0) @ np.swapaxes(R_world_person, -1, -2), true)


if __name__ == "__main__":
    main()
