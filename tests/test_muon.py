"""The Muon optimizer, which updates matrices in batches, compared with torch's."""

import pytest
import torch

from lidarpose.train.optim import Muon, orthogonalized

SHAPES = [(6, 6), (6, 6), (12, 6), (6, 12), (6, 12), (3, 6)]


def learned(optimizer_of, steps=6):
    """A few matrices after some steps of an optimizer."""
    torch.manual_seed(0)
    matrices = [torch.nn.Parameter(torch.randn(shape)) for shape in SHAPES]
    target = [torch.randn(shape) for shape in SHAPES]
    optimizer = optimizer_of(matrices)
    for _ in range(steps):
        optimizer.zero_grad()
        sum(((m - t) ** 2).sum() for m, t in zip(matrices, target, strict=True)).backward()
        optimizer.step()
    return matrices


@pytest.mark.parametrize("settings", [{"lr": 0.02}, {"lr": 0.1, "weight_decay": 0.3, "momentum": 0.8}])
def test_muon_matches_torch(settings):
    ours = learned(lambda matrices: Muon(matrices, **settings))
    theirs = learned(lambda matrices: torch.optim.Muon(matrices, **settings))
    # torch iterates in bfloat16, which is accurate to three digits
    for a, b, shape in zip(ours, theirs, SHAPES, strict=True):
        torch.testing.assert_close(a, b, atol=0.02 * settings["lr"] * 6, rtol=0, msg=str(shape))


@pytest.mark.parametrize("shape", [(5, 8, 8), (2, 4, 9), (2, 9, 4), (1, 1, 7)])
def test_orthogonalized_singular_values_are_near_one(shape):
    torch.manual_seed(1)
    values = torch.linalg.svdvals(orthogonalized(torch.randn(shape)))
    assert (values > 0.5).all() and (values < 1.3).all()
    assert torch.isfinite(orthogonalized(torch.zeros(shape))).all()


def test_muon_skips_parameters_without_gradient():
    still, moved = torch.nn.Parameter(torch.ones(3, 3)), torch.nn.Parameter(torch.ones(3, 3))
    optimizer = Muon([still, moved], lr=0.1)
    moved.grad = torch.randn(3, 3)
    optimizer.step()
    assert (still == 1).all() and (moved != 1).any()


def test_muon_rejects_vectors():
    with pytest.raises(ValueError, match="matrices, got a parameter of shape"):
        Muon([torch.nn.Parameter(torch.ones(3))], lr=0.1)
