"""Pictures and reports: view directions, colors, contents, and self-contained pages."""

import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.inference.result_panels import panels_of
from lidarpose.inference.results import PersonPose, Poses
from lidarpose.sample import Box, Pose, facing
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14, Skeleton
from lidarpose.viz import draw
from lidarpose.viz.bird_eye import ScanPanel
from lidarpose.viz.draw import draw_people, shortened
from lidarpose.viz.html import MAX_POINTS, render_report
from lidarpose.viz.person_view import Panel, bone_sides, describe, project, side, view_directions

BLUE, ORANGE = (0x00, 0x72, 0xB2), (0xE0, 0x70, 0x00)

# a T-pose that faces +x, meters: left is +y
_T_POSE = {
    "pelvis": (0, 0, 0.95), "spine1": (0, 0, 1.06), "spine2": (0, 0, 1.18), "spine3": (0, 0, 1.28),
    "neck": (0, 0, 1.45), "head": (0.02, 0, 1.54), "nose": (0.14, 0, 1.6), "head_center": (0.04, 0, 1.62),
    "hip": (0, 0.08, 0.87), "knee": (0.01, 0.1, 0.48), "ankle": (-0.02, 0.1, 0.08), "foot": (0.1, 0.12, 0.03),
    "collar": (0, 0.07, 1.38), "shoulder": (0, 0.18, 1.4), "elbow": (0, 0.43, 1.4), "wrist": (0, 0.68, 1.4),
    "hand": (0, 0.77, 1.4),
}  # fmt: skip


def t_pose(*, yaw=0.0, at=(8.0, 3.0, -1.0), skeleton=BODY26, confidence=0.9):
    sign = {"left": 1, "right": -1, "center": 1}
    rest = [np.array(_T_POSE[re.sub("left_|right_", "", j)]) * (1, sign[side(j)], 1) for j in skeleton.joints]
    joints = np.array(rest) @ rotation_about("z", yaw).T + at
    return Pose(joints=joints, skeleton=skeleton, confidence=np.full(len(skeleton), confidence))


def cloud(pose, *, count=200, seed=0):
    rng = np.random.default_rng(seed)
    bones = np.array(pose.skeleton.bones)[rng.integers(len(pose.skeleton.bones), size=count)]
    t = rng.uniform(size=(count, 1))
    joints = pose.joints
    return (joints[bones[:, 0]] * t + joints[bones[:, 1]] * (1 - t) + rng.normal(0, 0.03, (count, 3))).astype("f4")


def person(*, count=200, label="somebody", **pose):
    pose = t_pose(**pose)
    return Panel(points=cloud(pose, count=count), pose=pose, truth=t_pose(), label=label)


NOTHING = np.zeros((0, 3))
EMPTY = Panel(points=NOTHING)


def report(*people):
    """The page of people and the data embedded in it."""
    text = render_report(list(people), title="t", summary=[])
    return text, Reader(text).data()


def decoded(png):
    """(height, width, 3) uint8."""
    from matplotlib.image import imread

    return (imread(io.BytesIO(png), format="png")[..., :3] * 255).round().astype(int)


def pixels(image, color):
    """(k, 2) rows and columns of the pixels close to a color."""
    return np.argwhere(np.abs(image - color).max(-1) <= 12)


def test_facing_needs_one_known_pair_of_joints_not_vertical():
    pose = t_pose(yaw=1.0)
    assert facing(None) is None
    # lying on the side
    assert facing(replace(pose, joints=t_pose().joints @ rotation_about("x", np.pi / 2).T)) is None
    assert facing(replace(pose, joints=np.full((26, 3), np.nan))) is None
    joints = pose.joints.copy()
    joints[BODY26.index("left_hip")] = np.nan
    np.testing.assert_allclose(facing(replace(pose, joints=joints)), (np.cos(1), np.sin(1), 0), atol=1e-9)


