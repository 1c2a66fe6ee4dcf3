"""Time for ray casting one body, compared with the tests' reference and, if installed, Embree and Open3D.

    python benchmarks/raycast.py [--rounds 5] [--sensor dapt64] [--rings 60] [--plot docs/images/raycast.png]

30 scenes from one seed: 5 distances x 6 closed meshes, each with a ground quad. The methods take turns scene by scene,
so that a busy machine slows down all equally: compare ratios. `scan` is timed including window, cast and packed points;
the other methods get the rays of the window precomputed. "open3d" uses a legacy mesh, as the paper's released code
does, "open3d direct" passes tensors; every method builds its tree for each body. The slow twin, the reference of the
tests, casts a sample of the rays, and its time is scaled up. All on one thread.

    pip install embreex open3d-cpu matplotlib    # optional; Open3D also wants libusb-1.0-0 and libgl1 of the system
"""

import argparse
import os
import sys
import time
from pathlib import Path

# set before numpy and Open3D start their threads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from lidarpose.lidar.presets import sensor as named_sensor
from lidarpose.lidar.raycast import scan

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from reference.raycast_reference import cast_ray_list_reference, window_rays  # noqa: E402

DISTANCES = (4.0, 7.0, 10.0, 15.0, 20.0)
MESHES = 6
REFERENCE_RAYS = 16
# rings of the meshes in the plot, which have 4 * rings * (rings - 1) triangles
RINGS = (18, 25, 42, 60, 90)
REFERENCE = "slow twin"
# ms, ticks of the plot
TICKS = (0.05, 0.1, 0.2, 0.3, 0.5, 1, 5, 20, 50)


