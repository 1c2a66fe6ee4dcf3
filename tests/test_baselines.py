"""Networks of the baselines in the paper: parameter counts as published, padding, order of points."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from lidarpose.models.baselines import prn
from lidarpose.models.baselines.baseline_config import CLOUDS, LidarcapConfig, LpformerConfig, NeConfig, PrnConfig
from lidarpose.models.baselines.lidarcap import (
    Lidarcap,
    PointNet2,
    forward_kinematics,
    rotations_from_6d,
    tree_partition,
)
from lidarpose.models.baselines.lpformer import V2V, Lpformer
from lidarpose.models.baselines.ne import CloudExchange, Ne
from lidarpose.models.baselines.point_ops import ball_query, farthest_points, nearest_neighbors
from lidarpose.models.baselines.point_transformer_v2 import Rows
from lidarpose.models.baselines.prn import BareAttention, OffsetHead, Prn, PrnNeck
from lidarpose.models.checkpoint import build, parameter_count, save_checkpoint
from lidarpose.sample import CLIP_FRAMES
from lidarpose.skeleton import SMPL24, WAYMO14
from lidarpose.train.networks import PRETRAINED

# numbers of parameters, counted layer by layer from the authors' code
PARAMETERS = {
    "prn 15": (lambda: Prn(PrnConfig()), 1_738_482),
    "prn 24": (lambda: Prn(PrnConfig(joints=SMPL24.joints)), 1_739_652),
    "prn neck 64": (lambda: PrnNeck(64, 15), 228_870),
    "prn neck 128": (lambda: PrnNeck(128, 15), 899_910),
    "v2v": (V2V, 3_242_112),
    "lpformer 14": (lambda: Lpformer(LpformerConfig(joints=WAYMO14.joints)), 4_814_212),
    "lpformer 15": (lambda: Lpformer(LpformerConfig()), 4_814_485),
    "lpformer 24": (lambda: Lpformer(LpformerConfig(joints=SMPL24.joints, grid=32)), 4_816_942),
    "pointnet++ 1024": (lambda: PointNet2(1024), 805_184),
    "pointnet++ 512": (lambda: PointNet2(512), 542_016),
    "lidarcap": (lambda: Lidarcap(LidarcapConfig()), 34_925_854),
    "ne": (lambda: Ne(NeConfig()), 129_720_766),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameter_counts_match_published_networks(name):
    make, count = PARAMETERS[name]
    with torch.device("meta"):
        assert sum(p.numel() for p in make().parameters()) == count


# ---- neighborhoods


def _cloud(seed: int, counts: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (B, N, 3) of a person's size, padded with nonzero numbers, and valid (B, N)."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(len(counts), max(counts), 3, generator=rng) * torch.tensor([0.25, 0.25, 0.5])
    valid = torch.arange(max(counts)) < torch.tensor(counts)[:, None]
    return points.masked_fill(~valid[..., None], 0.4), valid


@pytest.mark.parametrize("as_published", [False, True])
def test_farthest_points_equals_definition(as_published):
    points, valid = _cloud(0, (40, 23))
    indices = farthest_points(points, valid, 30, as_published=as_published)
    for cloud, chosen, count in zip(points, indices.tolist(), (40, 23), strict=True):
        first = 0 if as_published else int((cloud[:count] - cloud[:count].mean(0)).norm(dim=1).argmax())
        usable = [i for i in range(count) if not as_published or cloud[i].square().sum() > 1e-3]
        expected = [first]
        while len(expected) < min(30, count):
            rest = [min(float((cloud[i] - cloud[j]).norm()) for j in expected) for i in usable]
            expected.append(usable[int(np.argmax(rest))])
        assert chosen == expected + [first] * (30 - len(expected))


@pytest.mark.parametrize("as_published", [False, True])
def test_ball_query_equals_definition(as_published):
    points, valid = _cloud(1, (50, 31))
    index = ball_query(points[:, :7], points, valid, 0.4, 12, as_published=as_published)
    for b, count in enumerate((50, 31)):
        for m in range(7):
            distance = (points[b, :count] - points[b, m]).norm(dim=1)
            inside = [i for i in range(count) if distance[i] < 0.4]
            expected = inside if as_published else sorted(inside, key=lambda i: float(distance[i]))
            assert index[b, m].tolist() == (expected + [expected[0]] * 12)[:12]


def test_nearest_neighbors_equals_definition():
    points, valid = _cloud(2, (30, 5))
    index = nearest_neighbors(points, valid, 8)
    for b, count in enumerate((30, 5)):
        for m in range(count):
            order = (points[b, :count] - points[b, m]).norm(dim=1).argsort()[:8].tolist()
            assert index[b, m].tolist() == order + [-1] * (8 - len(order))


# ---- rotations


def test_rotations_from_6d_are_proper_and_in_published_layout():
    rotations = rotations_from_6d(torch.randn(50, 6))
    assert torch.allclose(rotations @ rotations.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(50), atol=1e-5)
    # the six numbers are a 3x2 matrix, row by row
    assert torch.allclose(rotations_from_6d(torch.tensor([1.0, 0, 0, 1, 0, 0])), torch.eye(3))


def test_forward_kinematics_rotates_only_descendants():
    offsets = torch.randn(24, 3)
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations = torch.eye(3).expand(24, 3, 3).clone()
    rest = forward_kinematics(rotations, offsets, SMPL24.parents)
    rotations[4] = turn
    posed = forward_kinematics(rotations, offsets, SMPL24.parents)
    below = [j for j in range(24) if _descends(j, 4)]
    assert torch.allclose(posed[below] - posed[4], (rest[below] - rest[4]) @ turn.T, atol=1e-6)
    above = [j for j in range(24) if j not in below]
    assert torch.equal(posed[above], rest[above])


def _descends(joint: int, ancestor: int) -> bool:
    while joint >= 0 and joint != ancestor:
        joint = SMPL24.parents[joint]
    return joint == ancestor


def test_tree_partition_is_normalized_and_splits_by_depth():
    graph = tree_partition(SMPL24.parents)
    assert torch.allclose(graph.sum((0, 1)), torch.ones(24))
    knee, hip, ankle = 4, 1, 7
    assert graph[2, hip, knee] > 0 and graph[1, ankle, knee] > 0 and graph[0, knee, knee] > 0
    assert graph[1, hip, knee] == graph[2, ankle, knee] == 0


def kinds(layers):
    return [
        f"{type(layer).__name__} {layer.p}" if isinstance(layer, nn.Dropout) else type(layer).__name__
        for layer in layers
    ]


def test_layer_order_and_dropout_match_published_code():
    """Properties that parameter counts do not show."""
    config = {"lpformer": LpformerConfig(), "lidarcap": LidarcapConfig(), "ne": NeConfig()}
    assert kinds(build(config["lpformer"]).parts) == ["Linear", "ReLU", "Linear", "Linear"]
    for name in ("lidarcap", "ne"):
        first, *others = build(replace(config[name], width_divisor=8)).rotations.layers
        assert kinds(first.time)[-1] == "Dropout 0.0" and first.residual is None
        assert all(kinds(layer.time)[-1] == "Dropout 0.5" and layer.residual for layer in others)
    exchange = CloudExchange(16, 8)
    assert kinds(exchange.mlp) == ["Linear", "GELU", "Dropout 0.1", "Linear", "Dropout 0.1"]
    assert all(attention.dropout == 0 for attention in exchange.attention)
    # dropout on the output of attention, besides the drop path of whole clips
    clouds = torch.randn(3, 64, 16, 16)
    assert exchange.drop_path.probability == 0.2
    exchange.drop_path.probability = 0.0
    with torch.no_grad():
        outputs = [exchange._attend(0, *clouds) for _ in range(2)]
    shares = [(output == 0).float().mean().item() for output in outputs]
    assert all(0.07 < share < 0.13 for share in shares) and not torch.equal(*outputs)


# ---- order and padding


def _network(name: str) -> torch.nn.Module:
    """Network `name` with fixed weights, in evaluation mode, scaled so that each branch affects the output."""
    torch.manual_seed(3)
    configs = {"prn": PrnConfig(), "lpformer": LpformerConfig(grid=32)}
    network = PointNet2(64) if name == "pointnet++" else build(configs.get(name) or PRETRAINED[name][0])
    if name.startswith("prn"):
        # with random part logits, no point would be confident enough to vote
        network.vote.parts[-1].weight.mul_(100)
    if name.startswith("lpformer"):
        # its volume is nearly zero at initialization
        network.volume.last.weight.mul_(1000)
    # without statistics in batch norms, deep layers give nearly zero
    for module in network.modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            module.momentum = 1.0
    _run(network.train(), *_cloud(9, (60, 50, 40)))
    return network.eval()


def _run(network: torch.nn.Module, points: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Joints (B, J, 3), or features (B, C) of a part of a network. Clip networks get the cloud in each frame; NE also
    gets it negated and shifted as background and neighbors."""
    if not hasattr(network, "decode"):
        outputs = network(points, valid)
        return getattr(outputs, "joints", outputs)
    frames, shown = (x[:, None].expand(-1, CLIP_FRAMES, *x.shape[1:]) for x in (points, valid))
    clouds = {
        name: (sign * frames + shift, shown) for name, sign, shift in zip(CLOUDS, (1, -1, 1), (0, 0, 1), strict=True)
    }
    outputs = network(clouds)
    assert outputs.joints.shape == (len(points), CLIP_FRAMES, 24, 3)
    assert outputs.rotations.shape == (len(points), CLIP_FRAMES, 24, 3, 3)
    return outputs.posed()


