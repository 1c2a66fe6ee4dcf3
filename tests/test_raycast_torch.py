import numpy as np
import pytest
import torch
from raycast_meshes import body, ground

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.raycast_people import scan_people
from lidarpose.lidar.raycast_torch import scan_people_torch
from lidarpose.lidar.sensor import Sensor

NAMES = [name for name, s in SENSORS.items() if isinstance(s, Sensor) and not s.heads]
FACES = body(np.random.default_rng(0))[1]


def scene(height: float, distances, dtype=np.float32):
    """People all around, some over the seam, and a quad of ground below each."""
    vertices, quads = [], []
    for i, distance in enumerate(distances):
        rng = np.random.default_rng(i)
        azimuth = (np.pi, rng.uniform(-np.pi, np.pi))[i % 2]
        there = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), -height])
        # turned, so that no beam runs along a seam of faces
        vertices.append(body(rng)[0] @ rotation_about("z", 0.1234).T + there + [0, 0, 0.9])
        quads.append(ground(1.0, 0)[0] + there)
    return np.array(vertices, dtype), (np.array(quads, dtype), ground(1, 0)[1])


def tensors(extra):
    return torch.as_tensor(extra[0]), torch.as_tensor(extra[1])


def assert_same(got, want, *, error: float):
    """The same beams return; other faces only where two are equally far."""
    assert got.start.tolist() == want.start.tolist() and got.windows.tolist() == want.windows.tolist()
    assert np.array_equal(got.column.numpy(), want.column) and np.array_equal(got.ring.numpy(), want.ring)
    assert got.points.dtype == torch.float32
    apart = np.linalg.norm(got.points.numpy() - want.points, axis=1)
    assert apart.max(initial=0) <= error
    other = got.face.numpy() != want.face
    assert other.mean() < 0.01 and (apart[other] <= 1e-5).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_same_as_compiled(name, dtype):
    s = sensor(name)
    vertices, extra = scene(s.height, (2.5, 4.0, 7.0, 12.0, 20.0, 35.0), dtype)
    want = scan_people(vertices, FACES, s, extra=extra, margin=0.01)
    got = scan_people_torch(torch.as_tensor(vertices), torch.as_tensor(FACES), s, extra=tensors(extra), margin=0.01)
    assert len(want.points) > 100
    # float32 at grazing faces: 1e-7 of the range, over the sine of the angle
    assert_same(got, want, error=1e-5 if dtype == np.float64 else 1e-4)


def test_culled_same_as_compiled_and_as_two_sided():
    s = sensor("pandar64")
    vertices, extra = scene(s.height, (3.0, 6.0, 15.0))
    closed = np.arange(len(FACES) + 2) < len(FACES)
    got = scan_people_torch(vertices, FACES, s, extra=extra, cull=torch.as_tensor(closed))
    assert_same(got, scan_people(vertices, FACES, s, extra=extra), error=1e-4)
    turned = scan_people_torch(vertices, FACES[:, ::-1].copy(), s, cull=True)
    assert_same(turned, scan_people(vertices, FACES[:, ::-1], s, cull=True), error=1e-4)
    assert len(scan_people_torch(vertices, FACES, s, cull=False).face) == len(scan_people(vertices, FACES, s).face)


def test_near_people_are_cast_one_by_one():
    s = sensor("os1-64")
    vertices, extra = scene(s.height, (6.0, 0.4, 8.0, 1.2, 0.0))
    want = scan_people(vertices, FACES, s, extra=extra)
    # around the last one nothing is as far as the sensor's least range
    assert (np.diff(want.start)[:4] > 0).all()
    assert_same(scan_people_torch(vertices, FACES, s, extra=extra), want, error=1e-4)


def test_a_person_does_not_depend_on_the_others():
    s = sensor("vlp-32c")
    vertices, _ = scene(s.height, (3.0, 5.0, 9.0, 14.0))
    together = scan_people_torch(vertices, FACES, s)
    again = scan_people_torch(vertices, FACES, s)
    assert torch.equal(together.points, again.points) and torch.equal(together.face, again.face)
    for i in range(4):
        own = slice(int(together.start[i]), int(together.start[i + 1]))
        alone = scan_people_torch(vertices[i : i + 1], FACES, s)
        assert torch.equal(alone.points, together.points[own]) and torch.equal(alone.face, together.face[own])


def test_equal_ranges_give_the_first_face():
    s = sensor("os1-64")
    vertices, _ = scene(s.height, (5.0,), np.float64)
    twice = np.concatenate([FACES, FACES])
    assert scan_people_torch(vertices, twice, s).face.max() < len(FACES)


def test_the_range_limits_hold():
    s = sensor("hdl-64e")
    vertices, _ = scene(s.height, (5.0, 130.0), np.float64)
    got = scan_people_torch(vertices, FACES, s)
    assert_same(got, scan_people(vertices, FACES, s), error=1e-5)
    assert got.start.diff()[0] > 0 and got.start.diff()[1] == 0


def test_nobody_and_nothing():
    s = sensor("vlp-16")
    none = scan_people_torch(torch.zeros(0, 4, 3), torch.tensor([[0, 1, 2]]), s)
    assert none.points.shape == (0, 3) and none.start.tolist() == [0]
    empty = scan_people_torch(torch.zeros(2, 0, 3), torch.zeros(0, 3, dtype=torch.int64), s)
    assert empty.start.tolist() == [0, 0, 0] and empty.windows.tolist() == [[0] * 4] * 2


@pytest.mark.parametrize(
    "change, message",
    [
        ({"vertices": torch.zeros(4, 3)}, r"vertices must be \(B, V, 3\) float32 or float64, got \(4, 3\)"),
        ({"vertices": torch.ones(2, 4, 3, dtype=torch.int64)}, "vertices must be"),
        ({"vertices": torch.full((2, 4, 3), np.nan)}, "vertices must be finite, but those of person 0"),
        ({"faces": torch.tensor([[0, 1, 4]])}, "faces must index the 4 vertices"),
        ({"faces": torch.ones(1, 3)}, r"faces must be \(F, 3\) integers"),
        ({"extra": (torch.zeros(1, 4, 3), torch.tensor([[0, 1, 2]]))}, "extra must have as many people"),
        ({"margin": np.nan}, "margin"),
        ({"cull": torch.ones(9, dtype=torch.bool)}, "cull must be"),
    ],
)
def test_bad_input_says_what_is_wrong(change, message):
    good = {"vertices": torch.ones(2, 4, 3), "faces": torch.tensor([[0, 1, 2]]), "sensor": sensor("vlp-16")}
    with pytest.raises(InputError, match=message):
        scan_people_torch(**{**good, **change})
