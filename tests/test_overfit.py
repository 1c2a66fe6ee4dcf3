"""The paper's network learns a few people by heart, judged as it is used: in evaluation mode, from the saved file."""

from dataclasses import dataclass, replace

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
    """The same people in every epoch."""

    examples: list[Example]

    def example(self, index: int) -> Example:
        return self.examples[index % len(self.examples)]


@pytest.mark.slow
def test_sixteen_fixed_people_are_learned_by_heart(tmp_path):
    """`paper-small` by the recipe paper-one-stage in batches of 4 and without dropping anything, under 30 mm."""
    one_stage = recipe(
        Pretrain, "paper-one-stage", people=16 * 150, batch=4, drop_path=0.0, workers=0, pictures=0, validate=600
    )
    synthetic = SyntheticSource(scene="paper", seed=1)
    examples = [synthetic.example(k) for k in range(16)]
    setup = make_setup(one_stage)
    config = replace(setup.objective.config, anchor_dropout=0.0)
    objective = replace(setup.objective, config=config)
    setup = replace(
        setup, objective=objective, network=objective.network, source=Fixed(examples), validation=lambda: examples
    )
    network, header = load_checkpoint(loop.train(one_stage, tmp_path / "run", setup=setup))
    error, _ = validate(objective, network.eval(), examples, 16)
    assert error < 30 and abs(error - header.card["validation_mm"]) < 0.1
