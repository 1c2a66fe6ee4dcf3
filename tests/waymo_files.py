"""A small Waymo scene of synthesized people, and writers of both versions of the dataset in their on-disk layouts.

The scene is cast laser by laser from a moving car, so every point that a reader must return is known. The code of the
readers is not used here.
"""

import struct
import zlib
from dataclasses import dataclass, field
from functools import cache

import google_crc32c
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lidarpose.body.pose_prior.sampling import sample_rotations
from lidarpose.body.rig import load_rig, pose_bodies, sample_people
from lidarpose.geometry import rotation_about
from lidarpose.lidar.raycast import cast_ray_list
from lidarpose.skeleton import BODY26, WAYMO14

# Waymo's types of the 14 joints, in the skeleton's order
TYPES = (1, 5, 13, 6, 14, 7, 15, 8, 16, 9, 17, 10, 18, 20)
HIDDEN, SEEN = 1, 2
# time of the first frame of `scene`, us
START = 1_550_083_467_346_370
SWEEP = 0.1
FACES = load_rig().faces


@dataclass
class Laser:
    """E (4, 4) laser -> vehicle; beams (H,) rad, lowest first; table: whether `beams` is written, besides low and high;
    width: number of columns."""

    E: np.ndarray
    beams: np.ndarray
    table: bool
    low: float
    high: float
    width: int

    def directions(self):
        """(H, W, 3) in the laser's frame: row 0 is the highest beam; column 0 points just left of the car's rear, and
        the columns continue clockwise, for any heading of the laser."""
        ahead = np.pi * (1 - (2 * np.arange(self.width) + 1) / self.width)
        azimuth = ahead - np.arctan2(self.E[1, 0], self.E[0, 0])
        up = np.asarray(self.beams)[::-1, None]
        x, y = np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth)
        return np.stack([x, y, np.broadcast_to(np.sin(up), x.shape)], -1)


def rigid(x, y, z, yaw, pitch=0.0, roll=0.0):
    T = np.eye(4)
    T[:3, :3] = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
    T[:3, 3] = x, y, z
    return T


def even(low, high, rows):
    return low + (np.arange(rows) + 0.5) / rows * (high - low)


LASERS = {
    1: Laser(rigid(1.43, 0.02, 2.18, 2.59, 0.01, -0.02), -0.42 + 0.55 * np.linspace(0, 1, 40) ** 0.6, True, 0, 0, 600),
    2: Laser(rigid(4.07, 0.0, 0.69, 0.03, 0.02, 0.0), even(-0.6, 0.5, 30), False, -0.6, 0.5, 160),
    3: Laser(rigid(3.25, 1.03, 0.98, 1.58, 0.01, 0.02), even(-0.7, 0.4, 24), False, -0.7, 0.4, 150),
    4: Laser(rigid(3.25, -1.03, 0.98, -1.57, 0.0, -0.03), even(-0.7, 0.4, 24), False, -0.7, 0.4, 150),
    5: Laser(rigid(-1.15, 0.0, 0.46, 3.1, -0.02, 0.01), even(-0.5, 0.6, 30), False, -0.5, 0.6, 160),
}


@dataclass
class Someone:
    """track; kind: Waymo's type of the box; joints (14, 3) m in the frame's vehicle frame, NaN where not labeled, and
    labels (14,); box: center, size, heading or None; keypoints as they are written: (type, x, y, z, occluded); points:
    (laser, return) -> (n, 3) m in the vehicle's frame and their rows (n,)."""

    track: str
    kind: int = 2
    joints: np.ndarray | None = None
    labels: np.ndarray | None = None
    box: tuple | None = None
    keypoints: list | None = None
    points: dict = field(default_factory=dict)


@dataclass
class Frame:
    """time us; pose (4, 4) vehicle -> world; people; images: (laser, return) -> (H, W, 4) float32; poses (H, W, 6) of
    the top laser."""

    time: int
    pose: np.ndarray
    people: list
    images: dict = field(default_factory=dict)
    poses: np.ndarray | None = None


def car(seconds):
    """Roll, pitch, yaw, x, y, z of a car in a left bend at 12 m/s on uneven ground."""
    yaw = 0.8 + 0.4 * seconds
    angles = 0.01 * np.sin(9 * seconds), 0.012 * np.cos(7 * seconds), yaw
    return np.array([*angles, 1520 + 30 * np.sin(yaw), -810 - 30 * np.cos(yaw), 12 + 0.2 * np.sin(5 * seconds)])


def at(pose):
    roll, pitch, yaw, *place = pose
    return rigid(*place, yaw, pitch, roll)


