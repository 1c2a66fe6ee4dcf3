"""PoseNet: invariances, layers and heads, heatmaps, and its training examples."""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from lidarpose.errors import InputError
from lidarpose.geometry import rotation_about
from lidarpose.models.config import BIN, SIZES, NetworkConfig
from lidarpose.models.decode import HALF_WIDTH, window as window_mean
from lidarpose.models.layers import (
    REACH,
    WAVELENGTHS,
    Convolution,
    CrossAttention,
    JointHead,
    PersonHead,
    RotaryEmbedding,
    VoteHead,
    attend,
    bin_centers,
    decode,
    encode,
    head_frequencies,
    key_bias,
)
from lidarpose.models.posenet import Batch, PoseNet, Targets
from lidarpose.models.voxelize import view_features, voxelize
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import SCENES
from lidarpose.train.augment import VISIBLE_RADIUS, example, visible_joints
from lidarpose.train.objectives.objective import total
from lidarpose.train.objectives.posenet_objective import MAX_VOXELS, SIGMA, PoseNetObjective, losses
from lidarpose.train.optim import optimizers
from lidarpose.train.recipes import Pretrain

TINY = SIZES["tiny"]
TINY_PARAMETERS = 456_371
WINDOW = REACH["window"]
BINS = round(2 * WINDOW / BIN)


@cache
def network():
    return random_network(TINY).eval()


def person(n, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(0, [0.2, 0.2, 0.5], (n, 3))).astype(np.float32)


def batch_of(clouds, max_voxels=TINY.max_voxels, known=True, neighbors=True):
    origin = np.array([-8.0, 1, 1]) if known else None
    view = np.stack([view_features(np.full(3, k), origin) for k in range(len(clouds))])
    options = {"grid": TINY.grid, "max_voxels": max_voxels, "view": view, "neighbors": neighbors}
    return Batch.from_arrays(voxelize(np.concatenate(clouds), np.array([len(c) for c in clouds]), **options).arrays())


def random_network(config):
    """Random weights everywhere: layers initialized to zero would hide their inputs."""
    torch.manual_seed(0)
    made = PoseNet(config)
    with torch.no_grad():
        for value in made.parameters():
            value += 0.05 * torch.randn_like(value)
    return made


def random_targets(people, part):
    known = torch.ones(people, 26, dtype=torch.bool)
    somebody = torch.tensor([[1.0, torch.nan]]).expand(people, 2)
    return Targets(joints=torch.randn(people, 26, 3) * 0.3, known=known, visible=known, part=part, person=somebody)


@torch.inference_mode()
def run(clouds, **kwargs):
    return network()(batch_of(clouds, **kwargs))


def of_person(out, k):
    raw = (out.joints(), out.vote, out.heatmap, out.confidence, out.log_spread, out.visible, *out.level_joints)
    return [t[k] for t in raw]


def assert_close(a, b, atol=1e-5):
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, atol=atol, rtol=1e-5)


@pytest.mark.parametrize("n", [1, 2, 17, 300])
def test_posenet_is_invariant_to_batch_padding_and_point_order(n):
    # the view of person k depends on k: the person under test stays number 0
    cloud = person(n, 1)
    alone = run([cloud])
    among = run([np.random.default_rng(0).permutation(cloud), person(3000, 2), person(5, 3), person(0)])
    assert_close(of_person(alone, 0), of_person(among, 0))
    width = int(alone.part.shape[1])
    torch.testing.assert_close(alone.part[0], among.part[0, :width], atol=1e-5, rtol=1e-5)


def test_posenet_depends_on_points_density_and_view():
    cloud = person(300, 5)
    base = of_person(run([cloud]), 0)[1]
    moved = cloud + np.float32(0.2) * (np.arange(300) < 30)[:, None]
    for other in (run([moved]), run([np.concatenate([cloud, cloud[:100].repeat(5, 0)])]), run([cloud], known=False)):
        assert (of_person(other, 0)[1] - base).abs().max() > 1e-4


