"""`lidarpose view`: contact sheets and pages of datasets, streets from above; drawings of scans from above."""

import io
import json
import re
import shutil

import dataset_files as files
import numpy as np
import pytest
from matplotlib import rcParams, style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from lidarpose.cli import main
from lidarpose.data.prepare import prepare
from lidarpose.data.shards import open_dataset
from lidarpose.errors import InputError
from lidarpose.sample import Box, Pose
from lidarpose.skeleton import BODY26
from lidarpose.synth import shard_job
from lidarpose.synth.shard_job import SynthesisJob, write_dataset
from lidarpose.synth.street import street
from lidarpose.viz import bird_eye, contact_sheet
from lidarpose.viz.bird_eye import MAX_SCANS, ScanPanel, _window, draw_scan_and_people, draw_scans, label_offsets
from lidarpose.viz.contact_sheet import _spread, draw_dataset
from lidarpose.viz.draw import Panel, draw_people

PNG = b"\x89PNG\r\n"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shard_job, "PER_SHARD", {"people": 8, "clips": 1, "streets": 1})
        write_dataset(SynthesisJob(what="people", count=20, sensors=("os1-64",)), folder / "streetlife")
    return folder


@pytest.fixture
def dataset(written, tmp_path, monkeypatch):
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_view_writes_sheet_and_page(dataset, capsys):
    for _ in range(2):  # an existing sheet is replaced
        assert main(["view", "streetlife", "-n", "6"]) == 0
        assert capsys.readouterr().out.strip() == "streetlife.png"
    assert (dataset / "streetlife.png").read_bytes().startswith(PNG)
    assert main(["view", "streetlife", "-n", "40", "--html", "--out", "x/page.html"]) == 0
    page = (dataset / "x" / "page.html").read_text()
    assert "streetlife: 20 people, scene wild" in page
    # the table and the cards show the same distances
    number = r"<td class=\"number\">"
    table = re.findall(rf"<tr><td>#\d+ os1-64</td>{number}\d+</td><td>\w+</td>{number}([\d.]+)</td>", page)
    cards = re.findall(r"points · ([\d.]+) m<", page)
    assert len(cards) == 20 and cards == table


def test_spread_selects_people_of_whole_dataset(dataset):
    people = open_dataset("streetlife")
    index = [row["index"] for (row,) in _spread(people, "people", 6)]
    assert len(index) == 6 == len(set(index)) and {k // 8 for k in index} == {0, 1, 2}
    assert len(_spread(people, "people", 1)) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none"], "is not a dataset: there is no such folder"),
        (["streetlife", "-n", "0"], "expected 1 to"),
        (["streetlife", "--out", "streetlife/dataset.json/x.png"], "is a file"),
        (["streetlife", "--out", "sheet.jpg"], "sheet.jpg: is written as PNG: give a name that ends in .png"),
        (["streetlife", "--html", "--out", "page.png"], "page.png: is written as HTML: give a name that ends in .html"),
    ],
)
def test_view_rejects_invalid_arguments(dataset, capsys, arguments, message):
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_view_draws_unfinished_dataset(dataset, capsys):
    (dataset / "streetlife" / "people-00000.parquet").unlink()
    assert main(["view", "streetlife", "-n", "40", "--html"]) == 0
    page = (dataset / "streetlife.html").read_text()
    assert "2 of 3 shards written so far" in page and "#8 os1-64" in page and "#7 os1-64" not in page
    for path in (dataset / "streetlife").glob("*.parquet"):
        path.unlink()
    capsys.readouterr()
    assert main(["view", "streetlife"]) == 2
    assert "holds no shard yet" in capsys.readouterr().err


def test_page_title_is_singular_for_one_person(tmp_path):
    write_dataset(SynthesisJob(what="people", count=1, sensors=("os1-64",)), tmp_path / "alone")
    page = draw_dataset(tmp_path / "alone", html=True, out=tmp_path / "page.html").read_text()
    assert "alone: 1 person, scene wild" in page


def test_view_draws_prepared_dataset(tmp_path, monkeypatch):
    smpl = files.write_smpl(tmp_path / "SMPL_NEUTRAL.npz")
    files.write_sloper4d(tmp_path / "raw", smpl)
    prepare("sloper4d", tmp_path / "raw", tmp_path / "walks", smpl=smpl)
    monkeypatch.chdir(tmp_path)
    assert main(["view", "walks"]) == 0 and main(["view", "walks", "--html"]) == 0
    page = (tmp_path / "walks.html").read_text()
    assert "distance m" in page and "does" not in re.findall("<th>(.*?)</th>", page)
    # a person is named by sequence, frame and track
    assert len(set(re.findall(r"<strong>(\S+ \d+ \S+)</strong>", page))) == page.count("<strong>") > 1
    for path in (tmp_path / "walks").glob("*.parquet"):
        path.unlink()
    with pytest.raises(InputError, match="or run lidarpose prepare again"):
        draw_dataset("walks")


