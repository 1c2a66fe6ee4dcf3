"""Writers of tiny motion files in other formats, from poses of this package's body, for the tests of their readers."""

import json

import numpy as np

from lidarpose.body import rig
from lidarpose.body.pose_prior import sampling
from lidarpose.geometry import UP_AXES, rotation_about, rotation_vector
from lidarpose.skeleton import SMPL24

J = {name: i for i, name in enumerate(SMPL24.joints)}
# joints that retargeting places accurately; of hands and feet only the directions are known
MAIN = [J[name] for name in J if not name.endswith(("foot", "hand"))]
C = UP_AXES["y"]


def check_rotations(rotations, atol=1e-5):
    """Assert that rotations (..., 3, 3) are float32 and orthonormal, without reflection."""
    assert rotations.dtype == np.float32
    product = rotations @ np.swapaxes(rotations, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=atol)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=atol)


def a_clip(frames=6, seed=0):
    """Rotations (F, 24, 3, 3) of random poses in random headings, and a random path of the pelvis (F, 3) m, z up."""
    rng = np.random.default_rng(seed)
    rotations = sampling.sample_rotations(rng, frames, mix={"walk": 2, "idle": 2, "run": 1}).rotations.astype(float)
    rotations[:, 0] = rotation_about("z", rng.uniform(-3, 3, frames)) @ rotations[:, 0]
    way = np.cumsum(rng.uniform(-0.1, 0.1, (frames, 3)), 0) + [1.0, 2.0, 0.95]
    return rotations, way


def joints_of(rotations, translation=None):
    """Joints (F, 24, 3) m of the mean adult, with the pelvis at `translation` (F, 3) or at the origin."""
    rest = rig.mean_adult_joints()[None]
    way = np.zeros((len(rotations), 3)) if translation is None else np.asarray(translation, float)
    return rig.forward_kinematics(SMPL24.parents, rest, np.asarray(rotations, float), way)[1]


def to_smpl(rotations, up="z"):
    """Rotations of this package as SMPL's axis-angles (F, 72) in a world whose axis `up` points up."""
    local = C.T @ rotations @ C
    local[:, 0] = UP_AXES[up].T @ rotations[:, 0] @ C
    return rotation_vector(local.reshape(-1, 3, 3)).reshape(-1, 72)


def write_amass(path, rotations, translation, *, width=156, rate="mocap_framerate", fps=60.0, drop=(), **changes):
    poses = np.zeros((len(rotations), width))
    pose = to_smpl(rotations)[:, : width if width == 72 else 66]
    poses[:, : pose.shape[1]] = pose
    poses[:, 72:] = 0.3  # fingers
    content = dict(poses=poses, trans=translation, betas=np.zeros(16), gender=np.array("male"), dmpls=np.zeros(8))
    content |= {rate: np.float64(fps)} | changes
    np.savez(path, **{k: v for k, v in content.items() if k not in drop})
    return path


def write_pose_json(folder, rotations, translation, *, up="z", first=1):
    folder.mkdir(parents=True, exist_ok=True)
    for k, (pose, trans) in enumerate(zip(to_smpl(rotations, up), translation @ UP_AXES[up], strict=True)):
        content = {"beta": [0.0] * 10, "pose": pose.tolist(), "trans": trans.tolist()}
        (folder / f"{first + k:06d}.json").write_text(json.dumps(content))
    return folder


# names of SMPL's joints in other skeletons: limb joints in this order, to be put in a pattern with the side
_LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")
_CENTRAL = dict(pelvis="Hips", spine1="LowerBack", spine2="Spine", spine3="Spine1", neck="Neck", head="Head")


def _names(pattern, names):
    return _CENTRAL | {
        f"{side}_{joint}": pattern.format(name, Side=side.title(), s=side[0], S=side[0].upper())
        for side in ("left", "right")
        for joint, name in zip(_LIMBS, names.split(), strict=True)
    }


SMPL_NAMES = {name: name for name in SMPL24.joints}
CMU_NAMES = _names("{Side}{}", "UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand HandIndex1")
NAMES = {
    "smpl": SMPL_NAMES,
    "cmu": CMU_NAMES,
    "lower case": {joint: name.lower() for joint, name in CMU_NAMES.items()},
    "mixamo": {
        k: f"mixamorig:{v.replace('Spine', 'Back').replace('LowerBack', 'Spine')}" for k, v in CMU_NAMES.items()
    },
    "rokoko": _names("{Side}{}", "Thigh Shin Foot Toe Shoulder Arm ForeArm Hand Finger2"),
    "blender": _names("{}.{S}", "thigh shin foot toe shoulder upper_arm forearm hand f_middle.01"),
    "unreal": _names("{}_{s}", "thigh calf foot ball clavicle upperarm lowerarm hand middle_01"),
}


