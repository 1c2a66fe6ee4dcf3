"""Interface, file formats, bundled weights, samples and losses match those recorded in tests/goldens/*.json.

To change one of them on purpose, record it again with `python tests/test_goldens.py NAME` (interface, formats,
weights, samples or losses), add a line to the changelog, and give changed files a new schema.
"""

import contextlib
import inspect
import io
import json
import re
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from safetensors import safe_open

import lidarpose
from lidarpose.cli import main
from lidarpose.errors import InputError
from lidarpose.models import BUNDLED, DEFAULT, bundled_path
from lidarpose.skeleton import SMPL24
from lidarpose.synth.generator import Generator
from lidarpose.synth.street import street

FOLDER = Path(__file__).parent / "goldens"
SEED = 3
SCENES, INDICES, FRAMES = ("wild", "paper", "reference"), (0, 1, 2, 33, 70), 2
PEOPLE = [f"{scene} {index}" for scene in SCENES for index in INDICES]
PEOPLE += [f"clip, frame {frame}" for frame in range(FRAMES)] + ["street"]
# tolerances for other processors: m, m of a predicted joint, and points of a cloud at the edge of a body
POSITION, POSE, COUNT = 1e-3, 5e-4, 2


def recorded(name):
    return json.loads((FOLDER / f"{name}.json").read_text())


def printed(*arguments):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main([str(argument) for argument in arguments])
    return out.getvalue()


def differences(golden, found, path=""):
    """Yields removed and changed entries of a recorded tree; additions are ignored."""
    if isinstance(golden, dict) and isinstance(found, dict):
        for key, value in golden.items():
            if key in found:
                yield from differences(value, found[key], f"{path}/{key}")
            else:
                yield f"{path}/{key} is gone"
    elif golden != found:
        yield f"{path}: {golden} is now {found}"


# ---- the interface: commands and flags, public names and their parameters


def parameters(function):
    """Name -> position or "keyword", and whether it is optional."""
    kinds = {}
    for place, parameter in enumerate(inspect.signature(function).parameters.values()):
        by_position = parameter.kind is not inspect.Parameter.KEYWORD_ONLY
        optional = parameter.default is not inspect.Parameter.empty
        kinds[parameter.name] = f"{place if by_position else 'keyword'}{', optional' if optional else ''}"
    return kinds


def described(thing):
    if inspect.isclass(thing):
        members = {name: inspect.getattr_static(thing, name) for name in dir(thing) if not name.startswith("_")}
        members |= {field: None for field in getattr(thing, "__dataclass_fields__", ())}
        if issubclass(thing, Exception):
            return {"bases": {base.__name__: True for base in thing.__mro__[1:]}}
        return {
            "init": parameters(thing),
            "members": {name: parameters(one) if inspect.isfunction(one) else {} for name, one in members.items()},
        }
    return parameters(thing) if callable(thing) else {}


def commands():
    """Command -> flag -> whether it takes a value; "arguments" are those without a flag."""
    found = {}
    with mock.patch.dict("os.environ", COLUMNS="300"):
        for command in re.findall(r"^    ([a-z]+) ", printed("--help"), re.M):
            text = printed(command, "--help")
            options = re.findall(r"^  (-\S.*?)(?:  |$)", text, re.M)
            spellings = [spelling.split() for option in options for spelling in option.split(", ")]
            takes_value = {words[0]: len(words) > 1 for words in spellings}
            listed = re.search(r"^positional arguments:\n(.*?)(?:\n\n|\Z)", text, re.M | re.S)
            arguments = re.findall(r"^  \S+", listed[1], re.M) if listed else []
            found[command] = takes_value | {"arguments": len(arguments)}
    return found


