"""`lidarpose info`, `models`, `export` and `import`."""

import argparse
import json
import platform
from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from lidarpose._version import __version__
from lidarpose.cli.terminal import add_command, tell
from lidarpose.errors import counted
from lidarpose.models import BUNDLED, DEFAULT, bundled_path

_INFO = """
show versions, device, bundled weights and their scores
With a checkpoint or an exported file: what network it is, and how it was trained.
$ lidarpose info
<weights> FILE?  a checkpoint of your own, or a file that `lidarpose export` wrote
-v,--verbose  also show how the weights were trained, and all scores
--json  print everything as JSON
"""
_MODELS = """
list the networks: joints, frames, parameters
$ lidarpose models --json
--json  print them as JSON
"""
_EXPORT = f"""
write weights as ONNX or as a torch.export program
Converts a checkpoint to one file of another format, for any number of people and points. A file of the same name is
 replaced.
$ lidarpose export mine.safetensors
<weights> NAME|FILE? = {DEFAULT}  default {DEFAULT}
--format NAME = onnx  onnx (default) or torch (a .pt2 program)
--out FILE  default STEM.onnx or STEM.pt2, in the current folder
"""
_IMPORT = """
convert released DAPT weights to a checkpoint
Converts weights that DAPT's authors released, saved as safetensors, to a checkpoint for predict.
$ lidarpose import dapt_waymo.safetensors waymo.safetensors --config waymo
<file> file  the released weights, as .safetensors
<out> OUT  the checkpoint to write (.safetensors)
--config NAME  waymo, humanm3, lidarhuman26m, sloper4d, pretrain or paper (default: as stated in the file)
"""
# keys of the detector's header
_CALIBRATION = ("default_score", "calibrated_on", "labeled_scans")


def add(commands) -> None:
    """Adds the commands to the parser's."""
    add_command(commands, "info", _info, _INFO)
    add_command(commands, "models", _models, _MODELS)
    add_command(commands, "export", _export, _EXPORT)
    add_command(commands, "import", _import, _IMPORT)


def _info(options: argparse.Namespace) -> None:
    if options.weights:
        facts = checkpoint_facts(options.weights)
        lines = _checkpoint_lines(facts)
    else:
        facts = installed()
        lines = _lines(facts, verbose=options.verbose)
    print(json.dumps(facts, indent=1) if options.json else "\n".join(lines))


def checkpoint_facts(weights: str) -> dict[str, Any]:
    """A checkpoint's network, configuration, number of parameters (None for an exported file), and training runs, the
    last first. weights: a file or the name of a bundled network."""
    from lidarpose.models import weights_path
    from lidarpose.models.checkpoint import parameter_count, read_header, runs_of
    from lidarpose.models.onnx import open_network

    path = weights_path(weights)
    is_exported = path.suffix.lower() == ".onnx"
    header = open_network(path)[1] if is_exported else read_header(path)
    return {
        "file": str(path),
        "lidarpose": header.version,
        "network": header.network,
        "parameters": None if is_exported else parameter_count(path),
        "config": header.config.to_dict(),
        "runs": [{key: value for key, value in run.items() if key != "init_card"} for run in runs_of(header.card)],
    }


def _checkpoint_lines(facts: dict[str, Any]) -> Iterator[str]:
    from lidarpose.models.config import is_number

    name = facts["config"].get("size") or facts["config"].get("name") or facts["network"]
    size = "exported" if facts["parameters"] is None else f"{facts['parameters']:,} parameters"
    yield f"{facts['file']}: {name}, {size}, written by lidarpose {facts['lidarpose']}"
    for run in facts["runs"]:
        # cards are not checked when they are read
        numbers = {key: value for key, value in run.items() if is_number(value)}
        seen = next((f"{value:,} {key[:-5]}" for key, value in numbers.items() if key.endswith("_seen")), "")
        yield f"trained  {run.get('command', 'unknown')}"
        yield f"         {seen or 'unknown length'}, {numbers.get('hours', 0):.2f} hours"


