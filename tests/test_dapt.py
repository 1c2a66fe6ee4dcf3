"""The DAPT network: parity with the authors' code, invariances, tables, attention, configurations, import."""

import itertools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch.nn import functional as F

from lidarpose.errors import InputError
from lidarpose.models import decode
from lidarpose.models.dapt.dapt_config import CONFIGS, FAULTS, WAYMO_JOINTS, DaptConfig, named_config
from lidarpose.models.dapt.dapt_net import DaptNet, to_tensors
from lidarpose.models.dapt.import_weights import import_dapt
from lidarpose.models.dapt.point_transformer_v3 import PatchAttention, RowNorm, Stage, SubmanifoldConvolution
from lidarpose.models.dapt.voxel_tables import LAYOUTS, build_tables
from lidarpose.models.layers import DropPath
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14

PARITY = Path(__file__).parent / "parity"
WEIGHTS = PARITY / "dapt_tiny.safetensors"
ORACLE = np.load(PARITY / "dapt_tiny.npz")
CLOUDS = np.split(ORACLE["points"], np.cumsum(ORACLE["counts"])[:-1])
POINT_FEATURES = np.split(ORACLE["point_feat_last"].astype(np.float32), np.cumsum(ORACLE["counts"])[:-1])
TINY = DaptConfig(
    name="tiny",
    joints=BODY26.joints,
    bins=(44, 44, 44),
    ranges=((-1.1, 1.1),) * 3,
    encoder_depths=(1, 1, 2),
    encoder_channels=(16, 16, 32),
    encoder_heads=(1, 1, 2),
    decoder_depths=(2, 1),
    decoder_channels=(16, 16),
    decoder_heads=(1, 2),
    anchor_channels=(16, 24, 16),
    strides=(2, 2),
    grid=0.02,
    patch=512,
    parts=25,
    coordinates=True,
    auxiliary=True,
)
SIZES = ("encoder_depths", "encoder_channels", "encoder_heads", "decoder_depths", "decoder_channels", "decoder_heads")
SIZES += ("anchor_channels", "strides")
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def released():
    return import_dapt(WEIGHTS)


def network(config=TINY, seed=0):
    torch.manual_seed(seed)
    net = DaptNet(config).eval()
    # distinct values in norms and anchors, as after training
    for name, value in net.state_dict().items():
        if value.is_floating_point() and ("running" in name or "keypoint_embedding" in name):
            value.copy_(torch.rand_like(value) + 0.5)
    return net


def person(n, seed=0, size=(0.2, 0.3, 0.6)):
    return np.random.default_rng(seed).normal(0, size, (n, 3)).astype(np.float32)


def run(net, clouds, layout="ragged"):
    with torch.inference_mode():
        return net(net.batch(clouds, layout=layout))


def assert_outputs(one, other, atol=1e-5):
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_allclose(one[name], other[name], rtol=1e-5, atol=atol, err_msg=name)


# ---- parity


def assert_parity(out, people):
    for name in ("anchors", "logits_x", "logits_y", "logits_z"):
        np.testing.assert_allclose(out[name], ORACLE[name][people], rtol=0, atol=1e-5, err_msg=name)
    # relative to the joints' size: some coordinates are near zero
    assert np.abs(out["inter"] - ORACLE["inter"][people]).max() < 1e-4 * np.abs(ORACLE["inter"][people]).max()
    config = named_config("waymo")
    for k, axis in enumerate("xyz"):
        logits = out[f"logits_{axis}"]
        assert (logits.argmax(-1) == ORACLE["argmax"][people, :, k]).all()
        dark = decode.dark(logits, low=config.low[k], step=config.step[k])
        np.testing.assert_allclose(dark, ORACLE["dark"][people, :, k], rtol=0, atol=1e-4)
    want = np.concatenate([POINT_FEATURES[k] for k in people])
    # they were stored as float16: half a unit in the last place
    assert (np.abs(out["point_feat_last"] - want) <= np.maximum(np.abs(want) * 2**-11, 2**-24) + 2e-6).all()


def test_dapt_equals_authors_code_in_batches_and_alone(released):
    assert_parity(released.outputs(CLOUDS), np.arange(5))
    for k, cloud in enumerate(CLOUDS):
        assert_parity(released.outputs([cloud]), np.array([k]))


def test_dapt_padded_layout_equals_authors_code(released):
    out = run(released, CLOUDS, "padded")
    for name in ("anchors", "logits_x", "logits_y", "logits_z", "inter"):
        np.testing.assert_allclose(getattr(out, name), ORACLE[name], rtol=0, atol=1e-5, err_msg=name)