def bvh_text(rotations, translation, *, names=SMPL_NAMES, order="ZXY", unit=0.01, up="y", fps=30.0, drop=()):
    """BVH text of the mean adult: `unit` meters per number, rotation channels in the given order, without the joints in
    `drop` and their descendants."""
    world = UP_AXES[up]
    rest = rig.mean_adult_joints() @ C / unit
    local = C.T @ rotations @ C
    local[:, 0] = world.T @ rotations[:, 0] @ C
    euler = [np.degrees(to_euler(local[:, j], order)) for j in range(24)]
    at = translation @ world / unit
    lines, columns = ["HIERARCHY"], []

    def joint(j, depth):
        pad = "\t" * depth
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {names[SMPL24.joints[j]]}")
        lines.append(pad + "{")
        offset = rest[j] - rest[SMPL24.parents[j]] if depth else np.zeros(3)
        lines.append(f"{pad}\tOFFSET " + " ".join(f"{v:.6f}" for v in offset))
        turns = " ".join(f"{axis}rotation" for axis in order)
        lines.append(f"{pad}\tCHANNELS " + (f"3 {turns}" if depth else f"6 Xposition Yposition Zposition {turns}"))
        columns.extend([euler[j]] if depth else [at, euler[j]])
        children = [k for k in range(24) if SMPL24.parents[k] == j and SMPL24.joints[k] not in drop]
        for child in children:
            joint(child, depth + 1)
        if not children:
            lines.extend([f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET 0 0 0", pad + "\t}"])
        lines.append(pad + "}")

    joint(0, 0)
    lines += ["MOTION", f"Frames: {len(rotations)}", f"Frame Time: {1 / fps:.8f}"]
    lines += [" ".join(f"{v:.6f}" for v in row) for row in np.concatenate(columns, 1)]
    return "\n".join(lines) + "\n"


def to_euler(matrix, order):
    """Angles (F, 3) about the axes `order` whose rotations, multiplied in this order, give matrix (F, 3, 3)."""
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    second = np.arcsin(np.clip(sign * matrix[:, i, k], -1, 1))
    first = np.arctan2(-sign * matrix[:, j, k], matrix[:, k, k])
    third = np.arctan2(-sign * matrix[:, i, j], matrix[:, i, i])
    return np.stack([first, second, third], -1)


# CMU's bone that ends at each SMPL joint; a bone has the rotation of the joint at its start, the parent of that joint
_BONES = dict(
    pelvis="root", spine1="lowerback", spine2="upperback", spine3="midback", neck="thorax", head="lowerneck",
    hip="hipjoint", knee="femur", ankle="tibia", foot="foot", collar="inner", shoulder="clavicle", elbow="humerus",
    wrist="radius", hand="hand",
)  # fmt: skip


def _bone(joint):
    side, _, name = joint.rpartition("_")
    return side[:1] + _BONES[name]


# bone, its parent, the joints at its start and its end; bones of the trunk come first
_PARENTS = {end: SMPL24.joints[p] for end, p in zip(J, SMPL24.parents, strict=True) if p >= 0}
_ENDS = sorted(_PARENTS, key=lambda end: "_" in end)
_ASF = [(_bone(end), _bone(_PARENTS[end]), _PARENTS[end], end) for end in _ENDS]
_ASF.append(("upperneck", "lowerneck", "head", None))
ASF_ENDS = {bone: end for bone, _, _, end in _ASF if end}


def asf_text(*, length=0.45, seed=0, angle="deg"):
    """The mean adult as CMU's skeleton: y up, with random axes of each bone."""
    rng = np.random.default_rng(seed)
    scale = length / 0.0254
    rest = rig.mean_adult_joints() @ C
    axes = {}
    lines = ["# test", ":version 1.10", ":name test", ":units", "  mass 1.0", f"  length {length}", f"  angle {angle}"]
    lines += [":documentation", "  none", ":root", "   order TX TY TZ RX RY RZ", "   axis XYZ", "   position 0 0 0"]
    lines += ["   orientation 0 0 0", ":bonedata"]
    for k, (bone, _, start, end) in enumerate(_ASF, 1):
        way = (rest[J[end]] - rest[J[start]] if end else np.array([0, 0.02, 0])) * scale
        size = np.linalg.norm(way)
        axes[bone] = rng.uniform(-170, 170, 3)
        shown = axes[bone] if angle == "deg" else np.radians(axes[bone])
        lines += ["  begin", f"     id {k}", f"     name {bone}"]
        lines += ["     direction " + " ".join(f"{v:.8f}" for v in way / size), f"     length {size:.8f}"]
        lines += ["     axis " + " ".join(f"{v:.8f}" for v in shown) + "  XYZ"]
        if start != "pelvis":  # bones that start at the pelvis have the rotation of the root
            lines += ["    dof rx ry rz", "    limits (-160 20)", "           (-70 70)", "           (-60 70)"]
        lines += ["  end"]
    lines += [":hierarchy", "  begin"]
    for parent in dict.fromkeys(p for _, p, _, _ in _ASF):
        lines += [f"    {parent} " + " ".join(bone for bone, p, _, _ in _ASF if p == parent)]
    return "\n".join([*lines, "  end"]) + "\n", axes


def amc_text(rotations, translation, axes, *, length=0.45):
    local = C.T @ rotations @ C
    at = translation @ C * length / 0.0254
    columns = {"root": np.concatenate([at, np.degrees(_xyz(local[:, 0]))], 1)}
    for bone, _, start, _ in _ASF:
        if start != "pelvis":
            a = _from_xyz(np.radians(axes[bone]))
            columns[bone] = np.degrees(_xyz(a.T @ local[:, J[start]] @ a))
    lines = ["#!OML:ASF test", ":FULLY-SPECIFIED", ":DEGREES"]
    for f in range(len(rotations)):
        lines.append(str(f + 1))
        lines += [f"{bone} " + " ".join(f"{v:.7f}" for v in value[f]) for bone, value in columns.items()]
    return "\n".join(lines) + "\n"


def _xyz(matrix):
    """Angles (F, 3) about x, y, z that give rotations R_z R_y R_x."""
    return to_euler(matrix, "ZYX")[:, ::-1]


def _from_xyz(angles):
    return rotation_about("z", angles[2]) @ rotation_about("y", angles[1]) @ rotation_about("x", angles[0])
