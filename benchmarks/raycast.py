"""How long one cast of a body takes, beside the slow twin and, where installed, Embree and Open3D.

    python benchmarks/raycast.py [--rounds 5] [--sensor dapt64] [--rings 60]

30 scenes from one seed: 5 distances x 6 closed meshes, each with a ground quad. The ways take turns, one scene each,
so that a busy machine slows all alike: read the ratios. A cast is `scan`: window, cast and packed points; the others
get the window's rays ready made. The slow twin casts a sample of the rays and is scaled up.
"""

import argparse
import time

import numpy as np

from lidarpose.lidar.raycast import cast_window, find_window, scan
from lidarpose.lidar.raycast_reference import cast_ray_list_reference
from lidarpose.lidar.sensor import sensor as named_sensor

DISTANCES = (4.0, 7.0, 10.0, 15.0, 20.0)
MESHES = 6
REFERENCE_RAYS = 16


def blob(rng, rings):
    """A closed bumpy mesh about as large as a person, with 4 * rings * (rings - 1) triangles."""
    around = 2 * rings
    polar, angle = np.pi * np.arange(1, rings) / rings, np.pi * np.arange(around) / rings
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    grid = np.concatenate(
        [np.sin(polar)[:, None, None] * ring, np.broadcast_to(np.cos(polar)[:, None, None], (rings - 1, around, 1))], -1
    )
    vertices = np.concatenate([grid.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    j = np.arange(around)
    k, top = (j + 1) % around, (rings - 1) * around
    faces = [np.stack([np.full(around, top), j, k], -1)]
    for i in range(rings - 2):
        a, b = i * around, (i + 1) * around
        faces += [np.stack([a + j, b + j, b + k], -1), np.stack([a + j, b + k, a + k], -1)]
    faces.append(np.stack([np.full(around, top + 1), top - around + k, top - around + j], -1))
    bumps = 1 + 0.4 * np.sin(vertices @ rng.normal(0, 5, (3, 4))).sum(1, keepdims=True) / 4
    return vertices * bumps * [0.2, 0.35, 0.9], np.concatenate(faces)


def scenes(sensor, rings):
    """Lists of (distance, vertices, faces, the body's vertex count)."""
    made = []
    for m in range(MESHES):
        for distance in DISTANCES:
            rng = np.random.default_rng([m, int(distance)])
            vertices, faces = blob(rng, rings)
            azimuth = rng.uniform(-np.pi, np.pi)
            place = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.9 - sensor.height]
            ground = np.array([[-1.0, -1, -0.9], [1, -1, -0.9], [1, 1, -0.9], [-1, 1, -0.9]])
            n = len(vertices)
            faces = np.concatenate([faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]).astype(np.int32)
            made.append((distance, (np.concatenate([vertices, ground]) + place).astype(np.float32), faces, n))
    return made


def rays_of(sensor, window):
    a = sensor.azimuths(window)
    e = np.broadcast_to(sensor.elevations[window.row0 : window.row0 + window.rows], a.shape)
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], -1).reshape(-1, 3)


def other_ways():
    """Name -> function(vertices, faces, rays); each builds its tree and casts, as a new body needs."""
    ways = {}
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        def embree(vertices, faces, rays):
            scene = rtcore_scene.EmbreeScene()
            TriangleMesh(scene, vertices[faces])
            return scene.run(np.zeros_like(rays, dtype=np.float32), rays.astype(np.float32))

        ways["embreex"] = embree
    except ImportError:
        pass
    try:
        import open3d

        def open3d_cast(vertices, faces, rays):
            scene = open3d.t.geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
            return scene.cast_rays(open3d.core.Tensor(np.concatenate([0 * rays, rays], 1).astype(np.float32)), 1)

        ways["open3d"] = open3d_cast
    except ImportError:
        pass
    return ways


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sensor", default="dapt64")
    parser.add_argument("--rings", type=int, default=60, help="of the meshes: 60 are 14,160 triangles, 25 are 2,400")
    arguments = parser.parse_args()
    sensor, ways = named_sensor(arguments.sensor), other_ways()
    made = scenes(sensor, arguments.rings)
    best = {way: np.full(len(made), np.inf) for way in ("scan", "cast_window", *ways, "reference")}
    hits = np.zeros(len(made))
    rng = np.random.default_rng(0)
    for turn in range(arguments.rounds + 1):  # the first turn warms up
        for i, (_, vertices, faces, body) in enumerate(made):
            window = find_window(vertices[:body], sensor)
            rays = rays_of(sensor, window)

            def clock(way, function, i=i, turn=turn):
                start = time.perf_counter()
                result = function()
                if turn:
                    best[way][i] = min(best[way][i], time.perf_counter() - start)
                return result

            hits[i] = len(
                clock("scan", lambda: scan(vertices, faces, sensor, window_vertices=vertices[:body])).points  # noqa: B023
            )
            clock("cast_window", lambda: cast_window(vertices, faces, sensor, window))  # noqa: B023
            for name, way in ways.items():
                clock(name, lambda: way(vertices, faces, rays))  # noqa: B023
            if turn == 1:
                sample = rays[rng.permutation(len(rays))[:REFERENCE_RAYS]]
                clock("reference", lambda: cast_ray_list_reference(vertices, faces, sample))  # noqa: B023
                best["reference"][i] *= len(rays) / max(1, len(sample))
    distances = np.array([scene[0] for scene in made])
    print(f"{sensor.name}, {len(made[0][2]):,} triangles, best of {arguments.rounds}; ms a cast by distance")
    print(f"{'way':12s}" + "".join(f"{d:9.0f} m" for d in DISTANCES) + f"{'mean':>11s}{'casts/s':>10s}{'x scan':>10s}")
    for way, seconds in best.items():
        by_distance = [seconds[distances == d].mean() * 1e3 for d in DISTANCES]
        mean = seconds.mean()
        print(
            f"{way:12s}"
            + "".join(f"{ms:11.3f}" for ms in by_distance)
            + f"{mean * 1e3:11.3f}{1 / mean:10,.0f}{mean / best['scan'].mean():10.1f}"
        )
    print(f"{'hits':12s}" + "".join(f"{hits[distances == d].mean():11.0f}" for d in DISTANCES))


if __name__ == "__main__":
    main()
