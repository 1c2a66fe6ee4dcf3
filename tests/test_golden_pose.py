"""What the bundled weights say of one cloud, on any machine and by either backend.

The cloud in golden_poses.json is a synthesized walker of 221 points, 10 m from a VLP-32C; its joints were written by
tools/ship_weights.py.
"""

import json
from pathlib import Path

import numpy as np
import pytest

import lidarpose
from lidarpose.models import BUNDLED, DEFAULT, bundled_path
from lidarpose.skeleton import SMPL24

GOLDEN = json.loads((Path(__file__).parent / "golden_poses.json").read_text())
# another processor's rounding, m
TOLERANCE = 5e-4


@pytest.mark.parametrize("backend", ["onnx", "torch"])
@pytest.mark.parametrize("name", BUNDLED)
def test_the_pose_of_a_fixed_cloud(name, backend):
    model = lidarpose.load(name, backend=backend, tta=1)
    pose = model.predict(np.array(GOLDEN["points"]), sensor_origin=GOLDEN["sensor_origin"])
    np.testing.assert_allclose(pose.joints, GOLDEN["joints"][name], atol=TOLERANCE)


@pytest.mark.parametrize("name", BUNDLED)
def test_the_golden_pose_is_a_good_one(name):
    """Within 6 cm of the truth on average, so that what is held is no nonsense."""
    error = np.linalg.norm(np.array(GOLDEN["joints"][name]) - np.array(GOLDEN["truth"]), axis=-1)
    assert len(error) == len(SMPL24) and error.mean() < 0.06, f"{error.mean() * 1e3:.0f} mm"


def test_the_files_are_small():
    """What is taken by default is at most 6 MB with its ONNX twin, any file at most 12."""
    sizes = {name: [bundled_path(name, end).stat().st_size for end in (".safetensors", ".onnx")] for name in BUNDLED}
    assert sum(sizes[DEFAULT]) < 6e6 and max(map(max, sizes.values())) < 12e6
