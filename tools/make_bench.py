"""Makes lidarpose-bench 2: 3,000 synthetic people and 500 objects for evaluating weights. Run once; never again.

    python tools/make_bench.py DATA src/lidarpose/eval/assets/lidarpose-bench-2.parquet

DATA is a folder with the clips cmu_motion.npz, hdm05_motion.npz and idle_motion.npz, whose subjects in `SUBJECTS` are
excluded from all training. A third of the poses comes from the procedural prior (with seeds that no training run uses).
`conditions` defines the conditions. Crops have 20 to `MOST` points, at least 10 of them on the body. Later versions of
the generator make different people: the file is authoritative, and a test checks its hash. Bench 1 was made by the
version of this file in lidarpose 0.1.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, cycle, islice
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lidarpose._version import __version__
from lidarpose.body.mocap import load_motion
from lidarpose.eval.dataset import BENCHES
from lidarpose.io.atomic import atomic_path
from lidarpose.sample import Box, Sample
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.objects import draw_object
from lidarpose.synth.scene import CropErrors, SceneConfig, scene_config

NAME = BENCHES["bench-2"].name
# training counts its seeds from 0, the held-out benchmarks use seeds around 90,000, bench 1 seeds from 710,000
SEED = 720_000
SENSORS = ("vlp-16", "vlp-32c", "hdl-64e", "os1-64", "os1-128", "os0-128", "pandar64", "waymo-top")
ROSETTES = ("livox-avia", "livox-mid360", "livox-mid100")
# file -> prefixes of clip names and the family of their poses
SUBJECTS = {
    "cmu": {"007": "walk", "006": "basketball"},
    "idle": {"014": "idle", "015": "idle"},
    "hdm05": {
        "bk_depositFloorR": "floor",
        "bk_elbowToKnee1RepsLelbowStart": "elbow to knee",
        "bk_grabHighR": "grab",
        "bk_hopBothLegs1hops": "hop",
        "bk_jogLeftCircle4StepsRstart": "run",
        "bk_kickLFront1Reps": "kick",
        "bk_lieDownFloor": "lie",
        "bk_rotateArmsBothBackward1Reps": "rotate arms",
        "bk_sneak2StepsLStart": "sneak",
        "bk_squat1Reps": "squat",
        "bk_throwBasketball": "throw",
    },
}
# families of the prior's kinds with different names; the families of its fitted mixture are unknown
FAMILIES = {"captured": "mixture", "crouch": "squat"}
# number of people of each condition by source of the poses; "sparse" and "integrated" have half as many
SOURCES = {"prior": 100, "hdm05": 100, "cmu": 60, "idle": 40}
OBJECTS = 500
LEAST, LEAST_BODY, MOST = 20, 10, 1200
# key of the card in the file's metadata
METADATA = "lidarpose-bench"
# column -> type of the value, or of the values of a list
COLUMNS = {
    "clip": "int16",
    "frame": "int16",
    "person": "bool",
    "others": "int16",
    "condition": "string",
    "poses": "string",
    "family": "string",
    "sensor": "string",
    "kind": "string",
    "distance": "float32",
    "visible": "float32",
    "clutter": "float32",
    "upright": "bool",
    "origin": ["float64"],
    "points_mm": ["int16"],
    "part": ["uint8"],
    "joints": ["float32"],
    "box": ["float64"],
}


def schema() -> pa.Schema:
    """The file's Arrow schema; its columns are described in `lidarpose.eval.dataset`."""
    types = {
        name: pa.list_(pa.type_for_alias(kind[0])) if isinstance(kind, list) else pa.type_for_alias(kind)
        for name, kind in COLUMNS.items()
    }
    return pa.schema(list(types.items()))