@given(yaw=st.floats(-np.pi, np.pi), seed=st.integers(0, 99))
def test_view_directions_are_front_and_right_side(yaw, seed):
    pose = t_pose(yaw=yaw)
    for skeleton in (SMPL24, HUMAN15, WAYMO14, BODY26):
        forward = facing(t_pose(yaw=yaw, skeleton=skeleton))
        np.testing.assert_allclose(forward, (np.cos(yaw), np.sin(yaw), 0), atol=1e-9)
    front, from_right = view_directions(facing(pose))
    joint = {name: pose.joints[i] for i, name in enumerate(BODY26.joints)}
    seen = {name: project(at, seen_from=front) for name, at in joint.items()}
    assert seen["left_wrist"][0] > seen["right_wrist"][0] + 1  # the person's left on the picture's right
    assert seen["nose"][2] > seen["head"][2] + 0.05  # the nose towards the viewer
    seen = {name: project(at, seen_from=from_right) for name, at in joint.items()}
    assert seen["nose"][0] > seen["head"][0] + 0.05
    assert seen["right_wrist"][2] > seen["left_wrist"][2] + 1
    # a projection is rigid and keeps the up axis
    points = np.random.default_rng(seed).normal(size=(5, 3))
    moved = project(points, seen_from=front)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(points, axis=1))
    np.testing.assert_allclose(moved[:, 1], points[:, 2])


def test_bone_sides_are_left_right_and_center():
    named = dict(zip(WAYMO14.bones, bone_sides(WAYMO14), strict=True))
    at = WAYMO14.index
    assert named[at("nose"), at("left_shoulder")] == "left"
    assert named[at("right_knee"), at("right_ankle")] == "right"
    assert named[at("left_hip"), at("right_hip")] == "center"


def test_front_view_shows_left_side_in_blue_on_the_right():
    # the person faces +y of the frame; without points only the skeleton has colors
    panel = Panel(points=NOTHING, pose=t_pose(yaw=np.pi / 2, confidence=1.0), label="a")
    image = decoded(draw_people([panel]))[70:]  # below the legend
    blue, orange = pixels(image, BLUE), pixels(image, ORANGE)
    half = image.shape[1] // 2
    assert len(blue) > 200 and len(orange) > 200
    front_blue, front_orange = (c[c[:, 1] < half, 1] for c in (blue, orange))
    assert np.median(front_blue) > np.median(front_orange) + 30
    # seen from the right, the right leg covers the left one
    assert (orange[:, 1] > half).sum() > (blue[:, 1] > half).sum()


def test_pose_of_low_confidence_is_fainter():
    def ink(confidence):
        panel = Panel(points=NOTHING, pose=t_pose(confidence=confidence))
        return (255 - decoded(draw_people([panel]))[70:]).sum()

    assert ink(0.05) < 0.7 * ink(1.0)


def test_points_are_colored_by_part_or_else_by_depth():
    def shown(points, **settings):
        return decoded(draw_people([Panel(points=points, **settings)]))[70:]

    points = cloud(t_pose())
    part = np.full(len(points), 1, np.uint8)
    for side_of_body, channel in (("left", 2), ("right", 0)):
        image = shown(points, part=part + SMPL24.index(f"{side_of_body}_knee"))
        vivid = image[np.ptp(image, axis=-1) > 60]
        assert len(vivid) > 300 and (vivid.argmax(-1) == channel).mean() > 0.95
    # two planes, the nearer one on the right of the view from +x
    planes = np.mgrid[-1:1:2j, 0.3:0.9:20j, 0:1:20j].reshape(3, -1).T
    image = shown(planes * np.where(planes[:, :1] < 0, [1, -1, 1], 1))
    assert (np.ptp(image, axis=-1) <= 60).all()
    dark = pixels(image, np.round(255 * np.array(draw._NEAR)))[:, 1]
    dark = dark[dark < 290]
    assert len(dark) > 200 and dark.min() > 165
    light = pixels(image, np.round(255 * np.array(draw._FAR)))[:, 1]
    assert ((light > 40) & (light < 160)).sum() > 200