@pytest.mark.parametrize("clouds", [[0], [0, 0], [0, 40, 0]])
def test_posenet_is_finite_for_people_without_points(clouds):
    out = run([person(n) for n in clouds])
    for value in (out.joints(), out.heatmap, out.part, *of_person(out, 0)):
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("n", [1, 2, 5000])
def test_posenet_gradients_are_finite(n):
    model = PoseNet(TINY)
    batch = batch_of([person(n)])
    part = torch.where(batch.fine.valid, torch.tensor(3), torch.tensor(-1))
    value = total(losses(model(batch), random_targets(1, part)))
    value.backward()
    assert torch.isfinite(value)
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name


def test_posenet_tiny_parameters_and_shapes():
    assert sum(p.numel() for p in network().parameters()) == TINY_PARAMETERS
    # a full cube of 8 x 8 x 8 fine voxels: 512, thinned to 384, in 64 and in 8
    axis = (np.arange(8) + 0.5) * TINY.grid
    cube = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    batch = batch_of([cube, cube[:3]])
    assert [level.valid.shape[1] for level in (batch.fine, batch.mid, batch.coarse)] == [384, 64, 8]
    whole = batch_of([cube], max_voxels=512)
    torch.testing.assert_close(whole.coarse.log_count.exp(), torch.full((1, 8), 64.0))
    out = run([cube, cube[:3]])
    assert out.vote.shape == out.joints().shape == (2, 26, 3)
    assert out.heatmap.shape == (2, 26, 3, 24)
    assert out.part.shape == (2, 384, 25)
    assert out.confidence.shape == out.log_spread.shape == (2, 26)
    assert [tuple(j.shape) for j in out.level_joints] == [(2, 26, 3)] * 2


SMALL_ONE = {"size": "x", "channels": [4, 8, 8], "head_channels": 8, "blocks": [1, 0, 1]}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"head_channels": 5}, r"must be divisible by head_channels, got \(4, 8, 8\) and 5"),
        ({"channels": 8}, r"channels must be 3 whole numbers \(fine, mid, coarse\) from 1 to 16384, got 8"),
        ({"channels": [4, 0, 8]}, "channels must be 3 whole numbers"),
        ({"blocks": (1, -1, 1)}, r"blocks must be 3 whole numbers \(mid encoder, coarse, mid decoder\)"),
        ({"grid": 0}, "grid must be a positive number of meters, got 0"),
        ({"max_voxels": 1.5}, "max_voxels must be a whole number"),
        ({"heatmap": "wide"}, "unknown heatmap 'wide'.*window"),
        ({"convolution": -1}, "convolution must be a whole number from 0 to 16384, got -1"),
        ({"convolution": True}, "convolution must be a whole number from 0 to 16384, got True"),
        ({"skeleton": "cat"}, "unknown skeleton 'cat'"),
        ({"person": 1}, "person must be true or false, got 1"),
    ],
)
def test_network_config_rejects_invalid_values(change, message):
    with pytest.raises(InputError, match=message):
        NetworkConfig(**SMALL_ONE | change)
    assert NetworkConfig(**SMALL_ONE).blocks == (1, 0, 1)
    # older files have false instead of a number
    assert NetworkConfig(**SMALL_ONE | {"convolution": False}).convolution == 0


@pytest.mark.parametrize("size, parameters", [("tiny", TINY_PARAMETERS), ("small", 1_452_054), ("base", 5_509_087)])
def test_posenet_sizes(size, parameters):
    config = SIZES[size]
    assert NetworkConfig(**config.to_dict()) == config
    network = PoseNet(config)
    assert sum(p.numel() for p in network.parameters()) == parameters
    out = network(batch_of([person(50)]))
    assert out.joints().shape == (1, 26, 3) and torch.isfinite(out.joints()).all()
    # an untrained network predicts joints among the points
    cloud = person(500, 6) + np.array([0.4, -0.3, 0.2], np.float32)
    vote = network(batch_of([cloud])).vote[0].detach().numpy()
    assert (vote > cloud.min(0)).all() and (vote < cloud.max(0)).all()


