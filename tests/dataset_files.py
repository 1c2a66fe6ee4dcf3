"""Writers of tiny synthetic datasets in the on-disk layouts of the real ones, for the tests of their readers.

Each writer returns the expected output of a reader: (sequence, frame, track) -> joints (J, 3) m in its frame.
"""

import json
import pickle
from dataclasses import dataclass

import motion_files
import numpy as np
from test_smpl import synthetic

from lidarpose.body.smpl import load_body
from lidarpose.geometry import axis_angle_to_matrix, rotation_vector
from lidarpose.skeleton import HUMAN15, ITOP14, SMPL24

TO_HUMAN15 = SMPL24.map_to(HUMAN15)


@dataclass
class People:
    """F frames of one SMPL person, z up: betas (10,), pose (F, 72), trans (F, 3), vertices (F, V, 3), joints
    (F, 24, 3)."""

    betas: np.ndarray
    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    joints: np.ndarray

    def cloud(self, frame, rng, count=150, sensor=(0.0, 0.0, 0.0)):
        """Points (count, 3) on the side that faces the sensor."""
        at = self.vertices[frame]
        toward = np.asarray(sensor) - at.mean(0)
        near = at[np.argsort(-(at @ toward))[: len(at) // 2]]
        return near[rng.integers(0, len(near), count)] + rng.normal(0, 0.005, (count, 3))


def write_smpl(path, seed=0):
    """Write a SMPL file of a random body."""
    np.savez(path, **synthetic(seed=seed))
    return path


def person(smpl, frames=4, seed=0, at=(8.0, 2.0, 0.0), betas=None):
    """Motion of a random person of a model file, near `at` m."""
    rng = np.random.default_rng(seed)
    rotations, way = motion_files.a_clip(frames, seed)
    pose = motion_files.to_smpl(rotations)
    betas = rng.normal(0, 0.7, 10) if betas is None else betas
    trans = way + at
    vertices, joints = load_body(smpl).pose(np.repeat(betas[None], frames, 0), pose, trans)
    return People(betas=betas, pose=pose, trans=trans, vertices=vertices, joints=joints)


# --- clouds


def write_cloud(path, points, header, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = "".join("{:.6f} {:.6f} {:.6f}\n".format(*p) for p in points).encode()
    path.write_bytes(header.encode() + (rows if text else np.asarray(points, "<f4").tobytes()))


def write_ply(path, points, *, text=False):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    kind = "ascii" if text else "binary_little_endian"
    write_cloud(path, points, f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{axes}end_header\n", text)


def write_pcd(path, points, *, text=False):
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    header += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\n"
    write_cloud(path, points, f"{header}DATA {'ascii' if text else 'binary'}\n", text)


# --- HumanM3


def write_humanm3(root, smpl, *, sequences=("train/basketball1", "test/plaza/seg0"), frames=3, first=7, digits=4):
    """Two people per frame, and ground points. digits: width of the numbers in names of label files (0: not padded)."""
    truth = {}
    for k, sequence in enumerate(sequences):
        rng = np.random.default_rng(k)
        crowd = {str(t): person(smpl, frames, seed=10 * k + t, at=(4.0 * t, -3.0, 0.0)) for t in (2, 10)}
        for f in range(frames):
            frame = first + f
            ground = rng.uniform([-20, -20, -0.02], [40, 20, 0.02], (400, 3))
            clouds = [one.cloud(f, rng, sensor=(0, -10, 2)) for one in crowd.values()]
            write_pcd(root / sequence / f"pointcloud/{frame:06d}.pcd", np.concatenate([*clouds, ground]), text=f == 1)
            bodies = {track: one.joints[f, TO_HUMAN15] for track, one in crowd.items()}
            path = root / sequence / f"pose_calib/{frame:0{digits}d}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({track: joints.tolist() for track, joints in bodies.items()}))
            truth |= {(sequence, frame, track): joints for track, joints in bodies.items()}
        (root / sequence / "camera_calibration").mkdir()
    return truth


def write_humanm3_database(root, truth, *, cameras=4, name="train.pkl"):
    """The authors' database of the files of `write_humanm3`: each person once per camera, paths of another machine."""
    db = []
    for sequence, frame in dict.fromkeys((sequence, frame) for sequence, frame, _ in truth):
        joints = np.stack([joints for (s, f, _), joints in truth.items() if (s, f) == (sequence, frame)])
        view = {"joints_3d": joints, "joints_3d_vis": np.ones_like(joints), "joints_2d": joints[..., :2], "camera": {}}
        path = f"/somewhere/else/collection/{sequence}/pointcloud/{frame:06d}.pcd"
        db.append({"pcd": path, "info": [dict(view, camera={"fx": np.float64(k)}) for k in range(cameras)]})
    (root / name).write_bytes(pickle.dumps({"db": db}, protocol=4))


# --- LiDARHuman26M


def write_lidarhuman26m(root, smpl, *, sequences=("5", "7"), frames=3, R_sensor_level=None):
    """R_sensor_level (3, 3): rotation of the mounted LiDAR, level by default. The returned joints are level."""
    R = np.eye(3) if R_sensor_level is None else R_sensor_level
    truth = {}
    for sequence in sequences:
        rng = np.random.default_rng(int(sequence))
        one = person(smpl, frames, seed=int(sequence), at=(14.0, 3.0, 0.0))
        for f in range(frames):
            write_ply(root / f"labels/3d/segment/{sequence}/{f + 1:06d}.ply", one.cloud(f, rng) @ R.T, text=f == 1)
            path = root / f"labels/3d/pose/{sequence}/{f + 1:06d}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            pose, rest = one.pose[f].copy(), one.joints[f, 0] - one.trans[f]
            pose[:3] = rotation_vector((R @ axis_angle_to_matrix(pose[:3]))[None])[0]
            trans = R @ one.joints[f, 0] - rest
            content = {"beta": one.betas.tolist(), "pose": pose.tolist(), "trans": trans.tolist()}
            path.write_text(json.dumps(content))
            truth[sequence, f + 1, "0"] = one.joints[f]
    return truth


# --- SLOPER4D


def quaternion(matrix):
    """x y z w of a rotation (3, 3) of less than half a turn."""
    w = np.sqrt(max(1 + np.trace(matrix), 1e-12)) / 2
    skew = [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    return np.array([*(np.array(skew) / (4 * w)), w])


def sloper4d_labels(smpl, sequence, *, frames=4, without=(1,), total=None, refined=True, gender="male"):
    """(content of the label file, expected joints). The LiDAR moves and tilts as on a head; frames in `without` have no
    cloud."""
    rng = np.random.default_rng(len(sequence))
    one = person(smpl, frames, seed=3, at=(103.0, -50.0, 2.0))
    numbers = [100 + 5 * f for f in range(frames)]
    way, clouds, point_frame, truth = [], [], [], {}
    for f, number in enumerate(numbers):
        place = np.array([100.0 + 0.1 * f, -50.0, 3.7])
        heading, pitch, roll = 0.4 + 0.1 * f, 0.25, -0.1
        turns = [axis_angle_to_matrix(vector) for vector in ([0, 0, heading], [0, pitch, 0], [roll, 0, 0])]
        R_world_sensor = turns[0] @ turns[1] @ turns[2]
        # a quaternion and its negative are the same rotation
        way.append([f, *place, *(-1) ** f * quaternion(R_world_sensor), 1641234567.5 + 0.05 * f])
        if f in without:
            continue
        clouds.append(one.cloud(f, rng, sensor=place))
        point_frame.append(number)
        truth[sequence, number, "second_person"] = (one.joints[f] - place) @ axis_angle_to_matrix([0, 0, heading])
    poses = {"opt_pose": one.pose, "opt_trans": one.trans, "pose": one.pose * 0.9, "trans": one.trans + 0.1}
    if not refined:
        poses = {"pose": one.pose, "trans": one.trans}
    content = {
        "framerate": 20,
        "frame_num": numbers,
        "first_person": {"lidar_traj": np.array(way), "gender": "male"},
        "second_person": {
            **poses, "beta": one.betas, "gender": gender, "point_clouds": clouds, "point_frame": point_frame,
        },
        "RGB_info": {"fps": 20, "width": 1920, "height": 1080},
        "RGB_frames": {"file_basename": [""] * frames, "bbox": [[]] * frames},
    }  # fmt: skip
    return content | ({} if total is None else {"total_frames": total}), truth


def write_sloper4d(root, smpl, *, sequences=("seq002_football_001", "seq009_running_002"), **kinds):
    found = {}
    for sequence in sequences:
        content, truth = sloper4d_labels(smpl, sequence, **kinds)
        path = root / sequence / f"{sequence}_labels.pkl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(content, protocol=4))
        found |= truth
    return found


# --- corpora


def write_lipd(root, smpl, *, name="LIPD_train.pkl", frames=3):
    """Entries with each of three encodings of positions, one without positions, and one cloud in a separate file."""
    rng, entries, truth = np.random.default_rng(0), [], {}
    one = person(smpl, frames, seed=1)
    for f in range(frames):
        cloud = one.cloud(f, rng).astype(np.float32)
        root_at = one.joints[f, 0]
        entry = {"gt": one.pose[f], "gt_joint": one.joints[f] - root_at, "pc": cloud, "imu_ori": np.zeros((4, 3, 3))}
        if f == 0:
            (root / "bins").mkdir(parents=True)
            cloud.tofile(root / "bins/0.bin")
            entry |= {"pc": "/their/machine/bins/0.bin", "trans": root_at}
        elif f == 1:
            entry |= {"trans": root_at - cloud.mean(0)}
        else:
            entry |= {"gt_joint": one.joints[f].reshape(-1)}
        entries.append(entry | {"seq_path": "walk"})
        truth[f"{name}/walk", f, "0"] = one.joints[f]
    entries.append({"seq_path": "walk", "gt_joint": one.joints[0] - one.joints[0, 0], "pc": entries[1]["pc"]})
    (root / name).write_bytes(pickle.dumps(entries, protocol=4))
    return truth


def write_freemotion(root, smpl, *, name="fm_test2.pkl", frames=2, noise=False):
    """Each person is seen by three LiDARs. noise: the layout that the authors' script writes for NoiseMotion."""
    rng, entries, truth = np.random.default_rng(0), [], {}
    root.mkdir(parents=True, exist_ok=True)
    one = person(smpl, 3 * frames if noise else frames, seed=1)
    for f in range(frames):
        here = 3 * f + 1 if noise else f
        span = slice(3 * f, 3 * f + 3) if noise else f
        betas = np.repeat(one.betas[None], 3, 0) if noise else one.betas
        entry = {"seq_path" if noise else "motion_id": "m1", "gt": one.pose[span], "shape": betas}
        for view in (1, 2, 3):
            shift = np.array([3.0 * view, -view, 0.5])
            entry[f"pc_{view}"] = one.cloud(here, rng) + shift
            entry[f"T_{view}"] = one.joints[here, 0] + shift
            truth[f"{name}/m1", f, str(view)] = one.joints[here] + shift
        entries.append(entry)
    (root / name).write_bytes(pickle.dumps(entries, protocol=4))
    return truth


# --- ITOP


# the 15 joints of the file; SMPL has no torso joint, and the center of the head is placed above SMPL's head
ITOP_JOINTS = (*ITOP14.joints[:8], "torso", *ITOP14.joints[8:])


def itop_joints(joints):
    """SMPL's joints (F, 24, 3), z up -> ITOP's (F, 15, 3)."""
    of = {name: joints[:, SMPL24.index(name)] for name in SMPL24.joints}
    of |= {"head_center": of["head"] + [0, 0, 0.09], "torso": (of["neck"] + of["pelvis"]) / 2}
    return np.stack([of[name] for name in ITOP_JOINTS], 1)


def write_itop(root, smpl, *, parts=("side/test", "side/train"), frames=3, invalid=(), mirrored=False):
    """A person on the floor of a room with a wall and a chair. Frames in `invalid` are marked as not valid. mirrored: x
    is left. The camera is 1.2 m above the floor, in the top view 2.9 m."""
    import h5py

    root.mkdir(parents=True, exist_ok=True)
    truth, sign = {}, 1 if mirrored else -1
    for k, part in enumerate(parts):
        view, rng = part.split("/")[0], np.random.default_rng(k)
        # the camera of the side view looks along x, that of the top view down, with x up in its image
        at, floor, camera_of = (
            ((2.6, 0.0), -1.2, lambda p: np.stack([sign * p[..., 1], p[..., 2], p[..., 0]], -1))
            if view == "side"
            else ((0.2, 0.1), -2.9, lambda p: np.stack([sign * p[..., 1], p[..., 0], -p[..., 2]], -1))
        )
        one = person(smpl, frames, seed=k)
        clouds, joints = np.zeros((frames, 76800, 3), np.float16), np.zeros((frames, 15, 3), np.float32)
        visible, names = np.ones((frames, 15), np.int16), [f"{4 * k:02d}_{7 + f:05d}" for f in range(frames)]
        visible[:, ITOP_JOINTS.index("left_hand")] = 0
        for f in range(frames):
            shift = np.array([*at, floor]) - [*one.joints[f, 0, :2], one.vertices[f, :, 2].min()]
            body = one.vertices[f][rng.integers(0, len(one.vertices[f]), 3000)] + shift
            ground = rng.uniform([1.5, -1.5, floor], [3.5, 1.5, floor + 0.01], (20000, 3))
            wall = rng.uniform([3.9, -2, floor], [3.91, 2, 1.2], (5000, 3))
            chair = rng.uniform([3.1, -0.8, floor + 0.1], [3.3, -0.7, floor + 0.7], (400, 3))
            room = np.concatenate([body, *([ground, wall, chair] if view == "side" else [])])
            clouds[f, : len(room)] = camera_of(room)
            own = itop_joints(one.joints[f : f + 1])[0] + shift
            joints[f] = camera_of(own)
            if f not in invalid:
                truth[f"{view}/{4 * k:02d}", 7 + f, "0"] = np.delete(own, ITOP_JOINTS.index("torso"), 0)
        valid = np.array([f not in invalid for f in range(frames)], np.uint8)
        labels = {"is_valid": valid, "real_world_coordinates": joints, "visible_joints": visible}
        for kind, content in (("labels", labels), ("point_cloud", {"data": clouds})):
            with h5py.File(root / f"ITOP_{part.replace('/', '_')}_{kind}.h5", "w") as file:
                file["id"] = np.array(names, "S8")
                for name, values in content.items():
                    file[name] = values
    return truth
