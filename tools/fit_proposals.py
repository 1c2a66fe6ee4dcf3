"""Fits the classifier that discards columns that are almost never a person: models/weights/proposals.npz.

    python tools/fit_proposals.py SCENES

The columns are those of SCENES synthesized scenes (1,500: family "train", seed 9001). Fits a perceptron with 16 hidden
units, and the logit threshold below which three in a thousand of the people with a column lose all their columns. Needs
lidarpose[train].
"""

import sys
from pathlib import Path

import numpy as np
import torch

from lidarpose.models.detector.detector import BEYOND, MAX_RANGE
from lidarpose.models.detector.ground import estimate_ground, without_ground
from lidarpose.models.detector.proposals import columns, heights_above
from lidarpose.synth.detection_scene import detection_scene
from lidarpose.train.detector.candidate_source import as_detected

OUT = Path(__file__).parent.parent / "src" / "lidarpose" / "models" / "weights" / "proposals.npz"
SEED, HIDDEN, EPOCHS, LOST = 9001, 16, 25, 0.003


def scene_columns(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features (K, F) of columns, distance (K,) m to the nearest person with at least 5 points, and id of that person:
    1000 times the scene's index plus the person's number."""
    scene = detection_scene(SEED, index)
    scene = as_detected(scene, scene.origin)
    points, origin = scene.points.astype(float), scene.origin
    points = points[np.hypot(*(points - origin)[:, :2].T) < MAX_RANGE + BEYOND]
    ground = estimate_ground(points, origin) or without_ground(points, origin)
    places, features = columns(points, heights_above(points, ground))
    is_near = np.hypot(*(places - origin[:2]).T) < MAX_RANGE
    is_visible = np.bincount(scene.person[scene.person >= 0], minlength=len(scene.boxes)) >= 5
    people = np.array([box.center[:2] for box in scene.boxes]).reshape(-1, 2)
    distances = np.where(is_visible, np.hypot(*(places[is_near][:, None] - people).transpose(2, 0, 1)), 99.0)
    distances = np.concatenate([distances, np.full((len(distances), 1), 99.0)], 1)
    return features[is_near], distances.min(1), distances.argmin(1) + 1000 * index


def fit(features: np.ndarray, distance: np.ndarray, person: np.ndarray) -> dict[str, np.ndarray]:
    torch.manual_seed(0)
    mean, deviation = features.astype(float).mean(0), features.astype(float).std(0) + 1e-6
    x = torch.tensor((features - mean) / deviation, dtype=torch.float32)
    is_person = torch.tensor(distance < 0.35)
    weight = torch.where(is_person, (~is_person).sum() / is_person.sum() / 2, 1.0)
    training_rows = torch.tensor(np.flatnonzero((distance < 0.35) | (distance > 0.6)))
    net = torch.nn.Sequential(torch.nn.Linear(x.shape[1], HIDDEN), torch.nn.ReLU(), torch.nn.Linear(HIDDEN, 1))
    optimizer = torch.optim.Adam(net.parameters(), 3e-3, weight_decay=1e-5)
    for _ in range(EPOCHS):
        for rows in training_rows[torch.randperm(len(training_rows))].split(2048):
            loss = torch.nn.functional.binary_cross_entropy_with_logits(
                net(x[rows])[:, 0], is_person[rows].float(), weight[rows]
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    with torch.no_grad():
        logit = net(x)[:, 0].numpy()
    is_own_column = distance < 0.5
    best_logit = np.full(person.max() + 1, -np.inf)
    np.maximum.at(best_logit, person[is_own_column], logit[is_own_column])
    least_logit = np.quantile(best_logit[np.isfinite(best_logit)], LOST)
    print(f"{np.mean(logit > least_logit):.2f} of {len(logit):,} columns stay, with {1 - LOST:.3f} of the people")
    arrays = {"mean": mean, "deviation": deviation, "least": least_logit}
    for name, layer in (("hidden_", net[0]), ("", net[2])):
        arrays |= {f"{name}weight": layer.weight.detach().numpy().T, f"{name}bias": layer.bias.detach().numpy()}
    arrays |= {"weight": arrays["weight"][:, 0], "bias": arrays["bias"][0]}
    return {name: np.asarray(values, np.float32) for name, values in arrays.items()}


if __name__ == "__main__":
    scenes = [scene_columns(index) for index in range(int(sys.argv[1]))]
    np.savez(OUT, **fit(*(np.concatenate(values) for values in zip(*scenes, strict=True))))
