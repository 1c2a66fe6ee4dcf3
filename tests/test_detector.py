"""The detector's runtime, from a scan to people, with a scorer in place of the network."""

import numpy as np
import pytest
from test_proposals import column, nearest, plane

from lidarpose.models.detector import detector, proposals
from lidarpose.models.detector.detector import SAME, Detector
from lidarpose.models.detector.ground import estimate_ground
from lidarpose.models.detector.map_ground import ground_under
from lidarpose.synth.street import street

ORIGIN = np.zeros(3)


def upright(arrays):
    """A scorer in place of the network: number of slices above the ground with points within 0.4 m of the axis."""
    middle = arrays["fine"][:, 6:24, 8:16, 8:16]
    i, j = np.indices((8, 8)) - 3.5
    mass = middle.sum(1)
    total = np.maximum(mass.sum((1, 2)), 1e-6)
    filled = (middle > 0).any((2, 3)).sum(1)
    around = (arrays["fine"][:, 10:24] > 0).any(1).sum((1, 2)) - (middle[:, 4:] > 0).any(1).sum((1, 2))
    scores = np.zeros((len(mass), 6), np.float32)
    scores[:, 0] = filled - 8 - 0.3 * around
    scores[:, 1] = (mass * i).sum((1, 2)) / total / 10
    scores[:, 2] = (mass * j).sum((1, 2)) / total / 10
    scores[:, 4] = 1.75
    scores[:, 5] = -3
    return scores


@pytest.fixture(scope="module")
def points():
    return np.concatenate([plane(), column(5, 0), column(5, 0.5, seed=3), column(-8, 3, seed=4), column(30, 8, seed=5)])


def test_detector_finds_each_person_once(points):
    detections = Detector(upright).detect(points, ORIGIN, max_range=25)
    sure = detections.logit > 0
    assert sure.sum() == 3 and detections.has_ground
    for x, y in ((5, 0), (5, 0.5), (-8, 3)):
        assert nearest(detections.centers[sure], x, y) < 0.15
    np.testing.assert_allclose(detections.centers[sure, 2], -1.8 + 1.75 / 2, atol=0.1)
    np.testing.assert_allclose(detections.sizes[sure], [[0.9, 0.9, 1.85]] * 3, atol=1e-6)
    assert (np.diff(detections.logit) <= 0).all()
    np.testing.assert_allclose(detections.score, 1 / (1 + np.exp(-detections.logit)), atol=1e-6)
    assert len(Detector(upright).detect(points, ORIGIN, limit=2)) == 2


def test_context_of_people_at_end_of_range_is_kept(points, monkeypatch):
    """The network reads 10 m around a candidate: without them, a shorter range lowers scores inside it."""
    read = []

    class Recording(detector.SceneIndex):
        def __init__(self, points, *arguments, **named):
            read.append(points)
            super().__init__(points, *arguments, **named)

    monkeypatch.setattr(detector, "SceneIndex", Recording)
    Detector(upright).detect(points, ORIGIN, max_range=9)
    distance, kept = (np.hypot(*cloud[:, :2].T) for cloud in (points, read[0]))
    assert distance.max() > 25 and 19 < kept.max() < 24


def test_detector_separates_close_people_without_duplicates(points):
    """Candidates 0.4 m apart are kept, those refined to the same place are merged."""
    pair = np.concatenate([plane(), column(6, 0), column(6, 0.4, seed=3)])

    def still(arrays):
        return upright(arrays) * [1, 0, 0, 1, 1, 1]

    detections = Detector(still).detect(pair, ORIGIN)
    assert [nearest(detections.centers, 6, y) < 0.15 for y in (0, 0.4)] == [True, True]
    for scorer in (still, upright):
        for cloud in (pair, points):
            places = Detector(scorer).detect(cloud, ORIGIN).centers[:, :2]
            gaps = np.linalg.norm(places[:, None] - places, axis=-1)
            assert (gaps[~np.eye(len(gaps), dtype=bool)] >= SAME).all()


def test_detector_supports_rotated_scan_and_unknown_origin(points):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    sure = [
        detections.centers[detections.logit > 0]
        for detections in (
            Detector(upright).detect(points, ORIGIN),
            Detector(upright).detect(points @ turn.T, ORIGIN),
            Detector(upright).detect(points + [100, 50, 3], None),
        )
    ]
    for other in (sure[1] @ turn, sure[2] - [100, 50, 3]):
        assert len(other) == len(sure[0]) == 4
        assert all(nearest(other, *center[:2]) < 0.15 for center in sure[0])


def test_detector_ignores_far_stray_point(points):
    """The sensor is unknown, and the cells of the context grow with the extent of the scan."""
    shown = []

    def remembering(arrays):
        shown.append(arrays["context"].copy())
        return upright(arrays)

    for stray in ([], [[1e5, 1e5, 0]], [[-3e6, 0, 5.0]]):
        detections = Detector(remembering).detect(np.concatenate([points, np.reshape(stray, (-1, 3))]), None)
        assert (detections.logit > 0).sum() == 4
    np.testing.assert_array_equal(shown[0], shown[1])
    np.testing.assert_array_equal(shown[0], shown[2])


