"""What is installed: `lidarpose info`."""

import platform

import torch

from lidarpose._version import __version__
from lidarpose.infer.predictor import BUNDLED, bundled_path
from lidarpose.model.checkpoint import load_checkpoint


def lines() -> list[str]:
    """Version, torch, device, and of each bundled checkpoint its size, parameters, training and score."""
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else f"cpu, {torch.get_num_threads()} threads"
    out = [
        f"lidarpose  {__version__}",
        f"python     {platform.python_version()}",
        f"torch      {torch.__version__}",
        f"device     {device}",
    ]
    for name in BUNDLED:
        path = bundled_path(name)
        network, header = load_checkpoint(path)
        parameters = sum(value.numel() for value in network.parameters())
        card = header.card
        out += [
            f"weights    {name}: {path.stat().st_size / 1e6:.2f} MB, {parameters:,} parameters",
            f"  trained  {card.get('command', 'unknown')}",
            f"           {card.get('people_seen', 0):,} people, {card.get('hours', 0)} hours",
        ]
        out += [f"           {card['note']}"] if "note" in card else []
        out += [f"  score    {key}: {value}" for key, value in card.get("scores", {}).items()]
    return out
