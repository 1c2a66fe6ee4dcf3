"""Networks of benchmarks/backbones.py."""

import numpy as np
import pytest
import torch
from scripts import load_script

from lidarpose.models.config import SIZES
from lidarpose.models.posenet import PoseNet

pytestmark = pytest.mark.usefixtures("one_thread")
backbones = load_script("benchmarks/backbones.py")
KINDS = (backbones.Draft, backbones.GroupedViT, backbones.PointNet2)
POINT_COUNTS = (1, 40, 300)


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.__name__)
def network(request):
    torch.manual_seed(0)
    return request.param.of_parameters(450_000).eval()


def person(n, seed=0):
    return np.random.default_rng(seed).normal(0, (0.2, 0.2, 0.5), (n, 3)).astype(np.float32)


@torch.inference_mode()
def run(network, clouds):
    return network(network.prepare(clouds))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_of_parameters_matches_requested_count(kind):
    for size in ("tiny", "small"):
        due = backbones.count(PoseNet(SIZES[size]))
        assert backbones.count(kind.of_parameters(due)) == pytest.approx(due, rel=0.1)
    # the size of the draft that was measured
    assert backbones.count(backbones.Draft()) == pytest.approx(1.2e6, rel=0.1)
    with pytest.raises(ValueError, match="within a tenth"):
        backbones.PointNet2.of_parameters(100)


def test_joints_independent_of_batch_and_finite_for_few_points(network):
    clouds = [person(n, n) for n in POINT_COUNTS]
    together = run(network, clouds)
    assert together.shape == (len(POINT_COUNTS), 26, 3)
    for k, cloud in enumerate(clouds):
        torch.testing.assert_close(together[k : k + 1], run(network, [cloud]), atol=1e-5, rtol=1e-4)
    for few in ([person(1)], [person(0), person(3)], [np.ones((50, 3), np.float32)]):
        assert run(network, few).isfinite().all()


def test_all_parameters_receive_gradients(network):
    """So that the measured cost is that of the whole network."""
    network.train()
    joints = network(network.prepare([person(n, n) for n in (200, 60)]))
    joints.square().mean().backward()
    network.eval()
    idle = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.any()]
    network.zero_grad()
    assert idle == []


def test_grouped_collects_points_within_radius():
    points = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0], [9, 9, 9]]])
    valid = torch.tensor([[True, True, True, False]])
    groups = backbones.grouped(points, valid, centers=4, neighbors=3, radius=0.2)
    assert groups.center[0, :3, 0].tolist() == pytest.approx([0, 1, 0.1])
    assert groups.center_valid.tolist() == [[True, True, True, False]]
    assert groups.valid.sum(-1)[0, :3].tolist() == [2, 1, 2]
    assert groups.relative[0, 0, 1].tolist() == pytest.approx([0.1, 0, 0])


def test_draft_pools_each_voxel_into_its_own_parent():
    tables = backbones.Draft().prepare([person(n, n) for n in POINT_COUNTS])
    for level, above in zip(tables.levels, tables.levels[1:], strict=False):
        assert sorted(set(level.children.flatten().tolist())) == list(range(len(level.position)))
        for parent, children in enumerate(level.children):
            assert (level.parent[children] == parent).all()
            # a parent is at the mean of its points, which is inside the box of its children
            inside = level.position[children]
            assert (inside.amin(0) <= above.position[parent] + 1e-5).all()
            assert (above.position[parent] <= inside.amax(0) + 1e-5).all()