def conditions() -> dict[str, SceneConfig]:
    """The scene of each condition. clean: only sensor noise and 3 cm box jitter; each other one adds a difficulty."""
    wild = scene_config("wild")
    lossless_noise = replace(wild.noise, mask=0.0, clutter=0.0, missing_part=0.0)
    clean = replace(
        wild,
        sensors=(*SENSORS, *ROSETTES[:2]),
        distance=(2.0, 40.0),
        clutter=0.0,
        occluder=0.0,
        company=0.0,
        noise=lossless_noise,
        crop=CropErrors(jitter=0.03, loose=0.0, cut=0.0),
    )
    return {
        "clean": clean,
        "occluded": replace(clean, occluder=1.0, noise=replace(lossless_noise, mask=0.5, missing_part=0.25)),
        "cluttered": replace(clean, clutter=1.0, noise=replace(lossless_noise, clutter=0.5)),
        "crop": replace(clean, crop=CropErrors(jitter=0.16, loose=0.25, cut=0.35)),
        "company": replace(clean, company=1.0),
        "merged": replace(clean, merged=1.0),
        "accumulated": replace(clean, accumulated=1.0),
        "crowded": replace(clean, crowded=1.0),
        "inverted": replace(clean, inverted=1.0),
        "sparse": replace(clean, sparse=1.0),
        "integrated": replace(clean, integration=1.0, sensors=ROSETTES),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of the clips")
    parser.add_argument("out")
    options = parser.parse_args()
    rows = [*people(Path(options.data)), *objects()]
    card = {
        "name": NAME,
        "lidarpose": __version__,
        "seed": SEED,
        "conditions": list(conditions()),
        "people": sum(row["person"] for row in rows),
        "objects": OBJECTS,
        "skeleton": BODY26.name,
        "captured": "joint positions on other bodies, nothing of the files themselves: subjects 006 and 007 of the CMU "
        "Graphics Lab Motion Capture Database (mocap.cs.cmu.edu, created with funding from NSF EIA-0196217), bk of "
        "HDM05 (Mueller et al. 2007, CC BY-SA 3.0), 014 and 015 of ReActIdle (MIT)",
    }
    table = pa.Table.from_pylist(rows, schema()).replace_schema_metadata({METADATA: json.dumps(card)})
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    # coordinates of points are noise, for which a dictionary is larger than the values
    lists = {f"{name}.list.element": "BYTE_STREAM_SPLIT" for name in ("points_mm", "joints", "box", "origin")}
    words = ["condition", "poses", "family", "sensor", "kind", "part.list.element"]
    with atomic_path(out) as path:
        pq.write_table(
            table, path, compression="zstd", compression_level=19, row_group_size=500,
            use_dictionary=words, column_encoding=lists,
        )  # fmt: skip
    print(f"{out}: {len(rows)} rows, {out.stat().st_size / 1e6:.1f} MB")


def people(data: Path) -> Iterator[dict]:
    """Rows of people: fixed numbers for each condition and source, cycling through the families of a source; sensors
    are drawn at random."""
    banks: dict[str, dict[str, PoseBank | None]] = {"prior": {"": None}}
    for source, clips in SUBJECTS.items():
        motion = load_motion(data / f"{source}_motion.npz")
        banks[source] = {start: PoseBank.of_motion(motion.of((start,))) for start in clips}
    seed = count(SEED)
    for condition, scene in conditions().items():
        for source, num_people in SOURCES.items():
            streams = {
                start: _drawn(condition, source, SUBJECTS.get(source, {}).get(start, ""), scene, bank, next(seed))
                for start, bank in banks[source].items()
            }
            quota = num_people // 2 if condition in ("sparse", "integrated") else num_people
            yield from (next(streams[start]) for start in islice(cycle(streams), quota))


def _drawn(
    condition: str, source: str, family: str, scene: SceneConfig, bank: PoseBank | None, seed: int
) -> Iterator[dict]:
    """An endless stream of rows of people."""
    generator = Generator(scene=scene, bank=bank, captured=0.0 if bank is None else 1.0)
    for index in count():
        person = generator.person(seed, index)
        sample, facts = person.sample, person.facts
        # these conditions are not in every sample: a rosette's frame, for instance, may last only 0.1 s
        has_condition = condition in sample.conditions or condition not in (
            "merged",
            "accumulated",
            "sparse",
            "integrated",
        )
        if has_condition and LEAST <= len(sample.points) <= MOST and np.count_nonzero(sample.part) >= LEAST_BODY:
            yield _row(
                sample, sample.pose.joints, person=True, condition=condition, poses=source,
                family=family or FAMILIES.get(facts.kind, facts.kind), kind=facts.kind, sensor=facts.sensor,
                distance=facts.distance, visible=facts.visible, clutter=facts.clutter, upright=facts.upright,
            )  # fmt: skip


def objects() -> Iterator[dict]:
    """Rows of crops without a person, half of them with kinds of objects that are never used in training."""
    for left_out in (False, True):
        crops = (draw_object(conditions()["cluttered"], SEED, index, left_out=left_out) for index in count())
        usable_crops = (crop for crop in crops if LEAST <= len(crop[0].points) <= MOST)
        for sample, kind in islice(usable_crops, OBJECTS // 2):
            center = cast("Box", sample.box).center
            yield _row(
                sample, np.full((len(BODY26), 3), np.nan), person=False, condition="object", poses="", family=kind,
                kind="", sensor=sample.source.split("/")[2], distance=float(np.hypot(*center[:2])), visible=np.nan,
                clutter=np.nan, upright=False,
            )  # fmt: skip


def _row(sample: Sample, joints: np.ndarray, **columns: object) -> dict:
    origin = np.round(sample.center, 3)
    return columns | {
        "clip": -1,
        "frame": 0,
        "others": sample.second_person_points or 0,
        "origin": origin.tolist(),
        "points_mm": np.round((sample.points - origin) * 1e3).astype(np.int16).ravel().tolist(),
        "part": sample.part.tolist(),
        "joints": joints.astype(np.float32).ravel().tolist(),
        "box": [*sample.box.center.tolist(), *sample.box.size.tolist(), float(sample.box.yaw)],
    }


if __name__ == "__main__":
    main()
