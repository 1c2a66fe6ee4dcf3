"""Props that people carry, use and wear: closed meshes, attached at the right places for any pose."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from walkers import piece_volumes

from lidarpose.body.pose_prior.activities import KINDS
from lidarpose.body.rig import load_rig, sample_people
from lidarpose.geometry import rotation_about
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.props import draw_props
from lidarpose.synth.props.carried import CARRIED, carried_prop, free_hands
from lidarpose.synth.props.garments import girth, skirt

J = {name: i for i, name in enumerate(BODY26.joints)}
HANDS = [J["left_hand"], J["right_hand"]]
THINGS = {
    "bag", "shoulder bag", "rucksack", "phone", "ball", "box", "stick", "umbrella", "suitcase", "pram", "trolley",
    "chair", "wheelchair", "bicycle",
}  # fmt: skip


@pytest.fixture(scope="module")
def bodies():
    return draw_bodies(None, 0.0, 600, 5, 0, moving=False)


@pytest.fixture(scope="module")
def drawn(bodies):
    """name -> [(prop, its person's row)], drawn a few times for all people of the block."""
    by_name: dict[str, list] = {}
    rng = np.random.default_rng(0)
    for _ in range(4):
        for row, kind in enumerate(bodies.kinds):
            for prop in draw_props(rng, kind=kind, joints=bodies.joints[row]):
                by_name.setdefault(prop.name, []).append((prop, row))
    return by_name


@pytest.fixture(scope="module")
def placed(drawn, bodies):
    """(name, most) -> props with their people's joints, their vertices there, and the people's rows."""

    def of_name(name, most=None):
        for prop, row in drawn[name][:most]:
            yield prop, bodies.joints[row], prop.place(bodies.joints[row]).vertices, row

    return of_name


def test_draw_props_covers_all_props_near_body(drawn, bodies):
    assert THINGS | {"skirt", "hat"} == set(drawn)
    for name, props in drawn.items():
        for prop, row in props[:40]:
            mesh = prop.place(bodies.joints[row])
            assert np.isfinite(mesh.vertices).all() and mesh.vertices.dtype == np.float32, name
            # not below the ground, and close to the body
            assert mesh.vertices[:, 2].min() > -prop.lift - 0.03, name
            gap = np.linalg.norm(mesh.vertices[:, None] - bodies.vertices[row][None, ::7], axis=-1).min()
            assert gap < (0.6 if name == "chair" else 0.3), name
            assert len(mesh.faces) <= 310 and (prop.face_part is None) == (name in THINGS)
            if name != "skirt":
                assert min(piece_volumes(mesh)) > 0, f"{name}: a piece is inside out"


def test_draw_props_has_expected_shares_and_is_deterministic(bodies):
    rng, joints = np.random.default_rng(1), bodies.joints
    walkers = [r for r, kind in enumerate(bodies.kinds) if kind in ("walk", "idle")]
    carries = [bool({p.name for p in draw_props(rng, kind="walk", joints=joints[r])} & THINGS) for r in walkers * 5]
    assert 0.30 < np.mean(carries) < 0.42
    for kind in KINDS:
        counts = [len(draw_props(rng, kind=kind, joints=joints[r])) for r in range(100)]
        assert max(counts) <= 4 and (kind != "lie" or max(counts) == 0), kind
    # draws are deterministic and do not change the pose
    before = joints.copy()
    for row, kind in enumerate(bodies.kinds[:60]):
        first, again = (draw_props(np.random.default_rng(row), kind=kind, joints=joints[row]) for _ in range(2))
        assert [p.name for p in first] == [p.name for p in again]
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a.place(joints[row]).vertices, b.place(joints[row]).vertices)
    np.testing.assert_array_equal(joints, before)
    assert all(any(p.name == "bicycle" for p in draw_props(rng, kind="cycle", joints=joints[0])) for _ in range(9))


@settings(max_examples=25, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-5, 5), st.integers(0, 39))
def test_prop_place_follows_person_and_hands(drawn, bodies, yaw, x, pick):
    """Props rotate and move with their person."""
    turn, move = rotation_about("z", yaw), np.array([x, -x, 0])
    for name, props in drawn.items():
        prop, row = props[pick % len(props)]
        if name == "ball":
            continue  # round: its facets do not rotate
        joints = bodies.joints[row]
        there = (joints @ turn.T + move).astype(np.float32)
        expected = prop.place(joints).vertices @ turn.T + move
        np.testing.assert_allclose(prop.place(there).vertices, expected, atol=2e-4, err_msg=name)
        if name in ("bag", "stick", "umbrella", "suitcase", "phone"):
            # hands move alone
            moved = joints.copy()
            moved[HANDS] += np.float32([0.05, 0.02, 0.03])
            assert (prop.place(moved).vertices - prop.place(joints).vertices).max(0)[0] > 0.02, name


