"""Benefit of a learned background for a stationary sensor: detected people and false positives with and without it.

    python benchmarks/background.py --streets 20 --json docs/scores/background.json

Streets are synthesized by `synth.street`. The background is learned from the frames of four seconds, and people are
detected in three of these frames. People with at least ten points within 40 m count; a person is found if the center of
a box is within 0.5 m. People are moving if they move by more than a meter in these seconds; people who stand still for
all of them become part of the background by design.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

import lidarpose
from lidarpose.eval.detector.detection_scores import LEAST_POINTS, match
from lidarpose.inference.background import learn_background
from lidarpose.io.atomic import write_atomic
from lidarpose.synth.street import street

FRAMES, SEARCHED, MOVES = 40, (0, 19, 39), 1.0
SENSORS = ("os1-64", "os1-128", "hdl-32e", "os0-128", "pandar64")


def of_street(index: int, *, seed: int, scores: tuple[float | None, ...]) -> list[dict]:
    """One row for each searched frame, with and without background, and score threshold."""
    frames = street(seed, index, sensor=SENSORS[index % len(SENSORS)], people=(6, 10), frames=FRAMES).frames
    background = learn_background([frame.points for frame in frames])
    way = [np.linalg.norm(a.center - b.center) for a, b in zip(frames[0].boxes, frames[-1].boxes, strict=True)]
    rows = []
    for number in SEARCHED:
        frame = frames[number]
        centers = np.array([box.center[:2] for box in frame.boxes])
        counts = np.bincount(frame.person[frame.person >= 0], minlength=len(centers))
        is_wanted = (counts >= LEAST_POINTS) & (np.linalg.norm(centers, axis=1) < 40)
        # as in score_scan: a person without any point must not excuse a false positive
        visible_centers = np.where((counts > 0)[:, None], centers, np.inf)
        for name, known in (("no", None), ("yes", background)):
            for score in scores:
                boxes = lidarpose.detect(frame.points.astype(float), min_score=score, background=known)
                found = np.array([box.center[:2] for box in boxes]).reshape(-1, 2)
                person = match(found, np.array([box.score for box in boxes]), visible_centers, is_wanted)
                hits = np.isin(np.arange(len(centers)), person) & is_wanted
                moving = is_wanted & (np.array(way) > MOVES)
                rows.append(
                    {"street": index, "frame": number, "background": name, "score": score}
                    | {"false": int((person < 0).sum()), "people": int(is_wanted.sum()), "found": int(hits.sum())}
                    | {"moving": int(moving.sum()), "moving_found": int((hits & moving).sum())}
                )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streets", type=int, default=20)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    work = partial(of_street, seed=options.seed, scores=(None, 0.3))
    with ProcessPoolExecutor(options.workers) as pool:
        rows = [row for street_rows in pool.map(work, range(options.streets)) for row in street_rows]
    table = []
    for score in (None, 0.3):
        for name in ("no", "yes"):
            own = [row for row in rows if (row["background"], row["score"]) == (name, score)]
            total = {
                key: sum(row[key] for row in own) for key in ("false", "people", "found", "moving", "moving_found")
            }
            table.append({"background": name, "score": score, "frames": len(own)} | total)
            print(table[-1])
    if options.json:
        command = f"python benchmarks/background.py --streets {options.streets} --seed {options.seed}"
        write_atomic(options.json, (json.dumps({"command": command, "rows": table}, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
