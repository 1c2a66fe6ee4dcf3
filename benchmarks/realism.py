"""Similarity of synthetic and real people: counts, rings, surfaces, ground, boxes.

    python benchmarks/realism.py [FOLDER] [--people 60] [--picture docs/images/realism.png] [--crops crops.png]

FOLDER holds real sweeps of Argoverse 2 in the layout of `benchmarks/real.py` (sweep_N.pcd, .bin or .ply, each with a
sweep_N.json of boxes); without it only the published averages are compared. Each real person with at least 50 points
is compared with `--people` people of the scene `wild`, scanned with the same sensor at the same distance.

    points        in the box
    rings         rows of the sensor with at least two points
    ring step     third of the median |r[i-1] - 2 r[i] + r[i+1]| along a ring, upper body: noise and curvature, m
    ring offset   median distance from a ring's points to the mean of the rings above and below, upper body, m
    ground        share of the points within 10 cm of the box's bottom edge
    wide, tall    extent of the points across the line of sight and in height, m
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarpose.geometry import rotation_about
from lidarpose.io.boxes import read_boxes
from lidarpose.io.point_cloud import read_points
from lidarpose.lidar.presets import sensor
from lidarpose.lidar.ray_pattern import RayPattern
from lidarpose.lidar.raycast import scan, scan_pattern
from lidarpose.lidar.sensor import Sensor
from lidarpose.sample import Box
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES

LEAST = 50
SENSOR = "av2"
# m; the roof carries two sensors of 32 rings, the lower one upside down. The height was measured on the sweeps: with
# it, the elevations of the lower sensor's points match the manufacturer's table
LOWER_HEAD = -0.11
# a point belongs to a ring if their elevations differ by less than this, degrees
RING_TOLERANCE = 0.07
GROUND = 0.1
# maximum azimuth of people in front of a tilted sensor, rad
AHEAD = np.radians(40.0)
UPPER_BODY = (0.5, 0.85)
MEASURES = ("points", "rings", "ring step", "ring offset", "ground", "wide", "tall")


def measures(points: np.ndarray, ring: np.ndarray, box: Box) -> dict[str, float]:
    """The figures of one person. points (n, 3) m in the sensor frame, ring (n,), -1 for none; box as of a detector."""
    bottom = box.center[2] - box.size[2] / 2
    forward = box.center[:2] / np.linalg.norm(box.center[:2])
    lateral = points[:, :2] @ [-forward[1], forward[0]]
    low, high = (bottom + share * box.size[2] for share in UPPER_BODY)
    is_upper = (points[:, 2] > low) & (points[:, 2] < high) & (ring >= 0)
    numbers, counts = np.unique(ring[ring >= 0], return_counts=True)
    step, offset = along_rings(points[is_upper], ring[is_upper])
    return {
        "points": len(points),
        "rings": int((counts >= 2).sum()),
        "ring step": step,
        "ring offset": offset,
        "ground": float((points[:, 2] < bottom + GROUND).mean()),
        "wide": float(np.ptp(lateral)),
        "tall": float(np.ptp(points[:, 2])),
    }


def along_rings(points: np.ndarray, ring: np.ndarray) -> tuple[float, float]:
    """Roughness along rings and between rings, m; NaN if there are too few points."""
    distance = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    steps, middles = [], []
    for number in np.unique(ring):
        order = np.flatnonzero(ring == number)
        order = order[np.argsort(azimuth[order])]
        gaps = np.diff(azimuth[order])
        if len(order) < 3:
            continue
        is_even = (gaps[1:] < 1.6 * np.median(gaps)) & (gaps[:-1] < 1.6 * np.median(gaps))
        steps.append(np.abs(np.diff(distance[order], 2))[is_even])
        middles.append((np.median(points[order, 2]), np.median(distance[order])))
    step = float(np.median(np.concatenate(steps)) / 3) if steps and len(np.concatenate(steps)) else np.nan
    height = np.array(sorted(middles))
    offset = np.nan
    if len(height) >= 3:
        offset = float(np.median(np.abs(height[1:-1, 1] - (height[2:, 1] + height[:-2, 1]) / 2)))
    return step, offset


def rings_of(points: np.ndarray) -> np.ndarray:
    """(n,) rings of a real sweep's points, from their elevations relative to the two heads; -1 between rings."""
    table = np.degrees(sensor("vlp-32c").elevations)
    horizontal = np.hypot(points[:, 0], points[:, 1])
    deviations, numbers = [], []
    for head, angles in ((0.0, table), (LOWER_HEAD, -table)):
        deviation = np.abs(np.degrees(np.arctan2(points[:, 2] - head, horizontal))[:, None] - angles)
        deviations.append(deviation.min(1))
        numbers.append(deviation.argmin(1))
    is_upper = deviations[0] <= deviations[1]
    ring = np.where(is_upper, numbers[0], 32 + numbers[1])
    return np.where(np.minimum(*deviations) < RING_TOLERANCE, ring, -1)