def test_detector_searches_only_moving_points(points):
    is_moving = np.hypot(points[:, 0] - 5, points[:, 1]) < 0.3
    detections = Detector(upright).detect(points, ORIGIN, moving=is_moving)
    assert nearest(detections.centers, 5, 0) < 0.3
    assert nearest(detections.centers, -8, 3) > 1
    everybody = Detector(upright).detect(points, ORIGIN, moving=np.ones(len(points), bool))
    np.testing.assert_array_equal(everybody.centers, Detector(upright).detect(points, ORIGIN).centers)


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), np.full((3, 3), 2.0), plane()], ids=["none", "few", "bare"])
def test_detector_accepts_scans_without_people(cloud):
    detections = Detector(upright).detect(cloud, ORIGIN)
    assert len(detections) == 0 and detections.centers.shape == (0, 3)
    assert detections.has_ground == (len(cloud) > 3)


def test_detector_finds_people_at_map_heights(points):
    """The level frame of a tilted sensor in map coordinates."""
    shift = np.array([3e5, -2e5, 2_282_121.0])
    near, far = (Detector(upright).detect(points + way, ORIGIN + way) for way in (np.zeros(3), shift))
    np.testing.assert_allclose(far.centers - shift, near.centers, atol=5e-3)
    people, rows = np.array([[5.0, 0.0]]), np.arange(len(points))
    height = far.base + far.ground.at(people + shift[:2]) - shift[2]
    np.testing.assert_allclose(height, near.base + near.ground.at(people), atol=5e-3)
    near, far = (
        Detector(upright).detect_beside(points + way, ORIGIN + way, detections.ground, rows, people + way[:2])
        for way, detections in ((np.zeros(3), near), (shift, far))
    )
    assert len(near)
    np.testing.assert_allclose(far.centers - shift, near.centers, atol=5e-3)


def test_detector_limits_grow_with_the_area_of_a_map(points, monkeypatch):
    monkeypatch.setattr(detector, "_SCAN", 30_000)
    tile = np.concatenate([points, plane(reach=40, step=1.0)])
    tiles = [tile + [500.0 * k, 0, 0] for k in range(3)]
    for cloud, count in ((tile, 1), (np.concatenate(tiles), 3)):
        assert len(Detector(upright).detect(cloud, None, limit=1)) == count
        # with a known sensor the range limits the area
        assert len(Detector(upright).detect(cloud, ORIGIN, limit=1)) == 1
    # a thin map has few points on each person
    monkeypatch.setattr(detector, "_SCAN", 60_000)
    assert len(Detector(upright).detect(np.concatenate(tiles), None, limit=1)) == 2


def test_detector_columns_beyond_the_range_do_not_displace_others(points, monkeypatch):
    # all columns are equally likely, and those of the crowd come first
    monkeypatch.setattr(proposals, "_MOST", 4)
    monkeypatch.setattr(proposals, "_likeness", lambda features: np.zeros(len(features)))
    crowd = [column(-42 - 0.2 * k, 3.0 * k - 20, seed=k, count=900) for k in range(12)]
    detections = Detector(upright).detect(np.concatenate([points, *crowd]), ORIGIN)
    assert [nearest(detections.centers, *place) < 0.3 for place in ((5, 0), (5, 0.5), (-8, 3))] == [True] * 3


@pytest.mark.parametrize("terrain", [lambda x: 3 * np.sin(2 * np.pi * x / 400), lambda x: 0.04 * x])
def test_ground_under_map_follows_terrain(terrain):
    """Also where nothing is observed, and farther from the middle than a scan reaches."""
    rng = np.random.default_rng(0)
    xy = np.stack([rng.uniform(-700, 700, 200_000), rng.uniform(-30, 30, 200_000)], 1)
    xy = xy[np.sin(xy[:, 0] / 9) + np.sin(xy[:, 1] / 7) > -0.6]
    points = np.column_stack([xy, terrain(xy[:, 0]) + rng.normal(0, 0.02, len(xy))])
    places = np.stack([rng.uniform(-690, 690, 2000), rng.uniform(-25, 25, 2000)], 1)
    error = np.abs(ground_under(points, None).at(places) - terrain(places[:, 0]))
    assert error.mean() < 0.05 and error.max() < 0.6
    # a scan's own ground, as before
    near = points[np.abs(points[:, 0]) < 150]
    np.testing.assert_array_equal(ground_under(near, None).heights, estimate_ground(near).heights)
    assert ground_under(np.zeros((0, 3)), None) is None


def test_ground_under_map_is_not_a_roof():
    """In the middle of a block, and of 17 % of its area."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 600, (400_000, 2))
    roof = (np.abs(xy - 340) < 40).all(1)
    points = np.column_stack([xy, np.where(roof, 12.0, 0.0) + rng.normal(0, 0.02, len(xy))])
    ring = np.abs(xy - 340).max(1)
    heights = ground_under(points, None).at(xy[(ring > 41) & (ring < 70)])
    assert np.abs(heights).max() < 0.2


def test_detector_works_without_ground():
    detections = Detector(upright).detect(column(4, 1), ORIGIN)
    assert not detections.has_ground
    assert nearest(detections.centers, 4, 1) < 0.3


def test_detector_probability_uses_calibration_of_header(points):
    detector = Detector(upright)
    detector.header["calibration"] = [[-2.0, 0.0, 4.0], [0.0, 0.1, 0.9]]
    assert detector.probability(np.array([-5, -1, 2, 9])).tolist() == pytest.approx([0, 0.05, 0.5, 0.9])


def test_detector_scores_candidates_in_limited_batches():
    points = street(3, 2, sensor="hdl-64e").frames[0].points
    sizes = []

    def count(arrays):
        sizes.append(len(arrays["fine"]))
        return upright(arrays)

    together = Detector(count).detect(points, ORIGIN)
    assert max(sizes) <= 64 and len(sizes) > 1
    assert len(together) < sum(sizes)