@pytest.mark.parametrize("change", [{"heatmap": "full"}, {"heatmap": "none"}, {"convolution": 0}])
def test_posenet_variants_train_all_parameters(change):
    """The paper's full-range heatmaps, votes alone, no convolutions: all have gradients and ignore the batch."""
    config = replace(TINY, **change)
    made, clouds = random_network(config), [person(80, 1), person(700, 2)]
    out, alone = (made(batch_of(chosen, neighbors=config.convolution > 0)) for chosen in (clouds, clouds[:1]))
    assert_close(of_person(alone, 0), of_person(out, 0))
    bins = {"full": 80, "none": 0}.get(config.heatmap, BINS)
    assert out.heatmap.shape[-1] == bins and out.has_votes == (config.heatmap != "full")
    if config.heatmap == "full":
        assert not out.vote.any() and out.joints().abs().max() < REACH["full"]
    if config.heatmap == "none":
        assert (out.joints() == out.vote).all()
    terms = losses(out, random_targets(2, torch.zeros(out.part.shape[:2], dtype=int)))
    assert ("vote" in terms) == (config.heatmap != "full") and ("heatmap" in terms) == (config.heatmap != "none")
    total(terms).backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_convolution_matches_dense_conv3d_on_full_grid():
    torch.manual_seed(0)
    layer = Convolution(5, 3)
    axis = np.arange(8) * 0.06 + 0.03
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    tables = voxelize(cube, np.array([512]), grid=0.06, max_voxels=999, neighbors=True)
    rows = torch.randn(1, 64, 5)
    kernel = layer.mix.weight.view(5, 3, 3, 3, 3).movedim(-1, 1)
    grid = layer.narrow(layer.norm(rows)).view(1, 4, 4, 4, 3).movedim(-1, 1)
    dense = torch.nn.functional.conv3d(grid, kernel, layer.mix.bias, padding=1).movedim(1, -1).reshape(1, 64, 5)
    torch.testing.assert_close(layer(rows, torch.as_tensor(tables.mid.neighbors)), rows + dense, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("mask", [None, "bool", "bias"])
def test_attend_in_bfloat16_matches_float32(mask):
    """On a CPU it is equal for inputs that bfloat16 represents, gradients within rounding."""
    torch.manual_seed(0)
    inputs = [torch.randn(2, 3, 5, 8).bfloat16().float().requires_grad_() for _ in range(3)]
    valid = torch.arange(5)[None] < torch.tensor([[3], [5]])
    given = {None: None, "bool": valid[:, None, None], "bias": key_bias(valid, torch.float32)}[mask]
    weight = (inputs[0] @ inputs[1].mT / 8**0.5).masked_fill(~(valid | (mask is None))[:, None, None], -1e4).softmax(-1)
    found = {}
    for half in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            cast = [value.bfloat16() for value in inputs] if half else inputs
            mixed = attend(*cast, given if given is None or mask == "bool" or not half else given.bfloat16())
        assert mixed.dtype == torch.float32
        torch.testing.assert_close(mixed, weight @ inputs[2])
        found[half] = torch.autograd.grad(mixed.square().sum(), inputs)
    # the gradients pass a cast
    torch.testing.assert_close(found[True], found[False], atol=2e-2, rtol=1e-2)


def test_rotary_embedding_depends_on_relative_position():
    """The product of two rotated vectors depends only on the difference of their positions in meters."""
    torch.manual_seed(0)
    here, there = torch.randn(1, 1, 3), torch.randn(1, 1, 3)
    query, key = torch.randn(2, 1, 1, 3, 20)
    shift, scale = torch.tensor([3.1, -0.7, 0.4]), head_frequencies(3, 20)

    def product(a, b):
        return (RotaryEmbedding(a).rotate(query, scale) * RotaryEmbedding(b).rotate(key, scale)).sum(-1)

    torch.testing.assert_close(product(here, there), product(here + shift, there + shift), atol=1e-4, rtol=1e-4)
    assert (product(here, there) - product(here, there + shift)).abs().max() > 1e-2
    torch.testing.assert_close(product(here, here), (query * key).sum(-1), atol=1e-5, rtol=1e-5)


def test_head_frequencies_cycle_through_wavelengths():
    waves = 2 * np.pi / head_frequencies(5, 24).numpy()
    assert waves.shape == (5, 1, 4)
    np.testing.assert_allclose(waves.ravel(), [WAVELENGTHS[k % len(WAVELENGTHS)] for k in range(20)], rtol=1e-6)


def test_cross_attention_matches_loop():
    """The loop takes one query, one head and one voxel at a time."""
    torch.manual_seed(0)
    layer = CrossAttention(14, 2, 5)
    anchors, anchor_places = torch.randn(1, 3, 14), torch.randn(1, 3, 3)
    voxels, position, count = torch.randn(1, 4, 5), torch.randn(1, 4, 3), torch.tensor([[1.0, 5.0, 2.0, 9.0]])
    valid = torch.tensor([[True, True, True, False]])
    places, bias = RotaryEmbedding(position), key_bias(valid, torch.float32)
    read = layer(anchors, RotaryEmbedding(anchor_places), voxels, places, count.log(), bias)
    for j in range(3):
        mixed = []
        for h in range(2):
            channels, frequencies = slice(7 * h, 7 * h + 7), layer.frequencies[h : h + 1]
            query, score = layer.query(anchors[0, j])[channels], []
            for n in range(3):
                key = layer.key(voxels[0, n])[channels]
                rotated = [
                    RotaryEmbedding(place[None, None]).rotate(x[None, None, None], frequencies)[0, 0, 0]
                    for place, x in ((anchor_places[0, j], query), (position[0, n], key))
                ]
                score.append(rotated[0] @ rotated[1] / 7**0.5 + layer.density[h] * count[0, n].log())
            weight = torch.stack(score).softmax(0)
            mixed.append(sum(w * layer.value(voxels[0, n])[channels] for n, w in enumerate(weight)))
        torch.testing.assert_close(read[0, j], layer.out(torch.cat(mixed)), atol=1e-5, rtol=1e-4)


def test_vote_head_matches_loop():
    """The loop takes the weighted mean of every voxel's position and offset."""
    torch.manual_seed(0)
    head = VoteHead(6, 5, 4)
    with torch.no_grad():
        for value in head.parameters():
            value.copy_(torch.randn_like(value))
    anchors, voxels, position = torch.randn(2, 4, 6), torch.randn(2, 7, 5), torch.randn(2, 7, 3)
    bias = key_bias(torch.tensor([[True] * 7, [True] * 4 + [False] * 3]), torch.float32)
    vote, felt = head(anchors, voxels, position, bias)
    for b, n in ((0, 7), (1, 4)):
        for j in range(4):
            score = head.key(voxels[b, :n]) @ head.query(anchors[b, j]) / 5**0.5
            weight = score.softmax(0)
            said = position[b, :n] + voxels[b, :n] @ head.offset[j]
            expected = (weight[:, None] * said).sum(0) + head.residual(anchors[b, j])
            torch.testing.assert_close(vote[b, j], expected, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(felt[b, j], weight @ voxels[b, :n], atol=1e-5, rtol=1e-4)


def test_joint_head_uses_vote_without_gradient():
    torch.manual_seed(0)
    head, anchors, voxels = JointHead(32, 20, 24), torch.randn(2, 5, 32), torch.randn(2, 5, 20)
    vote = torch.randn(2, 5, 3, requires_grad=True)
    for value, other in zip(head(anchors, voxels, vote), head(anchors, voxels, vote + 1), strict=True):
        assert torch.autograd.grad(value.sum(), vote, retain_graph=True, allow_unused=True) == (None,)
        assert (value - other).abs().max() > 1e-3


def test_person_head_ignores_padding_and_has_no_input_gradient():
    torch.manual_seed(0)
    head, anchors, voxels = PersonHead(32, 20, 5), torch.randn(2, 5, 32, requires_grad=True), torch.randn(2, 7, 20)
    certainty, valid = [torch.randn(2, 5) for _ in range(3)], torch.arange(7) < torch.tensor([[4], [7]])
    logits = head(anchors, voxels, valid, certainty)
    torch.testing.assert_close(head(anchors, voxels[:, :4], valid[:, :4], certainty)[0], logits[0])
    assert torch.autograd.grad(logits.sum(), anchors, allow_unused=True) == (None,)


# --- heatmaps

# the target is 1.2 bins wide and not cut at this distance from the window's edge
CLEAR = WINDOW - (HALF_WIDTH + 1) * BIN


@settings(max_examples=80, deadline=None)
@given(st.lists(st.floats(-CLEAR, CLEAR), min_size=1, max_size=9))
def test_decode_is_within_tenth_of_bin_and_symmetric(offsets):
    offset = torch.tensor(offsets)
    heatmap = encode(offset, SIGMA, BINS)
    torch.testing.assert_close(heatmap.sum(-1), torch.ones(len(offsets)))
    assert (decode(heatmap.log()) - offset).abs().max() < 0.1 * BIN
    torch.testing.assert_close(heatmap, encode(-offset, SIGMA, BINS).flip(-1), atol=1e-6, rtol=1e-5)
    variance = (heatmap * (bin_centers(BINS) - offset[:, None]) ** 2).sum(-1)
    torch.testing.assert_close(variance.sqrt(), torch.full_like(variance, SIGMA), atol=0, rtol=0.02)
    torch.testing.assert_close(bin_centers(BINS), -bin_centers(BINS).flip(-1), atol=1e-6, rtol=0)


def test_decode_at_window_edge_stays_inside():
    offset = torch.linspace(-WINDOW, WINDOW, 200)
    decoded = decode(encode(offset, SIGMA, BINS).log())
    assert (decoded.abs() < WINDOW).all() and (decoded - offset).abs().max() < 1.2 * BIN


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 8), st.integers(1, BINS))
def test_decode_matches_numpy_window(seed, sharp, bins):
    logits = np.random.default_rng(seed).normal(0, sharp, (2, 3, bins))
    twin = window_mean(logits, low=(0.5 - bins / 2) * BIN, step=BIN)
    torch.testing.assert_close(decode(torch.tensor(logits)), torch.tensor(twin), atol=1e-5, rtol=0, check_dtype=False)


