"""`DetectorObjective`: classifies candidates with hard negative mining and regresses boxes of people; and the miss rate
on held-out whole scans.

Legend: K candidates of a batch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarpose.models.detector.candidates import suppress_near
from lidarpose.models.detector.detector import SAME, predicted_boxes
from lidarpose.models.detector.detector_config import INPUTS, DetectorConfig
from lidarpose.models.detector.render import render
from lidarpose.train.detector.candidate_source import IGNORE, NOBODY, DetectorExample
from lidarpose.train.objectives.objective import BuiltNetwork, Share, at_least_one, on_device, one_process

# loss weights; distances are in meters
PERSON, OFFSET, FOOT, HEIGHT, MOUNTED = 1.0, 2.0, 1.0, 1.0, 0.5
# negatives that are learned from: numbers of those with the largest loss, per positive and per scan; and the share of
# the rest, drawn at random
HARD, HARD_OF_SCAN, EASY = 1.5, 4, 0.1
# false positives per scan at which the miss rate is measured in validation
FALSE_PER_SCAN = 1.0


@dataclass(frozen=True, kw_only=True)
class DetectorObjective(BuiltNetwork):
    """The `Objective` of a `DetectorNet` with this configuration."""

    config: DetectorConfig

    def collate(self, examples: list[DetectorExample]) -> dict[str, np.ndarray]:
        """The network's inputs as float16, which halves the data sent between processes; labels (K, ...) of all scans,
        concatenated; and scan (K,), the index of each candidate's scan."""
        renders = [render(example.candidates, example.augmentation) for example in examples]
        # torch converts to float16 ten times as fast as numpy
        arrays = {
            name: torch.as_tensor(np.concatenate([scan[name] for scan in renders])).half().numpy() for name in INPUTS
        }
        for name in vars(examples[0].labels):
            arrays[name] = np.concatenate([getattr(example.labels, name) for example in examples])
        return arrays | {"scan": np.repeat(np.arange(len(examples)), [example.size for example in examples])}

    def terms(
        self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu", share: Share = one_process
    ) -> dict[str, Tensor]:
        """Cross entropy of positives and of selected negatives; errors of position and height of positives."""
        tensors = on_device(arrays, device)
        inputs = [tensors[name].float() for name in INPUTS]
        person = tensors["person"]
        with torch.no_grad():
            logit = network(*inputs).float()[:, 0]
            rows = training_rows(logit, person, tensors["scan"])
            precision = average_precision(logit[person != IGNORE], person[person != IGNORE] >= 0)
        out = network(*(values[rows] for values in inputs)).float()
        is_person = (person[rows] >= 0).float()
        people = at_least_one(share(is_person.sum()))

        def of_people(error: Tensor) -> Tensor:
            return (error * is_person).sum() / people

        def l1(column: int, name: str) -> Tensor:
            return of_people((out[:, column] - tensors[name][rows]).abs())

        cross_entropy = F.binary_cross_entropy_with_logits
        center = tensors["center"][rows]
        mounted = cross_entropy(out[:, 5], tensors["mounted"][rows].float(), reduction="none")
        count = at_least_one(share(torch.ones_like(is_person).sum()))
        return {
            "person": PERSON * cross_entropy(out[:, 0], is_person, reduction="sum") / count,
            "offset": OFFSET * of_people((out[:, 1:3] - center).norm(dim=1)),
            "foot": FOOT * l1(3, "foot"),
            "height": HEIGHT * l1(4, "height"),
            "mounted": MOUNTED * of_people(mounted),
            "ap": precision,
        }

    @torch.no_grad()
    def scores(self, network: Callable, arrays: dict, *, device: torch.device | str = "cpu") -> np.ndarray:
        """(K, 6), see `detector_config.OUTPUTS`."""
        inputs = [torch.as_tensor(arrays[name]).to(device).float() for name in INPUTS]
        return network(*inputs).float().cpu().numpy()


def training_rows(logit: Tensor, person: Tensor, scan: Tensor) -> Tensor:
    """Rows to learn from, given logits (K,): all positives, the hardest negatives, and some random negatives, drawn
    with torch's generator."""
    positives, negatives = (person >= 0).nonzero()[:, 0], (person == NOBODY).nonzero()[:, 0]
    scans = int(scan.max()) + 1 if len(scan) else 0
    hard_count = min(round(HARD * len(positives)) + HARD_OF_SCAN * scans, len(negatives))
    # the loss of a negative rises with its logit
    order = negatives[logit[negatives].argsort(descending=True)]
    easy = order[hard_count:]
    return torch.cat([positives, order[:hard_count], easy[torch.rand(len(easy), device=easy.device) < EASY]])


def average_precision(logit: Tensor, is_person: Tensor) -> Tensor:
    """Mean precision over the ranks of the positives; 0 if there are none."""
    hits = is_person[logit.argsort(descending=True)].float()
    precision = hits.cumsum(0) / torch.arange(1, len(hits) + 1, device=hits.device)
    return (precision * hits).sum() / hits.sum().clamp(min=1)


def missed_people(
    objective: DetectorObjective, network: nn.Module, examples: Sequence[DetectorExample], batch: int
) -> tuple[float, None]:
    """Percentage of the people with candidates that are missed at `FALSE_PER_SCAN` false positives per scan.

    batch: not used.
    """
    device = next(network.parameters()).device
    scans = []
    for example in examples:
        outputs = objective.scores(network, objective.collate([example]), device=device)
        logit, person, candidates = outputs[:, 0], example.labels.person, example.candidates
        centers, _ = predicted_boxes(candidates.centers, candidates.yaw, outputs)
        rows = suppress_near(centers, logit, SAME)
        scans.append((logit[rows], person[rows], np.unique(person[person >= 0])))
    return share_missed(scans), None


def share_missed(scans: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    """Percentage of people that are missed at `FALSE_PER_SCAN` false positives per scan.

    scans: (n,) logits, (n,) people as in `Labels.person`, and the numbers of all people, of each.
    """
    false_logits = [logit[person == NOBODY] for logit, person, _ in scans]
    best_logits = [logit[person == k].max(initial=-np.inf) for logit, person, people in scans for k in people]
    false_ranking = np.sort(np.concatenate([*false_logits, [-np.inf]]))[::-1]
    threshold = false_ranking[min(round(FALSE_PER_SCAN * len(scans)), len(false_ranking) - 1)]
    return float((np.array(best_logits) <= threshold).mean() * 100) if best_logits else 0.0
