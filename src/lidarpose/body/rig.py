"""The shipped body: a mesh with SMPL's joint tree, skinning, body shapes of people on streets, and clothing.

The rest pose is a T-pose facing +x: arms along +-y with the palms down, legs down, feet along +x, and the pelvis at the
origin. All bone frames are the level frame (x forward, y left, z up) at rest, so a pose is 24 local rotations
R_j and the position of the pelvis:

    G_j = G_parent @ R_j        p_j = p_parent + G_parent @ (rest_j - rest_parent)

Hip flexion (thigh forward) is a negative rotation about y, knee flexion a positive one.

Body shapes come from the rig's table of sampled people. The table's source has too many thin adults, so rows are drawn
with weights that bring the distributions of height and BMI close to those of real adults. Each drawn row is mixed with
a similar row so that no two people are the same.

n people, V vertices, F faces, S shape coefficients. Lengths in meters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import BODY26, SMPL24

CHILD_SHARE = 0.12
ADULT_AGE = 18.0

# adult height (mean, standard deviation) in m: chosen a little below US means, for streets of several continents
HEIGHT = {"male": (1.74, 0.075), "female": (1.615, 0.070)}
# adult BMI, log-normal (median in kg/m2, deviation of the logarithm): chosen, 5th to 95th percentile about 18 to 33
BMI = {"male": (25.0, 0.16), "female": (24.5, 0.19)}
# old people are rarer on streets (chosen): full weight up to 60 years, 40 % at 80
OLD_FROM, OLD_TO, OLD_SHARE = 60.0, 80.0, 0.4
# upper bound of a row's weight, as a multiple of the mean weight of its sex and age group
WEIGHT_CAP = 6.0
# a person is a row of the table mixed with one of this many nearest rows; the first row has a weight of at least half
NEIGHBORS = 8

MAX_CLOTHING = 0.04
# relative change of the cloth's thickness by a wave of folds
FOLD_GAIN = np.float32(0.18)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A body that can be posed: the shipped one, or one from a user's SMPL file (`body.smpl`). Arrays are read-only and
    C-contiguous.

    faces (F, 3) int32, counter-clockwise seen from outside; face_part (F,) uint8 = 1 + SMPL joint (0 is background);
    weight_index, weight (V, 4) int32, float32: the joints that move a vertex, strongest first, unused ones 0;
    parents (24,) int32; template (V, 3) m and morphs (S, V, 3) m per unit of coefficient; joint_template (26, 3) and
    joint_morphs (S, 26, 3) likewise, in BODY26's order. The table of N sampled people: coefficients (N, S),
    sex (N,) "female" or "male", age (N,) years, height (N,) m, bmi (N,) kg/m2; the last four are empty unless
    this is the shipped body.
    """

    faces: np.ndarray
    face_part: np.ndarray
    weight_index: np.ndarray
    weight: np.ndarray
    parents: np.ndarray
    template: np.ndarray
    morphs: np.ndarray
    joint_template: np.ndarray
    joint_morphs: np.ndarray
    coefficients: np.ndarray
    sex: np.ndarray
    age: np.ndarray
    height: np.ndarray
    bmi: np.ndarray

    def __post_init__(self):
        for field in fields(self):
            getattr(self, field.name).flags.writeable = False

    @property
    def dense_weight(self) -> np.ndarray:
        """(V, 24) float32: skinning weight of each joint at each vertex; rows sum to 1."""
        weights = np.zeros((len(self.weight), len(SMPL24)), np.float32)
        np.add.at(weights, (np.arange(len(weights))[:, None], self.weight_index), self.weight)
        return weights

    def rest(self, coefficients: np.ndarray) -> "RestBody":
        """T-posed bodies with shape coefficients (n, S); zeros give the mean person of the table."""
        coefficients = np.asarray(coefficients, np.float32)

        def shaped(template: np.ndarray, morphs: np.ndarray) -> np.ndarray:
            return template + (coefficients @ morphs.reshape(len(morphs), -1)).reshape(-1, *template.shape)

        return RestBody(
            vertices=shaped(self.template, self.morphs), joints=shaped(self.joint_template, self.joint_morphs)
        )

    def draw_people(self, rng: np.random.Generator, n: int) -> "RestBody":
        """Draws n people at rest: with `sample_people` for the shipped body, else uniformly from the table's rows."""
        if len(self.sex):
            return self.rest(sample_people(rng, n).coefficients)
        return self.rest(self.coefficients[rng.integers(len(self.coefficients), size=n)])