# --- from a sample to a batch


@cache
def people(count=12):
    maker = Generator(scene=SCENES["wild"], measure=False)
    return tuple(maker.person(3, index) for index in range(count))


def test_example_moves_points_and_joints_together():
    kinds = set()
    for k, known in enumerate(people()):
        shown, sample = example(known.sample, np.random.default_rng(k)), known.sample
        # offsets between joints and points are those in the sensor's frame
        offsets = sample.points[0] - sample.pose.joints
        np.testing.assert_allclose(shown.points[0] - shown.joints, offsets, atol=1e-5)
        np.testing.assert_array_equal(shown.part, sample.part)
        # clutter near a joint does not make it visible
        body = sample.points[sample.part > 0]
        np.testing.assert_array_equal(shown.visible, visible_joints(sample.pose.joints, body))
        assert np.abs(np.median(shown.points, axis=0)).max() < 1.0
        kinds.add(bool(shown.view[4]))
        if shown.view[4]:
            # the person's frame has the sensor's axes, and the view gives the sensor's position
            sensor = shown.view[:3] * np.exp(shown.view[3])
            np.testing.assert_allclose(shown.joints - sensor, sample.pose.joints, atol=1e-3)
        else:
            assert not shown.view.any()
    assert kinds == {True, False}


@pytest.mark.parametrize("yaw", [0.3, np.pi / 2, -2.5])
def test_example_of_rotated_person_is_rotated(yaw):
    """Targets rotate with points and view; only the drawn error of the pelvis estimate does not."""
    for k, known in enumerate(people()):
        sample, rotation = known.sample, rotation_about("z", yaw)
        other = replace(
            sample,
            points=(sample.points @ rotation.T).astype(np.float32),
            center=rotation @ sample.center,
            pose=replace(sample.pose, joints=sample.pose.joints @ rotation.T),
            box=replace(sample.box, center=rotation @ sample.box.center, yaw=sample.box.yaw + yaw),
        )
        a, b = (example(p, np.random.default_rng(k)) for p in (known.sample, other))
        shift = b.joints[0] - rotation @ a.joints[0]
        np.testing.assert_allclose(b.points, a.points @ rotation.T + shift, atol=2e-5)
        np.testing.assert_allclose(b.joints, a.joints @ rotation.T + shift, atol=2e-5)
        assert np.linalg.norm(shift) < 0.5
        sensor_a, sensor_b = (e.view[:3] * np.exp(e.view[3]) for e in (a, b))
        np.testing.assert_allclose(sensor_b, sensor_a @ rotation.T + shift * a.view[4], atol=1e-4)