def interface():
    public = {"lidarpose": lidarpose, "metrics": lidarpose.metrics, "evaluation": lidarpose.evaluation}
    names = {module: [name for name in dir(source) if not name.startswith("_")] for module, source in public.items()}
    names |= {module: public[module].__all__ for module in ("metrics", "evaluation")}
    return {
        "commands": commands(),
        **{
            module: {name: described(getattr(source, name)) for name in names[module]}
            for module, source in public.items()
        },
        "skeletons": {
            name: {"joints": list(skeleton.joints), "bones": [list(bone) for bone in skeleton.bones]}
            for name, skeleton in lidarpose.SKELETONS.items()
        },
    }  # fmt: skip


def test_interface_keeps_recorded_names():
    assert list(differences(recorded("interface"), interface())) == []


# ---- file formats: columns of Parquet files, keys of JSON files


def keys(tree):
    """The nested keys of a document; for a list of objects, those of the first one."""
    if isinstance(tree, dict):
        return {key: keys(value) for key, value in tree.items()}
    return {"[]": keys(tree[0])} if isinstance(tree, list) and tree and isinstance(tree[0], dict) else {}


def columns(folder):
    """Table -> column -> type, of the shards in a folder."""
    shards = {path.stem.partition("-")[0]: path for path in sorted(folder.glob("*.parquet"))}
    return {table: {field.name: str(field.type) for field in pq.read_schema(path)} for table, path in shards.items()}


def formats():
    import dataset_files

    found = {}
    with tempfile.TemporaryDirectory() as root:
        root = Path(root)
        raw = root / "raw"
        dataset_files.write_humanm3(raw, dataset_files.write_smpl(root / "smpl.npz"), sequences=("test/a",), frames=1)
        with contextlib.redirect_stderr(io.StringIO()):
            printed("synth", "--out", root / "streets", "-n", 1, "--scenes", "--sensor", "vlp-16")
            printed("prepare", "humanm3", raw, root / "prepared")
            printed("evaluate", "tiny", root / "prepared", "--out", root / "evaluation", "--split", "all")
            np.save(root / "crop.npy", Generator(scene="wild").person(SEED, 5).sample.points)
            printed("predict", root / "crop.npy", "--out", root)
        for folder in ("streets", "prepared"):
            found[folder] = columns(root / folder) | {
                "dataset.json": keys(json.loads((root / folder / "dataset.json").read_text()))
            }
        found["evaluation"] = columns(root / "evaluation")
        for path in (root / "evaluation" / "scores.json", root / "crop.poses.json"):
            document = json.loads(path.read_text())
            found[path.name] = {"schema": document["schema"], "keys": keys(document)}
    return found  # fmt: skip


def test_file_formats_keep_recorded_columns_and_keys():
    assert list(differences(recorded("formats"), formats())) == []


# ---- bundled weights


def weights():
    found = {}
    for path in map(bundled_path, sorted(BUNDLED)):
        with safe_open(str(path), framework="np") as file:
            tensors = {key: file.get_slice(key).get_shape() for key in file.keys()}
            entry = json.loads(file.metadata()["lidarpose"])
        assert entry["card"]["people_seen"] > 0 and entry["card"]["command"]
        # loading is strict: no tensor is missing or additional
        skeleton = lidarpose.load(path.stem, backend="torch").skeleton.name
        found[path.stem] = {"skeleton": skeleton, "tensors": tensors}
        found[path.stem] |= {key: entry[key] for key in ("schema", "network", "config")}
    return found


def test_bundled_weights_match_recorded_networks():
    assert list(differences(recorded("weights"), weights())) == []


# ---- poses that the bundled weights predict from a fixed cloud, with both backends

# a synthetic walking person of 221 points, 10 m from a VLP-32C; joints written by tools/ship_weights.py
GOLDEN_POSES = json.loads((FOLDER.parent / "golden_poses.json").read_text())


@pytest.mark.long
@pytest.mark.parametrize("backend", ["onnx", "torch"])
@pytest.mark.parametrize("name", BUNDLED)
def test_predict_matches_golden_pose(name, backend):
    model = lidarpose.load(name, backend=backend, tta=1)
    pose = model.predict(np.array(GOLDEN_POSES["points"]), sensor_origin=GOLDEN_POSES["sensor_origin"])
    np.testing.assert_allclose(pose.joints, GOLDEN_POSES["joints"][name], atol=POSE)