def test_draw_dataset_does_not_overwrite_dataset(dataset):
    folder = dataset / "streetlife"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name in before:
        with pytest.raises(InputError, match="is also an input file"):
            draw_dataset(folder, out=folder / name)
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}
    # another file in the folder is written, and replaced the second time
    for _ in range(2):
        draw_dataset(folder, count=1, out=folder / "people.png")


# ---- scans and streets from above

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


def test_draw_scans_shows_boxes_poses_and_tracks():
    png = draw_scans([panel()], title="one")
    # boxes are red, skeletons blue, tracks orange
    bare = pixels(draw_scans([panel(boxes=(), poses=None, tracks=())], title="one"))
    added = pixels(png)
    assert bare.shape == added.shape
    for color in ((0.70, 0.15, 0.12), (0.0, 0.45, 0.70), (0.88, 0.44, 0.0)):
        near = [(np.abs(image - color).max(-1) < 0.1).sum() for image in (bare, added)]
        assert near[1] > near[0] + 5, color


@pytest.mark.long
def test_pictures_of_scans_are_independent_of_settings_of_user():
    """LaTeX, which may be missing, and styles, which draw white on black."""
    scan, card = panel(), Panel(points=POINTS[:9], label="ann")
    png = draw_scan_and_people(scan, [card], title="one")
    ugly = {"text.usetex": True, "font.size": 30, "axes.grid": True, "lines.marker": "o", "image.cmap": "gray"}
    for settings in ("dark_background", "ggplot", ugly):
        with style.context(settings):
            assert draw_scan_and_people(scan, [card], title="one") == png
            assert settings is not ugly or rcParams["font.size"] == 30


def test_names_are_inside_view(monkeypatch):
    """A name that is cut off may read as another one."""
    figures = []
    monkeypatch.setattr(bird_eye, "png_of", lambda figure: figures.append(figure) or b"")
    places = [(x, y) for x in (-70, 0, 70) for y in (-70, 0, 70)]
    for sensor in (places[0], places[-1]):
        boxes = [
            Box(center=[*place, 0], size=[0.8, 0.9, 1.7], id="M" * 12 if k % 2 else 100 + k)
            for k, place in enumerate(places)
        ]
        draw_scans([panel(boxes=boxes, sensor=sensor)])
        axes, renderer = figures[-1].axes[0], FigureCanvasAgg(figures[-1]).get_renderer()
        view = axes.get_window_extent()
        texts = [text for text in axes.findobj(Text) if text.get_text() in {*map(bird_eye._name, boxes), "sensor"}]
        assert len(texts) == len(places) + 1
        for text in texts:
            text.update_positions(renderer)
            # of an annotation without its arrow
            extent = Text.get_window_extent(text, renderer)
            assert view.x0 <= extent.x0 and extent.x1 <= view.x1, (text.get_text(), extent, view)
            assert view.y0 <= extent.y0 and extent.y1 <= view.y1, (text.get_text(), extent, view)


@pytest.mark.long
def test_axes_of_maps_have_whole_coordinates():
    """Without an offset beside the axis, and inside the narrow margin at the left."""
    from matplotlib.figure import Figure

    for far, rotation in ((0.0, 0), (5e6, 90)):
        figure = Figure()
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
        bird_eye._draw_panel(axes, ScanPanel(points=POINTS + [far, far, 0], sensor=None), np.array([7.0, 7.0]))
        figure.canvas.draw()
        texts = axes.get_yticklabels()
        assert {text.get_rotation() for text in texts} == {rotation}
        assert axes.yaxis.get_offset_text().get_text() == "" and all(len(t.get_text()) == 7 for t in texts) == bool(far)


def test_draw_scans_accepts_no_and_too_many_panels():
    empty = ScanPanel(points=np.zeros((0, 3)), sensor=None)
    broken = ScanPanel(points=np.full((9, 3), np.nan), label="$x")
    one, many = (pixels(draw_scans(panels)).shape for panels in ([], [empty, broken] * MAX_SCANS))
    assert many[0] / one[0] == pytest.approx(MAX_SCANS / 2, rel=0.1)


@pytest.mark.parametrize("size", [(7, 7), (11, 7)])
def test_window_contains_people_and_sensor(size):
    size = np.array(size, float)
    center, scale = _window(panel(), POINTS, size)
    for place in ((12, -7), (0, 0)):
        assert (abs(place - center) < size * scale / 2 - 2).all()
    _, scale = _window(panel(boxes=(), tracks=()), POINTS, size)
    assert 40 < size.min() * scale < 50