def test_released_weights_need_stale_convolution(released):
    corrected = DaptNet(replace(released.config, stale_convolution=False)).eval()
    corrected.load_state_dict(released.state_dict())
    # the same voxels for both, so that only the flow differs
    batch = released.batch(CLOUDS)
    with torch.inference_mode():
        old, new = released(batch), corrected(batch)
    for name in ("anchors", "inter", "logits_z", "points"):
        assert (getattr(old, name) - getattr(new, name)).abs().max() > 1e-2, name


def test_stage_without_stale_convolution_chains_blocks():
    net = network()
    batch = net.batch([person(300), person(50, 1)])
    stage, level = net.backbone.enc.enc2, batch.levels[2]
    assert isinstance(stage, Stage) and stage.depth == 2
    rows = torch.randn(len(level.slots[level.valid]), 32)
    with torch.inference_mode():
        middle, branch = stage.block0(rows, rows, level)
        corrected = stage.block1(middle, middle, level)[0]
        stale = stage.block1(middle, branch, level)[0]
        torch.testing.assert_close(stage.blocks(rows, rows, level, stale_convolution=False), corrected)
        torch.testing.assert_close(stage.blocks(rows, rows, level, stale_convolution=True), stale)
    assert (corrected - stale).abs().max() > 1e-2


# ---- invariances


NECKS = {
    "corrected": TINY,
    "faults": replace(TINY, **dict.fromkeys(FAULTS, True)),
    "finest": replace(TINY, neck="finest"),
    "prn": replace(TINY, neck="prn", bins=(), ranges=(), parts=0),
}


@pytest.mark.long
@pytest.mark.parametrize("config", NECKS.values(), ids=NECKS)
@pytest.mark.parametrize("n", [1, 2, 40, 700])
def test_outputs_are_independent_of_batch(config, n):
    net, one = network(config), person(n)
    alone = net.outputs([one])
    among = net.outputs([person(900, 1), person(0), one, person(3, 2)])
    rows = slice(900, 900 + n)
    among = {
        name: values[rows] if name in ("point_feat_last", "parts") else values[2:3] for name, values in among.items()
    }
    assert_outputs(alone, among)


@pytest.mark.parametrize("n", [60, 900])
def test_outputs_are_independent_of_point_order(n):
    # some voxels have several points
    net, cloud = network(), person(n, size=0.05 if n < 100 else 0.2)
    order = np.random.default_rng(0).permutation(n)
    straight = net.outputs([cloud])
    per_point = {name: straight[name][order] for name in ("point_feat_last", "parts")}
    assert_outputs(straight | per_point, net.outputs([cloud[order]]))
    assert build_tables([cloud], net.config).features.shape[0] < n


def test_outputs_accept_any_dtype_and_memory_layout(released):
    want = released.outputs(CLOUDS[:2])
    assert_outputs(want, released.outputs([cloud.astype(np.float64) for cloud in CLOUDS[:2]]))
    wide = [np.concatenate([cloud, cloud], 1)[:, 3:] for cloud in CLOUDS[:2]]
    assert not wide[0].flags.contiguous
    assert_outputs(want, released.outputs([np.asfortranarray(wide[0]), wide[1]]))
    halved = [cloud.astype(np.float16) for cloud in CLOUDS[:2]]
    assert_outputs(released.outputs(halved), released.outputs([cloud.astype(np.float32) for cloud in halved]))
    assert released.outputs([np.zeros((2, 3), int)])["inter"].shape == (1, 14, 3)


def test_outputs_keep_network_state_and_mode():
    net = network().train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    first = net.outputs([person(100)])
    assert net.training and all(torch.equal(before[name], value) for name, value in net.state_dict().items())
    assert_outputs(first, net.eval().outputs([person(100)]))
    assert not net.training


# ---- sensitivity, few points, half precision


def test_outputs_depend_on_points():
    net, cloud = network(), person(300)
    base, moved = net.outputs([cloud]), cloud + 0.2 * (np.arange(300) < 30)[:, None]
    assert np.abs(net.outputs([moved])["anchors"] - base["anchors"]).max() > 1e-3
    assert np.abs(base["parts"] - base["parts"][0]).max() > 1e-2


@pytest.mark.parametrize("sizes", [[0], [0, 0], [0, 40, 0], [1], []])
def test_outputs_are_finite_for_few_points(sizes):
    for name, config in NECKS.items():
        net = network(config)
        out = net.outputs([person(n, k) for k, n in enumerate(sizes)])
        joints = {"anchors", "logits_x", "logits_y", "logits_z", "inter", "coordinates"}
        if name == "prn":
            joints = {"voted", "inter", "coordinates"}
        assert out.keys() == joints | {"point_feat_last", "parts"}
        for name, values in out.items():
            assert np.isfinite(values).all() and len(values) == (len(sizes) if name in joints else sum(sizes)), name


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_outputs_in_half_precision_are_close(dtype, layout):
    net = network()
    clouds = [person(200), person(0), person(700, 1)]
    want = run(net, clouds, layout)
    out = run(network().to(dtype), clouds, layout)
    loose = 0.02 if dtype == torch.float16 else 0.15
    assert (out.anchors.float() - want.anchors).abs().max() < loose and out.anchors.dtype == dtype
    assert torch.isfinite(out.joints()).all()