def real_people(folder: Path) -> list[tuple[str, float, np.ndarray, np.ndarray, Box]]:
    """(name, distance m, points (n, 3), ring (n,), box) of the labeled people with at least `LEAST` points."""
    people = []
    for labels in sorted(folder.glob("sweep_*.json")):
        sweep = next(path for path in sorted(folder.glob(f"{labels.stem}.*")) if path.suffix != ".json")
        cloud = read_points(sweep).points
        names = [str(entry["track"])[:6] for entry in json.loads(labels.read_text())["people"]]
        for name, box in zip(names, read_boxes(labels), strict=True):
            points = cloud[box.contains(cloud)]
            if len(points) >= LEAST:
                distance = float(np.hypot(*box.center[:2]))
                people.append((f"{labels.stem[6:]} {name}", distance, points, rings_of(points), box))
    return people


def synthetic_people(distance: float, count: int, seed: int) -> list[tuple[np.ndarray, np.ndarray, Box]]:
    """(points, ring, box) of `count` people of `wild` within 5 percent of a distance, scanned with the real sensor."""
    scene = replace(SCENES["wild"], sensors=(SENSOR,), distance=(0.95 * distance, 1.05 * distance), median_points=0)
    maker = Generator(scene=scene, measure=False)
    samples = [maker.person(seed, index).sample for index in range(count)]
    return [(sample.points, sample.ring, sample.box) for sample in samples if len(sample.points)]


# published means: data set, sensor, its tilt in rad, its height above the ground in m, points per person, mean distance
# in m (None: not published). From the review arXiv:2509.12197; SLOPER4D's sensor is tilted by 45 deg
PUBLISHED = (
    ("Waymo", "waymo-top", 0.0, 2.0, 384, 14.5),
    ("SLOPER4D", "os1-128", np.radians(45.0), 1.7, 968, 2.81),
    ("Human-M3", "livox-mid100", 0.0, 1.7, 369, None),
)


def points_alone(device: Sensor | RayPattern, tilt: float, height: float, distance: float, count: int) -> float:
    """Median number of returns from `count` isolated bodies at random places in front of a sensor."""
    rng, bodies, counts = np.random.default_rng(0), draw_bodies(None, 0.0, count, 1, 0), []
    mount = rotation_about("y", -tilt)
    for body in bodies.vertices:
        # a tilted sensor sees a whole person only near the direction of its tilt
        azimuth = rng.uniform(-AHEAD, AHEAD)
        vertices = (body + [distance * np.cos(azimuth), distance * np.sin(azimuth), -height]) @ mount.T
        if isinstance(device, RayPattern):
            counts.append(len(scan_pattern(vertices, bodies.faces, device, 0).points))
        else:
            counts.append(len(scan(vertices, bodies.faces, device).points))
    return float(np.median(counts))


def print_published(count: int) -> None:
    """Prints the points per person of our sensors at the mean distances of published data sets, and the distances at
    which they give the published numbers of points.

    A mean number of points exceeds the number at the mean distance, since points are proportional to 1 / distance^2.
    """
    distances = np.geomspace(2, 30, 10)
    for name, device, tilt, height, mean, distance in PUBLISHED:
        counts = [points_alone(sensor(device), tilt, height, d, count) for d in distances]
        # accumulated from far to near: at very small distances the vertical field of view cuts people off
        from_afar = np.maximum.accumulate(np.maximum(counts, 1)[::-1])
        same_distance = np.exp(np.interp(np.log(mean), np.log(from_afar), np.log(distances)[::-1]))
        line = f"{name}: {mean} points a person on average; {device} casts as many at {same_distance:.1f} m"
        if distance:
            count_there = np.exp(np.interp(np.log(distance), np.log(distances), np.log(np.maximum(counts, 1))))
            line += f", and {count_there:.0f} at the {distance} m that people are away on average"
        print(line)


def compare(real: list, count: int) -> tuple[list[tuple], list[tuple]]:
    """Rows (name, distance, real figures, synthetic figures: one dict per person) and the synthetic crops."""
    rows, crops = [], []
    for number, (name, distance, points, ring, box) in enumerate(real):
        synthetic = synthetic_people(distance, count, seed=100 + number)
        rows.append((name, distance, measures(points, ring, box), [measures(*person) for person in synthetic]))
        crops.append(synthetic)
    return rows, crops