@pytest.mark.long
def test_scan_is_as_wide_as_cards_below():
    for count in (0, 1, 4, 5):
        cards = [Panel(points=POINTS[:9]) for _ in range(count)]
        image = pixels(draw_scan_and_people(panel(), cards))
        widths = [pixels(draw_people(cards)).shape[1]] if cards else []
        assert image.shape[1] == pytest.approx(max(widths + [836]), abs=5)


@pytest.mark.long
def test_view_draws_streets_from_above(tmp_path, monkeypatch):
    monkeypatch.setattr(shard_job, "STREET_FRAMES", 2)
    monkeypatch.setattr(shard_job, "PER_SHARD", {"streets": 2})
    write_dataset(SynthesisJob(what="streets", count=3, seed=4, sensors=("vlp-16",)), tmp_path / "s")
    panels = []
    draw = contact_sheet.draw_scans
    monkeypatch.setattr(contact_sheet, "draw_scans", lambda p, **more: panels.extend(p) or draw(p, **more))
    assert draw_dataset(tmp_path / "s", out=tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    assert [p.label.split(":")[0] for p in panels] == [f"#{k} vlp-16" for k in range(3)]
    for index, shown in enumerate(panels):
        frames = street(4, index, sensor="vlp-16", frames=2).frames
        np.testing.assert_array_equal(shown.points, frames[0].points)
        np.testing.assert_array_equal(shown.poses.joints, frames[0].joints)
        assert [box.id for box in shown.boxes] == [box.id for box in frames[0].boxes]
        ways = np.array([[box.center[:2] for box in frame.boxes] for frame in frames])
        np.testing.assert_allclose(np.stack(shown.tracks, 1), ways, atol=1e-5)
    # the page shows the scans with the true poses first, and then the people
    page = draw_dataset(tmp_path / "s", html=True, out=tmp_path / "s.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert [len(scan["poses"]) for scan in data["scans"]] == [len(shown.poses.joints) for shown in panels]
    assert all(scan["labeled"] for scan in data["scans"])
    assert page.index('data-person="scan0"') < page.index('data-person="scan2"') < page.index('data-person="0"')
    assert re.search(r"<strong>#\d frame 0 track \d vlp-16</strong>", page)
    for path in (tmp_path / "s").glob("frames*"):
        path.unlink()
    with pytest.raises(InputError, match="holds no shard yet"):
        draw_dataset(tmp_path / "s", out=tmp_path / "s.png")


def test_label_offsets_avoid_overlap():
    rng = np.random.default_rng(0)
    centers = np.concatenate([[[0.0, 0.0], [900.0, 0.0]], 300 + rng.uniform(-25, 25, (6, 2))])
    tips = centers[1:2] + 20.0
    offsets = label_offsets(centers, np.zeros((0, 2)), np.full(8, 6.0))
    # labels avoid the tip of the heading arrow, too
    assert np.linalg.norm(centers[1] + label_offsets(centers, tips, np.full(8, 6.0))[1] - tips[0]) > 15
    # the label of an isolated person is close, to the upper right
    assert (offsets[:2] > 0).all() and (np.linalg.norm(offsets[:2], axis=1) < 16).all()
    places = centers + offsets
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 99 * np.eye(len(places))
    plain = np.linalg.norm((centers + [11, 11])[:, None] - (centers + [11, 11]), axis=-1) + 99 * np.eye(len(centers))
    assert apart.min() > 12 > plain.min()
    assert label_offsets(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)).shape == (0, 2)


def test_label_offsets_stay_inside_limits():
    # a person in each corner and a crowd at the right edge
    corners = [[x, y] for x in (1.0, 499.0) for y in (1.0, 299.0)]
    centers, width = np.concatenate([corners, [[495.0, 100 + 9 * k] for k in range(8)]]), 70.0
    places = centers + label_offsets(centers, np.zeros((0, 2)), np.full(12, width), np.array([[0, 0], [500, 300]]))
    half_size = np.array([width, 13]) / 2
    assert (places >= half_size).all() and (places <= [500, 300] - half_size).all()


def test_label_offsets_keep_long_names_apart():
    # a row of people with wide names, as detections of a queue
    centers, width = np.stack([np.arange(4) * 30.0, np.zeros(4)], -1), 72.0
    places = centers + label_offsets(centers, np.zeros((0, 2)), np.full(4, width))
    apart = np.abs(places[:, None] - places)
    assert ((apart[..., 0] > 0.8 * width) | (apart[..., 1] > 10) | np.eye(4, dtype=bool)).all()