# ---- training


def test_layouts_give_equal_gradients_with_small_patches():
    grads = []
    for layout in LAYOUTS:
        net = network(replace(TINY, patch=128))
        out = net(net.batch([person(300), person(20, 1)], layout=layout))
        (out.joints().sum() + out.parts.square().mean()).backward()
        grads.append({name: p.grad for name, p in net.named_parameters() if p.grad is not None})
    assert grads[0].keys() == grads[1].keys()
    for name, grad in grads[0].items():
        torch.testing.assert_close(grad, grads[1][name], rtol=1e-3, atol=1e-4, msg=name)


def test_outputs_joints_equal_window_decoder():
    net = network()
    out = run(net, [person(100), person(30, 1)])
    for k, name in enumerate(("logits_x", "logits_y", "logits_z")):
        # sharpened, and with broad peaks at the edges
        logits = getattr(out, name).numpy() * 30
        index = np.arange(logits.shape[-1])
        for joint, at in enumerate((0, 1, len(index) - 2)):
            logits[0, joint] = -0.2 * (index - at) ** 2
        sharp = replace(out, **{name: torch.from_numpy(logits)})
        want = decode.window(logits, low=net.config.low[k], step=net.config.step[k])
        np.testing.assert_allclose(sharp.joints()[..., k], want, rtol=0, atol=1e-5)
    bare = run(network(replace(TINY, bins=(), ranges=())), [person(9)])
    assert bare.logits_x is None and torch.equal(bare.joints(), bare.coordinates)


def test_drop_path_keeps_the_mean_and_drops_whole_rows():
    drop, rows = DropPath(0.3).train(), torch.ones(20_000, 2)
    torch.manual_seed(0)
    dropped = drop(rows)
    assert abs(float(dropped.mean()) - 1) < 0.02 and abs(float((dropped[:, 0] == 0).float().mean()) - 0.3) < 0.02
    assert torch.equal(dropped[:, 0], dropped[:, 1]) and torch.equal(drop.eval()(rows), rows)
    rates = [m.probability for m in DaptNet(TINY).backbone.enc.modules() if isinstance(m, DropPath)]
    np.testing.assert_allclose(rates, [0, 0.1, 0.2, 0.3])
    decoder = DaptNet(TINY).backbone.dec
    rates = [
        [m.probability for m in stage.modules() if isinstance(m, DropPath)] for stage in (decoder.dec0, decoder.dec1)
    ]
    np.testing.assert_allclose(sum(rates, []), [0.15, 0, 0.3])


def test_norms_match_authors_and_single_row_uses_running_mean():
    norms = [m for m in DaptNet(TINY).modules() if isinstance(m, torch.nn.BatchNorm1d)]
    # the stem, one per pooling, two per unpooling; the part head has torch's defaults
    assert [(m.eps, m.momentum) for m in norms] == [(1e-3, 0.01)] * 7 + [(1e-5, 0.1)]
    norm = RowNorm(4).train()
    norm.running_mean.fill_(2)
    torch.testing.assert_close(norm(torch.full((1, 4), 2.0)), torch.zeros(1, 4))
    assert (norm.running_mean == 2).all()
    torch.testing.assert_close(norm(torch.randn(50, 4)).mean(0), torch.zeros(4), atol=1e-5, rtol=0)
    assert not (norm.running_mean == 2).any()


# ---- tables


def cells_of(cloud, config):
    cells = np.floor(np.asarray(cloud, np.float32) / config.grid).astype(int)
    return cells - cells.min(0) if config.grid_from_minimum else cells