@torch.no_grad()
def test_bare_attention_equals_masked_attention():
    torch.manual_seed(0)
    layer, x = BareAttention(12, heads=3).eval(), torch.randn(3, 9, 12)
    # not all padding is at the end, and a person may have no row
    valid = torch.rand(3, 9) < 0.6
    valid[:2, :2], valid[2] = True, False
    query, key, value = (
        linear(x).unflatten(-1, (3, -1)).transpose(1, 2) for linear in (layer.query, layer.key, layer.value)
    )
    expected = x + F.scaled_dot_product_attention(query, key, value, valid[:, None, None]).transpose(1, 2).flatten(2)
    found = layer(x, valid)
    torch.testing.assert_close(found[valid], expected[valid], atol=1e-6, rtol=1e-5)
    assert torch.equal(found[~valid], x[~valid])
    torch.testing.assert_close(layer(x, valid, queries=2)[:2], expected[:2, :2], atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_bare_attention_takes_rows_of_lower_precision(monkeypatch):
    """As under autocast on a GPU, where attention stays in bfloat16."""
    torch.manual_seed(0)
    layer, x, valid = BareAttention(12, heads=3).eval(), torch.randn(2, 9, 12), torch.ones(2, 9, dtype=torch.bool)
    monkeypatch.setattr(prn, "attend", lambda *rows, dropout: F.scaled_dot_product_attention(*rows))
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(x, valid)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, layer(x, valid), atol=0.02, rtol=0.02)


