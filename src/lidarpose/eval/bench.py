"""lidarpose-bench: a frozen set of synthetic people and clips on which weights are scored.

One Parquet file that ships with the package and that no later version of the generator touches (`tools/make_bench.py`
made it once). A row is one person in one frame:

    clip, frame         number of the clip and frame of it; clip -1: a person alone
    condition           clean, occluded, cluttered, crop (a poor detector's box) or company (a second person)
    poses               prior (procedural) or captured (subjects kept out of all training)
    sensor, kind, distance, visible, clutter, upright      as in `sample.PersonInfo`
    origin              (3,) m in the level frame at the sensor; points_mm: x, y, z of all points from it, millimeters
    part                one a point: 0 = not body, 1 + j = the bone of SMPL-24's joint j
    joints              x, y, z of body26's joints, m, in the level frame at the sensor, which stands at its origin
    box                 center (3), size (3), yaw of the detector's box: m, rad
"""

import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.shards import pyarrow
from lidarpose.geometry import rotation_about
from lidarpose.io.files import file_error, read_bytes
from lidarpose.sample import center_of
from lidarpose.skeleton import BODY26

NAME = "lidarpose-bench-1"
# key of the card in the file's metadata
METADATA = "lidarpose-bench"
SHA256 = "8abcafc6628c7580b8bdf91f9c05992c7c6e4098d6922973c7cfc39d8fe0e0d2"

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


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The set in memory. points: one (n, 3) float64 m a row, in the level frame at the sensor; joints (N, 26, 3) m;
    columns: the others by name, (N,) or (N, k); card: how it was made."""

    points: tuple[np.ndarray, ...]
    joints: np.ndarray
    columns: dict[str, np.ndarray]
    card: dict

    @property
    def people(self) -> np.ndarray:
        """Rows of people alone."""
        return np.flatnonzero(self.columns["clip"] < 0)

    @property
    def clips(self) -> list[np.ndarray]:
        """Rows of each clip, in order of time."""
        clip = self.columns["clip"]
        return [np.flatnonzero(clip == k) for k in range(int(clip.max(initial=-1)) + 1)]


def bench_path() -> Path:
    """Where the package keeps the file."""
    return Path(str(resources.files("lidarpose.eval") / "assets" / f"{NAME}.parquet"))


def schema():
    """The file's Arrow schema."""
    pa, _ = pyarrow()
    types = {
        name: pa.list_(pa.type_for_alias(kind[0])) if isinstance(kind, list) else pa.type_for_alias(kind)
        for name, kind in COLUMNS.items()
    }
    return pa.schema(list(types.items()))


def load_bench() -> Bench:
    """The set. Raises InputError where the file is not the one that was frozen, MissingExtra without pyarrow."""
    pa, parquet = pyarrow()
    path = bench_path()
    data = read_bytes(path, expected=f"{NAME}, a Parquet file")
    if hashlib.sha256(data).hexdigest() != SHA256:
        raise file_error(path, f"is not {NAME} as it was frozen: install lidarpose again")
    table = parquet.read_table(pa.BufferReader(data), schema=schema())
    card = json.loads(parquet.read_schema(pa.BufferReader(data)).metadata[METADATA.encode()])
    columns: dict[str, Any] = {}
    for name, kind in COLUMNS.items():
        # lists of all people lie in one array, one after the other
        column = table[name].combine_chunks()
        if isinstance(kind, list):
            columns[name] = np.split(column.values.to_numpy(), column.offsets.to_numpy()[1:-1])
        else:
            columns[name] = column.to_numpy(zero_copy_only=False)
    columns |= {name: np.stack(columns[name]) for name in ("origin", "joints", "box")}
    shifts = zip(columns["origin"], columns.pop("points_mm"), strict=True)
    points = tuple(origin + millimeters.reshape(-1, 3) / 1e3 for origin, millimeters in shifts)
    columns["num_points"] = np.array([len(cloud) for cloud in points])
    joints = columns.pop("joints").reshape(-1, len(BODY26), 3)
    return Bench(points=points, joints=joints, columns=columns, card=card)


def facing(joints: np.ndarray) -> np.ndarray:
    """joints (N, 26, 3) m of body26 -> (N,) rad: the direction that hips and shoulders face, from above."""
    at = BODY26.index
    left = joints[:, at("left_hip")] - joints[:, at("right_hip")]
    left = left + joints[:, at("left_shoulder")] - joints[:, at("right_shoulder")]
    return np.arctan2(-left[:, 0], left[:, 1])


def mean_poses(bench: Bench) -> dict[str, np.ndarray]:
    """Baselines that know no points: joints (N, 26, 3) m of the mean skeleton about the points' center, turned to the
    true facing ("mean pose, true facing") and not turned at all ("mean pose"). The means are over this set's people."""
    clouds = zip(bench.points, bench.columns["origin"], strict=True)
    center = np.stack([center_of(points) if len(points) else origin for points, origin in clouds])
    offset = bench.joints - center[:, None]
    R_level_person = rotation_about("z", facing(bench.joints))
    # row vectors: x_person = x_level @ R_level_person
    turned = (offset @ R_level_person)[bench.people].mean(0)
    return {
        "mean pose, true facing": center[:, None] + turned @ np.swapaxes(R_level_person, -1, -2),
        "mean pose": center[:, None] + offset[bench.people].mean(0),
    }