@cache
def bodies(count=3, seed=4):
    """Vertices (n, V, 3) and WAYMO14 joints (n, 14, 3) about the pelvis."""
    rng, rig = np.random.default_rng(seed), load_rig()
    rotations = sample_rotations(rng, count, mix={"walk": 1.0}).rotations
    vertices, joints = pose_bodies(
        rig, rig.rest(sample_people(rng, count).coefficients), rotations, np.zeros((count, 3))
    )
    return vertices.astype(float), joints[:, BODY26.map_to(WAYMO14)].astype(float)


def someone(track, number, place, yaw, *, kind=2, missing=(), hidden=()):
    """A body of `bodies` at a place, with labels. Returns (Someone, vertices)."""
    vertices, joints = (x[number] @ rotation_about("z", yaw).T + place for x in bodies())
    local = (vertices - place) @ rotation_about("z", yaw)
    low, high = local.min(0) - 0.03, local.max(0) + 0.03
    center = (low + high) / 2 @ rotation_about("z", yaw).T + place
    labels = np.full(14, SEEN, np.uint8)
    labels[list(hidden)] = HIDDEN
    labels[list(missing)] = 0
    joints = np.where(labels[:, None] > 0, joints, np.nan)
    keypoints = [(TYPES[j], *joints[j], labels[j] == HIDDEN) for j in range(14) if labels[j]]
    # plus a joint of a camera and one of a later release, in another order
    keypoints = [(19, 1.0, 2.0, 3.0, False), *keypoints[::-1], (77, 0.0, 0.0, 0.0, True)]
    box = (*center, *(high - low), (yaw + np.pi) % (2 * np.pi) - np.pi)
    return Someone(track, kind, joints, labels, box, keypoints), vertices


