"""The paper's network overfits a few people, evaluated in evaluation mode from the saved checkpoint."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lidarpose.models.checkpoint import load_checkpoint
from lidarpose.train import loop
from lidarpose.train.augment import Example
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.recipes import Pretrain, recipe
from lidarpose.train.setup import make_setup
from lidarpose.train.validation import validate


@dataclass(frozen=True)
class Fixed:
    """The same people in every epoch, in another order.

    With the same batches in every epoch, the network recognizes a batch by the statistics of its batch norms: 3 mm in
    training and 31 in evaluation.
    """

    examples: list[Example]

    def example(self, index: int) -> Example:
        epoch, place = divmod(index, len(self.examples))
        return self.examples[np.random.default_rng([7, epoch]).permutation(len(self.examples))[place]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "people", "epochs", "batch", "rate"),
    [("paper-small", 16, 150, 4, 2e-3), ("paper-small", 256, 80, 16, 2e-3), ("paper", 16, 80, 4, 3e-4)],
)
def test_paper_network_overfits_fixed_people(size, people, epochs, batch, rate, tmp_path):
    """With the recipe paper-one-stage, small batches and no dropout, the error is below 30 mm."""
    one_stage = recipe(
        Pretrain,
        "paper-one-stage",
        size=size,
        people=people * epochs,
        batch=batch,
        rate=rate,
        drop_path=0.0,
        workers=0,
        pictures=0,
        validate=people * epochs // 4,
    )
    synthetic = SyntheticSource(scene="paper", seed=1)
    examples = [synthetic.example(k) for k in range(people)]
    setup = make_setup(one_stage)
    config = replace(setup.objective.config, anchor_dropout=0.0)
    objective = replace(setup.objective, config=config)
    setup = replace(
        setup, objective=objective, network=objective.network, source=Fixed(examples), validation=lambda: examples
    )
    network, header = load_checkpoint(loop.train(one_stage, tmp_path / "run", setup=setup))
    error, _ = validate(objective, network.eval(), examples, 16)
    assert error < 30 and abs(error - header.card["validation_mm"]) < 0.1