def test_bag_hangs_vertically_from_hand(placed):
    for prop, joints, vertices, _ in placed("bag", 40):
        middle, joints = vertices[:, :2].mean(0), joints.copy()
        hand = joints[HANDS][np.linalg.norm(joints[HANDS, :2] - middle, axis=-1).argmin()]
        np.testing.assert_allclose(middle, hand[:2], atol=0.02)
        assert 0 <= hand[2] - vertices[:, 2].max() + 1e-4 < 0.05
        # another forearm, the same hand
        joints[[J["left_elbow"], J["right_elbow"], J["left_wrist"], J["right_wrist"]]] += np.float32([0.1, 0, 0.2])
        np.testing.assert_array_equal(prop.place(joints).vertices, vertices)


@pytest.mark.parametrize("name", ["pram", "trolley"])
def test_pram_and_trolley_are_held_at_handle(placed, name):
    for _, joints, vertices, _ in placed(name):
        assert vertices[:, 2].min() == pytest.approx(0, abs=0.04)
        assert np.linalg.norm(vertices[:, None] - joints[HANDS], axis=-1).min() < 0.3


@pytest.mark.parametrize(("name", "radius", "sides"), [("stick", 0.02, 5), ("umbrella", 0.03, 4)])
def test_stick_and_umbrella_pass_through_hand(placed, name, radius, sides):
    for _, joints, vertices, _ in placed(name, 20):
        low, high = vertices[:sides].mean(0), vertices[sides : 2 * sides].mean(0)
        along, off = (high - low) / np.linalg.norm(high - low), joints[HANDS] - low
        assert np.linalg.norm(off - (off @ along)[:, None] * along, axis=-1).min() < radius
        assert name == "umbrella" or abs(vertices[:, 2].min()) < 0.02


def test_rucksack_touches_back(drawn, bodies):
    rig = load_rig()
    trunk = rig.dense_weight[:, [J[n] for n in ("spine1", "spine2", "spine3")]].sum(1) > 0.6
    gaps = []
    for prop, row in drawn["rucksack"]:
        if bodies.kinds[row] not in ("walk", "idle", "step", "run"):
            continue
        rest, placed = prop.mesh.vertices, prop.place(bodies.joints[row]).vertices
        fit = np.linalg.lstsq(np.c_[rest, np.ones(len(rest))], placed, rcond=None)[0]
        inside = (bodies.vertices[row][trunk] - fit[3]) @ np.linalg.inv(fit[:3])
        behind = inside[(np.abs(inside[:, 1]) < 0.45) & (inside[:, 2] > 0) & (inside[:, 2] < 1)]
        gaps.append(-behind[:, 0].min() * np.linalg.norm(fit[0]))
    # depth of the skin in the rucksack, m
    assert len(gaps) > 30 and -0.02 < np.median(gaps) < 0.03
    assert np.percentile(gaps, 5) > -0.05 and np.percentile(gaps, 95) < 0.10


