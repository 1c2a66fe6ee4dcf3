"""Validation of the detector's network on whole synthesized scans of what training never shows."""

from collections.abc import Sequence

import numpy as np
from torch import nn

from lidarpose.models.detector.candidates import suppress
from lidarpose.train.detector.candidate_source import NOBODY, DetectorExample, scan_example
from lidarpose.train.objectives.detector_objective import DetectorObjective

# scans to validate on, and the false people a scan at which people are counted
SCANS, FALSE = 30, 1.0


def validation_scans(seed: int) -> list[DetectorExample]:
    """All candidates of scans of the family "heldout"."""
    return [scan_example(seed, number, family="heldout", with_rows=True) for number in range(SCANS)]


def missed_people(
    objective: DetectorObjective, network: nn.Module, examples: Sequence[DetectorExample], batch: int
) -> tuple[float, None]:
    """Per cent of the people that candidates have who are missed at `FALSE` false people a scan. batch: is not used."""
    device = next(network.parameters()).device
    false: list[np.ndarray] = []
    best: list[np.ndarray] = []
    for example in examples:
        logit = objective.scores(network, objective.collate([example]), device=device)[:, 0]
        person = example.labels.person
        rows = suppress(example.rows or [], logit)
        false.append(logit[rows][person[rows] == NOBODY])
        people = np.unique(person[person >= 0])
        best.append(np.array([logit[rows][person[rows] == number].max(initial=-np.inf) for number in people]))
    ranked = np.sort(np.concatenate([*false, [-np.inf]]))[::-1]
    threshold = ranked[min(round(FALSE * len(examples)), len(ranked) - 1)]
    people = np.concatenate(best)
    return float((people <= threshold).mean() * 100) if len(people) else 0.0, None
