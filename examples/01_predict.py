"""The pose of one person from an array of points.

The cloud here is synthesized; yours may come from anywhere, as an (n, 3) array in meters with z up.
Run: python examples/01_predict.py    (needs, in the clone: pip install ".[synth]")
"""

import lidarpose
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config

points = Generator(scene=scene_config("wild").eased(0.0)).person(seed=3, index=5).sample.points
print(f"{len(points)} points, from {points.min(0).round(2)} to {points.max(0).round(2)} m")

model = lidarpose.load()
# the sensor is at the origin of these points; omit sensor_origin if the position is unknown
pose = model.predict(points, sensor_origin=(0, 0, 0))

for name, joint, confidence, spread in zip(
    pose.skeleton.joints, pose.joints, pose.confidence, pose.spread, strict=True
):
    print(f"{name:15} {joint.round(2)} m   {confidence:4.0%} within 10 cm, {spread:.2f} m to be expected")

pose.save("person.json")
pose.picture("person.png")
print("wrote person.json and person.png")