@pytest.mark.parametrize(
    "panel",
    [
        EMPTY,
        Panel(points=NOTHING, truth=t_pose()),
        Panel(points=np.ones((1, 3)), label="$x^$ \\frac <b>\n" + "long " * 99),
        Panel(points=np.full((9, 3), np.nan), pose=Pose(joints=np.full((26, 3), np.nan), skeleton=BODY26)),
        Panel(points=cloud(t_pose()) * [1, 1, 0.001], box=Box(center=(8, 3, 0), size=(1, 1, 2), yaw=0.3)),
        Panel(points=np.array([[0, 0, 0], [900, -900, 900.0]] * 5), pose=t_pose(at=(0, 0, 0))),
        Panel(points=cloud(t_pose(skeleton=WAYMO14)), pose=t_pose(skeleton=WAYMO14), truth=t_pose(skeleton=HUMAN15)),
    ],
)
def test_draw_people_accepts_unusual_panels(panel):
    image = decoded(draw_people([panel], title="odd"))
    assert (image < 128).any()


def test_person_beside_wall_is_drawn_large_enough():
    pose = t_pose(confidence=1.0)
    wall = np.random.default_rng(0).uniform((13, 4, -1), (13.1, 12, 2), (3000, 3))
    alone, beside = (
        pixels(decoded(draw_people([Panel(points=points, pose=pose)]))[70:], BLUE)
        for points in (cloud(pose), np.concatenate([cloud(pose), wall]))
    )
    assert len(beside) > 0.15 * len(alone)


def test_describe_gives_points_distance_and_confidence():
    panel = Panel(points=np.tile([3.0, 4, 0], (1500, 1)))
    assert describe(panel) == "1,500 points · 5.0 m"
    # the distance of the pose, not of most points
    assert describe(replace(panel, pose=t_pose(at=(6, 8, -1), confidence=0.5))) == (
        "1,500 points · 10.0 m · confidence 0.50"
    )
    assert describe(Panel(points=np.zeros((1, 3)), distance=12.34)) == "1 point · 12.3 m"
    assert describe(EMPTY) == "0 points"
    assert describe(Panel(points=np.zeros((1, 3)), distance=2.0, note="two people?")) == "1 point · 2.0 m · two people?"


def test_pictures_say_what_is_doubtful_about_a_person():
    """As the warnings do; a scored box is a person already."""
    for person, second, score, note in (
        (0.99, 0.1, None, None),
        (0.99, 0.9, None, "two people?"),
        (0.01, 0.9, None, "unlike a person"),
        (0.01, 0.1, 0.9, None),
    ):
        pose = replace(t_pose(), person=np.array(person), second_person=np.array(second))
        box = None if score is None else Box(center=np.zeros(3), size=np.ones(3), score=score)
        shown = PersonPose(pose=pose, skeleton=BODY26, points=cloud(pose), box=box)
        (panel,), _ = panels_of(Poses(people=(shown,), skeleton=BODY26))
        assert panel.note == note and ("unlike" in describe(panel)) == (note == "unlike a person")


def test_labels_and_titles_of_any_length_and_script(recwarn):
    name = "0aa51a7c-6c2d-4c0e-9d5e-7f1b2a3c4d5e"
    assert shortened(name, 36) == name and shortened(name, 11) == "0aa51…c4d5e"
    image = decoded(draw_people([EMPTY], title="0123456789abcdef" * 4 + ".npy"))
    assert (image[:, -8:] == 255).all()
    # characters missing in the font give no warning
    draw_people([Panel(points=np.zeros((3, 3)), label="人")], title="点云.pcd")
    assert not recwarn.list


def test_draw_people_limits_number_of_people(monkeypatch):
    monkeypatch.setattr(draw, "MAX_PEOPLE", 6)
    people = [Panel(points=np.ones((1, 3)) * i, label=str(i)) for i in range(7)]
    full, over = decoded(draw_people(people[:-1], title="t")), decoded(draw_people(people, title="t"))
    assert over.shape == full.shape
    assert (over[60:] == full[60:]).all() and (over[:60] != full[:60]).any()  # they differ only by the note
    assert decoded(draw_people([])).shape[1] > 200


