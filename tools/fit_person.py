"""Fits a network's outputs for whether a crop contains a person, and a second one, also to the detections in whole
scans, including false positives. The rest of the network is not changed.

    python tools/fit_person.py crops CROPS.npz --scenes 1500 --samples 20000 --motion wide_motion.npz
    python tools/fit_person.py fit CROPS.npz RUN/model.safetensors OUT.safetensors

`crops` creates the training data: crops of the detections in synthesized scans (family "train"), prepared as in
`lidarpose.detect`, and equal numbers of people and objects of the scene "wide", disturbed as in training. `fit`
trains the head further on the network's features of these crops. Later weights of a network are fitted to the same
crops. Needs lidarpose[train].
"""

import argparse
import multiprocessing
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from lidarpose.io.atomic import atomic_path
from lidarpose.metrics import auroc
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.onnx import voxelize_people
from lidarpose.models.posenet import Batch, PoseNet
from lidarpose.train.augment import second_person_label
from lidarpose.train.data_loader import SyntheticSource
from lidarpose.train.detector.candidate_source import NOBODY
from lidarpose.train.detector.crop_source import scan_crops

SEED = 9101
MOST_POINTS = 1024
# how often people and objects are disturbed, as in pre-training: else the head rejects people in blurred clouds
STRAYS, NOISE = 0.2, 0.15
EPOCHS, BATCH, RATE, HELD_OUT = 40, 512, 2e-3, 0.1

Crop = tuple[np.ndarray, np.ndarray, np.ndarray, int]


def scene_crops(index: int) -> list[Crop]:
    """Points (n, 3) m relative to the center, view (5,), labels (2,), group 1, of the detections in a scene."""
    scan = scan_crops(SEED, index)
    labels = [
        np.array([1.0, second_person_label(others, len(cloud))]) if person != NOBODY else np.zeros(2)
        for cloud, person, others in zip(scan.clouds, scan.person, scan.num_others, strict=True)
    ]
    return [(cloud, view, label, 1) for cloud, view, label in zip(scan.clouds, scan.view, labels, strict=True)]


def sample_crops(index: int, *, source: SyntheticSource) -> list[Crop]:
    """As `scene_crops`, for a person or an object of the scene "wide", with group 0."""
    example = source.example(index)
    return [(example.points, example.view, example.person, 0)]


def make_crops(out: Path, scenes: int, samples: int, motion: str | None, workers: int) -> None:
    captured = 0.6 if motion else 0.0
    source = SyntheticSource(
        scene="wide", seed=SEED, motion=motion, captured=captured, strays=STRAYS, noise=NOISE, objects=0.5
    )
    rng = np.random.default_rng(SEED)
    crops: list[Crop] = []
    with multiprocessing.get_context("forkserver").Pool(workers) as pool:
        for make_crop, count in ((scene_crops, scenes), (partial(sample_crops, source=source), samples)):
            for number, new_crops in enumerate(pool.imap(make_crop, range(count), chunksize=8)):
                crops += new_crops
                if number % 200 == 0:
                    print(f"{number} of {count}, {len(crops):,} crops", flush=True)
    clouds = [c if len(c) <= MOST_POINTS else rng.permutation(c)[:MOST_POINTS] for c, *_ in crops]
    _, view, label, group = zip(*crops, strict=True)
    arrays = {"points": np.concatenate(clouds).astype(np.float32), "count": [len(cloud) for cloud in clouds]}
    arrays |= {"view": np.stack(view), "label": np.stack(label), "group": group}
    with atomic_path(out) as path, open(path, "wb") as file:
        np.savez(file, **{name: np.asarray(value) for name, value in arrays.items()})


@torch.inference_mode()
def head_inputs(network: PoseNet, crops: dict[str, np.ndarray]) -> torch.Tensor:
    """(K, F): the input of the network's head for each crop."""
    inputs: list[torch.Tensor] = []
    clouds = np.split(crops["points"], np.cumsum(crops["count"])[:-1])
    order = np.argsort(crops["count"], kind="stable")
    handle = network.person.hidden.register_forward_pre_hook(lambda _, arguments: inputs.append(arguments[0]))
    for start in range(0, len(order), 64):
        rows = order[start : start + 64]
        arrays = voxelize_people([clouds[k] for k in rows], crops["view"][rows].astype(np.float32), network.config)
        network(Batch.from_arrays(arrays.arrays()))
        if start % 6400 == 0:
            print(f"{start:,} of {len(order):,} crops", flush=True)
    handle.remove()
    features = torch.cat(inputs)
    return features[torch.as_tensor(np.argsort(order))]


def fit(path: Path, model: Path, out: Path) -> None:
    torch.manual_seed(0)
    crops = dict(np.load(path, allow_pickle=False))
    network, header = load_checkpoint(model)
    x = head_inputs(network.eval(), crops).clone()
    label, group = torch.as_tensor(crops["label"], dtype=torch.float32), torch.as_tensor(crops["group"])
    # both groups have equal weight, and within each group crops with and without a person
    kind = 2 * group + label[:, 0].long()
    weight = (1 / torch.bincount(kind, minlength=4).clamp(min=1))[kind]
    weight = weight / weight.mean()
    is_held_out = torch.rand(len(x)) < HELD_OUT
    head = network.person
    optimizer = torch.optim.AdamW([*head.hidden.parameters(), *head.out.parameters()], RATE, weight_decay=1e-3)
    rows = torch.nonzero(~is_held_out)[:, 0]
    steps = EPOCHS * -(-len(rows) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(EPOCHS):
        for batch_rows in rows[torch.randperm(len(rows))].split(BATCH):
            truth = label[batch_rows]
            logit = head.out(head.hidden(x[batch_rows]))
            entropy = F.binary_cross_entropy_with_logits(logit, truth.nan_to_num(0), reduction="none")
            loss = (entropy * ~truth.isnan() * weight[batch_rows, None]).sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        logit = head.out(head.hidden(x))
    for number, name in enumerate(("people and objects", "detections")):
        is_in_group = is_held_out & (group == number)
        print(
            f"{name}: AUROC of a person {auroc(logit[is_in_group, 0], label[is_in_group, 0]):.4f}, "
            f"{int(is_in_group.sum()):,} crops held out"
        )
    save_checkpoint(out, network, card=header.card)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("crops")
    making.add_argument("out", type=Path)
    making.add_argument("--scenes", type=int, default=1500)
    making.add_argument("--samples", type=int, default=20_000)
    making.add_argument("--motion")
    making.add_argument("--workers", type=int, default=1)
    fitting = commands.add_parser("fit")
    for name in ("crops", "model", "out"):
        fitting.add_argument(name, type=Path)
    options = parser.parse_args()
    if options.command == "crops":
        make_crops(options.out, options.scenes, options.samples, options.motion, options.workers)
    else:
        fit(options.crops, options.model, options.out)


if __name__ == "__main__":
    main()