@pytest.mark.parametrize("from_minimum", [False, True])
def test_build_tables_equals_dictionaries(from_minimum):
    config = replace(TINY, grid_from_minimum=from_minimum)
    clouds = [person(150, size=0.1), person(1, 1), person(80, 2, 0.04)]
    tables = build_tables(clouds, config)
    points = np.concatenate(clouds)
    assert (tables.features == points[tables.kept]).all()
    cells = [cells_of(cloud, config) for cloud in clouds]
    people = [list(dict.fromkeys(map(tuple, c))) for c in cells]
    # level 0: one row per cell, each point in the row of its cell
    found = [(b, *cell) for b, c in enumerate(cells) for cell in c.tolist()]
    row_of = {}
    for point, row in enumerate(tables.point_voxel):
        assert row_of.setdefault(found[point], row) == row
    assert len(row_of) == len(tables.features) == len(set(row_of.values())) == sum(map(len, people))
    assert all(row_of[found[index]] == row for row, index in enumerate(tables.kept))

    for depth, level in enumerate(tables.levels):
        cell_of = {row: cell for cell, row in row_of.items()}
        assert level.lengths.tolist() == [sum(cell[0] == b for cell in row_of) for b in range(3)]
        for b in range(3):
            rows = level.slots[b]
            assert {cell_of[row][0] for row in rows} == {b}
            assert len(set(rows)) == level.lengths[b] == level.valid[b].sum()
        assert_neighbors(level.near, row_of, 1)
        if depth == 0:
            assert_neighbors(tables.stem, row_of, 2)
        if depth == len(tables.levels) - 1:
            assert level.parent is None and level.children is None
            break
        above = {}
        for cell, row in row_of.items():
            above.setdefault((cell[0], *(x >> 1 for x in cell[1:])), []).append(row)
        coarser = {}
        for cell, rows in above.items():
            assert len({level.parent[row] for row in rows}) == 1
            coarser[cell] = level.parent[rows[0]]
            assert set(level.children[coarser[cell]]) == set(rows)
        row_of = coarser


def assert_neighbors(near, row_of, reach):
    steps = list(itertools.product(range(-reach, reach + 1), repeat=3))
    want = {
        (tap, row, row_of[other])
        for tap, step in enumerate(steps)
        for cell, row in row_of.items()
        if any(step) and (other := (cell[0], *(c + s for c, s in zip(cell[1:], step, strict=True)))) in row_of
    }
    taps = np.repeat(np.arange(len(steps)), near.counts)
    assert set(zip(taps.tolist(), near.target.tolist(), near.source.tolist(), strict=True)) == want
    assert len(near.source) == len(want)


def test_build_tables_keeps_point_nearest_to_cell_center():
    cloud = np.float32([[0.001, 0.001, 0.001], [0.011, 0.009, 0.01], [0.019, 0.019, 0.019]])
    assert build_tables([cloud], TINY).kept.tolist() == [1]


def test_build_tables_shuffles_curves_in_training():
    rng, straight = np.random.default_rng(0), build_tables([person(900)], TINY).levels[0].sequence
    shuffled = {build_tables([person(900)], TINY, rng=rng).levels[0].sequence[0].tobytes() for _ in range(20)}
    assert shuffled == {sequence.tobytes() for sequence in straight}


def test_build_tables_neighbors_do_not_wrap_at_range_limits():
    # the first and last cell of each axis: a step beyond must not wrap to another cell
    reach = TINY.grid * (1 << 15)
    corners = np.array(list(itertools.product((-reach, reach - TINY.grid / 2), repeat=3)))
    tables = build_tables([corners, corners], TINY)
    assert [level.lengths.tolist() for level in tables.levels] == [[8, 8]] * 3
    assert len(tables.stem.source) == 0 and all(len(level.near.source) == 0 for level in tables.levels)


def test_stray_point_moves_voxels_only_with_grid_from_minimum():
    near, stray = np.float32([[0.001, 0, 0], [0.021, 0, 0]]), np.float32([[-0.339, 0, 0]])
    for from_minimum, shared in ((False, True), (True, False)):
        tables = build_tables([np.concatenate([near, stray])], replace(TINY, grid_from_minimum=from_minimum))
        # the released grid begins at the stray point, so voxels with a common parent may get different ones
        parent = tables.levels[0].parent[tables.point_voxel]
        assert (parent[0] == parent[1]) == shared and tables.levels[0].lengths.tolist() == [3]
        assert build_tables([near], replace(TINY, grid_from_minimum=from_minimum)).levels[1].lengths.tolist() == [1]


def test_dapt_rejects_bad_clouds_and_layouts():
    net = network()
    for cloud, message in (
        (np.zeros((4, 4)), r"cloud 1: expected numbers of shape \(n, 3\), x y z in meters, got float64 of \(4, 4\)"),
        (np.zeros((4, 3), bool), "got bool of"),
        (np.array([["a", "b", "c"]]), "expected numbers of shape"),
        (np.full((4, 3), np.nan), "must be finite"),
        (np.full((4, 3), 1e6), "within 655 m of their person"),
    ):
        with pytest.raises(InputError, match=message):
            net.outputs([person(3), cloud])
    with pytest.raises(InputError, match="a batch holds 1 to 4095 people, got 0"):
        build_tables([], TINY)
    with pytest.raises(InputError, match="unknown layout 'padd': did you mean padded"):
        build_tables([person(3)], TINY, layout="padd")


