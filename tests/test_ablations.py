"""Losses and data of the variants in benchmarks/ablations.py; stored results of benchmarks."""

import sys
from argparse import Namespace
from types import ModuleType

import numpy as np
import pytest
import torch
from test_results import benchmark

from lidarpose.models.config import SIZES
from lidarpose.skeleton import BODY26
from lidarpose.synth.generator import Generator
from lidarpose.train.augment import example
from lidarpose.train.objectives.objective import total
from lidarpose.train.recipes import Pretrain, recipe


@pytest.fixture(scope="module")
def ablations():
    return benchmark("ablations")


@pytest.fixture(scope="module")
def objectives():
    return benchmark("ablation_objectives")


@pytest.fixture(scope="module")
def people():
    generator = Generator(scene="wild", measure=False)
    return [example(generator.person(5, k).sample, np.random.default_rng(k)) for k in range(8)]


NAMES = ("point joints", "local refinement", "hardest people", "mirrored pairs", "taught")


def terms_of(objective, people):
    torch.manual_seed(0)
    return objective.terms(objective.network(), objective.collate(people))


@pytest.mark.parametrize("name", NAMES)
def test_variant_losses_give_gradients_to_all_weights(ablations, people, name):
    variant = ablations.VARIANTS[name]
    objective = variant.objective(config=SIZES["tiny"], made=variant.network)
    torch.manual_seed(0)
    network = objective.network()
    total(objective.terms(network, objective.collate(people))).backward()
    for weight, value in network.named_parameters():
        assert value.grad is not None and value.grad.isfinite().all(), weight


def test_mirrored_twice_restores_example(objectives, people):
    one = people[0]
    image = objectives.mirrored(one)
    assert np.array_equal(
        image.joints[BODY26.index("left_wrist")], one.joints[BODY26.index("right_wrist")] * [1, -1, 1]
    )
    again = objectives.mirrored(image)
    for name in ("points", "part", "joints", "visible", "view"):
        assert np.array_equal(getattr(again, name), getattr(one, name)), name


