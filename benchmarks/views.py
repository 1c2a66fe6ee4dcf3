"""What several views of one person are worth at test time: the cloud turned about z, and its mirror image.

    python benchmarks/views.py --motion cmu_motion.npz

The people of benchmarks/heldout.py under another seed, the sensor's place known. Poses of all views are turned back and
put together by their mean, by a mean weighted with confidence, or by taking the surest.
"""

import argparse

import heldout
import numpy as np

from lidarpose.data.views import MIRROR
from lidarpose.evaluate.metrics import mpjpe
from lidarpose.geometry import rotation_about
from lidarpose.infer.predictor import load
from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.bodies import PoseBank

TURNS = 4
# how much more a surer view counts
POWER = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", required=True)
    parser.add_argument("--subjects", default="006,007")
    parser.add_argument("--people", type=int, default=1000)
    parser.add_argument("--weights", default="tiny")
    options = parser.parse_args()
    bank = PoseBank.from_clips(options.motion, tuple(options.subjects.split(",")))
    found = heldout.people(bank, options.people, 50, heldout.SEED + 5)
    true = np.stack([person.sample.pose.to(HUMAN15).joints for person in found])
    model = load(options.weights)
    joints, sure = [], []
    for turn in range(TURNS):
        for mirrored in (False, True):
            # a little more than a quarter turn, so that no two views share the voxels' axes
            R = rotation_about("z", turn * (np.pi / 2 + 0.1))
            view = MIRROR @ R if mirrored else R
            clouds = [person.sample.points @ view.T for person in found]
            poses = model.predict(clouds, sensor_origin=(0, 0, 0), skeleton="body26")
            back = np.stack([pose.joints for pose in poses]) @ view
            joints.append((back[:, list(BODY26.flip)] if mirrored else back)[:, BODY26.map_to(HUMAN15)])
            sure.append(np.array([pose.confidence.mean() for pose in poses]))
    joints, sure = np.array(joints), np.array(sure)
    everyone = np.arange(len(found))
    for name, views in (("one", [0]), ("two turned", [0, 2]), ("four turned", [0, 2, 4, 6]), ("eight", list(range(8)))):
        picked, weight = joints[views], sure[views] ** POWER
        weighted = (picked * weight[..., None, None]).sum(0) / weight.sum(0)[:, None, None]
        surest = picked[sure[views].argmax(0), everyone]
        figures = {"mean": picked.mean(0), "weighted": weighted, "surest": surest}
        print(f"{name:<12}", "  ".join(f"{key} {mpjpe(value, true):.1f} mm" for key, value in figures.items()))


if __name__ == "__main__":
    main()
