"""Draws the picture of real people at the top of the README, from three public recordings of Ouster sensors.

    python tools/draw_real_scans.py STREET.npz WALL.npz BICYCLE.npz --out docs/images/real.png

The recordings are `OS-1-32-G_v2.1.1_1024x10`, `OS-0-32-U1_v2.2.0_1024x10` and `OS-0-128-U1_v2.3.0_1024x10`,
test data of Ouster's SDK (https://github.com/ouster-lidar/ouster-sdk, BSD-3-Clause). Each npz holds the first frame of
one of them as `xyz`, (..., 3) meters in the sensor frame, z up, 0,0,0 for missing returns; with `ouster-sdk`:

    for frames in ouster.sdk.open_source("OS-1-32-G_v2.1.1_1024x10.pcap"):
        xyz = ouster.sdk.core.XYZLut(frames[0].sensor_info, False)(frames[0])

The boxes were placed by hand. The poses are those of the default weights, unchanged.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

import lidarpose

# center and size in meters, in the sensor frame
BOXES = {
    "street": [
        {"id": "2", "center": [7.24, -4.62, -0.85], "size": [0.60, 0.60, 1.85]},
        {"id": "3", "center": [6.88, -5.03, -0.85], "size": [0.60, 0.55, 1.85]},
        {"id": "4", "center": [2.78, -5.52, -0.80], "size": [0.85, 0.75, 1.90]},
        {"id": "5", "center": [1.92, -5.82, -0.85], "size": [0.65, 0.65, 1.90]},
        {"id": "6", "center": [1.72, -4.28, -0.85], "size": [0.80, 0.75, 1.85]},
        {"id": "7", "center": [-0.18, -4.80, -0.85], "size": [0.70, 0.55, 1.85]},
    ],
    "wall": [{"id": "8", "center": [-2.72, 0.78, -0.42], "size": [0.75, 0.80, 1.95]}],
    "bicycle": [{"id": "1", "center": [1.85, 3.28, -1.10], "size": [1.00, 0.80, 1.75]}],
}
BACKGROUND, INK, FAINT = "#0b0f14", "#e6edf3", "#8b949e"
SIDE_COLORS = {"left": "#3fb6ff", "right": "#ff9a3c", "center": "#ffffff"}
WIDTH, SCENE_HEIGHT, CARD_HEIGHT = 12.0, 3.5, 3.0  # inches
SCENE_GAP = 0.06


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: `eye` and `target` (3,) m in the sensor frame, `focal` in image widths."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    focal: float

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) image coordinates, 0 in the middle, 1 = one image width; (n,) depth in m."""
        eye = np.asarray(self.eye)
        forward = np.asarray(self.target) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        offset = np.asarray(points) - eye
        depth = offset @ forward
        image = np.stack((offset @ right, offset @ np.cross(right, forward)), axis=-1)
        return self.focal * image / np.maximum(depth, 0.05)[..., None], depth


GROUND = {"street": -1.75, "wall": -1.33, "bicycle": -1.95}  # m
# recording, width in inches, camera
SCENES = [
    ("bicycle", 5.2, Camera(eye=(1.5, -1.0, 0.5), target=(1.35, 4.0, -0.62), focal=0.72)),
    ("street", 6.74, Camera(eye=(3.55, 0.7, 0.5), target=(3.6, -5.5, -0.72), focal=0.62)),
]
CARDS = [("bicycle", 0), *(("street", index) for index in range(6)), ("wall", 0)]


def read_points(path: Path) -> np.ndarray:
    """(n, 3) m: the returns of a decoded recording."""
    with np.load(path) as arrays:
        points = arrays["xyz"].reshape(-1, 3).astype(float)
    # leaves out the car that carries the sensor
    return points[np.linalg.norm(points[:, :2], axis=1) > 2.1]


def near_box(points: np.ndarray, box: dict, margin: float) -> np.ndarray:
    """(n,) bool: the points within a box that is enlarged by `margin` meters on each side."""
    return (np.abs(points - box["center"]) <= np.asarray(box["size"]) / 2 + margin).all(axis=1)


def height_colors(points: np.ndarray, depth: np.ndarray, ground: float) -> np.ndarray:
    """(n, 4) colors: from blue on the ground to green above, fading with depth."""
    color = colormaps["viridis"](np.clip((points[:, 2] - ground) / 5.0, 0, 1) * 0.62 + 0.3)
    color[:, :3] *= np.clip(1.2 - depth / 40, 0.65, 1.0)[:, None]
    return color


def draw_points(
    ax, points: np.ndarray, camera: Camera, *, ground: float, size: float, largest: float, person: np.ndarray
) -> None:
    image, depth = camera.project(points)
    is_visible = (depth > 0.4) & (np.abs(image[:, 0]) < 0.55)
    order = np.flatnonzero(is_visible)[np.argsort(-depth[is_visible])]
    colors = height_colors(points, depth, ground)
    colors[person] = (0.93, 0.93, 0.88, 0.9)
    area = np.clip(size / depth**2, 0.5, largest) * np.where(person, 2.0, 1.0)
    ax.scatter(*image[order].T, s=area[order], c=colors[order], lw=0)


