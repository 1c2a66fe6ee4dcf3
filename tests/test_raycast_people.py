import concurrent.futures
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raycast_meshes import body, ground, join, soup, sphere

from lidarpose.body.rig import load_rig
from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.raycast import Hits, cast_window, find_window, is_closed, scan
from lidarpose.lidar.raycast_people import scan_people
from lidarpose.lidar.sensor import Sensor, Window

SPINNING = [name for name, s in SENSORS.items() if isinstance(s, Sensor)]
ONE_ORIGIN = [name for name in SPINNING if not SENSORS[name].heads]
FACES = body(np.random.default_rng(0))[1]


def people(count: int, height: float = 1.7, dtype=np.float32):
    """(B, V, 3) of one topology, all around the sensor, some near."""
    made = []
    for i in range(count):
        rng = np.random.default_rng(i)
        azimuth, distance = rng.uniform(-np.pi, np.pi), rng.choice([0.8, 2.0, 5.0, 12.0, 25.0])
        made.append(body(rng)[0] + [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.9 - height])
    return np.array(made, dtype)


def quads(vertices: np.ndarray):
    """Ground below each: vertices (B, 4, 3), faces (2, 3)."""
    corners, faces = ground(1.0, 0)
    return (corners + vertices.mean(1, keepdims=True) * [1, 1, 0] + [0, 0, vertices[0, :, 2].min()]).astype(
        vertices.dtype
    ), faces


def assert_equal(got: Hits, want: Hits):
    for field in fields(Hits):
        a, b = getattr(got, field.name), getattr(want, field.name)
        assert np.array_equal(a, b) and np.asarray(a).dtype.kind == np.asarray(b).dtype.kind, field.name


@pytest.mark.parametrize("threads, dtype", [(1, np.float32), (2, np.float32), (3, np.float64)])
def test_people_are_single_scans(threads, dtype):
    s = sensor("pandar64")
    vertices = people(17, s.height, dtype)
    extra = quads(vertices)
    got = scan_people(vertices, FACES, s, extra=extra, margin=0.01, threads=threads)
    assert len(got) == 17 and got.start[-1] == len(got.points) > 2000
    for i in range(17):
        mesh = join((vertices[i], FACES), (extra[0][i], extra[1]))
        assert_equal(got.of(i), scan(*mesh, s, window_vertices=vertices[i], margin=0.01))
    alone = scan_people(vertices, FACES, s, threads=threads)
    assert_equal(alone.of(3), scan(vertices[3], FACES, s))


def test_people_from_many_threads():
    s = sensor("vlp-32c")
    vertices = people(8, s.height)
    want = scan_people(vertices, FACES, s)
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for got in pool.map(lambda i: scan_people(vertices, FACES, s, threads=1 + i % 2), range(12)):
            assert np.array_equal(got.points, want.points) and np.array_equal(got.start, want.start)


def test_no_people_and_people_without_a_mesh():
    s = sensor("vlp-16")
    for threads in (1, 2):
        none = scan_people(np.zeros((0, 4, 3)), [[0, 1, 2]], s, threads=threads)
        assert len(none) == 0 and none.points.shape == (0, 3) and none.start.tolist() == [0]
        empty = scan_people(np.zeros((3, 0, 3)), np.zeros((0, 3), int), s, threads=threads)
        assert len(empty) == 3 and empty.start.tolist() == [0, 0, 0, 0] and len(empty.of(1).face) == 0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"vertices": np.zeros((4, 3))}, r"vertices must be \(B, V, 3\), got \(4, 3\)"),
        ({"vertices": "people"}, r"vertices must be a \(B, V, 3\) array"),
        ({"faces": [[0, 1, 9]]}, "faces must index the 4 vertices"),
        ({"extra": (np.zeros((1, 4, 3)), [[0, 1, 2]])}, "extra must have as many people as vertices, 2, got 1"),
        ({"extra": (np.full((2, 4, 3), np.inf), [[0, 1, 2]])}, "extra vertices of person 0 must be finite"),
        ({"extra": (np.zeros((2, 4, 3)), [[0, 1, 4]])}, "faces must index the 4 vertices"),
        ({"margin": np.inf}, "margin"),
        ({"threads": 0}, "threads must be at least 1"),
        ({"cull": np.ones(7, bool)}, r"cull must be True, False or \(1,\) bool"),
        ({"cull": "yes"}, "cull must be"),
    ],
)
def test_bad_people_say_what_is_wrong(change, message):
    good = {"vertices": np.ones((2, 4, 3)), "faces": [[0, 1, 2]], "sensor": sensor("vlp-16")}
    with pytest.raises(InputError, match=message):
        scan_people(**{**good, **change})


def test_bad_person_is_named():
    vertices = people(5)
    vertices[3, 7, 1] = np.nan
    for threads in (1, 2):
        with pytest.raises(InputError, match="vertices of person 3 must be finite and below .* but 1 of"):
            scan_people(vertices, FACES, sensor("vlp-16"), threads=threads)
    with pytest.raises(InputError, match="vertices must be finite"):
        scan(vertices[3], FACES, sensor("vlp-16"))
    with pytest.raises(InputError, match="faces must index"):
        scan(vertices[0], np.array([[0, 1, 10_000]], np.int32), sensor("vlp-16"))
    with pytest.raises(InputError, match="window_vertices must be finite"):
        scan(vertices[0], FACES, sensor("vlp-16"), window_vertices=vertices[3])


