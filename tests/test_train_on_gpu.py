"""Training on a GPU: what can be tested without one. `--check` of the script compares graphs with ordinary steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scripts import load_script

from lidarpose.models.config import SIZES
from lidarpose.models.posenet import Batch, PoseNet
from lidarpose.skeleton import BODY26
from lidarpose.train.augment import FLIP_PART
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.objectives.posenet_objective import PoseNetObjective
from lidarpose.train.optim import rate_factor
from lidarpose.train.recipes import Pretrain

PEOPLE = 6


@pytest.fixture(scope="module")
def tool():
    return load_script("tools/train_on_gpu.py")


@pytest.fixture(scope="module")
def objective():
    return PoseNetObjective(config=replace(SIZES["tiny"], person=True))


@pytest.fixture(scope="module")
def network(objective):
    torch.manual_seed(0)
    return PoseNet(objective.config).eval()


@pytest.fixture(scope="module")
def examples():
    source = SyntheticSource(scene="wild", seed=4, objects=0.3)
    # of few points, so that no voxels are subsampled
    few = [example for example in map(source.example, range(40)) if len(example.points) < 150]
    return few[:PEOPLE]


def inputs(tool, objective, examples, which=0):
    index, block = tool.pack(objective.collate(examples), PEOPLE)
    tensors = tool.Inputs(index, PEOPLE, torch.device("cpu"))
    arrays = tool.unpack(block, index, PEOPLE)
    tensors.fill(tool.transformed(arrays, torch.full((PEOPLE,), which)))
    return tensors.tensors


def test_packed_batch_has_same_losses(tool, objective, network, examples):
    expected = objective.terms(network, objective.collate(examples))
    packed = objective.terms(network, inputs(tool, objective, examples))
    for name, value in expected.items():
        torch.testing.assert_close(packed[name], value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("which", range(8))
def test_symmetries_are_those_of_voxelized_points(tool, objective, network, examples, which):
    """Turned and mirrored voxels, and the voxels of turned and mirrored points."""
    R = tool.symmetries(torch.device("cpu"))[0][which].numpy().astype(float)
    is_mirrored = np.linalg.det(R) < 0
    joints = list(BODY26.flip) if is_mirrored else list(range(26))
    moved = [
        replace(
            one,
            points=(one.points @ R.T).astype(np.float32),
            joints=(one.joints @ R.T)[joints].astype(np.float32),
            visible=one.visible[joints],
            part=FLIP_PART[one.part + 1] if is_mirrored else one.part,
            view=np.append(one.view[:3] @ R.T, one.view[3:]).astype(np.float32),
        )
        for one in examples
    ]
    turned, expected = inputs(tool, objective, examples, which), inputs(tool, objective, moved)
    with torch.no_grad():
        poses = [network(Batch.from_arrays(arrays)).joints() for arrays in (turned, expected)]
    torch.testing.assert_close(poses[0], poses[1], rtol=1e-4, atol=1e-5)
    for name in ("joints", "visible", "known", "view", "person"):
        torch.testing.assert_close(turned[name], expected[name], equal_nan=True, rtol=1e-4, atol=1e-5)
    # the part of a voxel on a tie of its points depends on the numbers of the parts
    assert (turned["part"].sort(1)[0] == expected["part"].sort(1)[0]).float().mean() > 0.98


def test_students_learn_the_same_batches(tool, objective, examples, tmp_path):
    torch.manual_seed(0)
    index, block = tool.pack(objective.collate(examples), PEOPLE)
    tensors = tool.Inputs(index, PEOPLE, torch.device("cpu"))
    tensors.fill(tool.unpack(block, index, PEOPLE))
    recipe = Pretrain(rate=2e-3, muon_rate=2e-2, cool=0.9)
    student = tool.Student(PoseNet(objective.config), recipe, torch.device("cpu"))
    errors = [float(student.step(index, tensors, 1.0)[student.names.index("mpjpe")]) for _ in range(12)]
    assert errors[-1] < 0.8 * errors[0]
    student.save(tmp_path / "tiny.safetensors", {"command": "x"})
    assert (tmp_path / "tiny.safetensors").stat().st_size < 1.1e6
    assert rate_factor(0.01, recipe) == 0.5 and rate_factor(1.0, recipe) == 0 and rate_factor(0.09, recipe) == 1


def test_card_has_whole_command_without_paths(tool, tmp_path, monkeypatch, capsys):
    words = ["--sizes", "tiny", "--motion=some/folder/wide.npz", "--device", "cpu", "--minutes", "2"]
    with pytest.raises(SystemExit, match="2"):
        tool.options_of([str(tmp_path), *words, "--rates", "1e-3", "2e-3"])
    assert "--rates needs one number for each of 1 sizes, got 2" in capsys.readouterr().err
    options = tool.options_of([*words, str(tmp_path)])
    assert options.rates == [8e-4]
    command = tool.command_of(options)
    assert command.startswith("python tools/train_on_gpu.py OUT --minutes 2.0 --sizes tiny --rates 0.0008 ")
    assert "--motion wide.npz" in command and "/" not in command.removeprefix("python tools/")
    again = tool.options_of([str(tmp_path), *command.split()[3:]])
    assert {**vars(again), "motion": options.motion} == vars(options)