def test_seat_is_under_thighs(drawn, bodies):
    rig = load_rig()
    thigh = rig.dense_weight[:, [J["left_hip"], J["right_hip"], J["pelvis"]]].sum(1) > 0.8
    for name, seat in (("chair", 1.0), ("wheelchair", 0.5)):
        for prop, row in drawn[name][:30]:
            joints, vertices = bodies.joints[row], prop.place(bodies.joints[row]).vertices
            assert vertices[:, 2].min() == pytest.approx(-prop.lift, abs=0.03)
            left = joints[J["left_hip"]] - joints[J["right_hip"]]
            ahead = np.array([left[1], -left[0]]) / np.linalg.norm(left[:2])
            skin = bodies.vertices[row][thigh]
            along = (skin[:, :2] - (joints[J["left_hip"], :2] + joints[J["right_hip"], :2]) / 2) @ ahead
            lowest = skin[(along > -0.12) & (along < 0.2), 2].min()
            # affine fit of the placed mesh, which gives the height of the seat
            rest = np.c_[prop.mesh.vertices, np.ones(len(vertices))]
            fit = np.linalg.lstsq(rest, vertices, rcond=None)[0]
            assert abs(seat * fit[2, 2] + fit[3, 2] - lowest) < 0.06, name


def test_bicycle_is_at_hands_and_feet(placed):
    held = []
    for prop, joints, vertices, _ in placed("bicycle"):
        assert vertices[:, 2].min() == pytest.approx(-prop.lift, abs=0.03) and prop.lift == pytest.approx(0.1)
        held += [np.linalg.norm(vertices - joints[hand], axis=-1).min() for hand in HANDS]
        feet = [np.linalg.norm(vertices - joints[J[f]], axis=-1).min() for f in ("left_foot", "right_foot")]
        assert min(feet) < 0.2
    # joints of hands are the knuckles; a few cyclists wave
    assert np.median(held) < 0.2


def test_bicycle_pedals_move_with_feet():
    moving, rng, apart = draw_bodies(None, 0.0, 200, 5, 0), np.random.default_rng(0), []
    for row in np.flatnonzero(np.array(moving.kinds) == "cycle"):
        (prop,) = (p for p in draw_props(rng, kind="cycle", joints=moving.joints[row]) if p.name == "bicycle")
        for joints in (moving.joints[row], moving.moved(row)[1]):
            vertices = prop.place(joints).vertices
            feet = joints[[J["left_foot"], J["right_foot"]]]
            apart.append(np.linalg.norm(vertices - feet[:, None], axis=-1).min(1))
    now, later = np.array(apart).reshape(-1, 2, 2).transpose(1, 0, 2)
    assert len(now) >= 3 and np.median(later) < np.median(now) + 0.02


def test_girth_matches_skin():
    rig = load_rig()
    people = rig.rest(sample_people(np.random.default_rng(7), 200).coefficients)
    trunk = rig.dense_weight[:, [J[n] for n in ("pelvis", "spine1", "spine2", "spine3", "left_hip", "right_hip")]].sum(
        1
    )
    off = {"back": [], "hip_side": [], "hip_front": [], "hip_back": []}
    for vertices, joints in zip(people.vertices[:, trunk > 0.5], people.joints, strict=True):
        points, spine = joints.tolist(), joints[J["spine3"]]
        middle = joints[[J["left_hip"], J["right_hip"]]].mean(0)
        back = vertices[(np.abs(vertices[:, 2] - spine[2] + 0.05) < 0.1) & (np.abs(vertices[:, 1]) < 0.1)]
        hips = vertices[np.abs(vertices[:, 2] - middle[2] - 0.03) < 0.08]
        side = vertices[np.abs(vertices[:, 2] - middle[2]) < 0.06]
        off["back"].append(spine[0] - back[:, 0].min() - girth(points, "back"))
        off["hip_side"].append(side[:, 1].max() - girth(points, "hip_side"))
        off["hip_front"].append(hips[:, 0].max() - middle[0] - girth(points, "hip_front"))
        off["hip_back"].append(middle[0] - hips[:, 0].min() - girth(points, "hip_back"))
    for name, values in off.items():
        assert np.abs(values).mean() < 0.01 and np.abs(values).max() < 0.04, name