def installed() -> dict[str, Any]:
    """Versions, threads, torch and its device, of each bundled network its size, training and scores, and of what finds
    people how it is calibrated."""
    from lidarpose.models.checkpoint import parameter_count, read_header, runs_of
    from lidarpose.models.detector.detector import open_detector
    from lidarpose.models.onnx import runtime, usable_threads

    weights = {}
    for name in BUNDLED:
        path = bundled_path(name)
        card = read_header(path).card
        runs = runs_of(card)
        weights[name] = {
            "default": name == DEFAULT,
            "file": str(path),
            "parameters": parameter_count(path),
            "bytes": path.stat().st_size,
            "onnx_bytes": bundled_path(name, ".onnx").stat().st_size,
            # sums over all runs, including those that trained the initial weights of the last run
            "people_seen_in_all": sum(run.get("people_seen", 0) for run in runs),
            "hours_in_all": round(sum(run.get("hours", 0) for run in runs), 2),
            "last_run": {key: card[key] for key in ("command", "people_seen", "hours", "note") if key in card},
            "scores": card.get("scores", {}),
        }
    _, detector = open_detector()
    return {
        "lidarpose": __version__,
        "python": platform.python_version(),
        "onnxruntime": runtime().__version__,
        "threads": usable_threads(),
        "torch": _torch(),
        "weights": weights,
        "detector": {name: detector[name] for name in ("version", *_CALIBRATION) if name in detector},
    }


def _lines(facts: dict[str, Any], *, verbose: bool) -> Iterator[str]:
    """`installed` for reading: what a user needs, or everything."""
    yield f"lidarpose  {facts['lidarpose']}, Python {facts['python']}"
    threads = counted(facts["threads"], "thread")
    yield f"onnx       ONNX Runtime {facts['onnxruntime']}, cpu, {threads}: the default backend"
    yield f"torch      {facts['torch']}"
    for name, entry in facts["weights"].items():
        size = f"{entry['parameters']:,} parameters, {entry['bytes'] / 1e6:.2f} MB"
        yield f"weights    {name}{', the default' * entry['default']}: {size}"
        scores = list(entry["scores"].items())
        if verbose:
            run = entry["last_run"]
            yield f"           as ONNX {entry['onnx_bytes'] / 1e6:.2f} MB; {entry['file']}"
            yield f"  trained  {run.get('command', 'unknown')}"
            yield (
                f"           {run.get('people_seen', 0):,} people, {run.get('hours', 0):.2f} hours; all its runs "
                f"{entry['people_seen_in_all']:,} people, {entry['hours_in_all']:.2f} hours"
            )
            if "note" in run:
                yield f"           {run['note']}"
        measured_on = entry["scores"].get("measured on")
        for label, score in scores if verbose else scores[:1]:
            yield f"  score    {label}: {score}" + (f" ({measured_on})" if measured_on and not verbose else "")
    default_score, *counts = (facts["detector"].get(name, 0) for name in _CALIBRATION)
    yield (
        f"detector   default --min-score {default_score:.2f}, calibrated on {counts[0]} synthesized and {counts[1]} "
        "real scans"
    )
    if not verbose:
        yield "more       lidarpose info --verbose: training and all scores; --json: the same for programs"


def _models(options: argparse.Namespace) -> None:
    from lidarpose.train.networks import networks

    rows = networks()
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    print(f"{'name':10}{'size':16}{'joints':>6}{'frames':>8}{'parameters':>14}")
    for row in rows:
        print(f"{row['name']:10}{row['size']:16}{row['joints']:6}{row['frames']:8}{row['parameters']:14,}")


def _torch() -> str:
    if find_spec("torch") is None:
        return 'not installed, training and --device need it: in the clone, pip install ".[train]"'
    try:
        # torch may be installed and still fail to load its shared libraries
        import torch

        device = (
            torch.cuda.get_device_name() if torch.cuda.is_available() else f"cpu, {torch.get_num_threads()} threads"
        )
    except (ImportError, OSError, RuntimeError) as error:
        return f"{metadata.version('torch')}, which cannot be used ({' '.join(str(error).split())[:120]})"
    return f"{torch.__version__}, device {device}"


def _export(options: argparse.Namespace) -> None:
    from lidarpose.models import weights_path
    from lidarpose.models.export import FORMATS, export

    path = weights_path(options.weights)
    out = options.out or path.stem + FORMATS.get(options.format, "")
    export(path, out, format=options.format)
    tell(f"{path.name} -> {out} ({Path(out).stat().st_size / 1e6:.2f} MB)")


def _import(options: argparse.Namespace) -> None:
    from lidarpose.models.dapt.dapt_config import DaptConfig
    from lidarpose.models.dapt.import_weights import import_released

    header = import_released(options.file, options.out, config=options.config)
    tell(f"{cast(DaptConfig, header.config).name}, joints of {header.skeleton.name} -> {options.out}")
