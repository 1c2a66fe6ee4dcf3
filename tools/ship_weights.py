"""Makes a run's model a bundled checkpoint: float16, its card completed with what it scores; its ONNX twin beside; and
what it says of the cloud in tests/golden_poses.json.

python benchmarks/heldout.py --motion cmu_motion.npz --weights RUN/model.safetensors --json scores.json
python tools/ship_weights.py RUN/model.safetensors scores.json src/lidarpose/models/weights/tiny.safetensors
"""

import argparse
import json
import tempfile
from pathlib import Path

from lidarpose.inference.predictor import load
from lidarpose.io.files import write_atomic
from lidarpose.models.checkpoint import load_checkpoint, save_checkpoint
from lidarpose.models.export import export

GOLDEN = Path(__file__).parents[1] / "tests" / "golden_poses.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("scores")
    parser.add_argument("out")
    parser.add_argument("--note", help="what the command does not tell of the training")
    options = parser.parse_args()
    network, header = load_checkpoint(options.model)
    with open(options.scores) as file:
        scores = json.load(file)
    measured = {}
    for condition in ("sensor known", "sensor unknown"):
        for group in ("all", "upright, whole, uncluttered"):
            figures = scores[condition]["groups"][group]
            measured[f"{condition}, {group}"] = f"MPJPE {figures['mpjpe']} mm of {figures['people']} people"
    measured["measured on"] = f"benchmarks/heldout.py, subjects {scores['subjects']}, seed {scores['seed']}, human15"
    note = {"note": options.note} if options.note else {}
    out = Path(options.out)
    # both or none: twins of different weights would not load
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / out.name
        save_checkpoint(made, network, card=header.card | note | {"scores": measured}, half=True)
        export(made, made.with_suffix(".onnx"))
        for path in (out, out.with_suffix(".onnx")):
            write_atomic(path, (made.parent / path.name).read_bytes())
    golden = json.loads(GOLDEN.read_text())
    pose = load(out.with_suffix(".onnx"), tta=1).predict(golden["points"], sensor_origin=golden["sensor_origin"])
    golden["joints"][out.stem] = pose.joints.round(4).tolist()
    write_atomic(GOLDEN, json.dumps(golden) + "\n")


if __name__ == "__main__":
    main()