# ---- convolution


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kernel", [3, 5])
def test_submanifold_convolution_equals_dense_convolution(kernel, layout):
    rng = np.random.default_rng(0)
    side = 7
    occupied = np.argwhere(rng.random((side, side, side)) < 0.4)
    tables = build_tables([(occupied + 0.5) * TINY.grid, (occupied[:20] + 0.5) * TINY.grid], TINY, layout=layout)
    batch = to_tensors(tables)
    near = batch.levels[0].near if kernel == 3 else batch.stem
    torch.manual_seed(0)
    conv = SubmanifoldConvolution(5, 4, kernel, bias=True)
    torch.nn.init.normal_(conv.bias)
    cells = torch.from_numpy(np.concatenate([occupied, occupied[:20]])[tables.kept]).T
    owner = torch.from_numpy((tables.kept >= len(occupied)).astype(int))
    rows = torch.randn(cells.shape[1], 5, requires_grad=True)
    grid = torch.zeros(2, side, side, side, 5).index_put((owner, *cells), rows)
    dense = F.conv3d(grid.permute(0, 4, 1, 2, 3), conv.weight.permute(0, 4, 1, 2, 3), conv.bias, padding=kernel // 2)
    want = dense.permute(0, 2, 3, 4, 1)[(owner, *cells)]
    got = conv(rows, near)
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    inputs = (rows, conv.weight, conv.bias)
    scale = torch.randn_like(want)
    for a, b in zip(
        torch.autograd.grad((got * scale).sum(), inputs), torch.autograd.grad((want * scale).sum(), inputs), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


# ---- patches


@pytest.mark.parametrize("from_minimum", [False, True])
def test_large_cloud_is_split_into_patches(from_minimum):
    config, cloud = replace(TINY, grid_from_minimum=from_minimum), person(3400, size=0.3)
    tables = build_tables([cloud, person(40, 1)], config)
    level = tables.levels[0]
    assert level.lengths[0] > 3000 and level.sequence.shape[0] == 4
    whole = [512] * (level.lengths[0] // 512)
    assert level.patch_lengths.tolist() == [*whole, level.lengths[0] % 512, level.lengths[1]]
    for sequence in level.sequence:
        assert sorted(sequence) == list(range(len(sequence)))
        patches = np.split(sequence, np.cumsum(level.patch_lengths)[:-1])
        # patches are compact and contain points of one person only
        assert all(len(set(rows < level.lengths[0])) == 1 for rows in patches)
        spread = np.mean([tables.features[rows].std(0).mean() for rows in patches[:-1]])
        assert spread < 0.8 * tables.features[: level.lengths[0]].std(0).mean()
    assert len({tuple(sequence) for sequence in level.sequence}) == 4

    net = network(config)
    out, order = net.outputs([cloud]), np.random.default_rng(1).permutation(3400)
    per_point = {name: out[name][order] for name in ("point_feat_last", "parts")}
    assert_outputs(out | per_point, net.outputs([cloud[order]]))
    whole = network(replace(config, patch=4096)).outputs([cloud])
    assert np.abs(whole["point_feat_last"] - out["point_feat_last"]).max() > 1e-3


@pytest.mark.parametrize("patch, lengths", [(64, [64, 64]), (128, [128]), (100, [100, 28]), (127, [127, 1])])
def test_last_patch_contains_remainder(patch, lengths):
    # 128 cells in a row
    row = np.zeros((128, 3))
    row[:, 0] = (np.arange(128) + 0.5) * TINY.grid
    net = network(replace(TINY, patch=patch))
    assert build_tables([row], net.config).levels[0].patch_lengths.tolist() == lengths
    torch.testing.assert_close(run(net, [row]).anchors, run(net, [row], "padded").anchors, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("orders", [TINY.orders, ("hilbert",), ("z",)])
def test_layouts_agree_with_patches_and_small_people_are_exact(orders):
    net = network(replace(TINY, patch=100, orders=orders))
    clouds = [person(700), person(30, 1), person(100, 2), person(0)]
    ragged, padded = run(net, clouds), run(net, clouds, "padded")
    for name in ("anchors", "points", "inter", "logits_x", "parts"):
        torch.testing.assert_close(getattr(ragged, name), getattr(padded, name), rtol=1e-4, atol=1e-5, msg=name)
    # a person of at most one patch has exact full attention in any batch
    small = network(replace(TINY, patch=4096)).outputs(clouds[1:2])
    np.testing.assert_allclose(padded.anchors[1].numpy(), small["anchors"][0], rtol=1e-4, atol=1e-5)


def test_layouts_give_equal_gradients_of_points_and_anchors():
    net = network(TINY)
    gradients = {}
    for layout in ("ragged", "padded"):
        net.zero_grad()
        out = net(net.batch([person(300), person(40, 1)], layout=layout))
        (out.points[:, 0].sum() + out.anchors[..., 1].sum()).backward()
        gradients[layout] = {name: value.grad for name, value in net.named_parameters() if value.grad is not None}
    assert len(gradients["ragged"]) > 50
    for name, value in gradients["ragged"].items():
        scale = value.abs().max().clamp(min=1e-6)
        torch.testing.assert_close(gradients["padded"][name] / scale, value / scale, rtol=0, atol=1e-3, msg=name)


def test_patch_attention_equals_formula():
    torch.manual_seed(0)
    attention = PatchAttention(32, 2).eval()
    tables = build_tables([person(70), person(9, 1)], replace(TINY, patch=32))
    level = to_tensors(tables).levels[0]
    rows = torch.randn(int(level.patch_lengths.sum()), 32)
    for order in range(4):
        sequence = torch.from_numpy(tables.levels[0].sequence[order])
        want = torch.empty_like(rows)
        for patch in sequence.split(level.patch_lengths.tolist()):
            query, key, value = attention.qkv(rows[patch]).view(-1, 3, 2, 16).unbind(1)
            weight = torch.einsum("ihd,jhd->hij", query, key).div(4).softmax(-1)
            want[patch] = torch.einsum("hij,jhd->ihd", weight, value).flatten(1)
        torch.testing.assert_close(attention(rows, level, order), attention.proj(want), rtol=1e-4, atol=1e-5)


def test_tables_and_decoders_do_not_import_torch():
    code = "import sys, lidarpose.models.decode, lidarpose.models.dapt.voxel_tables; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


# ---- configurations


def parameters(config):
    with torch.device("meta"):
        return sum(p.numel() for p in DaptNet(config).parameters())


def test_named_configs_have_published_sizes_and_bins():
    counts = {name: parameters(config) for name, config in CONFIGS.items()}
    assert counts == {
        "paper": 50_513_310,
        # the authors state 50.40 M
        "waymo": 50_403_794,
        "humanm3": 50_436_033,
        "lidarhuman26m": 50_472_828,
        "sloper4d": 50_426_388,
        "pretrain": 50_073_148,
    }
    widths = {name: config.step.round(6).tolist() for name, config in CONFIGS.items() if config.bins}
    meters = {"paper": 0.01, "waymo": 0.025, "humanm3": 0.01, "lidarhuman26m": 0.01, "sloper4d": 0.02}
    assert widths == {name: [width] * 3 for name, width in meters.items()}
    assert named_config("waymo").low.tolist() == [-0.9, -0.9, -1.5]
    for config in CONFIGS.values():
        assert DaptConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize("width, finest, prn", [(64, 267_136, 228_870), (128, 1_058_560, 899_910)])
def test_necks_have_published_parameter_counts(width, finest, prn):
    """In addition to the plain Point Transformer V3 with a decoder of `width` channels, for 15 joints."""
    widths = {"decoder_channels": (width, 128, 128, 256), "anchor_channels": (width, 128, 128, 256, 256)}
    plain = replace(named_config("pretrain"), parts=0, **widths)
    whole = parameters(replace(plain, neck="prn"))
    head = 3 * width + 3 + width**2 + width
    assert parameters(replace(plain, neck="finest")) == whole - prn + finest + width * 15 + head
    with torch.device("meta"):
        backbone = DaptNet(replace(plain, neck="prn")).backbone
    assert whole - prn == sum(p.numel() for p in backbone.parameters())


def test_dapt_config_without_neck_means_mde():
    entries = TINY.to_dict()
    assert entries.pop("neck") == "mde" and DaptConfig.from_dict(entries) == TINY
    assert DaptConfig.from_dict(json.loads(json.dumps(NECKS["finest"].to_dict()))) == NECKS["finest"]


def test_named_configs_have_joints_of_released_networks():
    # the authors' order: rows 1 to 13 and 15 of Waymo's table of keypoints
    limbs = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    both = [f"{side}_{limb}" for side in ("left", "right") for limb in limbs]
    assert list(WAYMO_JOINTS) == ["nose", *both, "head_center"] and WAYMO_JOINTS != WAYMO14.joints
    for name, skeleton in (
        ("waymo", WAYMO14),
        ("humanm3", HUMAN15),
        ("pretrain", HUMAN15),
        ("lidarhuman26m", SMPL24),
        ("sloper4d", SMPL24),
        ("paper", BODY26),
        ("paper", WAYMO14),
    ):
        config = named_config(name)
        assert [config.joints[k] for k in config.order_in(skeleton)] == list(skeleton.joints)
    # the authors' subset of SMPL's joints
    subset = [0, 1, 2, 4, 5, 7, 8, 12, 15, 16, 17, 18, 19, 20, 21]
    assert named_config("pretrain").joints == tuple(SMPL24.joints[k] for k in subset)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"encoder_depths": (1,)}, "encoder_depths must be 2 whole numbers"),
        ({"encoder_channels": (16, 16)}, "encoder_channels must be 3 whole numbers"),
        ({"decoder_heads": (1, 0)}, "decoder_heads must be 2 whole numbers"),
        ({"encoder_heads": (3, 1, 1)}, "encoder_channels must be divisible by encoder_heads"),
        ({"anchor_heads": 5}, "decoder_channels must be divisible by anchor_heads"),
        ({"patch": 0}, "patch must be a whole number"),
        ({"grid": -0.01}, "grid must be a positive number"),
        ({"strides": (2, 3)}, "strides must be 2, 4 or 8"),
        ({"orders": ("z", "spiral")}, "unknown curve 'spiral'"),
        ({"orders": ()}, "at least one curve"),
        ({"orders": 5}, "at least one curve of .*, got 5"),
        ({"drop_path": 1.0}, "drop_path must be a probability"),
        ({"joints": ("nose", "nose")}, "joints must be joint names, each once"),
        ({"joints": ("noze",)}, "unknown joint of body26 'noze': did you mean nose"),
        ({"bins": (44, 44)}, "bins must be 3"),
        ({"ranges": ((1.0, -1.0),) * 3}, "ranges must be three pairs"),
        ({"bins": (), "ranges": (), "coordinates": False}, "without them it predicts nothing"),
        ({"parts": 1}, "parts must be 0"),
        ({"parts": 10**19}, "parts must be a whole number from 0 to 16384"),
        ({"bins": (10**19, 1, 1)}, "bins must be 3"),
        ({"patch": 10**6}, "patch must be a whole number from 1 to 16384"),
        ({"zero_anchors": 1}, "zero_anchors must be true or false"),
        ({"neck": "giraffe"}, "unknown neck 'giraffe'"),
        ({"neck": "prn"}, "the neck prn has joints and parts of its own: leave bins, ranges and parts empty"),
        (
            {"neck": "prn", "bins": (), "ranges": (), "parts": 0, "coordinates": True, "zero_anchors": True},
            "zero_anchors: the neck prn has no anchors, heatmaps or auxiliary head: omit it",
        ),
    ],
)
def test_dapt_config_rejects_invalid_values(change, message):
    with pytest.raises(InputError, match=message):
        replace(TINY, **change)


