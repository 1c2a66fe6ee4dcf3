"""`lidarpose predict` and `lidarpose demo`."""

import argparse
import os
from contextlib import ExitStack
from pathlib import Path

from lidarpose.cli.terminal import is_watched, tell
from lidarpose.models import DEFAULT, NAMES

# people named by a warning that several share, and characters of an id
_MOST_NAMED, _LONGEST_ID = 3, 40


def add(commands) -> None:
    """Adds the commands to the parser's."""
    predict = commands.add_parser(
        "predict",
        help="estimate the poses of the people in a point file",
        description="Writes STEM.poses.json: every person's joints, in metres and in the file's own frame.",
    )
    predict.set_defaults(run=_predict)
    predict.add_argument("file", help=".pcd .ply .bin .npy .npz .csv .xyz .txt")
    predict.add_argument(
        "--boxes",
        metavar="FILE",
        help='people to find: {"people": [{"center": [x,y,z], "size": [l,w,h], "yaw": rad}]}, .npy rows, KITTI labels',
    )
    predict.add_argument(
        "--crop", action="store_true", help="the file holds one person (assumed when it is under 4 m across)"
    )
    predict.add_argument(
        "--sensor-origin",
        metavar="X,Y,Z",
        help="sensor position, or unknown (default: 0,0,0 with --boxes, unknown otherwise)",
    )
    predict.add_argument(
        "--skeleton", metavar="NAME", help="smpl24, human15, waymo14 or body26 (default smpl24, else the network's own)"
    )
    predict.add_argument(
        "--up",
        default="z",
        metavar="AXIS",
        help="what is up in the file: z (default), y or x, -y where y points down (cameras), or a direction x,y,z",
    )
    predict.add_argument(
        "--columns", type=int, metavar="N", help="values per point in a .bin: 4 for KITTI, 5 for nuScenes"
    )
    predict.add_argument(
        "--out",
        default=".",
        metavar="DIR|FILE.json",
        help="folder or file for the results (default: the current folder); - prints the JSON",
    )
    predict.add_argument("--picture", action="store_true", help="also draw STEM.poses.png, or FILE.png")
    predict.add_argument(
        "--weights",
        default=DEFAULT,
        metavar="NAME|FILE",
        help=f"{NAMES}, a checkpoint, or an exported .onnx",
    )
    predict.add_argument(
        "--backend",
        metavar="NAME",
        help="onnx or torch (default onnx for bundled weights and .onnx, torch for .safetensors and other devices)",
    )
    predict.add_argument("--device", default="cpu", metavar="NAME", help="cpu (default), or cuda (backend torch)")
    predict.add_argument(
        "--decode", default="window", metavar="NAME", help="how heatmaps are decoded: window (default), argmax or dark"
    )
    predict.add_argument(
        "--tta",
        type=int,
        metavar="N",
        help="test-time augmentation: average N looks at each person, 1 to 8 (default 4)",
    )

    demo = commands.add_parser(
        "demo",
        help="show people seen by three LiDARs, true and predicted",
        description="Synthesizes people, predicts their poses and writes an interactive 3D report.",
    )
    demo.set_defaults(run=_demo)
    demo.add_argument("--out", default="lidarpose-demo", metavar="DIR", help="folder (default lidarpose-demo)")
    demo.add_argument("--seed", type=int, default=7, metavar="N", help="random seed (default 7)")
    demo.add_argument("--weights", default=DEFAULT, metavar="NAME|FILE", help=f"{NAMES}, or a checkpoint")


def _predict(options: argparse.Namespace) -> None:
    from lidarpose.inference.predict_file import predict
    from lidarpose.inference.predictor import TTA, load
    from lidarpose.io.files import atomic_path, check_apart, check_writable

    file = Path(options.file)
    to_stdout = options.out == "-"
    out = Path("." if to_stdout else options.out)
    result = out if _is_json(options.out) else out / f"{file.stem}.poses.json"
    json_path = None if to_stdout else str(result)
    picture_path = str(result.with_suffix(".png")) if options.picture else None
    for path in filter(None, (json_path, picture_path)):
        check_apart(path, options.file, options.boxes, options.weights)
        # before the work
        check_writable(path)
    choices = {"backend": options.backend, "device": options.device, "decode": options.decode}
    choices["tta"] = TTA if options.tta is None else options.tta
    poses = predict(
        options.file,
        boxes=options.boxes,
        crop=options.crop,
        sensor_origin=options.sensor_origin,
        skeleton=options.skeleton,
        up=options.up,
        columns=options.columns,
        # loaded once the input has proved readable
        model=lambda: load(options.weights, **choices),
        progress=is_watched(),
    )
    outputs: dict[str, bytes] = {}
    if json_path is not None:
        outputs[json_path] = poses.to_json().encode()
    if picture_path is not None:
        outputs[picture_path] = poses.picture(title=file.name)
    # all of them or none
    with ExitStack() as stack:
        for path, content in outputs.items():
            stack.enter_context(atomic_path(path)).write_bytes(content)
    if to_stdout:
        print(poses.to_json(), end="")
    for line in _warnings(poses):
        tell(f"lidarpose: warning: {line}")
    seen = sum(person.pose is not None for person in poses)
    where = f" -> {' and '.join(outputs)}" if outputs else ""
    tell(f"{seen} of {len(poses)} people, {poses.timing_ms['per_person']:.0f} ms each{where}")


def _is_json(out: str) -> bool:
    """Whether results go to this file, not into a folder."""
    # os.path says no where a name is too long, which is told when it is written
    return Path(out).suffix.lower() == ".json" and not out.endswith(("/", os.sep)) and not os.path.isdir(out)


def _warnings(poses) -> list[str]:
    """The input's warnings, and each of the people's once with the ids of those it is about."""
    from lidarpose.io.files import shorten

    shared: dict[str, list[str]] = {}
    for person in poses:
        for warning in person.warnings:
            shared.setdefault(warning, []).append(shorten(str(person.id), _LONGEST_ID))
    lines = list(poses.warnings)
    for warning, ids in shared.items():
        more = f" and {len(ids) - _MOST_NAMED} more" if len(ids) > _MOST_NAMED else ""
        who = "person" if len(ids) == 1 else "people"
        lines.append(f"{who} {', '.join(ids[:_MOST_NAMED])}{more}: {warning}")
    return lines


def _demo(options: argparse.Namespace) -> None:
    from lidarpose.cli.demo import run

    run(options.out, seed=options.seed, weights=options.weights)