def test_visible_joints_have_points_within_radius():
    joints = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 0, 2.0]])
    points = np.array([[0.1, 0.1, 0.0], [1.0, 0.17, 0.0], [0.0, 0.0, 1.8]])
    np.testing.assert_array_equal(visible_joints(joints, points), [True, True, False])
    assert not visible_joints(joints, points[:0]).any()
    for known, distance in product(people(), (0, 100, 300)):
        sample = known.sample
        joints, body = (
            (values + [distance, 0, 0]).astype(np.float32)
            for values in (sample.pose.joints, sample.points[sample.part > 0])
        )
        nearest = np.linalg.norm(joints[:, None].astype(float) - body, axis=-1).min(1, initial=np.inf)
        np.testing.assert_array_equal(visible_joints(joints, body), nearest < VISIBLE_RADIUS)


def test_collate_keeps_targets_and_takes_majority_of_parts():
    shown = [example(known.sample, np.random.default_rng(k)) for k, known in enumerate(people())]
    arrays = PoseNetObjective(config=TINY).collate(shown)
    assert arrays["fine.valid"].shape[1] <= MAX_VOXELS and "point_voxel" not in arrays
    assert (arrays["part"][~arrays["fine.valid"]] == -1).all()
    assert ((arrays["part"] >= 0) == arrays["fine.valid"]).all()
    for b, one in enumerate(shown):
        np.testing.assert_array_equal(arrays["joints"][b], one.joints)
        np.testing.assert_array_equal(arrays["view"][b], one.view)
        cell = np.floor(one.points / TINY.grid).astype(int)
        for n in np.flatnonzero(arrays["fine.valid"][b]):
            center = np.floor(arrays["fine.position"][b, n] / TINY.grid - arrays["offset"][b, n]).astype(int)
            mine = one.part[(cell == center).all(1)]
            if len(mine):
                votes = np.bincount(mine, minlength=25)
                assert votes[arrays["part"][b, n]] == votes.max()