def test_wider_strides_give_coarser_levels():
    net, cloud = network(replace(TINY, strides=(4, 8))), person(500)
    lengths = [level.lengths[0] for level in build_tables([cloud], net.config).levels]
    assert lengths == [len(np.unique(cells_of(cloud, net.config) >> shift, axis=0)) for shift in (0, 2, 5)]
    assert np.isfinite(net.outputs([cloud])["inter"]).all()
    # the range of cell numbers limits the product of strides
    levels = {name: (1,) * (7 if name in ("decoder_depths", "decoder_heads") else 8) for name in SIZES}
    levels |= {"encoder_channels": (8,) * 8, "decoder_channels": (8,) * 7, "anchor_channels": (8,) * 8}
    config = replace(TINY, **levels | {"anchor_heads": 1, "strides": (4, 4, 4, 4, 4, 8, 8)})
    assert len(build_tables([cloud], config).levels) == 8
    with pytest.raises(InputError, match="their product at most 65536"):
        replace(config, strides=(8,) * 7)


# ---- the authors' files


def header():
    with safe_open(WEIGHTS, "pt") as file:
        return json.loads(file.metadata()["config"])


def faults_of(net):
    return [name for name in FAULTS if getattr(net.config, name)]


def test_import_dapt_by_header_dict_and_config(released, tmp_path):
    want = released.outputs(CLOUDS[1:2])
    assert not released.training and released.config.joints == WAYMO_JOINTS
    assert faults_of(released) == ["stale_convolution", "grid_from_minimum"]
    assert_outputs(want, import_dapt(str(WEIGHTS), header()).outputs(CLOUDS[1:2]), atol=0)
    assert_outputs(want, import_dapt(WEIGHTS, released.config).outputs(CLOUDS[1:2]), atol=0)
    own = released.config.to_dict()
    prefixed = {f"module.{name}": value.clone() for name, value in load_file(WEIGHTS).items()}
    save_file(prefixed, tmp_path / "wrapped.safetensors", {"config": json.dumps(own)})
    assert_outputs(want, import_dapt(tmp_path / "wrapped.safetensors").outputs(CLOUDS[1:2]), atol=0)
    assert faults_of(import_dapt(WEIGHTS, header() | {"legacy": False})) == []
    assert faults_of(import_dapt(WEIGHTS, own | {"stale_convolution": False})) == ["grid_from_minimum"]