def test_mirrored_pairs_consistency_loss_measures_asymmetry(objectives, people):
    objective = objectives.MirroredPairs(config=SIZES["tiny"])
    arrays = objective.collate(people)
    joints = torch.as_tensor(arrays["joints"])

    class Perfect:
        def __init__(self, answer):
            self.answer = answer

        def __call__(self, batch):
            torch.manual_seed(0)
            outputs = objective.network()(batch)
            return objectives.replace(outputs, vote=self.answer, heatmap=outputs.heatmap[..., :0])

    found = objective.terms(Perfect(joints), arrays)
    assert found["consistency"] == pytest.approx(0, abs=1e-6) and found["mpjpe"] == pytest.approx(0, abs=1e-6)
    moved = joints.clone()
    moved[: len(joints) // 2, :, 1] += 0.1
    # the two predictions are 0.1 m apart
    found = objective.terms(Perfect(moved), arrays)["consistency"]
    assert found == pytest.approx(0.1 * objectives.CONSISTENCY, rel=1e-4)


def test_mirrored_pairs_validates_all_people_unmirrored(ablations, people):
    """In training, `collate` leaves out every other person."""
    settings = recipe(Pretrain, people=64, workers=0, pictures=0)
    mirrored, base = (ablations.job(ablations.VARIANTS[name], settings) for name in ("mirrored pairs", "base"))
    torch.manual_seed(0)
    network = base.network().eval()
    # 7: an odd number of people is validated, too
    found, expected = (job.validate(job.objective, network, people[:7], 4) for job in (mirrored, base))
    assert found[0] == expected[0] and np.array_equal(found[1], expected[1])


def test_hardest_people_weights_large_errors_more(objectives, people):
    config = SIZES["tiny"]
    plain = terms_of(objectives.VariantObjective(config=config), people)
    found = terms_of(objectives.HardestPeople(config=config), people)
    assert found["mpjpe"] == plain["mpjpe"]
    assert found["joints"] > plain["joints"]


def test_point_joints_losses_of_clutter_and_unlabeled_points(objectives, people):
    config = SIZES["tiny"]
    objective = objectives.PointJoints(config=config, made=objectives.with_point_joints)
    arrays = objective.collate(people)
    torch.manual_seed(0)
    network = objective.network()
    nobody = objective.terms(network, arrays | {"part": np.where(arrays["part"] > 0, 0, arrays["part"])})
    unknown = objective.terms(network, arrays | {"part": np.full_like(arrays["part"], -1)})
    assert nobody["offset"] == 0 and nobody["label"] > 0
    assert unknown["offset"] == 0 and unknown["label"] == 0


def test_local_refinement_starts_equal_to_votes(objectives, people):
    config = SIZES["tiny"]
    objective = objectives.PointJoints(config=config, made=objectives.with_local_refinement)
    arrays = objective.collate(people)
    network = objective.network().eval()
    rough = objectives.VoteHead.forward
    seen = {}

    def kept(self, *inputs):
        seen["vote"], features = rough(self, *inputs)
        return seen["vote"], features

    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr(objectives.VoteHead, "forward", kept)
        refined = network(objectives.Batch.from_arrays(arrays)).vote
    assert torch.equal(refined, seen["vote"])


def test_local_refinement_of_trained_weights_keeps_outputs(objectives, people):
    trained = objectives.load_checkpoint(objectives.bundled_path("tiny"))[0]
    larger = objectives.grown(trained, objectives.with_local_refinement).eval()
    objective = objectives.VariantObjective(config=trained.config)
    batch = objectives.Batch.from_arrays(objective.collate(people))
    with torch.no_grad():
        before, after = trained(batch), larger(batch)
    assert torch.equal(before.joints(), after.joints()) and torch.equal(before.confidence, after.confidence)
    assert torch.equal(before.part, after.part[..., : trained.config.parts])


def test_hard_kinds_variant_prefers_hard_activities(ablations):
    settings = recipe(Pretrain, people=1024, seed=3, workers=0, pictures=0)
    job = ablations.job(ablations.VARIANTS["hard kinds"], settings)
    base = ablations.job(ablations.VARIANTS["base"], settings)
    # twice as many people are drawn, so the curriculum has twice as many steps
    assert job.source.easy == 2 * base.source.easy
    weights = {k: ablations.KIND_WEIGHTS.get(job.source.kind(k), 1.5) for k in range(512)}
    shown = [job.source.chosen(k) for k in range(256)]
    assert all(k // 2 == index for index, k in enumerate(shown))
    assert np.mean([weights[k] for k in shown]) > np.mean(list(weights.values()))


# ---- stored results


def test_ablations_each_rejects_scores_of_other_options(ablations, tmp_path):
    options = Namespace(seeds="1", out=tmp_path, people=64, motion="a.npz", subjects="002", init="")
    runs = []

    def scored(name, seed, folder):
        runs.append(name)
        return {"figures": {}, "processor_seconds": 0.0}

    ablations.each(["base"], options, scored)
    ablations.each(["base"], options, scored)
    assert runs == ["base"]
    (tmp_path / "weights").write_bytes(b"trained")
    for other in ({"motion": "b.npz"}, {"subjects": "005"}, {"init": str(tmp_path / "weights")}):
        with pytest.raises(SystemExit, match=r"base-64-1/scores\.json is of \{.*: delete it$"):
            ablations.each(["base"], Namespace(**vars(options) | other), scored)
    # scores without recorded options are rejected, too
    (tmp_path / "base-64-1" / "scores.json.of.json").unlink()
    with pytest.raises(SystemExit, match="unknown options"):
        ablations.each(["base"], options, scored)


def test_clips_rejects_store_of_other_options_or_weights(tmp_path, monkeypatch):
    clips = benchmark("clips")
    made = []
    monkeypatch.setattr(clips, "make_clips", lambda *arguments: made.append(arguments) or {"true": np.zeros(1)})
    monkeypatch.setattr(clips, "run", lambda clips: {"ways": {}, "spread_over_error": 1.0})
    command = ["clips.py", "--store", str(tmp_path / "clips.npz"), "--weights"]
    for words in (["tiny"], ["tiny"]):
        monkeypatch.setattr(sys, "argv", [*command, *words])
        clips.main()
    assert len(made) == 1
    for words in (["small"], ["tiny", "--seed", "5"], ["tiny", "--clips", "9"], ["tiny", "--motion", "prior"]):
        monkeypatch.setattr(sys, "argv", [*command, *words])
        with pytest.raises(SystemExit, match=r"clips\.npz is of \{.*: delete it$"):
            clips.main()


def test_tracks_rejects_stored_boxes_of_other_networks(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trackeval", ModuleType("trackeval"))
    tracks = benchmark("tracks")
    monkeypatch.setattr(tracks, "recording", lambda seed, index: [])
    assert tracks.stored(2, 0, tmp_path) == tracks.stored(2, 0, tmp_path) == []
    monkeypatch.setattr(tracks, "digest", lambda weights: "another")
    with pytest.raises(SystemExit, match=r"2-0\.json is of \{.*: delete it$"):
        tracks.stored(2, 0, tmp_path)
