"""Creates a bundled checkpoint from a run's model: float16, with the scores in its card; also writes its ONNX file, and
its prediction for the cloud in tests/golden_poses.json.

python benchmarks/heldout.py --motion cmu_motion.npz --weights RUN/model.safetensors --json scores.json
python tools/ship_weights.py RUN/model.safetensors scores.json src/lidarpose/models/weights/tiny.safetensors
python tools/ship_weights.py RUN/model.safetensors scores.json OUT --average OLD.safetensors 0.2

The last command averages with the weights that the run began with, by their share, which preserves more of their
abilities (Wortsman et al. 2022, Robust fine-tuning of zero-shot models). With - instead of the scores, the same command
writes only the checkpoint, which can then be scored.
"""

import argparse
import json
import tempfile
from pathlib import Path

import torch
from torch import nn

from lidarpose.inference.predictor import load
from lidarpose.io.atomic import write_atomic
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.export import export

GOLDEN = Path(__file__).parents[1] / "tests" / "golden_poses.json"


def average(network: nn.Module, old: nn.Module, share: float) -> None:
    """Interpolates to an older network's weights by `share`, in place. Weights missing in it do not change."""
    old_weights = old.state_dict()
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name in old_weights:
                value.lerp_(old_weights[name], share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("scores")
    parser.add_argument("out")
    parser.add_argument("--average", nargs=2, metavar=("OLD", "SHARE"), help="keep a share of older weights")
    parser.add_argument("--note", help="what the command does not tell of the training")
    options = parser.parse_args()
    network, header = load_checkpoint(options.model)
    if options.average:
        average(network, load_checkpoint(options.average[0])[0], float(options.average[1]))
    if options.scores == "-":
        save_checkpoint(options.out, network, card=header.card, half=True)
        return
    with open(options.scores) as file:
        scores = json.load(file)
    card_scores = {}
    for condition in ("sensor known", "sensor unknown"):
        for group in ("all", "upright, whole, uncluttered"):
            figures = scores[condition]["groups"][group]
            card_scores[f"{condition}, {group}"] = f"MPJPE {figures['mpjpe']} mm of {figures['people']} people"
    card_scores["measured on"] = f"benchmarks/heldout.py, subjects {scores['subjects']}, seed {scores['seed']}, human15"
    note = {"note": options.note} if options.note else {}
    out = Path(options.out)
    # both files are made before either is written, since a checkpoint and an ONNX file of different weights do not load
    with tempfile.TemporaryDirectory() as folder:
        temporary_path = Path(folder) / out.name
        save_checkpoint(temporary_path, network, card=header.card | note | {"scores": card_scores}, half=True)
        export(temporary_path, temporary_path.with_suffix(".onnx"))
        for path in (out, out.with_suffix(".onnx")):
            write_atomic(path, (temporary_path.parent / path.name).read_bytes())
    golden = json.loads(GOLDEN.read_text())
    pose = load(out.with_suffix(".onnx"), tta=1).predict(golden["points"], sensor_origin=golden["sensor_origin"])
    golden["joints"][out.stem] = pose.joints.round(4).tolist()
    write_atomic(GOLDEN, json.dumps(golden) + "\n")


if __name__ == "__main__":
    main()