@dataclass(frozen=True, kw_only=True)
class RestBody:
    """T-posed bodies, pelvis at the origin: vertices (n, V, 3), joints (n, 26, 3) in BODY26's order, float32 m."""

    vertices: np.ndarray
    joints: np.ndarray


@cache
def load_rig() -> Rig:
    """The shipped body; cached."""
    with resources.files(__package__).joinpath("assets/body.npz").open("rb") as file:
        arrays = dict(np.load(file, allow_pickle=False))
    for name in ("template", "morphs", "joint_template", "joint_morphs", "coefficients", "age", "height", "bmi"):
        arrays[name] = np.ascontiguousarray(arrays[name], np.float32)
    arrays["weight"] = arrays["weight"].astype(np.float32) / np.float32(255)
    for name in ("faces", "weight_index"):
        arrays[name] = np.ascontiguousarray(arrays[name], np.int32)
    arrays["sex"] = np.where(arrays.pop("female"), "female", "male")
    return Rig(parents=np.array(SMPL24.parents, np.int32), **arrays)


def forward_kinematics(
    parents: Sequence[int] | np.ndarray, rest_joints: np.ndarray, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations and joint positions of a kinematic tree.

    Args:
        parents: J indices, -1 for the root; parents precede their children.
        rest_joints: (n or 1, J, 3) m.
        rotations: (n, J, 3, 3), local.
        translation: (n, 3) m, position of the root.

    Returns:
        Global rotations (n, J, 3, 3) and positions (n, J, 3) m.
    """
    rotations, translation = np.asarray(rotations), np.asarray(translation)
    global_rotations = np.empty_like(rotations)
    positions = np.empty(rotations.shape[:-1], np.result_type(rest_joints, rotations, translation))
    for j, parent in enumerate(parents):
        if parent < 0:
            global_rotations[:, j], positions[:, j] = rotations[:, j], translation
        else:
            global_rotations[:, j] = global_rotations[:, parent] @ rotations[:, j]
            bone = (rest_joints[:, j] - rest_joints[:, parent])[..., None]
            positions[:, j] = positions[:, parent] + (global_rotations[:, parent] @ bone)[..., 0]
    return global_rotations, positions


def heading(rotations: np.ndarray) -> np.ndarray:
    """Yaw (n,) rad of poses (n, 24, 3, 3): the twist of the root's rotation about z (swing-twist)."""
    root = rotations[:, 0]
    return np.arctan2(root[:, 1, 0] - root[:, 0, 1], root[:, 0, 0] + root[:, 1, 1])


def without_yaw(rotations: np.ndarray) -> np.ndarray:
    """The same poses (n, 24, 3, 3) with the root turned about z so that they face +x: `heading` is 0."""
    rotations = np.array(rotations)
    rotations[:, 0] = rotation_about("z", -heading(rotations)) @ rotations[:, 0]
    return rotations


@cache
def mean_adult_joints() -> np.ndarray:
    """(24, 3) m: T-pose joints of the shipped body's mean adult, in SMPL's order; read-only."""
    rig = load_rig()
    mean_coefficients = rig.coefficients[rig.age >= ADULT_AGE].mean(0, keepdims=True)
    joints = rig.rest(mean_coefficients).joints[0, : len(SMPL24)].astype(float)
    joints.flags.writeable = False
    return joints


def pose_bodies(
    rig: Rig, rest: RestBody, rotations: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses bodies by linear blend skinning on one core; callers distribute people over threads.

    Args:
        rest: n bodies.
        rotations: (n, 24, 3, 3) local rotations.
        translation: (n, 3) m, position of the pelvis.

    Returns:
        Vertices (n, V, 3) and joints (n, 26, 3) in BODY26's order, float32 m.

    Raises:
        InputError: for other shapes.
        ModuleNotFoundError: without numba.
    """
    from lidarpose.body.rig_kernels import pose_people

    rotations, translation = (np.ascontiguousarray(a, np.float32) for a in (rotations, translation))
    count = len(rest.vertices)
    # the kernel does not check bounds
    if rotations.shape != (count, 24, 3, 3) or translation.shape != (count, 3):
        expected = f"rotations ({count}, 24, 3, 3) and translation ({count}, 3)"
        raise InputError(f"{count} bodies need {expected}, got {rotations.shape} and {translation.shape}")
    vertices, joints = np.empty_like(rest.vertices), np.empty_like(rest.joints)
    pose_people(
        rest.vertices, rest.joints, rotations, translation, rig.parents, rig.weight_index, rig.weight, vertices, joints
    )
    return vertices, joints


@dataclass(frozen=True, kw_only=True)
class BodyShapes:
    """n people: coefficients (n, S) float32 for `Rig.rest`, sex (n,) "female" or "male", age (n,) years, height (n,) m,
    bmi (n,) kg/m2."""

    coefficients: np.ndarray
    sex: np.ndarray
    age: np.ndarray
    height: np.ndarray
    bmi: np.ndarray


def sample_people(rng: np.random.Generator, n: int) -> BodyShapes:
    """Draws n people: 88 % adults of 18 to 80 years, 12 % children of 4 to 18, half of them female."""
    rig = load_rig()
    probability, neighbors = _sampling_table()
    first_row = rng.choice(len(probability), size=n, p=probability)
    second_row = neighbors[first_row, rng.integers(0, neighbors.shape[1], n)]
    share = rng.uniform(0.0, 0.5, n).astype(np.float32)

    def mix(table: np.ndarray) -> np.ndarray:
        s = share.reshape(-1, *[1] * (table.ndim - 1))
        return (1 - s) * table[first_row] + s * table[second_row]

    mixture = {name: mix(getattr(rig, name)) for name in ("coefficients", "age", "height", "bmi")}
    return BodyShapes(sex=rig.sex[first_row], **mixture)


@cache
def _sampling_table() -> tuple[np.ndarray, np.ndarray]:
    """Probability (N,) of each row of the rig's table, and its nearest (N, NEIGHBORS) of equal sex and age group."""
    rig = load_rig()
    adult_mask, log_bmi = rig.age >= ADULT_AGE, np.log(rig.bmi)
    weight = np.where(adult_mask, np.interp(rig.age, [OLD_FROM, OLD_TO], [1.0, OLD_SHARE]), 1.0)
    neighbors = np.empty((len(weight), NEIGHBORS), int)
    for sex in ("male", "female"):
        for is_adult, share, age_unit in ((True, 1 - CHILD_SHARE, 15), (False, CHILD_SHARE, 3)):
            rows = np.flatnonzero((rig.sex == sex) & (adult_mask == is_adult))
            if is_adult:
                median, spread = BMI[sex]
                weight[rows] *= _density_ratio(rig.height[rows], *HEIGHT[sex])
                weight[rows] *= _density_ratio(log_bmi[rows], np.log(median), spread)
            weight[rows] = np.minimum(weight[rows], WEIGHT_CAP * weight[rows].mean())
            weight[rows] *= share / 2 / weight[rows].sum()
            # one unit of distance: 5 cm, 10 % of BMI, 15 years (3 for children, who change faster)
            features = np.stack([rig.height[rows] / 0.05, log_bmi[rows] / 0.1, rig.age[rows] / age_unit], -1)
            distance = ((features[:, None] - features) ** 2).sum(-1)
            np.fill_diagonal(distance, np.inf)
            neighbors[rows] = rows[np.argsort(distance, 1)[:, :NEIGHBORS]]
    return weight / weight.sum(), neighbors


def _density_ratio(value: np.ndarray, mean: float, spread: float) -> np.ndarray:
    """Density of a normal distribution at `value` over that of the normal fitted to `value`, up to a constant."""
    target_score = (value - mean) / spread
    fitted_score = (value - value.mean()) / value.std()
    return np.exp((fitted_score**2 - target_score**2) / 2)


def clothing(rng: np.random.Generator, n: int, rig: Rig | None = None) -> np.ndarray:
    """Draws clothing: offsets of clothes, hair and shoes from the skin along its normals, smooth over the body.

    The mean offset of a torso is about 1.5 cm. A tenth of the people wear almost nothing, a tenth bulky coats; hands
    and faces are bare except for a few gloves.

    Args:
        rig: The body whose vertices are dressed; None means the shipped body.

    Returns:
        (n, V) float32 m in [0, `MAX_CLOTHING`].

    Raises:
        ModuleNotFoundError: without numba.
    """
    from lidarpose.body.rig_kernels import fold_clothing

    dense_weight, scalp, template = _regions(load_rig() if rig is None else rig)
    offset = _outfit(rng, n) @ dense_weight.T
    hair = rng.uniform(0.0, 0.03, (n, 1)) + rng.choice([0.0, 0.012], (n, 1), p=[0.8, 0.2])
    offset += hair.astype(np.float32) * scalp
    # folds: a few waves of 15 to 60 cm length that vary the cloth's thickness by about a quarter
    wave_count = 4
    direction = rng.normal(size=(n, wave_count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True) * rng.uniform(0.15, 0.6, (n, wave_count, 1))
    phase = rng.random((n, wave_count))
    fold_clothing(template, direction.astype(np.float32), phase.astype(np.float32), FOLD_GAIN, offset)
    return np.clip(offset, 0, MAX_CLOTHING)


@cache
def _regions(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dense weights (V, 24), weight of the hair at each vertex (V,), and the mean body's vertices (V, 3)."""
    dense_weight = rig.dense_weight
    from_center = rig.template - rig.joint_template[BODY26.index("head_center")]
    # hair: above and behind a plane that rises forward from below the ears to the brow, with a transition of 4 cm
    plane_distance = from_center @ np.array([-0.6, 0.0, 0.8], np.float32)
    scalp = np.clip(plane_distance / 0.04 + 0.5, 0, 1) * dense_weight[:, SMPL24.index("head")]
    return dense_weight, scalp.astype(np.float32), rig.template


def _outfit(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 24) float32 m: thickness of the clothes on the body part of each joint."""
    top = _pick(rng, n, [0.12, 0.40, 0.36, 0.12], [(0.0, 0.005), (0.006, 0.018), (0.014, 0.028), (0.026, 0.038)])
    is_thick = top > 0.014
    sleeve = top * np.where(is_thick | (rng.random(n) < 0.4), rng.uniform(0.5, 0.9, n), 0.0)
    leg_kind = rng.choice(4, size=n, p=[0.22, 0.52, 0.13, 0.13])
    is_tight, has_shorts, has_skirt = leg_kind == 0, leg_kind == 2, leg_kind == 3
    thigh = np.select(
        [is_tight, has_skirt], [rng.uniform(0.001, 0.006, n), rng.uniform(0.015, 0.035, n)], rng.uniform(0.008, 0.02, n)
    )
    shank = np.select([is_tight, has_shorts, has_skirt], [thigh, 0.0, 0.0], thigh * rng.uniform(0.8, 1.4, n))
    shank = np.where(has_skirt & (rng.random(n) < 0.3), thigh, shank)
    # long coats cover the thighs
    thigh = np.where((top > 0.024) & (rng.random(n) < 0.6), np.maximum(thigh, 0.9 * top), thigh)
    neck = np.where(rng.random(n) < 0.15, rng.uniform(0.01, 0.03, n), 0.3 * top)
    glove = np.where(is_thick & (rng.random(n) < 0.2), rng.uniform(0.002, 0.006, n), 0.0)
    shoe = rng.uniform(0.004, 0.014, n)
    thickness = {
        "pelvis": np.maximum(0.9 * top, 0.8 * thigh), "hip": thigh, "knee": shank, "ankle": shoe, "foot": shoe,
        "spine1": 1.05 * top, "spine2": top, "spine3": 0.9 * top, "neck": neck, "collar": 0.8 * top,
        "shoulder": np.maximum(0.75 * top, sleeve), "elbow": sleeve, "wrist": glove, "hand": glove,
    }  # fmt: skip
    no_cloth = np.zeros(n)
    return np.stack([thickness.get(name.split("_")[-1], no_cloth) for name in SMPL24.joints], -1).astype(np.float32)


def _pick(rng: np.random.Generator, n: int, shares: list[float], ranges: list[tuple[float, float]]) -> np.ndarray:
    """Values (n,), uniform within a range that is chosen with the given probabilities."""
    low, high = np.array(ranges)[rng.choice(len(shares), size=n, p=shares)].T
    return rng.uniform(low, high)