@torch.no_grad()
@pytest.mark.parametrize("count", [3, 40, 60, 200])
@pytest.mark.parametrize("has_copies", [False, True])
def test_pointnet_features_are_independent_of_batch(count, has_copies):
    torch.manual_seed(0)
    network, (points, valid) = PointNet2(64, 8).eval(), _cloud(4, (512, count))
    if has_copies:
        points[1, count // 2 : count] = points[1, : count - count // 2].clone()
    alone = network(points[1:, :count], valid[1:, :count])
    torch.testing.assert_close(network(points, valid)[1:], alone, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_pointnet_batch_norms_count_no_copies():
    """A cloud smaller than the batch's padding repeats a center."""
    points, valid = _cloud(4, (512, 40))
    means = []
    for size in (40, 512):
        torch.manual_seed(0)
        network = PointNet2(64, 8).train()
        network(points[1:, :size], valid[1:, :size])
        norms = [module for module in network.modules() if isinstance(module, torch.nn.modules.batchnorm._BatchNorm)]
        means.append(torch.cat([norm.running_mean for norm in norms]))
    torch.testing.assert_close(*means, atol=1e-6, rtol=1e-5)


@pytest.mark.long
@torch.no_grad()
@pytest.mark.parametrize(
    "name",
    ["prn", "prn-small", "lpformer", "lpformer-small", "pointnet++", "lidarcap", "lidarcap-small", "ne", "ne-small"],
)
def test_networks_ignore_point_order_and_padding(name):
    network = _network(name)
    points, valid = _cloud(4, (150, 90, 8))
    expected = _run(network, points, valid)
    assert len(expected) == 3 and expected.isfinite().all()
    assert name == "pointnet++" or expected.shape[-2:] == ((24 if hasattr(network, "decode") else 15), 3)
    # tolerance for sums in another order
    near = 2e-5 * float(expected.abs().max())
    # outputs differ between people
    assert (expected[0] - expected[1]).abs().max() > 100 * near
    order = torch.randperm(150, generator=torch.Generator().manual_seed(5))
    assert torch.allclose(_run(network, points[:, order], valid[:, order]), expected, atol=near)
    more = torch.cat([points, torch.full((3, 40, 3), 0.2)], 1)
    wide = torch.cat([valid, torch.zeros(3, 40, dtype=torch.bool)], 1)
    assert torch.allclose(_run(network, more, wide), expected, atol=near)
    # the other people of the batch have no effect
    assert torch.allclose(_run(network, points[2:, :8], valid[2:, :8]), expected[2:], atol=near)


@pytest.mark.parametrize("name", ["prn-small", "lpformer-tiny", "lidarcap-tiny", "ne-tiny", "paper-tiny"])
def test_parameters_of_a_checkpoint_are_those_of_its_network(name, tmp_path):
    network = build(PRETRAINED[name][0])
    save_checkpoint(tmp_path / "a.safetensors", network, card={})
    assert parameter_count(tmp_path / "a.safetensors") == sum(value.numel() for value in network.parameters())


@torch.no_grad()
def test_offset_head_averages_votes_of_confident_points():
    torch.manual_seed(0)
    head = OffsetHead(6, 3, background=3).eval()
    head.parts[-1].weight.mul_(100)
    xyz, features, person = torch.randn(40, 3), torch.randn(40, 6), torch.arange(40) // 30
    voted, parts, offsets = head(features, Rows(xyz=xyz, person=person, count=torch.tensor([30, 10])))
    share, votes = parts.softmax(1), 0
    for k in range(2):
        for joint in range(3):
            own = [m for m in range(40) if person[m] == k and share[m, 3] < 0.6 and share[m].max() > 0.6]
            own = [m for m in own if share[m, :3].max() > 0.6]
            weight = share[own, joint]
            expected = (weight[:, None] * (xyz + offsets)[own]).sum(0) / (weight.sum() + 1e-8)
            assert torch.allclose(voted[k, joint], expected, atol=1e-5)
            votes += len(own)
    assert 0 < votes < 3 * 40
    # without votes, joints are at the center
    head.parts[-1].weight.zero_()
    assert not head(features, Rows(xyz=xyz, person=person, count=torch.tensor([30, 10])))[0].any()


@torch.no_grad()
def test_prn_neck_equals_padded_attention():
    torch.manual_seed(0)
    neck, count = PrnNeck(8, 3).eval(), torch.tensor([40, 3, 9])
    rows = Rows(xyz=torch.randn(52, 3), person=torch.repeat_interleave(torch.arange(3), count), count=count)
    features = torch.randn(52, 8)
    slots = nn.utils.rnn.pad_sequence(torch.arange(52).split(count.tolist()), batch_first=True)
    valid = torch.arange(40) < count[:, None]
    with torch.no_grad():
        nn.init.normal_(neck.joint)
        neck.vote.parts[7].weight *= 100
        found = neck(features, rows)
        joint_features = neck.embed(torch.cat([found.voted, neck.joint.expand(3, -1, -1)], -1))
        joint_tokens = torch.cat([found.voted, joint_features], -1)
        tokens = neck.token(torch.cat([joint_tokens, torch.cat([rows.xyz, features], -1)[slots]], 1))
        is_padding = torch.cat([valid.new_zeros(3, 3), ~valid], 1)
        expected = neck.output(neck.norm(neck.layers(tokens, src_key_padding_mask=is_padding))[:, :3])
    assert found.voted.abs().amax((1, 2)).min() > 0.01
    torch.testing.assert_close(found.joints, expected, atol=1e-5, rtol=1e-5)


def test_lpformer_weights_fit_any_grid_and_points_read_own_cell():
    torch.manual_seed(0)
    networks = {grid: Lpformer(LpformerConfig(grid=grid, width_divisor=8)).eval() for grid in (64, 32)}
    networks[32].load_state_dict(networks[64].state_dict())
    points, valid = _cloud(8, (30, 12))
    for grid, network in networks.items():
        joints = network(points, valid).joints
        assert joints.shape == (2, 15, 3) and joints.isfinite().all()
        assert network.occupancy(points, valid).shape == (2, 1, grid, grid, grid)
    # a volume that contains x, y and z of each cell's center
    network, middle = networks[32], (torch.arange(32) + 0.5) / 16 - 1
    z, y, x = torch.meshgrid(middle, middle, middle, indexing="ij")
    known, read = torch.stack([x, y, z, z * 0])[None].expand(2, -1, -1, -1, -1), {}
    network.volume = torch.nn.Identity()
    network.volume.forward = lambda occupied: known
    network.token.register_forward_pre_hook(lambda _, given: read.update(tokens=given[0]))
    inside = points.clamp(-0.9, 0.9)
    network(inside, valid)
    assert torch.allclose(read["tokens"][..., 6:9], inside, atol=1e-5)
    cells = network.occupancy(inside, valid)[0, 0].nonzero()
    expected = {tuple(((p + 1) * 16).floor().long().flip(0).tolist()) for p in inside[0, :30]}
    assert {tuple(cell) for cell in cells.tolist()} == expected


@pytest.mark.long
@torch.no_grad()
def test_lidarcap_clips_are_independent():
    points, valid = _cloud(6, (40,) * 2 * CLIP_FRAMES)
    points, valid = points.unflatten(0, (2, CLIP_FRAMES)), valid.unflatten(0, (2, CLIP_FRAMES))
    torch.manual_seed(0)
    network = Lidarcap(LidarcapConfig()).eval()
    both, first = network({"person": (points, valid)}), network({"person": (points[:1], valid[:1])})
    assert torch.allclose(both.rotations[:1], first.rotations, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("across_batch", [False, True])
def test_ne_exchange_across_batch_mixes_clips(across_batch):
    points, valid = _cloud(7, (20,) * 2 * CLIP_FRAMES)
    points, valid = points.unflatten(0, (2, CLIP_FRAMES)), valid.unflatten(0, (2, CLIP_FRAMES))
    clouds = {name: (points + k, valid) for k, name in enumerate(CLOUDS)}
    torch.manual_seed(0)
    network = Ne(NeConfig(exchange_across_batch=across_batch, width_divisor=8)).eval()
    both = network(clouds)
    alone = network({name: (points[:1], valid[:1]) for name, (points, valid) in clouds.items()})
    assert both.rotations.shape == (2, CLIP_FRAMES, 24, 3, 3)
    assert torch.allclose(both.joints[:1], alone.joints, atol=1e-5) == (not across_batch)
