"""`lidarpose demo`: people that three LiDARs see, predicted with the bundled weights, beside the truth."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarpose.errors import check_int
from lidarpose.inference.predictor import TTA, Predictor, load
from lidarpose.io.atomic import check_writable, write_all_atomic
from lidarpose.models import DEFAULT
from lidarpose.progress import Progress

SENSORS = ("vlp-32c", "os1-128", "hdl-64e")
PEOPLE_EACH = 4
# difficulty of the scene, lower than in training, so that most people are recognizable by eye
_HARD = 0.4


def run(folder: str | Path, *, seed: int, weights: str = DEFAULT) -> None:
    """Synthesizes, predicts, prints a table, and writes index.html and a PNG a sensor to `folder`, all or none.

    Raises MissingExtra without numba; InputError for a negative seed or a folder that cannot be written.
    """
    import pandas

    from lidarpose.synth.generator import Generator
    from lidarpose.synth.scene import scene_config

    check_int("seed", seed, least=0)
    folder = Path(folder)
    names = ["index.html", *(f"{name}.png" for name in SENSORS)]
    # reports a missing write permission now; the files are opened only when their content is ready, since a killed
    # process would leave temporary files
    for name in names:
        check_writable(folder / name)
    model = load(weights, tta=TTA)
    print("synthesizing people (the first run compiles the ray caster: about ten seconds) ...", flush=True)
    scene = scene_config("wild").eased(_HARD)
    people: list = []
    with Progress(len(SENSORS) * PEOPLE_EACH, unit="people") as bar:
        for name in SENSORS:
            generator = Generator(scene=replace(scene, sensors=(name,), distance=(3.0, 20.0)))
            for _ in range(PEOPLE_EACH):
                people.append(generator.person(seed, len(people)))
                bar.update(len(people))
    rows, contents, milliseconds = _report(model, people)
    write_all_atomic({folder / name: content for name, content in contents.items()})
    print(pandas.DataFrame(rows).to_string(index=False, justify="left"))
    print(f"{milliseconds:.1f} ms per person")
    print(f"open {folder / 'index.html'} to view the people in 3D; pictures: {folder}/*.png")


def _report(model: Predictor, people: list) -> tuple[list[dict], dict[str, bytes], float]:
    """Predicts synthetic people. Returns the table's rows, the report and the pictures by their files' names, and the
    time in ms per person."""
    from lidarpose.viz.draw import Panel, draw_people
    from lidarpose.viz.html import render_report

    clouds = [person.sample.points for person in people]
    # the sensor is at the origin of a sample's frame; the first call is the warm-up
    model.predict(clouds[:2], sensor_origin=(0, 0, 0))
    start = time.perf_counter()
    poses = model.predict(clouds, sensor_origin=(0, 0, 0))
    milliseconds = (time.perf_counter() - start) * 1e3 / len(people)

    rows, panels = [], []
    for person, pose in zip(people, poses, strict=True):
        facts, points, truth = person.facts, person.sample.points, person.sample.pose.to(pose.skeleton)
        error = float(np.linalg.norm(pose.joints - truth.joints, axis=-1).mean() * 1e3)
        rows.append(
            {
                "LiDAR": facts.sensor,
                "points": len(points),
                "distance m": round(facts.distance, 1),
                "visible %": round(facts.visible * 100),
                "MPJPE mm": round(error),
            }
        )
        label = f"{facts.sensor}, {facts.distance:.1f} m"
        caption = f"{len(points)} points, {facts.visible:.0%} visible, MPJPE {error:.0f} mm"
        panels.append(Panel(points=points, pose=pose.pose, truth=truth, label=label, caption=caption))
    contents = {
        f"{name}.png": draw_people(
            panels[k * PEOPLE_EACH : (k + 1) * PEOPLE_EACH], title=f"{name}: predicted (solid), true (dashed)"
        )
        for k, name in enumerate(SENSORS)
    }
    title = "lidarpose demo: synthesized people, predicted and true"
    contents["index.html"] = render_report(panels, title=title, summary=rows).encode()
    return rows, contents, milliseconds
