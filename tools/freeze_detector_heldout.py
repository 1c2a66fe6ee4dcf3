"""Freezes the scenes on which detectors of people are evaluated: their indices and the hash of each scene's points.

    python tools/freeze_detector_heldout.py src/lidarpose/eval/assets/detector-heldout-1.json

They contain kinds of objects and rooms that are never drawn in training. Run once, before the first detector was
trained. A later generator that makes different scenes needs its own list; a test compares some of the scenes.
"""

import argparse
import json
from pathlib import Path

from lidarpose.io.atomic import atomic_path
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.synth.environment.layouts import LEFT_OUT
from lidarpose.synth.environment.things import THINGS

# training counts its seeds from 0
SEED, COUNT = 720_000, 240


def main() -> None:
    """Writes the list."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    scenes = [detection_scene(SEED, index, family="heldout") for index in range(COUNT)]
    content = {
        "name": "detector-heldout-1",
        "family": "heldout",
        "seed": SEED,
        "left_out": sorted([*LEFT_OUT, *(name for name, kind in THINGS.items() if kind.left_out)]),
        "indices": list(range(COUNT)),
        "kinds": [scene.kind for scene in scenes],
        "sensors": [scene.sensor for scene in scenes],
        "sha256": [scene.points_digest() for scene in scenes],
    }
    with atomic_path(out) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