def print_table(rows: list[tuple]) -> None:
    """Prints each real figure, and below it the 10, 50 and 90 percent quantiles of the synthetic people."""
    print(f"{'real person':>14} {'m':>5} " + " ".join(f"{name:>17}" for name in MEASURES))
    inside_counts = dict.fromkeys(MEASURES, 0)
    for name, distance, figures, synthetic in rows:
        cells, quantile_cells = [], []
        for measure in MEASURES:
            low, middle, high = np.nanquantile([m[measure] for m in synthetic], [0.1, 0.5, 0.9])
            inside_counts[measure] += low <= figures[measure] <= high
            cells.append(f"{figures[measure]:17.3g}")
            quantile_cells.append(f"{low:5.3g} {middle:5.3g} {high:5.3g}")
        print(f"{name:>14} {distance:5.1f} " + " ".join(cells))
        print(f"{'wild':>14} {'':5} " + " ".join(f"{cell:>17}" for cell in quantile_cells))
    print("real people within the synthetic 10 to 90 percent, of", len(rows), end=": ")
    print(", ".join(f"{measure} {hits}" for measure, hits in inside_counts.items()))
    ratio = {
        measure: np.nanmedian(
            [f[measure] / max(np.nanmedian([m[measure] for m in synthetic]), 1e-9) for *_, f, synthetic in rows]
        )
        for measure in MEASURES
    }
    print("median of real / synthetic median: " + ", ".join(f"{m} {value:.2f}" for m, value in ratio.items()))


def draw(rows: list[tuple], path: Path) -> None:
    """Draws figures by distance: real people as dots, synthetic ones as bars from 10 to 90 percent."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(11, 4.6))
    for axis, measure in zip(axes.flat, MEASURES, strict=False):
        for _, distance, figures, synthetic in rows:
            low, middle, high = np.nanquantile([m[measure] for m in synthetic], [0.1, 0.5, 0.9])
            axis.plot([distance, distance], [low, high], color="0.75", linewidth=5, solid_capstyle="butt")
            axis.plot(distance, middle, "_", color="0.35", markersize=9)
            axis.plot(distance, figures[measure], "o", color="crimson", markersize=4)
        axis.set_title(measure, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_ylim(bottom=0)
    axes.flat[-1].axis("off")
    axes.flat[-1].text(
        0,
        0.5,
        "red: labeled people of real sweeps\ngray: wild, same sensor and distance,\n"
        "10 to 90 percent, median\nx: distance, m",
        fontsize=8,
        va="center",
    )
    figure.tight_layout()
    figure.savefig(path, dpi=70)


def draw_crops(real: list, crops: list, path: Path) -> None:
    """Draws real crops from the front and the side, above three synthetic ones of the same sensor and distance."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(8, len(real), figsize=(1.7 * len(real), 15), squeeze=False)
    for column, (name, distance, points, _, box) in enumerate(real):
        people = [(points, box)] + [(p, b) for p, _, b in crops[column][:3]]
        for row, (cloud, crop) in enumerate(people):
            forward = crop.center[:2] / np.linalg.norm(crop.center[:2])
            local = cloud - crop.center
            for k, values in enumerate((local[:, :2] @ [forward[1], -forward[0]], local[:, :2] @ forward)):
                axis = axes[2 * row + k, column]
                axis.plot(values, local[:, 2], ".", color="crimson" if row == 0 else "black", markersize=2.5)
                axis.set(xlim=(-0.9, 0.9), ylim=(-1.2, 1.2), aspect="equal", xticks=[], yticks=[])
            axes[2 * row, column].set_title(f"{name if row == 0 else 'wild'} {len(cloud)} {distance:.0f} m", fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=60)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--people", type=int, default=60, help="synthetic people for each real one")
    parser.add_argument("--picture", type=Path, help="draw the figures by distance to this PNG")
    parser.add_argument("--crops", type=Path, help="draw real beside synthetic crops to this PNG")
    options = parser.parse_args()
    print_published(24)
    if options.folder is None or not list(options.folder.glob("sweep_*.json")):
        print(f"skipped: no real sweeps in {options.folder} (name a folder with sweep_N.pcd and sweep_N.json)")
        return
    real = real_people(options.folder)
    rows, crops = compare(real, options.people)
    print_table(rows)
    if options.picture:
        draw(rows, options.picture)
    if options.crops:
        draw_crops(real, crops, options.crops)


if __name__ == "__main__":
    main()