def cast(frame, start, vertices, owners):
    """Fills in the images, pixel poses and people's points of a frame. vertices (P, V, 3) m of owners, in its vehicle
    frame."""
    faces = np.concatenate([FACES + k * vertices.shape[1] for k in range(len(vertices))])
    middles = vertices.mean(1)
    # the second return sees the same surface 6 cm farther away from the car
    outwards = middles * [1, 1, 0] / np.linalg.norm(middles[:, :2], axis=1)[:, None]
    surfaces = {1: vertices, 2: vertices + 0.06 * outwards[:, None]}
    rng = np.random.default_rng(frame.time % 1000)
    frame.poses = np.zeros((len(LASERS[1].beams), LASERS[1].width, 6), np.float32)
    for number, laser in LASERS.items():
        directions = laser.directions()
        image = {which: np.zeros((*directions.shape[:2], 4), np.float32) for which in (1, 2)}
        truth = {which: np.zeros((*directions.shape[:2], 4)) for which in (1, 2)}
        if number == 1:
            # the top laser turns once per sweep; the middle of the sweep is the frame's time
            seconds = start + ((np.arange(laser.width) + 0.5) / laser.width - 0.5) * SWEEP
            frame.poses[:] = np.array([car(s) for s in seconds], np.float32)
            columns = np.array([[c] for c in near_columns(laser, middles)])
        else:
            columns = np.arange(laser.width)[None]
        for some in columns:
            # pose of the car at the time of this column, in the frame's vehicle frame
            T = np.eye(4) if number > 1 else np.linalg.inv(frame.pose) @ at(frame.poses[0, some[0]].astype(float))
            T = T @ laser.E
            rays = directions[:, some].reshape(-1, 3)
            for which, surface in surfaces.items():
                seen = (surface.reshape(-1, 3) - T[:3, 3]) @ T[:3, :3]
                distance, face = cast_ray_list(seen, faces, rays)
                hit = face >= 0
                points = (rays * np.where(hit, distance, 0.0)[:, None]) @ T[:3, :3].T + T[:3, 3]
                owner = np.where(hit, face // len(FACES) + 1, 0)
                of = np.concatenate([points, owner[:, None]], 1).reshape(len(directions), len(some), 4)
                truth[which][:, some] = of
                image[which][:, some, 0] = np.where(hit, distance, 0.0).reshape(len(directions), len(some))
        # a pixel has a second return only behind its first
        second = (image[2][..., 0] > image[1][..., 0] + 0.01) & (image[1][..., 0] > 0)
        image[2][~second], truth[2][~second] = 0, 0
        # a far background between the people, in half of the pixels
        free = (image[1][..., 0] == 0) & (rng.random(image[1].shape[:2]) < 0.5)
        image[1][free, 0] = rng.integers(30, 60, free.sum())
        for which in (1, 2):
            image[which][..., 1:3] = 0.25, 0.5
            frame.images[number, which] = image[which]
            for k, one in enumerate(owners):
                row, column = np.nonzero(truth[which][..., 3] == k + 1)
                one.points[number, which] = truth[which][row, column, :3], row
    # pixels without a return have no pose
    nothing = (frame.images[1, 1][..., 0] == 0) & (frame.images[1, 2][..., 0] == 0)
    frame.poses[nothing] = 0


def near_columns(laser, middles):
    """The columns of a laser that may hit one of the people (P, 3), with a margin for the car's motion."""
    flat = middles[:, :2] - laser.E[:2, 3]
    azimuth = np.arctan2(flat[:, 1], flat[:, 0])
    ahead = np.pi * (1 - (2 * np.arange(laser.width) + 1) / laser.width)
    apart = np.abs((ahead[:, None] - azimuth + np.pi) % (2 * np.pi) - np.pi)
    return np.flatnonzero((apart < 0.25).any(1))


@cache
def scene():
    """Three frames of a segment: people with all, some and no labeled joints, without a box, and without points."""
    frames = []
    for k in range(2):
        seconds = 1.3 + 0.5 * k
        one, a = someone("ped-b", 0, [-3.5 + k, 4.0, 0.95], 0.7)
        two, b = someone("cyc-a", 1, [5.5, -4.5 + 0.3 * k, 0.9], 2.9, kind=4, missing=(3, 13), hidden=(0, 5, 6))
        people, shown, casts = [one, two], [one, two], [a, b]
        if k == 1:
            far, _ = someone("ped-far", 2, [0.0, -25.0, 1.0], 0.0)
            nowhere, _ = someone("ped-boxless", 2, [2.0, 20.0, 1.0], 0.0)
            nowhere.box = None
            unlabeled, _ = someone("ped-unlabeled", 2, [9.0, 9.0, 1.0], 0.0, missing=range(14))
            people += [far, nowhere, unlabeled]
        people += [Someone("sign-1", 3, box=(10.0, 10.0, 2.0, 0.2, 0.6, 0.7, 0.1))]
        frame = Frame(START + 500_000 * k, at(car(seconds)), people)
        cast(frame, seconds, np.array(casts), shown)
        frames.append(frame)
    # a frame without labeled people
    frames.append(Frame(START + 700_000, at(car(2.0)), [Someone("sign-1", 3, box=(9.0, 9.0, 2.0, 0.2, 0.6, 0.7, 0.1))]))
    frames[-1].images, frames[-1].poses = frames[0].images, frames[0].poses
    return frames


# --- version 2


def write_v2(root, segment="10017090168044687777_6380_000_6400_000", split="training", *, frames=None, **kinds):
    """Writes a segment. wide: int32 and double instead of int8 and float; index: with the index column of pandas;
    shuffled: rows in random order; group: rows per row group."""
    for name, (rows, schema) in v2_tables(frames or scene(), segment, **kinds).items():
        path = root / split / name / f"{segment}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), path, row_group_size=kinds.get("group", 3))


def v2_tables(frames, segment, *, wide=False, index=True, shuffled=False, group=3):
    small, real = (pa.int32(), pa.float64()) if wide else (pa.int8(), pa.float32())
    double, text = pa.float64(), pa.string()
    keys = {"segment_context_name": text, "frame_timestamp_micros": pa.int64()}
    matrix, image = pa.list_(double, 16), {"values": pa.list_(real), "shape": pa.list_(pa.int32(), 3)}
    key = {"segment_context_name": segment}
    found = {
        "lidar_hkp": ([], {**keys, "laser_object_id": text}, {
            "type": pa.list_(small), **{f"keypoint_3d.location_m.{x}": pa.list_(double) for x in "xyz"},
            "keypoint_3d.visibility.is_occluded": pa.list_(pa.bool_()),
        }, "[LiDARHumanKeypointsComponent].lidar_keypoints[*]."),
        "lidar_box": ([], {**keys, "laser_object_id": text}, {
            **{f"box.{of}.{x}": double for of in ("center", "size") for x in "xyz"}, "box.heading": double,
            "type": small, "num_lidar_points_in_box": pa.int64(), "difficulty_level.detection": small,
        }, "[LiDARBoxComponent]."),
        "lidar_calibration": ([], {"segment_context_name": text, "laser_name": small}, {
            "extrinsic.transform": matrix, "beam_inclination.min": double, "beam_inclination.max": double,
            "beam_inclination.values": pa.list_(double),
        }, "[LiDARCalibrationComponent]."),
        "vehicle_pose": ([], keys, {"world_from_vehicle.transform": matrix}, "[VehiclePoseComponent]."),
        "lidar": ([], {**keys, "laser_name": small}, {
            f"range_image_return{k}.{name}": kind for k in (1, 2) for name, kind in image.items()
        }, "[LiDARComponent]."),
        "lidar_pose": ([], {**keys, "laser_name": small}, {
            f"range_image_return1.{name}": kind for name, kind in image.items()
        }, "[LiDARPoseComponent]."),
    }  # fmt: skip
    for number, laser in LASERS.items():
        beams = laser.beams.tolist() if laser.table else None
        row = (laser.E.ravel().tolist(), laser.low, laser.high, beams)
        found["lidar_calibration"][0].append(({**key, "laser_name": number}, row))
    for frame in frames:
        of = {**key, "frame_timestamp_micros": frame.time}
        found["vehicle_pose"][0].append((of, (frame.pose.ravel().tolist(),)))
        found["lidar_pose"][0].append(({**of, "laser_name": 1}, flat(frame.poses)))
        for number in LASERS:
            row = (*flat(frame.images[number, 1]), *flat(frame.images[number, 2]))
            found["lidar"][0].append(({**of, "laser_name": number}, row))
        for one in frame.people:
            track = {**of, "laser_object_id": one.track}
            if one.box is not None:
                found["lidar_box"][0].append((track, (*one.box, one.kind, 123, 1)))
            if one.keypoints is not None:
                kinds, *places = zip(*one.keypoints, strict=True)
                found["lidar_hkp"][0].append((track, (kinds, *places)))
    rng, tables = np.random.default_rng(0), {}
    for name, (rows, keyed, valued, prefix) in found.items():
        fields = {f"key.{k}": kind for k, kind in keyed.items()} | {prefix + k: kind for k, kind in valued.items()}
        full = [
            {f"key.{k}": v for k, v in of.items()} | dict(zip([prefix + k for k in valued], row, strict=True))
            for of, row in rows
        ]
        if index:
            fields = {"index": text} | fields
            full = [{"index": ";".join(map(str, of.values()))} | row for (of, _), row in zip(rows, full, strict=True)]
        order = rng.permutation(len(full)) if shuffled else range(len(full))
        tables[name] = [full[k] for k in order], pa.schema(list(fields.items()))
    return tables


def flat(image):
    return image.ravel(), list(image.shape)


# --- version 1.4


def write_v1(root, segment="10017090168044687777_6380_000_6400_000", split="training", *, frames=None):
    path = root / split / f"segment-{segment}_with_camera_labels.tfrecord"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(record(v1_frame(frame, segment)) for frame in frames or scene()))
    return path