def test_import_dapt_by_name_of_config(tmp_path, monkeypatch):
    # with fewer channels than the released one, to write 200 MB less
    narrow = {name: getattr(TINY, name) for name in SIZES}
    monkeypatch.setitem(CONFIGS, "pretrain", replace(named_config("pretrain"), **narrow))
    tensors = {name: value.contiguous() for name, value in DaptNet(CONFIGS["pretrain"]).state_dict().items()}
    # the names of the authors' pre-training heads
    assert {"heads.query.fc.fc2.weight", "heads.feat.fc.3.weight", "heads.feat.fc.1.running_mean"} <= tensors.keys()
    save_file(tensors, tmp_path / "pretrain.safetensors")
    out = import_dapt(tmp_path / "pretrain.safetensors", "pretrain").outputs([CLOUDS[1]])
    assert out["coordinates"].shape == (1, 15, 3) and out["parts"].shape == (57, 25) and "logits_x" not in out


FIRST_BIAS = "heads.query.fcs.0.fc1.bias"


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t.pop(FIRST_BIAS), f"tensor {FIRST_BIAS} is missing"),
        (lambda t: t.update({"heads.other.weight": torch.zeros(3)}), "unknown tensor heads.other.weight"),
        (
            lambda t: t.update({"backbone.keypoint_embedding": torch.zeros(15, 64)}),
            r"keypoint_embedding should be \(14, 64\) for the configuration released, got \(15, 64\)",
        ),
        (lambda t: t[FIRST_BIAS].fill_(np.nan), f"tensor {FIRST_BIAS} holds values that are not finite"),
        (
            lambda t: t["heads.query.coord_range"].mul_(2),
            "tensor heads.query.coord_range says .*-1.8, 1.8.*the configuration released says \\[\\[-0.9",
        ),
        (lambda t: t.clear(), "has 0 tensors, too few for the .* or more of the configuration released"),
    ],
)
def test_import_dapt_rejects_mismatched_tensors(tmp_path, change, message):
    tensors = load_file(WEIGHTS)
    change(tensors)
    save_file(tensors, tmp_path / "bad.safetensors", {"config": json.dumps(header())})
    with pytest.raises(InputError, match=message) as caught:
        import_dapt(tmp_path / "bad.safetensors")
    assert "bad.safetensors: " in str(caught.value) and "\n" not in str(caught.value)