def test_draw_people_is_deterministic_and_keeps_input():
    from matplotlib import rc_context

    panel = person(count=60)
    before = panel.points.copy(), panel.pose.joints.copy()
    png = draw_people([panel], title="a")
    # independent of the user's settings of matplotlib
    with rc_context({"savefig.bbox": "tight", "savefig.dpi": 50, "font.size": 30, "figure.facecolor": "black"}):
        assert draw_people([panel], title="a") == png
    np.testing.assert_array_equal(before[0], panel.points)
    np.testing.assert_array_equal(before[1], panel.pose.joints)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"points": np.zeros((5, 2))}, r"points must be \(n, 3\) meters, got \(5, 2\)"),
        ({"pose": Pose(joints=np.zeros((2, 26, 3)), skeleton=BODY26)}, r"pose must hold one person, joints \(26, 3\)"),
        ({"truth": Pose(joints=np.zeros((2, 26, 3)), skeleton=BODY26)}, r"got \(2, 26, 3\): draw people one by one"),
        ({"part": np.zeros(4, int)}, r"part must be \(5,\)"),
    ],
)
def test_panel_rejects_wrong_shapes(settings, message):
    with pytest.raises(InputError, match=message):
        Panel(**{"points": np.zeros((5, 3))} | settings)


VOID = {"meta", "input", "br", "link", "img"}


