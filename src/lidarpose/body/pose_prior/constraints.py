"""Physical constraints on poses: no self-intersection, feet on the ground, and balance of standing people.

The body is modeled by capsules and points of its soles. n poses of the mean adult, C capsules, Q pairs. Frame: x
forward, y left, z up, the pelvis at the origin. Meters; angles (n, 27) in degrees, in the order of `activities.ANGLES`.
Balance corrections are continuous in the pose, so they can be applied to each frame of a clip independently.
"""

from functools import cache

import numpy as np

from lidarpose.body.pose_prior.activities import ANGLE_INDEX, KINDS, LIMITS, TABLES, UNUSUAL, rotations_from_angles
from lidarpose.body.rig import mean_adult_joints
from lidarpose.skeleton import SMPL24

_J = {name: i for i, name in enumerate(SMPL24.joints)}

# points of the left sole relative to the ankle joint, m: heel, inner and outer ball, toes; measured on the shipped mesh
_SOLE = np.array([[-0.05, 0.0, -0.077], [0.10, -0.045, -0.077], [0.10, 0.045, -0.077], [0.19, -0.01, -0.074]])
# joints of the left and the right leg
_HIPS, _KNEES, _ANKLES = (np.array([_J[f"{s}_{name}"] for s in ("left", "right")]) for name in ("hip", "knee", "ankle"))
# points within about this height above the lowest one bear weight, m
_BEARING = 0.008


def _capsules() -> tuple[np.ndarray, ...]:
    """Joint (C,), ends (C, 2, 3) and radius (C,) m of the capsules; pairs (Q, 2) that may collide; masks
    (2, K, C) of the capsules that each kind of activity rests on, and of others that touch the floor."""
    trunk, collisions = TABLES["capsules"]["trunk"], TABLES["collisions"]
    rows = {name: (_J[c["joint"]], c["start"], c["end"], c["radius"]) for name, c in trunk.items()}
    for side, mirror in (("left", [1, 1, 1]), ("right", [1, -1, 1])):
        for name, c in TABLES["capsules"]["left_limbs"].items():
            start, end = np.multiply([c["start"], c["end"]], mirror)
            rows[f"{side}_{name}"] = (_J[f"{side}_{c['joint']}"], start, end, c["radius"])
    index = {name: i for i, name in enumerate(rows)}
    pairs = []
    for side, other_side in (("left", "right"), ("right", "left")):
        for a, b in collisions["same_side"]:
            pairs.append((index[f"{side}_{a}"], index[b if b in trunk else f"{side}_{b}"]))
        for a, b in collisions["across"]:
            if side == "left" or a != b:
                pairs.append((index[f"{side}_{a}"], index[f"{other_side}_{b}"]))
    joint, start, end, radius = (np.array(column) for column in zip(*rows.values(), strict=True))
    floor_parts = [[TABLES["activities"][kind].get(word, ()) for kind in KINDS] for word in ("rests_on", "touches")]
    floor_mask = np.array([[[name in parts for name in rows] for parts in kinds] for kinds in floor_parts])
    return joint, np.stack([start, end], 1).astype(np.float32), radius.astype(np.float32), np.array(pairs), floor_mask


def _mass_of_joints() -> np.ndarray:
    """Fractions (24,) of the body's mass: each segment's is split between its ends to preserve its center of mass."""
    mass = np.zeros(24, np.float32)
    segments = [("", segment) for segment in TABLES["mass"]["trunk"]]
    segments += [(side, segment) for side in ("left_", "right_") for segment in TABLES["mass"]["limbs"]]
    for side, segment in segments:
        mass[_J[side + segment["start"]]] += segment["share"] * (1 - segment["center"])
        mass[_J[side + segment["end"]]] += segment["share"] * segment["center"]
    return mass / mass.sum()


