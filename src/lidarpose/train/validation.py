"""Validation during training: the mean error over samples, and a picture of some of them."""

from collections.abc import Callable, Sequence

import numpy as np
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from lidarpose.sample import Pose
from lidarpose.skeleton import BODY26, Skeleton
from lidarpose.train.augment import ClipExample, Example
from lidarpose.train.objectives.objective import PoseObjective

# examples in their own frames, predicted joints (N, 26, 3) m of body26, the skeleton to draw, a title -> PNG
Draw = Callable[[list[Example], np.ndarray, Skeleton, str], bytes]


def validate(
    objective: PoseObjective, network: nn.Module, examples: Sequence[Example | ClipExample], batch: int
) -> tuple[float, np.ndarray]:
    """MPJPE in mm of a network in evaluation mode over the labeled joints that it predicts, and its joints (N, 26, 3) m
    of all N frames. batch: number of examples per batch."""
    device = next(network.parameters()).device
    batches = [objective.collate(list(examples[k : k + batch])) for k in range(0, len(examples), batch)]
    joints = np.concatenate([objective.joints(network, arrays, device=device) for arrays in batches])
    true_joints = np.stack([frame.joints for example in examples for frame in example.frames])
    # labeled joints that the network predicts; a prediction that is unexpectedly not finite must show in the error
    is_counted = ~np.isnan(true_joints).any(-1) & ~np.isnan(joints).all((0, 2))
    return float(np.linalg.norm(joints - true_joints, axis=-1)[is_counted].mean() * 1e3), joints


def batch_norms(network: nn.Module) -> list[_BatchNorm]:
    return [module for module in network.modules() if isinstance(module, _BatchNorm)]


def update_batch_norms(network: nn.Module, objective: PoseObjective, batches: list) -> None:
    """Re-estimates the statistics of a network's batch norms as their means over collated batches. In place.

    Like `torch.optim.swa_utils.update_bn`, but without dropout, so that the statistics are those of evaluation. Running
    statistics from training belong to weights of up to some hundred steps ago, and not to the averaged weights.
    """
    network.eval()
    norms = batch_norms(network)
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        # None: cumulative mean
        norm.momentum = None
        norm.train()
    device = next(network.parameters()).device
    for arrays in batches:
        objective.joints(network, arrays, device=device)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    network.eval()


def draw_examples(examples: list[Example], joints: np.ndarray, skeleton: Skeleton, title: str) -> bytes:
    """A PNG of people in their own frames with predicted joints (N, 26, 3) m of body26, drawn in `skeleton`."""
    from lidarpose.viz.draw import Panel, draw_people

    def pose(joints: np.ndarray) -> Pose | None:
        # None if any of the skeleton's joints is unknown
        skeleton_joints = joints[BODY26.map_to(skeleton)]
        return None if np.isnan(skeleton_joints).any() else Pose(joints=skeleton_joints, skeleton=skeleton)

    panels = []
    for example, predicted in zip(examples, joints, strict=True):
        error = np.nanmean(np.linalg.norm(predicted - example.joints, axis=-1)) * 1e3
        panels.append(
            Panel(
                points=example.points,
                pose=pose(predicted),
                truth=pose(example.joints),
                label=f"{error:.0f} mm",
                # the position of the sensor in the person's frame is unknown
                distance=np.nan,
            )
        )
    return draw_people(panels, title=title)