@pytest.mark.parametrize("name", BUNDLED)
def test_golden_pose_is_accurate(name):
    """The recorded joints are within 6 cm of the truth on average."""
    error = np.linalg.norm(np.array(GOLDEN_POSES["joints"][name]) - np.array(GOLDEN_POSES["truth"]), axis=-1)
    assert len(error) == len(SMPL24) and error.mean() < 0.06, f"{error.mean() * 1e3:.0f} mm"


def test_bundled_files_are_small():
    """The default weights and their ONNX file have at most 6.1 MB together, every file at most 12 MB."""
    sizes = {name: [bundled_path(name, end).stat().st_size for end in (".safetensors", ".onnx")] for name in BUNDLED}
    assert sum(sizes[DEFAULT]) < 6.1e6 and max(map(max, sizes.values())) < 12e6


# ---- synthetic people


def of_sample(sample):
    parts, counts = np.unique(sample.part, return_counts=True)
    middle = sample.points.mean(0) if len(sample.points) else np.zeros(3)
    return {
        "points": len(sample.points),
        "parts": dict(zip(map(str, parts.tolist()), counts.tolist(), strict=True)),
        "middle": middle.astype(float).round(4).tolist(),
        "center": sample.center.round(4).tolist(),
        "box": [*sample.box.center.round(4), *sample.box.size.round(4), round(sample.box.yaw, 4)],
        "joints": sample.pose.joints.astype(float).round(4).tolist(),
        "source": sample.source,
    }


def samples():
    people = {}
    for scene in SCENES:
        generator = Generator(scene=scene)
        for index in INDICES:
            person = generator.person(SEED, index)
            facts = {field.name: getattr(person.facts, field.name) for field in fields(person.facts)}
            people[f"{scene} {index}"] = of_sample(person.sample) | {"facts": facts}
    clip = Generator(scene="wild").clip(SEED, 0, frames=FRAMES)
    people |= {f"clip, frame {frame}": of_sample(person.sample) for frame, person in enumerate(clip)}
    scene = street(SEED, 0, sensor="vlp-16")
    (turn,) = scene.frames
    boxes = [[*box.center, *box.size, box.yaw] for box in turn.boxes]
    people["street"] = {
        "points": len(turn.points),
        "parts": {str(person): int((turn.person == person).sum()) for person in range(-1, len(turn.boxes))},
        "box": np.round(boxes, 4).tolist(),
        "joints": turn.joints.astype(float).round(4).tolist(),
        "source": scene.sensor,
    }
    return people


@pytest.fixture(scope="module")
def drawn():
    return samples()


@pytest.mark.parametrize("which", PEOPLE)
def test_generator_matches_golden_samples(drawn, which):
    golden, found = recorded("samples")[which], drawn[which]
    assert found["source"] == golden["source"]
    np.testing.assert_allclose(found["joints"], golden["joints"], atol=POSITION)
    np.testing.assert_allclose(found["box"], golden["box"], atol=POSITION)
    assert found["points"] == pytest.approx(golden["points"], abs=COUNT, rel=1e-3)
    for part in found["parts"] | golden["parts"]:
        assert found["parts"].get(part, 0) == pytest.approx(golden["parts"].get(part, 0), abs=COUNT, rel=1e-3), part
    if "middle" in golden:
        # one point more or less moves the mean of few points
        np.testing.assert_allclose(found["middle"], golden["middle"], atol=POSITION + 1.0 / golden["points"])
    for name, value in golden.get("facts", {}).items():
        assert found["facts"][name] == (pytest.approx(value, abs=0.02) if isinstance(value, float) else value), name


# ---- training