def _levels() -> list[tuple[np.ndarray, np.ndarray]]:
    """The joints at each depth of the tree below the root, and their parents."""
    parents, depth = np.array(SMPL24.parents), [0]
    for parent in SMPL24.parents[1:]:
        depth.append(depth[parent] + 1)
    levels = [np.flatnonzero(np.equal(depth, d)) for d in range(1, max(depth) + 1)]
    return [(joints, parents[joints]) for joints in levels]


_JOINT, _ENDS, _RADIUS, _PAIRS, (_RESTS, _TOUCHES) = _capsules()
_ON_FLOOR = _RESTS.any(1)
_MASS_OF_JOINTS = _mass_of_joints()
_LEVELS = _levels()


@cache
def _bones() -> np.ndarray:
    """(24, 3, 1) float32 m: offset of each joint from its parent at rest."""
    rest_joints = mean_adult_joints()
    parents = np.array(SMPL24.parents)
    parents[0] = 0  # the root is at the origin
    return np.ascontiguousarray((rest_joints - rest_joints[parents])[..., None], np.float32)


def body_frames(rotations: np.ndarray, bones: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """rotations (n, 24, 3, 3) local -> global rotations (n, 24, 3, 3) and joints (n, 24, 3) m of the mean adult, or of
    bodies with bones (n, 24, 3, 1) m, see `_bones`.

    Like `rig.forward_kinematics`, but one level of the tree at a time and in float32.
    """
    # rotation and bone in one 3 x 4 matrix halve the number of products
    local_frames = np.empty((len(rotations), 24, 3, 4), np.float32)
    local_frames[..., :3], local_frames[..., 3:] = rotations, _bones() if bones is None else bones
    frames = local_frames.copy()
    for rows, parents in _LEVELS:
        parent_frames = frames[:, parents]
        level_frames = parent_frames[..., :3] @ local_frames[:, rows]
        level_frames[..., 3] += parent_frames[..., 3]
        frames[:, rows] = level_frames
    return frames[..., :3], frames[..., 3]


def capsule_ends(
    rotations: np.ndarray, joints: np.ndarray, joint: np.ndarray = _JOINT, ends: np.ndarray = _ENDS
) -> np.ndarray:
    """The capsules' ends (n, C, 2, 3) m on posed bodies, given the results of `body_frames`. `joint` (C,) carries each
    capsule; `ends` (n or 1, C, 2, 3) m are relative to it at rest."""
    return joints[:, joint, None] + ends @ np.swapaxes(rotations[:, joint], -1, -2)


def undersides(ends: np.ndarray) -> np.ndarray:
    """ends (n, C, 2, 3) -> (n, 2 C, 3) m: the lowest point of the ball at each end of each capsule."""
    lowest_points = ends - _RADIUS[:, None, None] * np.array([0, 0, 1], np.float32)
    return lowest_points.reshape(len(ends), 2 * len(_JOINT), 3)


def self_collision(ends: np.ndarray, radius: np.ndarray = _RADIUS, pairs: np.ndarray = _PAIRS) -> np.ndarray:
    """Penetration depths (n, Q) m of pairs (Q, 2) of capsules, negative if they are apart; radius (C,) or (n, C) m."""
    a, b = ends[:, pairs[:, 0]], ends[:, pairs[:, 1]]
    return radius[..., pairs].sum(-1) - _segment_distance(a, b)


def hovering(ends: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Maximum height (n,) m of the supporting parts of each kind (n,) above the body's lowest point; 0 for kinds that
    stand on their feet."""
    gap = np.zeros(len(kind), np.float32)
    rows = np.flatnonzero(_ON_FLOOR[kind])
    bottom_height = (ends[rows, ..., 2] - _RADIUS[:, None]).min(2)
    gap[rows] = np.where(_RESTS[kind[rows]], bottom_height - bottom_height.min(1, keepdims=True), 0).max(1)
    return gap


def mass_center(joints: np.ndarray) -> np.ndarray:
    """Center of mass: joints (n, 24, 3) -> (n, 3) m. Source: de Leva 1996 (body segments)."""
    return np.einsum("j,njk->nk", _MASS_OF_JOINTS, joints)


def _segment_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance (...) between segments a and b (..., 2, 3)."""
    difference = between_segments(a, b)[0]
    return np.sqrt((difference * difference) @ np.ones(3, np.float32))


def between_segments(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vector (..., 3) from the nearest point on segment b to that on a, both (..., 2, 3), and the latter's position
    (...) along a, in [0, 1]: nearest points of the lines, clamped (Ericson, Real-Time Collision Detection, 5.1.9)."""
    start, other_start = a[..., 0, :], b[..., 0, :]
    u, v, w = a[..., 1, :] - start, b[..., 1, :] - other_start, start - other_start
    ones = np.ones(3, np.float32)
    uu, vv, uv, uw, vw = ((x * y) @ ones for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, 1e-9), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    return w + s[..., None] * u - t[..., None] * v, s


@cache
def _leg_offsets() -> tuple[np.ndarray, ...]:
    """Offsets in the left and the right leg, float32 m: pelvis to hip, hip to knee and knee to ankle, each (2, 3), and
    ankle to the sole's points (2, 4, 3)."""
    rest_joints = mean_adult_joints()
    hip, knee, ankle = rest_joints[_HIPS], rest_joints[_KNEES], rest_joints[_ANKLES]
    sole = np.stack([_SOLE, _SOLE * [1, -1, 1]])
    return tuple(np.asarray(v, np.float32) for v in (hip, knee - hip, ankle - knee, sole))


def sole_points(rotations: np.ndarray) -> np.ndarray:
    """rotations (n, 24, 3, 3) -> (n, 2, 4, 3) float32 m: heel, inner and outer ball and toes of the left and the right
    foot, relative to the pelvis; the foot is rigid."""
    to_hip, to_knee, to_ankle, sole = _leg_offsets()
    root = rotations[:, None, 0]
    thigh = root @ rotations[:, _HIPS]
    shank = thigh @ rotations[:, _KNEES]
    foot = shank @ rotations[:, _ANKLES]
    ankle = (root @ to_hip[..., None] + thigh @ to_knee[..., None] + shank @ to_ankle[..., None])[..., 0]
    return ankle[:, :, None] + sole @ np.swapaxes(foot, -1, -2)


def planted_displacement(points: np.ndarray) -> np.ndarray:
    """Displacement (n, T, 3) m of the body if the points that bear it do not slide; z is 0.

    points (n, T, P, 3) m are relative to the pelvis in axes of fixed orientation, at T closely spaced moments. The
    displacement starts at 0.
    """
    height = points[..., 2]
    # each point's fraction of the body weight
    share = np.exp((height.min(-1, keepdims=True) - height) / np.float32(_BEARING))
    share = share / share.sum(-1, keepdims=True)
    share = (share[:, 1:] + share[:, :-1]) / 2
    displacement = np.zeros((*points.shape[:2], 3), points.dtype)
    np.cumsum(-np.einsum("ntp,ntpk->ntk", share, np.diff(points[..., :2], axis=1)), 1, out=displacement[:, 1:, :2])
    return displacement


def walked_displacement(pace: np.ndarray, strides: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Displacement (n, T, 2) m over the ground from `pace` (n, T) m per stride, the number of `strides` (n, T) made
    so far and the heading `course` (n, T) rad."""
    displacement = np.zeros((*pace.shape, 2))
    mean_course = (course[:, 1:] + course[:, :-1]) / 2
    step_length = (pace[:, 1:] + pace[:, :-1]) / 2 * np.diff(strides, axis=1)
    np.cumsum(
        step_length[..., None] * np.stack([np.cos(mean_course), np.sin(mean_course)], -1), 1, out=displacement[:, 1:]
    )
    return displacement


# kinds that are balanced: on both feet or on a foot and a knee, and on one foot
STATIC = ("idle", "crouch", "bend", "kneel", "squat", "stoop", "reach_down", "get_down", "box")
ON_ONE_FOOT = ("kick", "knee_raise")
_STATIC, _ONE_FOOT = (np.array([name in names for name in KINDS]) for names in (STATIC, ON_ONE_FOOT))
_ITERATED_KINDS = _STATIC & (UNUSUAL > 0)
_KNEEL = KINDS.index("kneel")
_HIP, _KNEE, _ANKLE, _ABD = (
    np.array([ANGLE_INDEX[f"{side}_{name}"] for side in ("left", "right")]) for name in ("hip", "knee", "ankle", "abd")
)
_KNEE_RADIUS = 0.055  # m, from the joint to the front of the knee on the shipped body
_MARGIN = 0.03  # m: the center of mass stays this far inside the outline of the feet
# a point bears weight up to this height above the lowest one, m; above it, its penalty rises with this slope
_TOUCHING, _FADE = 0.03, 4.0
# directions in which the outline of the feet is measured
_AROUND = np.stack([f(np.arange(16) * np.pi / 8) for f in (np.cos, np.sin)]).astype(np.float32)
# minimum distance from hip to ankle of a folded leg, m: of the unusual kinds, and of others
_SHORTEST = np.array([0.18, 0.3], np.float32)
# shift of the center of mass when a kneeling body's trunk leans, m per radian: 2/3 of the mass, 0.4 m above the hips
_TRUNK_LEAN = 0.27


def balanced(angles: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """The poses (n, 27) with static kinds on both feet (or a foot and a knee), and static and one-foot kinds balanced.

    The body leans about its ankles (kneeling: the trunk about the hips) until its center of mass is above the outline
    of its support. The leg that reaches lower is bent more; in kneeling, the front leg is extended to the ground. This
    is one linear step with an error of millimeters; unusual kinds, whose legs are strongly bent, get several.
    """
    for kind_mask in (_STATIC | _ONE_FOOT, *[_ITERATED_KINDS] * 2):
        angles = _balance_once(angles, kind, np.flatnonzero(kind_mask[kind]))
    return angles


def _balance_once(angles: np.ndarray, kind: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """One step of `balanced` for the given rows."""
    if not len(rows):
        return angles
    row_angles, is_kneeling = angles[rows], kind[rows] == _KNEEL
    rotations = rotations_from_angles(row_angles)
    joints = body_frames(rotations)[1]
    points = _ground_points(rotations, joints)
    center = mass_center(joints)
    lean = _lean(
        row_angles, overhang(center, _bearing_points(row_angles, points, is_kneeling)), center, joints, is_kneeling
    )
    # the lean changes the feet's heights, too; the soles keep their pitch
    points[:, :8, 2] -= np.repeat(joints[:, _ANKLES, 0], 4, 1) * lean[:, :1]
    points[:, :8, 2] -= (points[:, :8, 1] - np.repeat(joints[:, _HIPS, 1], 4, 1)) * lean[:, 1:]
    is_on_both_feet = _STATIC[kind[rows]]
    least_reach = np.where(_ITERATED_KINDS[kind[rows[is_on_both_feet]]], _SHORTEST[0], _SHORTEST[1])
    row_angles[is_on_both_feet] = _level_feet(
        row_angles[is_on_both_feet],
        joints[is_on_both_feet],
        points[is_on_both_feet],
        is_kneeling[is_on_both_feet],
        least_reach[:, None],
    )
    angles = angles.copy()
    angles[rows] = np.clip(row_angles, LIMITS[0], LIMITS[1])
    return angles


def overhang(center: np.ndarray, points: np.ndarray, margin: float = _MARGIN) -> np.ndarray:
    """center (n, 3) of mass, points (n, P, 3) that may bear it -> (n, 2) m: the displacement that moves the center to
    `margin` inside the outline of the lowest points; 0 if it is there already."""
    height = points[..., 2] - points[..., 2].min(1, keepdims=True)
    penalty = _FADE * np.maximum(height - _TOUCHING, 0)
    points_xy = points[..., :2]
    weight = np.exp(-penalty / 0.05)[..., None]
    weighted_center = (weight * points_xy).sum(1) / weight.sum(1)
    outline = (points_xy @ _AROUND - penalty[..., None]).max(1)
    clearance, half_width = outline - center[:, :2] @ _AROUND, outline - weighted_center @ _AROUND
    fraction = np.clip((margin - clearance) / np.maximum(half_width - clearance, 1e-4), 0, 1).max(1)
    return fraction[:, None] * (weighted_center - center[:, :2])


def _ground_points(rotations: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(n, 10, 3) m: the soles' points, left foot first, and the undersides of the knees."""
    knees = joints[:, _KNEES] - np.array([0, 0, _KNEE_RADIUS], np.float32)
    return np.concatenate([sole_points(rotations).reshape(len(joints), 8, 3), knees], 1)


def _bearing_points(angles: np.ndarray, points: np.ndarray, is_kneeling: np.ndarray) -> np.ndarray:
    """The points that will bear the body once it is level: for kneeling bodies, both soles and the rear knee."""
    rows = np.flatnonzero(is_kneeling)
    points = points.copy()
    points[rows, :, 2] = 0
    points[rows, 8 + angles[rows][:, _HIP].argmax(1), 2] = 1
    return points


def _level_feet(
    angles: np.ndarray, joints: np.ndarray, points: np.ndarray, is_kneeling: np.ndarray, least_reach: np.ndarray
) -> np.ndarray:
    """The poses (n, 27), also modified in place, with legs bent so that both feet, or the front foot and the rear knee,
    are at the same height; least_reach (n, 1) m is the minimum distance from hip to ankle."""
    rest_joints = mean_adult_joints()[[_HIPS[0], _KNEES[0], _ANKLES[0]]]
    thigh, shank = np.linalg.norm(np.diff(rest_joints, axis=0), axis=1).tolist()
    sole_height = np.stack([points[:, :4, 2].min(1), points[:, 4:8, 2].min(1)], 1)
    lift = sole_height.max(1, keepdims=True) - sole_height
    kneeling_rows = np.flatnonzero(is_kneeling)
    if len(kneeling_rows):
        front_leg = angles[kneeling_rows][:, _HIP].argmax(1)
        rear_leg = 1 - front_leg
        floor_height = points[kneeling_rows, 8 + rear_leg, 2]
        lift[kneeling_rows] = 0
        lift[kneeling_rows, front_leg] = floor_height - sole_height[kneeling_rows, front_leg]
        # the rear toes touch the floor like the rear knee
        angles[kneeling_rows, _KNEE[rear_leg]] += np.degrees(
            (floor_height - sole_height[kneeling_rows, rear_leg]) / shank
        )
    leg_vector = joints[:, _ANKLES] - joints[:, _HIPS]
    reach = np.linalg.norm(leg_vector, axis=-1)
    steepness = np.maximum(-leg_vector[..., 2] / reach, 0.5)
    knee, fold = np.degrees(leg_angles(reach, thigh, shank))
    new_reach = np.clip(reach - lift / steepness, least_reach, 0.9985 * (thigh + shank))
    new_knee, new_fold = np.degrees(leg_angles(new_reach, thigh, shank))
    knee, fold = np.where(lift != 0, new_knee - knee, 0), np.where(lift != 0, new_fold - fold, 0)
    angles[:, _KNEE] += knee
    angles[:, _HIP] += fold
    angles[:, _ANKLE] += knee - fold
    return angles


def leg_angles(reach: np.ndarray, thigh: float, shank: float) -> tuple[np.ndarray, np.ndarray]:
    """Knee flexion and angle between thigh and the line hip -> ankle, rad, at a hip-ankle distance `reach` m."""
    bend = np.arccos(np.clip((reach**2 - thigh**2 - shank**2) / (2 * thigh * shank), -1, 1))
    return bend, np.arctan2(shank * np.sin(bend), thigh + shank * np.cos(bend))


def _lean(
    angles: np.ndarray, displacement: np.ndarray, center: np.ndarray, joints: np.ndarray, is_kneeling: np.ndarray
) -> np.ndarray:
    """Leans bodies, in place, so that their centers of mass move by `displacement` (n, 2) m. Returns the angles by
    which the legs turn, (n, 2) rad: forward with the body, and to the left under it."""
    height = np.maximum(center[:, 2] - joints[:, _ANKLES, 2].min(1), 0.3)
    forward_angle = displacement[:, 0] / np.where(is_kneeling, _TRUNK_LEAN, height)
    left_angle = displacement[:, 1] / height
    forward_degrees = np.degrees(forward_angle)
    angles[:, ANGLE_INDEX["tilt"]] += forward_degrees
    # the body rotates about its ankles, or the trunk about the hips
    angles[:, _ANKLE] += np.where(is_kneeling, 0, forward_degrees)[:, None]
    angles[:, _HIP] += np.where(is_kneeling, forward_degrees, 0)[:, None]
    angles[:, _ABD] += np.degrees(left_angle)[:, None] * np.array([-1, 1])
    return np.stack([np.where(is_kneeling, 0, forward_angle), left_angle], 1)


# the four limbs: their capsules, and the angles that move them, from the trunk outward
_LIMBS = len(TABLES["capsules"]["trunk"]) + np.arange(4 * 3).reshape(4, 3)
_LIMB_ANGLES = np.array(
    [[ANGLE_INDEX[f"{side}_{name}"] for name in names]
     for side in ("left", "right") for names in (("raise", "out", "elbow"), ("hip", "knee", "ankle"))]
)  # fmt: skip
# number of steps to fit the floor, damping, m^2 per degree^2, and maximum step, degrees
_STEPS, _DAMPING, _LONGEST = 4, 1e-5, 20.0


def fitted_to_floor(angles: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """The poses (n, 27), those of kinds that rest on the floor fitted to it: no arm or leg is below the parts that bear
    the body, and parts that touch the floor are at that height. Damped least squares, limb by limb."""
    rows = np.flatnonzero(_ON_FLOOR[kind])
    if not len(rows):
        return angles
    row_angles, rest_mask, touch_mask = angles[rows], _RESTS[kind[rows]], _TOUCHES[kind[rows]][:, _LIMBS]
    repeated_rest_mask = np.tile(rest_mask, (4, 1))
    for _ in range(_STEPS):
        # the pose itself, and with each of a limb's three angles one degree larger
        perturbed_angles = np.tile(row_angles, (4, 1, 1))
        for k in range(3):
            perturbed_angles[1 + k, :, _LIMB_ANGLES[:, k]] += 1.0
        height, *perturbed_height = _limb_heights(
            perturbed_angles.reshape(-1, row_angles.shape[1]), repeated_rest_mask
        ).reshape(4, len(rows), 4, 3)
        jacobian = np.stack(perturbed_height, -1) - height[..., None]
        transpose = np.swapaxes(jacobian, -1, -2)
        residual = np.where(touch_mask, height, np.minimum(height, 0))[..., None]
        step = (transpose @ np.linalg.solve(jacobian @ transpose + _DAMPING * np.eye(3), residual))[..., 0]
        row_angles[:, _LIMB_ANGLES] -= np.clip(step, -_LONGEST, _LONGEST)
        row_angles = np.clip(row_angles, LIMITS[0], LIMITS[1])
    angles = angles.copy()
    angles[rows] = row_angles
    return angles


def _limb_heights(angles: np.ndarray, rest_mask: np.ndarray) -> np.ndarray:
    """Heights (n, 4, 3) m of the limbs' capsules above the lowest part that the body rests on."""
    ends = capsule_ends(*body_frames(rotations_from_angles(angles)))
    bottom_height = (ends[..., 2] - _RADIUS[:, None]).min(2)
    return bottom_height[:, _LIMBS] - np.where(rest_mask, bottom_height, np.inf).min(1)[:, None, None]