def blob(rng, rings):
    """A closed bumpy mesh of about the size of a person, with 4 * rings * (rings - 1) triangles."""
    segments = 2 * rings
    polar, angle = np.pi * np.arange(1, rings) / rings, np.pi * np.arange(segments) / rings
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    grid = np.concatenate(
        [np.sin(polar)[:, None, None] * ring, np.broadcast_to(np.cos(polar)[:, None, None], (rings - 1, segments, 1))],
        -1,
    )
    vertices = np.concatenate([grid.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    j = np.arange(segments)
    k, top = (j + 1) % segments, (rings - 1) * segments
    faces = [np.stack([np.full(segments, top), j, k], -1)]
    for i in range(rings - 2):
        a, b = i * segments, (i + 1) * segments
        faces += [np.stack([a + j, b + j, b + k], -1), np.stack([a + j, b + k, a + k], -1)]
    faces.append(np.stack([np.full(segments, top + 1), top - segments + k, top - segments + j], -1))
    bumps = 1 + 0.4 * np.sin(vertices @ rng.normal(0, 5, (3, 4))).sum(1, keepdims=True) / 4
    return vertices * bumps * [0.2, 0.35, 0.9], np.concatenate(faces)


def scenes(sensor, rings):
    """A list of (distance, vertices, faces, the body's vertex count); the ground's two faces are the last ones."""
    scene_list = []
    for m in range(MESHES):
        for distance in DISTANCES:
            rng = np.random.default_rng([m, int(distance)])
            vertices, faces = blob(rng, rings)
            azimuth = rng.uniform(-np.pi, np.pi)
            place = [distance * np.cos(azimuth), distance * np.sin(azimuth), 0.9 - sensor.height]
            ground = np.array([[-1.0, -1, -0.9], [1, -1, -0.9], [1, 1, -0.9], [-1, 1, -0.9]])
            n = len(vertices)
            faces = np.concatenate([faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]).astype(np.int32)
            scene_list.append((distance, (np.concatenate([vertices, ground]) + place).astype(np.float32), faces, n))
    return scene_list


def other_ways():
    """Name -> function(vertices, faces, rays, ...) that builds the tree and casts, as is necessary for each body."""
    casters = {}
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        def embree(vertices, faces, rays, *_):
            scene = rtcore_scene.EmbreeScene()
            TriangleMesh(scene, vertices[faces])
            return scene.run(np.zeros_like(rays, dtype=np.float32), rays.astype(np.float32))

        casters["embreex"] = embree
    except ImportError:
        pass
    try:
        import open3d

        def cast(scene, rays):
            return scene.cast_rays(open3d.core.Tensor(np.concatenate([0 * rays, rays], 1).astype(np.float32)), 1)

        def by_legacy_mesh(vertices, faces, rays, *_):
            mesh = open3d.geometry.TriangleMesh(
                open3d.utility.Vector3dVector(vertices.astype(float)), open3d.utility.Vector3iVector(faces)
            )
            scene = open3d.t.geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
            return cast(scene, rays)

        def by_tensors(vertices, faces, rays, *_):
            scene = open3d.t.geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
            return cast(scene, rays)

        casters["open3d"], casters["open3d direct"] = by_legacy_mesh, by_tensors
    except ImportError:
        pass
    return casters


def measure(made, sensor, ways, rounds, *, reference=False):
    """Method -> minimum seconds for each scene (scenes,), and the number of hits in each scene."""
    best = {name: np.full(len(made), np.inf) for name in (*ways, *([REFERENCE] if reference else []))}
    counts = np.zeros(len(made))
    rng = np.random.default_rng(0)
    for turn in range(rounds + 1):  # the first round is the warm-up
        for i, (_, vertices, faces, body) in enumerate(made):
            hits = scan(vertices, faces, sensor, window_vertices=vertices[:body])
            rays, counts[i] = window_rays(hits, sensor).reshape(-1, 3), len(hits.points)
            for name, caster in ways.items():
                start = time.perf_counter()
                caster(vertices, faces, rays, body)
                if turn:
                    best[name][i] = min(best[name][i], time.perf_counter() - start)
            if reference and turn == 1:
                sample = rays[rng.permutation(len(rays))[:REFERENCE_RAYS]]
                start = time.perf_counter()
                cast_ray_list_reference(vertices, faces, sample)
                best[REFERENCE][i] = (time.perf_counter() - start) * len(rays) / max(1, len(sample))
    return best, counts


def plot(path, sensor, by_distance, by_count):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, series in ((left, by_distance), (right, by_count)):
        for name in next(iter(series.values())):
            values = [series[x][name] * 1e3 for x in series]
            axis.plot(list(series), values, marker="o", ms=4, label=name)
        axis.set_yscale("log")
        axis.grid(True, lw=0.3)
    # the limits of both axes, which are shared
    limits = left.get_ylim()
    left.set_yticks(TICKS, [f"{ms:g}" for ms in TICKS])
    left.set_ylim(limits)
    left.minorticks_off()
    left.set(xlabel="distance, m", ylabel="ms a person, one thread", title=f"{sensor.name}, 14,160 triangles")
    right.set(xlabel="triangles", xscale="log", title="mean over 4 to 20 m")
    right.set_xticks(list(by_count), [f"{count:,}" for count in by_count], rotation=30)
    right.minorticks_off()
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=80)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sensor", default="dapt64")
    parser.add_argument("--rings", type=int, default=60, help="of the meshes: 60 are 14,160 triangles, 25 are 2,400")
    parser.add_argument("--plot", help="also draw cost by distance and by number of triangles to this PNG")
    arguments = parser.parse_args()
    sensor = named_sensor(arguments.sensor)

    def cast_scan(vertices, faces, rays, body):
        return scan(vertices, faces, sensor, window_vertices=vertices[:body])

    casters = {"scan": cast_scan, **other_ways()}
    scene_list = scenes(sensor, arguments.rings)
    best, hits = measure(scene_list, sensor, casters, arguments.rounds, reference=True)
    distances = np.array([scene[0] for scene in scene_list])
    print(f"{sensor.name}, {len(scene_list[0][2]):,} triangles, best of {arguments.rounds}; ms a cast by distance")
    print(f"{'way':14s}" + "".join(f"{d:9.0f} m" for d in DISTANCES) + f"{'mean':>11s}{'casts/s':>10s}{'x scan':>10s}")
    for name, seconds in best.items():
        by_distance = [seconds[distances == d].mean() * 1e3 for d in DISTANCES]
        mean = seconds.mean()
        print(
            f"{name:14s}"
            + "".join(f"{ms:11.3f}" for ms in by_distance)
            + f"{mean * 1e3:11.3f}{1 / mean:10,.0f}{mean / best['scan'].mean():10.1f}"
        )
    print(f"{'hits':14s}" + "".join(f"{hits[distances == d].mean():11.0f}" for d in DISTANCES))
    if arguments.plot:
        plotted_times = {name: best[name] for name in casters}
        by_distance = {d: {name: plotted_times[name][distances == d].mean() for name in casters} for d in DISTANCES}
        by_count = {}
        for rings in RINGS:
            times_by_name, _ = measure(scenes(sensor, rings), sensor, casters, max(1, arguments.rounds // 2))
            by_count[4 * rings * (rings - 1)] = {name: seconds.mean() for name, seconds in times_by_name.items()}
        for count, series in by_count.items():
            print(f"{count:7,} triangles: " + ", ".join(f"{name} {ms * 1e3:.3f} ms" for name, ms in series.items()))
        plot(arguments.plot, sensor, by_distance, by_count)


if __name__ == "__main__":
    main()
