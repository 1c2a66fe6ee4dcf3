"""Scans from above, and streets of a dataset as such."""

import io

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import BODY26
from lidarpose.synth import shard_job
from lidarpose.synth.shard_job import Job, write_dataset
from lidarpose.synth.street import street
from lidarpose.viz import contact_sheet
from lidarpose.viz.bird_eye import MAX_SCANS, ScanPanel, _window, draw_scans
from lidarpose.viz.contact_sheet import draw_dataset

POINTS = np.random.default_rng(0).uniform([-20, -20, -1.7], [20, 20, 3], (4000, 3)).astype(np.float32)


def panel(**settings):
    box = Box(center=[12.0, -7.0, -0.9], size=[0.8, 0.9, 1.7], yaw=0.4, id="ann")
    joints = box.center + np.random.default_rng(1).uniform(-0.4, 0.4, (1, 26, 3))
    settings = {
        "boxes": [box],
        "poses": Pose(joints=joints, skeleton=BODY26),
        "tracks": [box.center[None, :2]],
    } | settings
    return ScanPanel(points=POINTS, **settings)


def pixels(png):
    from matplotlib.image import imread

    return imread(io.BytesIO(png))[..., :3]


def test_a_scan_is_drawn_with_its_people(tmp_path):
    png = draw_scans([panel()], tmp_path / "scan.png", title="one")
    assert (tmp_path / "scan.png").read_bytes() == png
    # what a box, a skeleton and a track add is red, blue and orange
    bare = pixels(draw_scans([panel(boxes=(), poses=None, tracks=())], title="one"))
    added = pixels(png)
    assert bare.shape == added.shape
    for color in ((0.70, 0.15, 0.12), (0.0, 0.45, 0.70), (0.88, 0.44, 0.0)):
        near = [(np.abs(image - color).max(-1) < 0.1).sum() for image in (bare, added)]
        assert near[1] > near[0] + 5, color
    with pytest.raises(InputError, match="ends in .png"):
        draw_scans([panel()], tmp_path / "scan.jpg")


def test_nothing_and_too_much_are_drawn_too():
    empty = ScanPanel(points=np.zeros((0, 3)), sensor=None)
    broken = ScanPanel(points=np.full((9, 3), np.nan), label="$x")
    one, many = (pixels(draw_scans(panels)).shape for panels in ([], [empty, broken] * MAX_SCANS))
    assert many[0] / one[0] == pytest.approx(MAX_SCANS / 2, rel=0.1)


def test_everybody_is_inside_the_window_and_the_sensor_too():
    corner, span = _window(panel(), POINTS)
    for place in ((12, -7), (0, 0)):
        assert (corner + 2 < place).all() and (corner + span - 2 > place).all()
    corner, span = _window(panel(boxes=(), tracks=()), POINTS)
    assert 40 < span < 50


def test_view_of_streets_shows_them_from_above(tmp_path, monkeypatch):
    monkeypatch.setattr(shard_job, "STREET_FRAMES", 2)
    monkeypatch.setattr(shard_job, "PER_SHARD", {"streets": 2})
    write_dataset(Job(what="streets", count=3, seed=4, sensors=("vlp-16",)), tmp_path / "s")
    panels = []
    draw = contact_sheet.draw_scans
    monkeypatch.setattr(contact_sheet, "draw_scans", lambda p, path, **more: panels.extend(p) or draw(p, path, **more))
    assert draw_dataset(tmp_path / "s", out=tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    assert [p.label.split(":")[0] for p in panels] == [f"#{k} vlp-16" for k in range(3)]
    for index, shown in enumerate(panels):
        frames = street(4, index, sensor="vlp-16", frames=2).frames
        np.testing.assert_array_equal(shown.points, frames[0].points)
        np.testing.assert_array_equal(shown.poses.joints, frames[0].joints)
        assert [box.id for box in shown.boxes] == [box.id for box in frames[0].boxes]
        ways = np.array([[box.center[:2] for box in frame.boxes] for frame in frames])
        np.testing.assert_allclose(np.stack(shown.tracks, 1), ways, atol=1e-5)
    for path in (tmp_path / "s").glob("frames*"):
        path.unlink()
    with pytest.raises(InputError, match="holds no shard yet"):
        draw_dataset(tmp_path / "s", out=tmp_path / "s.png")
