"""Adds digests to old checkpoints without one and to their ONNX files; tensors stay bit-identical.

python tools/add_digests.py src/lidarpose/models/weights/*.safetensors
"""

import argparse
from pathlib import Path

import onnx

from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import content_digest
from lidarpose.models import onnx as onnx_files
from lidarpose.models.checkpoint import DIGEST, with_digest


def add_digests(path: Path) -> None:
    """Rewrites a checkpoint, and the .onnx file next to it if there is one."""
    write_atomic(path, with_digest(path.read_bytes()))
    onnx_path = path.with_suffix(".onnx")
    if not onnx_path.is_file():
        return
    model = onnx.load(onnx_path)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    metadata |= {onnx_files.SOURCE: content_digest(path, expected="a checkpoint"), DIGEST: onnx_files.NO_DIGEST}
    onnx.helper.set_model_props(model, metadata)
    write_atomic(onnx_path, onnx_files.with_digest(model.SerializeToString(deterministic=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path)
    for path in parser.parse_args().checkpoints:
        add_digests(path)


if __name__ == "__main__":
    main()