def draw_skeleton(ax, person, camera: Camera, *, width: float) -> None:
    names = person.skeleton.joints
    image, _ = camera.project(person.joints)
    for i, j in person.skeleton.bones:
        side = names[j].split("_")[0]
        color = SIDE_COLORS.get(side, SIDE_COLORS["center"])
        alpha = np.clip(min(person.confidence[[i, j]]) * 1.1, 0.3, 1)
        for line_color, line_width, zorder in ((BACKGROUND, 2 * width, 3), (color, width, 4)):
            style = {"lw": line_width, "capstyle": "round", "alpha": alpha, "zorder": zorder}
            ax.add_collection(LineCollection([image[[i, j]]], colors=line_color, **style))


def view_axes(figure, left: float, bottom: float, width: float, height: float, total: float):
    """Axes of `width` x `height` inches in which one image width is one unit."""
    ax = figure.add_axes((left / WIDTH, bottom / total, width / WIDTH, height / total), facecolor=BACKGROUND)
    ax.set(xlim=(-0.5, 0.5), ylim=(-0.5 * height / width, 0.5 * height / width), xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    return ax


def draw(scans: dict[str, np.ndarray], poses: dict) -> Figure:
    total = SCENE_HEIGHT + CARD_HEIGHT
    figure = Figure(figsize=(WIDTH, total), dpi=140, facecolor=BACKGROUND)
    left = 0.0
    for name, width, camera in SCENES:
        ax = view_axes(figure, left, CARD_HEIGHT, width, SCENE_HEIGHT, total)
        draw_scene(ax, scans[name], poses[name], BOXES[name], camera, GROUND[name])
        left += width + SCENE_GAP
    width = WIDTH / len(CARDS)
    for k, (name, index) in enumerate(CARDS):
        ax = view_axes(figure, k * width, 0, width, CARD_HEIGHT, total)
        draw_card(ax, scans[name], poses[name][index], BOXES[name][index], GROUND[name])
    return figure


def draw_scene(ax, points: np.ndarray, poses, boxes: list[dict], camera: Camera, ground: float) -> None:
    is_person = np.any([near_box(points, box, 0.0) & (points[:, 2] > ground + 0.12) for box in boxes], axis=0)
    draw_points(ax, points, camera, ground=ground, size=60, largest=3, person=is_person)
    for pose in poses:
        draw_skeleton(ax, pose, camera, width=2.0)
        head, _ = camera.project(pose.joints[15] + (0, 0, 0.38))
        ax.text(*head, pose.id, color=INK, fontsize=10, ha="center", weight="bold", zorder=6)


def draw_card(ax, points: np.ndarray, pose, box: dict, ground: float) -> None:
    """One person, seen from 35 degrees beside the sensor's line of sight."""
    center = pose.joints.mean(axis=0)
    distance = np.linalg.norm(center[:2])
    bearing = np.arctan2(-center[1], -center[0]) + np.radians(35)
    eye = center + 4.0 * np.array([np.cos(bearing), np.sin(bearing), 0.16])
    camera = Camera(eye=tuple(eye), target=tuple(center - (0, 0, 0.24)), focal=3.1)
    low = ax.get_ylim()[0]
    near_points = points[near_box(points, box, 0.25)]
    near_points = near_points[camera.project(near_points)[0][:, 1] > low + 0.38]
    is_person = near_box(near_points, box, 0.0) & (near_points[:, 2] > ground + 0.12)
    draw_points(ax, near_points, camera, ground=ground, size=60, largest=7, person=is_person)
    draw_skeleton(ax, pose, camera, width=2.6)
    ax.text(0, low + 0.27, pose.id, color=INK, fontsize=9, ha="center", weight="bold")
    text = f"{pose.num_points} points, {distance:.1f} m\nconfidence {pose.confidence.mean():.2f}"
    ax.text(0, low + 0.05, text, color=FAINT, fontsize=7.5, ha="center", linespacing=1.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in BOXES:
        parser.add_argument(name, type=Path, help=f"npz of the recording with the {name}")
    parser.add_argument("--out", type=Path, default=Path("docs/images/real.png"))
    args = parser.parse_args()
    model = lidarpose.load()
    scans, poses = {}, {}
    for name, boxes in BOXES.items():
        scans[name] = read_points(getattr(args, name))
        poses[name] = model.predict(scans[name], boxes=boxes)
    figure = draw(scans, poses)
    FigureCanvasAgg(figure).print_png(args.out, metadata={"Software": None})
    with Image.open(args.out) as image:
        image.convert("RGB").quantize(96, dither=Image.Dither.NONE).save(args.out, optimize=True)
    print(f"{args.out}: {args.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