THEIRS = header()


@pytest.mark.parametrize(
    "config, message",
    [
        ("waymoo", "unknown DAPT configuration 'waymoo': did you mean waymo"),
        ("waymo", "enc0.block1.* is missing, but the configuration waymo needs it: give the configuration"),
        ({"enc_depths": [1, 1]}, "does not fit: encoder_channels must be 2"),
        ({"widths": 3}, "unknown setting of the network 'widths'"),
        ({"name": "x"}, "needs the entry 'joints'"),
        ([1], "should be a dict, a name or a DaptConfig, got list"),
        # other networks of the authors
        (THEIRS | {"in_channels": 6}, "in_channels must be 3"),
        (THEIRS | {"dec_kp_mixer": "linear"}, "dec_kp_mixer must be 'attn'"),
        (THEIRS | {"num_keypoints": 17}, "num_keypoints must be 14, 15 or 24"),
        (THEIRS | {"num_keypoints": [14]}, "num_keypoints must be 14, 15 or 24"),
        (THEIRS | {"enc_patch_size": [1024, 512, 1024, 1024, 1024]}, "one number throughout"),
        (THEIRS | {"grid": 7}, "grid must be .*of the heatmaps, got 7"),
    ],
)
def test_import_dapt_rejects_wrong_configurations(config, message):
    with pytest.raises(InputError, match=message):
        import_dapt(WEIGHTS, config)


def test_import_dapt_rejects_pickles_and_damaged_files(tmp_path):
    pickle, cut = tmp_path / "dapt.pth", tmp_path / "cut.safetensors"
    pickle.write_bytes(b"\x80\x04.")
    with pytest.raises(InputError, match=r"dapt.pth: .* pickle.*weights_only=True.*safetensors"):
        import_dapt(pickle)
    # other faults of a file give the errors of any checkpoint
    cut.write_bytes(WEIGHTS.read_bytes()[:100])
    with pytest.raises(InputError, match="cut.safetensors: .*ends at byte"):
        import_dapt(cut)
    for entry, message in (({}, "no configuration: give one of paper, waymo"), ({"config": "{"}, "not JSON")):
        save_file(load_file(WEIGHTS), cut, entry)
        with pytest.raises(InputError, match=message):
            import_dapt(cut)