@pytest.mark.slow
def test_posenet_overfits_eight_people():
    torch.manual_seed(0)
    maker = Generator(scene=SCENES["wild"], measure=False)
    rng = np.random.default_rng(0)
    arrays = PoseNetObjective(config=TINY).collate([example(maker.person(0, index).sample, rng) for index in range(8)])
    model, recipe, steps = PoseNet(TINY), Pretrain(), 300
    made = optimizers(model, recipe)
    for step in range(steps):
        share = min(1, (step + 1) / 20, 2.5 * (1 - step / steps))
        for optimizer, rate in zip(made, (recipe.rate, recipe.muon_rate), strict=True):
            optimizer.param_groups[0]["lr"] = rate * share
            optimizer.zero_grad()
        terms = losses(model(Batch.from_arrays(arrays)), Targets.from_arrays(arrays))
        total(terms).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        for optimizer in made:
            optimizer.step()
    assert terms["mpjpe"] < 0.01


def test_person_loss_trains_only_person_head():
    """The loss has gradients only in the person head, and unknown labels have no loss."""
    model = random_network(replace(TINY, person=True))
    batch = batch_of([person(40), person(90, seed=1)])
    part = torch.where(batch.fine.valid, torch.tensor(3), torch.tensor(-1))
    targets = random_targets(2, part)
    terms = losses(model(batch), replace(targets, person=torch.tensor([[1.0, torch.nan], [0.0, 1.0]])))
    terms["person"].backward()
    learned = {name for name, value in model.named_parameters() if value.grad is not None and value.grad.any()}
    assert learned == {name for name, _ in model.named_parameters() if name.startswith("person.")}
    unknown = losses(model(batch), replace(targets, person=torch.full((2, 2), torch.nan)))
    assert unknown["person"] == 0 and terms["person"] > 0
    without = random_network(TINY)
    assert set(terms) - set(losses(without(batch), targets)) == {"person"}
    without.load_state_dict({k: v for k, v in model.state_dict().items() if not k.startswith("person.")})
    torch.testing.assert_close(model(batch).joints(), without(batch).joints(), atol=0, rtol=0)