def losses():
    """Mean of each loss term over each of the first ten chunks of eight steps, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as root, mock.patch("lidarpose.train.setup.VALIDATION", 0):
        words = {"people": 160, "batch": 2, "workers": 0, "pictures": 0, "device": "cpu", "seed": SEED}
        options = [word for name, value in words.items() for word in (f"--{name}", value)]
        printed("pretrain", Path(root) / "run", *options)
        lines = [json.loads(line) for line in (Path(root) / "run" / "log.jsonl").read_text().splitlines()]
    torch.set_num_threads(threads)
    return {"tiny": {name: [line[name] for line in lines] for name in lines[0] if name not in ("people", "seconds")}}


@pytest.mark.long
def test_pretrain_matches_golden_losses():
    golden, found = recorded("losses")["tiny"], losses()["tiny"]
    assert set(golden) <= set(found) and len(golden["joints"]) == 10
    for name, values in golden.items():
        # rounding errors grow from step to step
        np.testing.assert_allclose(found[name][:5], values[:5], rtol=1e-3, atol=1e-4, err_msg=name)
        np.testing.assert_allclose(found[name], values, rtol=5e-2, atol=5e-3, err_msg=name)


# ---- errors

NOWHERE = "no/such/file"
BAD_CALLS = {
    "read_points of no file": lambda: lidarpose.read_points(f"{NOWHERE}.pcd"),
    "read_points of another suffix": lambda: lidarpose.read_points(__file__),
    "read_boxes of a number": lambda: lidarpose.read_boxes(5),
    "Box without a size": lambda: lidarpose.Box(center=[0, 0, 0], size=[1, 0, 1]),
    "Pose of another skeleton": lambda: lidarpose.Pose(joints=np.zeros((3, 3)), skeleton=lidarpose.SKELETONS["smpl24"]),
    "Sample of float64": lambda: lidarpose.Sample(points=np.zeros((3, 3)), center=np.zeros(3)),
    "sensor": lambda: lidarpose.sensor("vlp"),
    "sample_poses": lambda: lidarpose.sample_poses(-1, 0),
    "cast_rays in degrees": lambda: lidarpose.cast_rays(np.zeros((3, 3)), [[0, 1, 2]], [0.0], [45.0]),
    "load": lambda: lidarpose.load("tyni"),
    "load a file that is none": lambda: lidarpose.load(__file__),
    "load with a decoder": lambda: lidarpose.load("tiny", decode="mean"),
    "load with looks": lambda: lidarpose.load("tiny", tta=9),
    "predict an array": lambda: lidarpose.predict(np.zeros((9, 2))),
    "predict no file": lambda: lidarpose.predict(f"{NOWHERE}.npy"),
    "predict up": lambda: lidarpose.predict(f"{NOWHERE}.npy", up="w"),
    "export": lambda: lidarpose.export("tiny", "x.tflite", format="tflite"),
    "import_dapt": lambda: lidarpose.import_dapt(f"{NOWHERE}.safetensors"),
    "metrics of other shapes": lambda: lidarpose.metrics.mpjpe(np.zeros((2, 15, 3)), np.zeros((2, 14, 3))),
    "evaluate nothing": lambda: lidarpose.evaluation.run("tiny", []),
    "evaluate what is no network": lambda: lidarpose.evaluation.evaluate(5, "bench"),
    "table of nothing": lambda: lidarpose.evaluation.table([NOWHERE]),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_call_raises_input_error_of_one_line(case):
    with pytest.raises(InputError) as caught:
        BAD_CALLS[case]()
    assert isinstance(caught.value, ValueError) and "\n" not in str(caught.value)


GOLDENS = {"interface": interface, "formats": formats, "weights": weights, "samples": samples, "losses": losses}


def text_of(tree):
    """JSON with one line per entry of the first two levels."""
    parts = []
    for name, entries in tree.items():
        lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value, default=float)}" for key, value in entries.items())
        parts.append(f" {json.dumps(name)}: {{\n{lines}\n }}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


if __name__ == "__main__":
    for chosen in sys.argv[1:] or GOLDENS:
        (FOLDER / f"{chosen}.json").write_text(text_of(GOLDENS[chosen]()))