@pytest.mark.parametrize("name", [name for name in SPINNING if not SENSORS[name].heads])
def test_the_window_of_a_scan_is_find_window(name):
    s = sensor(name)
    for i, vertices in enumerate(people(25, s.height, np.float64)):
        hits = scan(vertices, FACES[:0], s, margin=0.001 * i)
        window = Window(column0=hits.column0, columns=hits.columns, row0=hits.row0, rows=hits.rows)
        assert window == find_window(vertices, s, margin=0.001 * i) and len(hits.face) == 0


def test_closed_is_a_matter_of_edges():
    vertices, faces = sphere(6)
    assert is_closed(faces) and is_closed(load_rig().faces) and is_closed(faces.astype(np.int32))
    assert not is_closed(faces[1:]) and not is_closed(np.concatenate([faces, faces[:1]]))
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert not is_closed(turned) and not is_closed(ground(1, 0)[1]) and not is_closed(np.zeros((0, 3), int))
    assert not is_closed([[0, 0, 0]]) and is_closed([[0, 1, 2], [2, 1, 0]])
    assert is_closed(join((vertices, faces), (vertices, faces))[1])
    with pytest.raises(InputError, match="faces must be"):
        is_closed(np.zeros((3, 4), int))


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    distance=st.sampled_from([0.0, 0.3, 0.6, 1.0, 2.0, 5.0, 20.0]),
    name=st.sampled_from(SPINNING),
    rings=st.integers(2, 14),
)
def test_culled_is_two_sided_on_closed_meshes(seed, distance, name, rings):
    # at 0 m the sensor is inside, at 0.3 m perhaps; parts cross each other as limbs do
    rng, s = np.random.default_rng(seed), sensor(name)
    azimuth = rng.choice([np.pi, rng.uniform(-np.pi, np.pi)])
    there = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.9 - s.height if distance else 0.0]
    parts = [body(rng, rings), body(rng, rings)]
    parts = [(v @ rotation_about("z", rng.uniform(0, 7)).T + there + rng.normal(0, 0.1, 3), f) for v, f in parts]
    parts.append((ground(1.5, 0)[0] + np.array(there) - [0, 0, 0.9], ground(1.5, 0)[1]))
    parts.append((soup(rng, 5, 0.5, 0.2)[0] + there, soup(rng, 5, 0.5, 0.2)[1]))
    vertices, faces = join(*parts)
    closed = np.arange(len(faces)) < len(parts[0][1]) + len(parts[1][1])
    assert is_closed(faces[closed])
    both, culled = scan(vertices, faces, s), scan(vertices, faces, s, cull=closed)
    assert np.array_equal(both.column, culled.column) and np.array_equal(both.ring, culled.ring)
    assert np.abs(both.points - culled.points).max(initial=0) <= 1e-5
    assert (both.face != culled.face).mean() < 0.01 if len(both.face) > 200 else (both.face != culled.face).sum() <= 2


def test_culling_leaves_out_what_it_may():
    # inside out: the far side is seen, as the near one turns its back; the mask decides for each mesh
    s = sensor("os1-128")
    vertices, faces = sphere(10)
    near, far = vertices + [4, 0, 0], vertices + [8, 0, 0]
    seen = scan(near, faces[:, ::-1], s, cull=True)
    assert len(seen.points) == len(scan(near, faces, s).points) and np.linalg.norm(seen.points, axis=1).min() > 3.8
    two = join((near, faces[:, ::-1]), (far, faces))
    mask = np.arange(len(two[1])) >= len(faces)
    assert np.array_equal(scan(*two, s, cull=mask).points, scan(*two, s).points)
    # what has no back is never left out
    corners = ground(1, 0)[0][:, [2, 1, 0]] + [5, 0, 0]
    assert (len(scan(corners, [[0, 1, 2], [0, 2, 3]], s, cull=True).points) > 0) != (
        len(scan(corners, [[2, 1, 0], [3, 2, 0]], s, cull=True).points) > 0
    )


@pytest.mark.parametrize("shift", [(5, 0, 0), (-5, 0.3, 0), (0.2, 4.9, 0.1)])
def test_culled_meshes_have_no_holes(shift):
    # beams far denser than the mesh, over the whole of it and past its rim
    s = Sensor(name="dense", elevations=np.linspace(-0.23, 0.25, 500), azimuth_step=2 * np.pi / 8000, range_min=0.0)
    vertices, faces = sphere(16)
    both, culled = (
        scan(vertices + shift, faces, s, margin=0.01),
        scan(vertices + shift, faces, s, margin=0.01, cull=True),
    )
    assert np.array_equal(both.column, culled.column) and np.array_equal(both.ring, culled.ring)
    assert len(culled.face) > 100_000 and np.abs(both.points - culled.points).max() < 1e-5
    rows = np.bincount(culled.column)
    for column in (np.argmax(rows), np.argmax(rows) + 40):
        assert (np.diff(culled.ring[culled.column == column]) == 1).all()


def test_culled_people_and_windows():
    s = sensor("dapt64")
    vertices = people(9, s.height)
    extra = quads(vertices)
    closed = np.arange(len(FACES) + 2) < len(FACES)
    both = scan_people(vertices, FACES, s, extra=extra)
    culled = scan_people(vertices, FACES, s, extra=extra, cull=closed, threads=2)
    assert np.array_equal(both.column, culled.column) and np.abs(both.points - culled.points).max() < 1e-5
    window = find_window(vertices[1], s)
    a, b = cast_window(vertices[1], FACES, s, window), cast_window(vertices[1], FACES, s, window, cull=True)
    assert np.array_equal(a[1] >= 0, b[1] >= 0) and (a[1] >= 0).any()
    assert np.abs(a[0][a[1] >= 0] - b[0][b[1] >= 0]).max() < 1e-5
    assert np.array_equal(scan(vertices[1], FACES, s, cull=False).points, scan(vertices[1], FACES, s).points)