def inside_share(prop, vertices, joints, legs):
    """Share of the legs' vertices between hips and hem that are inside the skirt's rings."""
    rings = prop.place(joints).vertices.reshape(4, 14, 3)
    points = vertices[legs]
    points = points[(points[:, 2] < rings[1, :, 2].min()) & (points[:, 2] > rings[3, :, 2].max())]
    inside = []
    for x, y, z in points:
        outline = []
        for column in rings[1:].transpose(1, 0, 2):
            order = np.argsort(column[:, 2])
            outline.append([np.interp(z, column[order, 2], column[order, a]) for a in (0, 1)])
        a = np.array(outline) - [x, y]
        b = np.roll(a, -1, 0)
        angle = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(1)).sum()
        inside.append(abs(angle) > np.pi)
    return np.mean(inside) if inside else 1.0


def test_skirt_encloses_legs_and_has_their_parts(drawn, bodies):
    rig = load_rig()
    legs = rig.dense_weight[:, [J[n] for n in ("left_hip", "right_hip", "left_knee", "right_knee")]].sum(1) > 0.7
    legs = np.flatnonzero(legs)[::4]
    shares = [inside_share(p, bodies.vertices[r], bodies.joints[r], legs) for p, r in drawn["skirt"][:40]]
    assert np.mean(shares) > 0.95 and np.percentile(shares, 10) > 0.8
    for prop, _ in drawn["skirt"]:
        assert set(prop.face_part) <= {1 + J[n] for n in ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee")}
        assert len(prop.face_part) == len(prop.mesh.faces) and prop.face_part.min() > 0
    prop, row = drawn["skirt"][0]
    vertices = prop.place(bodies.joints[row]).vertices
    middle = vertices[prop.mesh.faces].mean(1)
    left = bodies.joints[row][J["left_hip"]] - bodies.joints[row][J["right_hip"]]
    on_left = (middle - bodies.joints[row][J["pelvis"]]) @ left > 0
    thighs = np.isin(prop.face_part, [1 + J["left_hip"], 1 + J["right_hip"]])
    assert ((prop.face_part == 1 + J["left_hip"]) == on_left)[thighs].mean() > 0.8


def test_hat_is_on_head(placed, bodies):
    head = load_rig().dense_weight[:, J["head"]] > 0.8
    for prop, joints, hat, row in placed("hat", 40):
        assert set(prop.face_part) == {1 + J["head"]}
        skin, up = bodies.vertices[row][head], joints[J["head_center"]] - joints[J["head"]]
        assert np.linalg.norm(skin - hat.mean(0), axis=-1).min() < 0.16
        assert -0.02 < ((hat @ up).max() - (skin @ up).max()) / np.linalg.norm(up) < 0.08


def test_long_skirt_parts_are_on_side_of_their_leg():
    joints = load_rig().rest(np.zeros((1, load_rig().coefficients.shape[1]), np.float32)).joints[0]
    joints = joints + [0, 0, 1 - joints[:, 2].min()]
    vertices, mesh, part = skirt(joints.tolist(), [1.0, 0.0, 0.0, 0.0])
    middle = mesh.vertices[mesh.faces].mean(1)[:, 1] - joints[J["pelvis"], 1]
    for row in ("hip", "knee"):
        for side, sign in (("left", 1), ("right", -1)):
            own = part == 1 + J[f"{side}_{row}"]
            assert own.any() and (sign * middle[own] > -0.02).all(), (side, row)


@pytest.mark.parametrize("name", ["bag", "suitcase"])
def test_bag_and_suitcase_are_carried_by_either_hand(name):
    joints = load_rig().rest(np.zeros((1, load_rig().coefficients.shape[1]), np.float32)).joints[0]
    for side, sign in (("left", 1), ("right", -1)):
        for joint, place in (("elbow", (0, 0.22, 0.15)), ("wrist", (0, 0.24, -0.1)), ("hand", (0, 0.24, -0.18))):
            joints[J[f"{side}_{joint}"]] = np.multiply(place, [1, sign, 1])
    joints = joints + [0, 0, -joints[:, 2].min()]
    hands = free_hands(joints.tolist())[CARRIED[name].hands]
    assert hands == HANDS
    for share, sign in ((0.2, 1), (0.8, -1)):
        prop = carried_prop(name, joints.tolist(), hands, [0.5, 0.5, share, *[0.5] * 9])
        assert sign * prop.place(joints).vertices[:, 1].mean() > 0.15
