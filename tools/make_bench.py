"""Makes lidarpose-bench 1: 2,000 synthetic people and 60 clips on which weights are judged. Run once; never again.

    python tools/make_bench.py cmu_motion.npz src/lidarpose/evaluate/assets/lidarpose-bench-1.parquet

Equal parts of five conditions, eight sensors, and poses from the procedural prior (seeds that no training run uses) and
from captured motion of two subjects that nothing was trained on. What each condition is stands in `conditions`.
Distances of 2 to 40 m, at least 20 points in the crop, 10 of them on the body. Later versions of the generator make
other people: the file is what counts, and a test holds its hash.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lidarpose._version import __version__
from lidarpose.eval.dataset import BENCH_NAME
from lidarpose.io.files import atomic_path
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator, SyntheticPerson
from lidarpose.synth.scene import CropErrors, SceneConfig, scene_config

# training counts its seeds from 0, the held-out benchmarks use those about 90,000
SEED = 710_000
SENSORS = ("vlp-32c", "hdl-64e", "os1-64", "os0-128", "pandar64", "waymo-top", "livox-avia", "livox-mid360")
SUBJECTS = ("006", "007")
SOURCES = ("prior", "captured")
PEOPLE, CLIPS = 2000, 60
LEAST, LEAST_BODY = 20, 10
# key of the card in the file's metadata
METADATA = "lidarpose-bench"
# column -> type, of a value or of the values of a list
COLUMNS = {
    "clip": "int16",
    "frame": "int16",
    "condition": "string",
    "poses": "string",
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
    """clean: nothing but the sensor's own noise and a detector's box 3 cm off; each other one adds its own trouble."""
    wild = scene_config("wild")
    whole = replace(wild.noise, mask=0.0, clutter=0.0, missing_part=0.0)
    clean = replace(
        wild,
        distance=(2.0, 40.0),
        clutter=0.0,
        occluder=0.0,
        company=0.0,
        noise=whole,
        crop=CropErrors(jitter=0.03, loose=0.0, cut=0.0),
    )
    return {
        "clean": clean,
        "occluded": replace(clean, occluder=1.0, noise=replace(whole, mask=0.5, missing_part=0.25)),
        "cluttered": replace(clean, clutter=1.0, noise=replace(whole, clutter=0.5)),
        "crop": replace(clean, crop=CropErrors(jitter=0.16, loose=0.25, cut=0.35)),
        "company": replace(clean, company=1.0),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motion", help="npz of clips that holds the subjects " + ", ".join(SUBJECTS))
    parser.add_argument("out")
    options = parser.parse_args()
    bank = PoseBank.from_clips(options.motion, SUBJECTS)
    rows = [*people(bank), *clips(bank)]
    card = {
        "name": BENCH_NAME,
        "lidarpose": __version__,
        "seed": SEED,
        "sensors": SENSORS,
        "conditions": list(conditions()),
        "people": PEOPLE,
        "clips": CLIPS,
        "skeleton": BODY26.name,
        "captured": f"subjects {', '.join(SUBJECTS)} of the CMU Graphics Lab Motion Capture Database "
        "(mocap.cs.cmu.edu), created with funding from NSF EIA-0196217; their joint positions on other bodies, "
        "nothing of the files themselves",
    }
    table = pa.Table.from_pylist(rows, schema()).replace_schema_metadata({METADATA: json.dumps(card)})
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as path:
        pq.write_table(table, path, compression="zstd", compression_level=19, row_group_size=500)
    print(f"{out}: {len(rows)} rows, {out.stat().st_size / 1e6:.1f} MB")


def people(bank: PoseBank) -> Iterator[dict]:
    """As many of every condition, source and sensor."""
    each = PEOPLE // (len(conditions()) * len(SOURCES) * len(SENSORS))
    for cell, (condition, scene, source, device) in enumerate(_cells()):
        generator = _generator(scene, source, device, bank)
        drawn, index = 0, 0
        while drawn < each:
            person = generator.person(SEED + cell, index)
            index += 1
            if _enough(person):
                yield _row(person, condition=condition, source=source, clip=-1, frame=0)
                drawn += 1


def clips(bank: PoseBank) -> Iterator[dict]:
    """Conditions in turn, then sources; sensors go round. In most frames of a clip there is enough to see."""
    cells = list(_cells())
    each = CLIPS // (len(conditions()) * len(SOURCES))
    clip = 0
    for condition in conditions():
        for source in SOURCES:
            for _ in range(each):
                device = SENSORS[clip % len(SENSORS)]
                scene = conditions()[condition]
                cell = next(k for k, c in enumerate(cells) if (c[0], c[2], c[3]) == (condition, source, device))
                generator = _generator(scene, source, device, bank)
                index = 1000 + 100 * clip
                while sum(map(_enough, frames := generator.clip(SEED + cell, index))) < 12:
                    index += 1
                for frame, person in enumerate(frames):
                    yield _row(person, condition=condition, source=source, clip=clip, frame=frame)
                clip += 1


def _cells() -> Iterator[tuple[str, SceneConfig, str, str]]:
    for condition, scene in conditions().items():
        for source in SOURCES:
            for device in SENSORS:
                yield condition, scene, source, device


def _generator(scene: SceneConfig, source: str, device: str, bank: PoseBank) -> Generator:
    captured = 1.0 if source == "captured" else 0.0
    return Generator(scene=replace(scene, sensors=(device,)), bank=bank if captured else None, captured=captured)


def _enough(person: SyntheticPerson) -> bool:
    sample = person.sample
    return len(sample.points) >= LEAST and np.count_nonzero(sample.part) >= LEAST_BODY


def _row(person: SyntheticPerson, *, condition: str, source: str, clip: int, frame: int) -> dict:
    sample, facts = person.sample, person.facts
    origin = np.round(sample.center, 3)
    return {
        "clip": clip,
        "frame": frame,
        "condition": condition,
        "poses": source,
        "sensor": facts.sensor,
        "kind": facts.kind,
        "distance": facts.distance,
        "visible": facts.visible,
        "clutter": facts.clutter,
        "upright": facts.upright,
        "origin": origin.tolist(),
        "points_mm": np.round((sample.points - origin) * 1e3).astype(np.int16).ravel().tolist(),
        "part": sample.part.tolist(),
        "joints": sample.pose.joints.astype(np.float32).ravel().tolist(),
        "box": [*sample.box.center.tolist(), *sample.box.size.tolist(), float(sample.box.yaw)],
    }


if __name__ == "__main__":
    main()
