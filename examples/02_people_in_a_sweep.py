"""All people in a whole sweep, detected or given by boxes, from files.

The sweep here is synthesized and written first; for your own files only the second half is needed.
Run: python examples/02_people_in_a_sweep.py    (needs, in the clone: pip install ".[synth]")
"""

import json

import numpy as np

import lidarpose
from lidarpose.lidar.raycast import scan
from lidarpose.synth.bodies import draw_bodies
from lidarpose.synth.environment.mesh import Mesh, quad, union

# ---- a sweep: three people on flat ground around a sensor 1.7 m above it

device = lidarpose.sensor("os1-128")
assert isinstance(device, lidarpose.Sensor)  # not a rosette
bodies = draw_bodies(None, captured=0.0, count=3, seed=1, block=0)
places = np.array([[6.0, 1.0], [-4.0, 5.0], [2.0, -9.0]])
feet = np.column_stack([places, np.full(3, -device.height)]).astype(np.float32)
meshes = [Mesh(vertices, bodies.faces).moved(foot) for vertices, foot in zip(bodies.vertices, feet, strict=True)]
scene = union([*meshes, quad(15.0, np.zeros(2)).moved(np.array([0, 0, -device.height]))])
points = scan(scene.vertices, scene.faces, device).points
np.save("sweep.npy", points)

people = []
for name, mesh in zip("abc", meshes, strict=True):
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    center, size = (low + high) / 2, high - low + 0.1
    people.append({"id": name, "center": center.tolist(), "size": size.tolist(), "yaw": 0.0})
with open("people.json", "w") as file:
    json.dump({"people": people}, file)

# ---- detecting the people

boxes = lidarpose.detect("sweep.npy")
for box in boxes:
    print(f"found at {box.center.round(1)} m with a score of {box.score:.2f}")

# ---- their poses, in given boxes; without boxes, in detected ones

poses = lidarpose.predict("sweep.npy", boxes="people.json", skeleton="human15")
for person in poses:
    head = person.joints[poses.skeleton.index("head")]
    print(f"{person.id}: {person.num_points} points, head at {head.round(2)} m, {person.confidence.mean():.0%} sure")
poses.save("sweep.poses.json")
poses.picture("sweep.poses.png")
print("wrote sweep.poses.json and sweep.poses.png; the same by command:")
print("  lidarpose predict sweep.npy --boxes people.json --skeleton human15 --picture")
print("and without boxes:")
print("  lidarpose predict sweep.npy --picture")