def record(data):
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked(length)) + data + struct.pack("<I", masked(data))


def masked(data):
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17 & 0xFFFFFFFF) + 0xA282EAD8) & 0xFFFFFFFF


def varint(value):
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def number(field, value):
    return varint(field << 3) + varint(value)


def double(field, value):
    return varint(field << 3 | 1) + struct.pack("<d", value)


def block(field, data):
    data = data.encode() if isinstance(data, str) else data
    return varint(field << 3 | 2) + varint(len(data)) + data


def doubles(field, values):
    return b"".join(double(field, float(v)) for v in values)


def matrix_float(image):
    shape = b"".join(number(1, n) for n in image.shape)
    return zlib.compress(block(1, image.astype("<f4").tobytes()) + block(2, shape), 1)


def v1_frame(frame, segment):
    context = block(1, segment) + block(2, number(1, 1) + doubles(2, [2000.0] * 9))
    for laser, of in LASERS.items():
        calibration = number(1, laser) + (doubles(2, of.beams) if of.table else b"")
        calibration += double(3, of.low) + double(4, of.high) + block(5, doubles(1, of.E.ravel()))
        context += block(3, calibration)
    context += block(4, block(2, "Day") + block(3, "location_sf"))
    out = block(1, context) + number(2, frame.time) + block(3, doubles(1, frame.pose.ravel()))
    # a camera image, which is most of a real frame
    out += block(4, number(1, 1) + block(2, b"\xff\xd8" + bytes(3000)) + double(5, 1.0))
    for laser in LASERS:
        first = block(2, matrix_float(frame.images[laser, 1])) + block(3, zlib.compress(b"a projection"))
        if laser == 1:
            first += block(4, matrix_float(frame.poses))
        second = block(2, matrix_float(frame.images[laser, 2]))
        out += block(5, number(1, laser) + block(2, first) + block(3, second))
    for one in frame.people:
        label = b""
        if one.box is not None:
            x, y, z, length, width, height, heading = one.box
            label += block(1, doubles(1, [x]) + doubles(2, [y]) + doubles(3, [z]) + double(4, width) + double(5, length)
                           + double(6, height) + double(7, heading))  # fmt: skip
        label += block(2, double(1, 0.5)) + number(3, one.kind) + block(4, one.track) + number(7, 123)
        if one.keypoints is not None:
            joints = b""
            for kind, x, y, z, occluded in one.keypoints:
                place = block(1, double(1, x) + double(2, y) + double(3, z)) + block(2, number(1, int(occluded)))
                joints += block(1, number(1, kind) + block(2, place))
            label += block(8, joints)
        out += block(6, label)
    return out + block(8, number(1, 1) + block(2, block(9, b""))) + block(11, double(1, 0.0)) + number(1000, 5)