class Reader(HTMLParser):
    """Parses a page strictly: tags must nest. Collects tags, attributes and texts."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.attributes, self.texts = [], [], [], {}
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *a) for a in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        key = self.open[-1] if self.open else ""
        self.texts.setdefault(key, []).append(text)

    def data(self):
        assert ("script", "id", "data") in self.attributes
        return json.loads(self.texts["script"][0])


EVIL = "</script><script>alert('\"%%DATA%%&amp;"


def evil_report():
    people = [person(label=EVIL), Panel(label="b", points=NOTHING, caption=EVIL)]
    return render_report(people, title=EVIL, summary=[{EVIL: EVIL}])


def test_report_escapes_text_of_callers():
    page = Reader(evil_report())
    assert page.tags.count("script") == 2
    assert page.tags.count("canvas") == 2
    for tag in ("title", "h1", "strong", "th", "td"):
        assert EVIL in page.texts[tag], tag
    assert EVIL in page.texts["span"]
    assert ("canvas", "aria-label", f"3D view of {EVIL}") in page.attributes


def test_report_data_cannot_end_script_element():
    name = "</script><!--<script>"
    pose = Pose(joints=np.zeros((1, 3)), skeleton=Skeleton(name=name, joints=(name,), parents=(-1,)))
    _, data = report(Panel(label="", points=np.ones((9, 3)), pose=pose))
    assert data["skeletons"][name]["joints"] == [name]


def test_report_loads_no_external_resources():
    text = evil_report()
    assert not re.search(r"https?:|//\w+\.|@import|url\(|\bsrc=|<link|fetch\(|XMLHttpRequest|import\(", text)
    assert "default-src 'none'" in text


def test_report_contains_data_of_people():
    given = person(yaw=1.25)
    joints = given.pose.joints.copy()
    joints[3] = np.nan
    _, data = report(replace(given, pose=Pose(joints=joints, skeleton=BODY26)))
    (entry,) = data["people"]
    center = np.median(given.truth.joints, axis=0)
    np.testing.assert_allclose(np.reshape(entry["points"], (-1, 3)) / 1000 + center, given.points, atol=6e-4)
    assert entry["pose"]["joints"][3] is None and "confidence" not in entry["pose"]
    np.testing.assert_allclose(np.array(entry["pose"]["joints"][:3]) / 1000 + center, joints[:3], atol=6e-4)
    assert entry["facing"] == pytest.approx(1.25, abs=1e-3)
    assert entry["truth"]["confidence"] == [0.9] * 26
    skeleton = data["skeletons"]["body26"]
    assert tuple(skeleton["joints"]) == BODY26.joints
    assert [tuple(b[:2]) for b in skeleton["bones"]] == list(BODY26.bones)
    assert {s for *_, s in skeleton["bones"]} == set(skeleton["sides"]) == set("lrc")


def test_report_scan_keeps_points_near_people():
    """All points near people, a subset of the others, no distant points, and joints at their positions."""
    rng = np.random.default_rng(2)
    joints = np.stack([person().pose.joints + at for at in ([5.0, 0, 0], [9.0, 3, 0])])
    joints[1, 4] = np.nan
    boxes = [Box(center=np.nanmean(body, 0), size=np.array([1.0, 1, 2])) for body in joints]
    near = boxes[0].center + rng.uniform(-0.5, 0.5, (500, 3))
    wide, far = rng.uniform((-5, -8, -1), (20, 12, 2), (60_000, 3)), rng.uniform(50, 60, (1000, 3))
    points = np.concatenate([wide, near, far, [[np.nan, 0, 0]]])
    scan = ScanPanel(points=points, boxes=boxes, poses=Pose(joints=joints, skeleton=BODY26), label=EVIL)
    page = Reader(text := render_report([], title="", summary=[], scans=[scan]))
    assert EVIL in page.texts["strong"] and len(text) < 500_000
    shown = json.loads(page.texts["script"][0])["scans"][0]
    center = np.median([box.center for box in boxes], axis=0)
    drawn = np.reshape(shown["points"], (-1, 3)) / 1000 + center
    assert 20_000 <= len(drawn) <= 40_000 and drawn.max() < 40
    assert all(np.linalg.norm(drawn - row, axis=1).min() < 1e-3 for row in near)
    assert shown["poses"][1]["joints"][4] is None
    np.testing.assert_allclose(np.array(shown["poses"][0]["joints"]) / 1000 + center, joints[0], atol=6e-4)
    nobody = replace(scan, boxes=(), poses=None)
    assert "canvas" in Reader(render_report([], title="", summary=[], scans=[nobody])).tags


def test_report_scan_states_points_drawn_and_controls_in_use():
    """Nothing promises more than the page has: a scan of few points is drawn whole, labels are no predictions."""
    few, many = (np.random.default_rng(0).normal(0, 5, (n, 3)) for n in (300, 60_000))
    poses = Pose(joints=t_pose().joints[None], skeleton=BODY26)
    for scan, caption, predicted in (
        (ScanPanel(points=few, boxes=[], poses=poses), "<span>300 points</span>", True),
        (ScanPanel(points=many, boxes=[], poses=poses, labeled=True), " of 60,000 points drawn</span>", False),
    ):
        text = render_report([], title="t", summary=[], scans=[scan])
        assert caption in text and Reader(text).data()["scans"][0]["predicted"] is predicted
    assert Reader(render_report([person()], title="t", summary=[])).data()["people"][0]["spins"]
    assert 'data-if="spins"' in text and 'data-if="pose predicted"' in text


def test_report_is_small_and_subsamples_points():
    people = [person(count=1000, label=str(i), yaw=i) for i in range(12)]
    text, data = report(*people)
    assert len(text.encode()) < 500_000 and text == report(*people)[0]
    assert len(data["people"][0]["points"]) == 3000
    text, _ = report(*[person(count=MAX_POINTS)] * 2)
    assert len(text.encode()) < 1_500_000
    assert "30,000 of 60,000 points drawn" in text
    # points without a valid position are not drawn, and not counted as drawn
    odd = person(count=100)
    odd.points[:90], odd.points[90] = np.nan, 1e30
    text, data = report(odd)
    assert "9 of 100 points drawn" in text and len(data["people"][0]["points"]) == 27


def test_report_accepts_people_without_pose():
    nothing = Pose(joints=np.full((26, 3), np.nan), skeleton=BODY26)
    text, data = report(
        Panel(label="none", points=NOTHING),
        Panel(label="few", points=np.zeros((4, 3))),
        Panel(label="nan", points=np.full((9, 3), np.nan), pose=nothing, truth=nothing),
    )
    assert [len(p["points"]) for p in data["people"]] == [0, 12, 0]
    assert all(p["pose"] is None and p["facing"] is None for p in data["people"])
    assert text.count("no pose: under 5 points") == 2
    assert "no pose" not in report(Panel(label="few", points=np.zeros((4, 3)), truth=t_pose()))[0]
    assert "no people" in report()[0]


def test_report_formats_summary_table():
    rows = [
        {"set": "near", "people": 1873, "MPJPE mm": 63.412, "PCK": np.float32(0.5), "ok": True, "a": 8.6, "b": 3.0},
        {"set": "far", "people": np.int64(2), "MPJPE mm": 103.25, "extra": "x", "a": 20.0, "b": 4.0, "c": 12.5},
        {"set": "none", "people": 0, "MPJPE mm": float("nan"), "PCK": None, "c": 0.1234},
    ]
    text = render_report([], title="t", summary=rows)
    page = Reader(text)
    assert page.texts["th"] == ["set", "people", "MPJPE mm", "PCK", "ok", "a", "b", "extra", "c"]
    assert np.reshape(page.texts["td"], (3, 9)).tolist() == [
        ["near", "1873", "63.4", "0.5", "yes", "8.6", "3", "–", "–"],
        ["far", "2", "103.2", "–", "–", "20.0", "4", "x", "12.50"],
        ["none", "0", "–", "–", "–", "–", "–", "–", "0.12"],
    ]
    assert text.count('<td class="number">') == 18


@settings(max_examples=20, deadline=None)
@given(label=st.text(max_size=40))
def test_report_label_survives_round_trip(label):
    page = Reader(report(Panel(label=label, points=np.ones((1, 3))))[0])
    shown = "".join(page.texts.get("strong", []))
    assert shown == label or any(not c.isprintable() for c in label)


def test_undecodable_titles_are_written(tmp_path):
    label = "a\udc80\x00b"
    assert draw_people([Panel(points=np.ones((9, 3)), label=label)], title=label)
    poses, path = PersonPose(pose=None, skeleton=SMPL24, points=np.ones((9, 3))).alone(), tmp_path / "report.html"
    poses.html(path, title=label)
    assert "a?" in path.read_text(encoding="utf-8")


def test_pictures_and_reports_are_written_with_their_suffixes(tmp_path):
    poses, page, picture = PersonPose(pose=None, skeleton=SMPL24, points=np.ones((9, 3))).alone(), "a.html", "a.png"
    assert (poses.html(tmp_path / page), poses.picture(tmp_path / picture)) == (poses.html(), poses.picture())
    assert (tmp_path / page).read_text(encoding="utf-8") == poses.html()
    assert (tmp_path / picture).read_bytes() == poses.picture()
    with pytest.raises(InputError, match="ends in .png"):
        poses.picture(tmp_path / "b.jpg")
    with pytest.raises(InputError, match="ends in .html"):
        poses.html(tmp_path / "b.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == [page, picture]


def test_report_has_side_of_every_joint_and_point():
    part = np.array([0, 1, 1 + BODY26.index("left_knee"), 1 + BODY26.index("right_hand"), 24], np.uint8)
    points = np.arange(15.0).reshape(5, 3)
    points[1] = np.nan
    _, data = report(Panel(points=points, pose=Pose(joints=np.zeros((26, 3)), skeleton=BODY26), part=part))
    assert data["people"][0]["sides"] == "nlrr"
    sides = data["skeletons"]["body26"]["sides"]
    for name, letter in (("left_hand", "l"), ("right_hip", "r"), ("neck", "c")):
        assert sides[BODY26.index(name)] == letter
    assert [sides.count(letter) for letter in "lrc"] == [9, 9, 8]
