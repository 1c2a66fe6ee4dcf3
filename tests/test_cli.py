"""The command line: results, and errors of one line with exit code 2."""

import argparse
import functools
import io
import json
import os
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
from hostile_files import CALIBRATION, KITTI
from safetensors.numpy import load_file, save_file

import lidarpose
from lidarpose import progress
from lidarpose.cli import demo, main, predicting
from lidarpose.errors import InputError
from lidarpose.inference import predictor
from lidarpose.models import BUNDLED, DEFAULT, bundled_path, weights_file
from lidarpose.models.checkpoint import DIGEST, SafetensorsFile, read_header, runs_of
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.viz import contact_sheet

DAPT = Path(__file__).parent / "parity" / "dapt_tiny.safetensors"
EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


@pytest.fixture(scope="module")
def points():
    return Generator(scene=scene_config("wild").eased(0.0)).person(3, 5).sample.points


@pytest.fixture(scope="module", autouse=True)
def bundled_networks():
    """Load each bundled network once for all commands of this process."""
    cached = functools.cache(predictor.load)

    def load(weights=DEFAULT, **choices):
        return (cached if weights in BUNDLED else predictor_load)(weights, **choices)

    predictor_load = predictor.load
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(predictor, "load", load)
        yield


@pytest.fixture
def crop(tmp_path, points):
    path = tmp_path / "crop.npy"
    np.save(path, points)
    return path


@pytest.fixture
def boxes(tmp_path, points):
    low, high = points.min(0), points.max(0)
    box = {"center": ((low + high) / 2).tolist(), "size": (high - low + 0.1).tolist(), "yaw": 0.0, "id": "a"}
    return write(tmp_path / "boxes.json", json.dumps({"people": [box]}))


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def write(path, content):
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def run(*arguments):
    """The exit code, returned by the command or raised by argparse."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as exit:
        return exit.code


def one_line(capsys):
    """Assert that a failed command printed one line, on stderr, and return it."""
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("lidarpose: error: ") and captured.err.count("\n") == 1, captured.err
    return captured.err


# ---- valid commands


def _ply(points):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    return (head + "property float z\nend_header\n").format(len(points)).encode() + points.astype("<f4").tobytes()


FORMATS = {
    "a.ply": (_ply, []),
    "a.PLY": (_ply, []),
    "b.bin": (lambda p: np.pad(p, ((0, 0), (0, 2))).astype("<f4").tobytes(), ["--columns", 5]),
    "a.csv": (lambda p: "x,y,z\n" + "\n".join(",".join(map(str, row)) for row in p.tolist()), []),
}


def test_predict_gives_same_pose_for_all_formats(tmp_path, out, crop, points):
    results = []
    for name, (content, options) in {"crop.npy": (None, []), **FORMATS}.items():
        file = write(tmp_path / name, content(points)) if content else crop
        assert run("predict", file, "--out", out, "--tta", 1, *options) == 0
        results.append(json.loads((out / f"{file.stem}.poses.json").read_text()))
        assert results[-1]["source"] == str(file)
        np.testing.assert_allclose(results[-1]["people"][0]["joints"], results[0]["people"][0]["joints"], atol=1e-3)


@pytest.mark.parametrize(
    "words, written, is_printed",
    [
        ("", ["crop.poses.json"], False),
        ("--out -", [], True),
        ("--out - --picture", ["crop.poses.png"], True),
        ("--out a/one.JSON --picture", ["a/one.JSON", "a/one.png"], False),
        ("--out a.CSV --picture --html", ["a.CSV", "a.html", "a.png"], False),
        # a path is a folder if it exists as one or ends with a slash, whatever its suffix
        ("--out b.json", ["b.json/crop.poses.json"], False),
        ("--out c.csv/", ["c.csv/crop.poses.json"], False),
    ],
)
def test_predict_writes_results_to_out(crop, tmp_path, monkeypatch, capsys, words, written, is_printed):
    here = tmp_path / "here"
    (here / "b.json").mkdir(parents=True)
    write(here / "crop.poses.json", "an older result")
    monkeypatch.chdir(here)
    assert run("predict", crop, "--tta", 1, *words.split()) == 0
    text = capsys.readouterr().out
    assert json.loads(text)["schema"] == "lidarpose.poses/1" if is_printed else text == ""
    files = {path.relative_to(here).as_posix(): path.read_bytes() for path in here.rglob("*") if path.is_file()}
    if "crop.poses.json" not in written:
        assert files.pop("crop.poses.json") == b"an older result"
    assert sorted(files) == written
    for name, content in files.items():
        if name.endswith("png"):
            assert content.startswith(b"\x89PNG")
        elif name.endswith("html"):
            assert content.startswith(b"<!doctype html>") and b'data-person="0"' in content
        elif name.endswith("CSV"):
            table = pandas.read_csv(io.BytesIO(content))
            assert len(table) == 24 and {"id", "joint", "x", "y", "z", "confidence"} <= set(table.columns)
        else:
            assert json.loads(content)["people"]


def test_predict_with_boxes_and_skeleton(crop, boxes, out, capsys):
    words = ["--skeleton", "waymo14", "--sensor-origin", "-1.5,0,2"]
    assert run("predict", crop, "--boxes", boxes, "--out", out, *words) == 0
    (person,) = json.loads((out / "crop.poses.json").read_text())["people"]
    assert person["id"] == "a" and len(person["joints"]) == 14
    assert "1 of 1 person" in capsys.readouterr().err


def test_predict_combines_warnings_of_people_without_pose(crop, tmp_path, out, capsys):
    assert run("predict", write(tmp_path / "a.xyz", "0 0 0\n0 0 1\n"), "--out", out) == 0
    assert "person 0: no pose: under 5 points" in capsys.readouterr().err
    empty = [{"center": [90 + i, 0, 0], "size": [1, 1, 1], "id": f"p{i}"} for i in range(5)]
    assert run("predict", crop, "--boxes", write(tmp_path / "b.json", json.dumps(empty)), "--out", out) == 0
    err = capsys.readouterr().err
    assert "warning: people p0, p1, p2 and 2 more: no pose: under 5 points\n" in err
    assert "warning: no box holds 5 points" in err and "0 of 5 people" in err
    people = json.loads((out / "crop.poses.json").read_text())["people"]
    assert [person["joints"] for person in people] == [None] * 5 and people[0]["warnings"]


def test_info_prints_short_verbose_and_json(capsys):
    printed = {}
    for flag in ("", "-v", "--json"):
        assert run("info", *flag.split()) == 0
        printed[flag] = capsys.readouterr().out
    facts = json.loads(printed["--json"])
    assert facts["lidarpose"] == lidarpose.__version__ and facts["threads"] > 0 and "device" in facts["torch"]
    assert set(facts["weights"]) == set(BUNDLED) and len(printed[""].splitlines()) <= 10
    for name, entry in facts["weights"].items():
        assert entry["default"] == (name == DEFAULT) and Path(entry["file"]).stat().st_size == entry["bytes"]
        assert entry["people_seen_in_all"] > entry["last_run"]["people_seen"] and entry["scores"]
        for text in (printed[""], printed["-v"]):
            size = f"{entry['parameters']:,} parameters, {entry['bytes'] / 1e6:.2f} MB"
            assert f"{name}{', the default' * entry['default']}: {size}" in text
        for label, score in entry["scores"].items():
            assert f"{label}: {score}" in printed["-v"]
        assert entry["last_run"]["command"] in printed["-v"] and entry["last_run"]["command"] not in printed[""]
        label, score = next(iter(entry["scores"].items()))
        assert f"{label}: {score} ({entry['scores']['measured on']})\n" in printed[""]
    detector = facts["detector"]
    counts = f"{detector['calibrated_on']} synthesized and {detector['labeled_scans']} real scans"
    assert f"default --min-score {detector['default_score']:.2f}, calibrated on {counts}\n" in printed[""]


def test_info_sums_people_of_all_runs(monkeypatch, capsys):
    before = {"people_seen": 1_000, "hours": 1.25}
    header = SimpleNamespace(card={"people_seen": 500, "hours": 0.5, "init_card": before})
    monkeypatch.setattr("lidarpose.models.checkpoint.read_header", lambda path: header)
    assert run("info", "--verbose") == 0
    assert "  500 people, 0.50 hours; all its runs 1,500 people, 1.75 hours" in capsys.readouterr().out


def test_random_initial_weights_are_no_run():
    card = {"command": "lidarpose finetune", "init_card": {}}
    assert runs_of(card) == [card] and runs_of(card | {"init_card": card}) == [card | {"init_card": card}, card]
    for _ in range(2_000):
        card = {"init_card": card}
    assert len(runs_of(card)) == 2_001


def test_info_of_a_card_with_wrong_types(monkeypatch, capsys):
    header = read_header(bundled_path("tiny"))
    card = {"hours": "x", "people_seen": "many", "command": 7, "init_card": {"hours": 10**400, "people_seen": 5}}
    monkeypatch.setattr("lidarpose.models.checkpoint.read_header", lambda path: replace(header, card=card))
    assert run("info", "tiny") == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines == [
        "trained  7",
        " " * 9 + "unknown length, 0.00 hours",
        "trained  unknown",
        " " * 9 + "5 people, 0.00 hours",
    ]


def test_info_of_checkpoint_prints_network_and_runs(capsys):
    path = bundled_path("tiny")
    card = read_header(path).card
    assert run("info", path, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["config"] == json.loads(json.dumps(read_header(path).config.to_dict()))
    assert [entry["command"] for entry in facts["runs"]] == [entry["command"] for entry in runs_of(card)]
    assert run("info", "tiny") == 0
    text = capsys.readouterr().out
    assert f"tiny, {facts['parameters']:,} parameters" in text
    assert f"trained  {card['command']}\n         {card['people_seen']:,} people, {card['hours']:.2f} hours" in text
    assert run("info", "nowhere.safetensors") == 2
    capsys.readouterr()
    exported = path.with_suffix(".onnx")
    assert run("info", exported) == 0
    assert capsys.readouterr().out.startswith(f"{exported}: tiny, exported, written by lidarpose ")


@pytest.mark.long
def test_predict_selects_backend_decoder_and_tta(crop, capsys):
    results = {}
    for words in ("", "--backend onnx", "--backend torch", "--decode argmax", "--decode dark", "--tta 2"):
        assert run("predict", crop, "--out", "-", *words.split()) == 0
        document = json.loads(capsys.readouterr().out)
        model = document["model"]
        results[words] = np.array(document["people"][0]["joints"])
        assert model["backend"] == ("torch" if "torch" in words else "onnx")
        assert model["decode"] == (words.split()[1] if "--decode" in words else "window")
        assert model.get("tta") == {"--tta 2": 2}.get(words)
    np.testing.assert_allclose(results["--backend torch"], results[""], atol=1.1e-4)
    np.testing.assert_array_equal(results["--backend onnx"], results[""])
    assert not np.array_equal(results["--decode argmax"], results[""])


@pytest.mark.parametrize(
    "words, name, format, out",
    [
        ([], DEFAULT, "onnx", f"{DEFAULT}.onnx"),
        (["tiny", "--format", "torch"], "tiny", "torch", "tiny.pt2"),
        (["runs/mine.safetensors", "--out", "deep/a.bin"], "mine", "onnx", "deep/a.bin"),
    ],
)
def test_export_chooses_output_file(tmp_path, monkeypatch, capsys, words, name, format, out):
    # the content is tested elsewhere, because an export takes long
    def export(weights, out, *, format):
        called.append((Path(weights).stem, format, str(out)))
        Path(out).parent.mkdir(exist_ok=True)
        Path(out).write_bytes(bytes(1_500_000))

    called = []
    monkeypatch.setattr("lidarpose.models.export.export", export)
    monkeypatch.chdir(tmp_path)
    assert run("export", *words) == 0
    assert called == [(name, format, out)]
    assert f"{name}.safetensors -> {out} (1.50 MB)" in capsys.readouterr().err


@pytest.mark.long
def test_predict_with_imported_released_weights(crop, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("import", DAPT, "mine.safetensors") == 0
    assert "joints of waymo14 -> mine.safetensors" in capsys.readouterr().err
    assert run("predict", crop, "--weights", "mine.safetensors") == 0
    document = json.loads((tmp_path / "crop.poses.json").read_text())
    assert document["skeleton"]["name"] == "waymo14" and len(document["people"][0]["joints"]) == 14
    capsys.readouterr()
    assert run("predict", crop, "--weights", "mine.safetensors", "--skeleton", "smpl24", "--out", "new") == 2
    assert "waymo14 has no pelvis" in one_line(capsys)
    assert run("export", "mine.safetensors") == 2
    line = one_line(capsys)
    assert "cannot be exported as onnx: run it with torch, or export one of the package's own networks" in line
    assert run("import", "mine.safetensors", "again.safetensors", "--config", "waymo") == 2
    assert "tensor " in one_line(capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["crop.npy", "crop.poses.json", "mine.safetensors"]


def test_predict_reads_kitti_calibration_from_calib_option(crop, tmp_path, out, capsys):
    label, calib = write(tmp_path / "label.txt", KITTI), write(tmp_path / "mine.txt", CALIBRATION)
    assert run("predict", crop, "--boxes", label, "--out", out) == 2
    assert "expected its calibration at" in one_line(capsys)
    assert run("predict", crop, "--boxes", label, "--calib", calib, "--out", out) == 0
    (person,) = json.loads((out / "crop.poses.json").read_text())["people"]
    # 8.41 m in front of the camera is 8.41 m along the LiDAR's x
    assert person["box"]["center"][0] == pytest.approx(8.41)


def test_results_of_pcd_bin_files_are_named_like_frames(points, out):
    """So that --boxes FOLDER finds them by the frames' ids."""
    path = out.parent / "top.pcd.bin"
    path.write_bytes(np.pad(points, ((0, 0), (0, 2))).astype(np.float32).tobytes())
    assert run("predict", path, "--crop", "--out", out) == 0 and run("detect", path, "--out", out) == 0
    assert sorted(file.name for file in out.iterdir()) == ["top.boxes.json", "top.poses.json"]


# ---- errors


def test_commands_never_overwrite_input_files(crop, boxes, tmp_path, capsys):
    """Given by the same path, by a link, or as a default name."""
    default = boxes.rename(tmp_path / "crop.poses.json")
    weights = tmp_path / "mine.safetensors"
    weights.write_bytes(bundled_path("tiny").read_bytes())
    link = tmp_path / "link.onnx"
    link.symlink_to(weights)
    for words in (
        ("predict", crop, "--boxes", default, "--out", tmp_path),
        ("predict", crop, "--boxes", default, "--out", default),
        ("export", weights, "--out", weights),
        ("export", weights, "--format", "torch", "--out", link),
        ("import", DAPT, DAPT),
    ):
        files = [Path(word) for word in words if isinstance(word, Path) and word.is_file()]
        before = [path.read_bytes() for path in files]
        assert run(*words) == 2
        assert "is also an input file" in one_line(capsys)
        assert [path.read_bytes() for path in files] == before
    # printing the result is allowed
    assert run("predict", crop, "--boxes", default, "--out", "-") == 0


@pytest.mark.long
def test_warning_of_weights_file_is_one_line_without_source(crop, tmp_path, out):
    file = SafetensorsFile.open(bundled_path("tiny"))
    metadata = {name: text for name, text in file.metadata.items() if name != DIGEST}
    save_file(load_file(bundled_path("tiny")), tmp_path / "older.safetensors", metadata=metadata)
    command = [sys.executable, "-m", "lidarpose", "predict", crop, "--crop", "--out", out]
    command += ["--weights", tmp_path / "older.safetensors"]
    first = subprocess.run(command, capture_output=True, text=True).stderr.splitlines()[0]
    assert re.fullmatch("lidarpose: warning: .*older.safetensors: has no digest, so damage .*", first)
    assert subprocess.run([*command, "--quiet"], capture_output=True, text=True).stderr == ""


def test_warnings_escape_and_shorten_ids(crop, tmp_path, out, capsys):
    far = {"center": [500, 0, 0], "size": [1, 1, 1]}
    forged = write(
        tmp_path / "b.json", json.dumps([far | {"id": "a\nlidarpose: error: b \x1b[31m"}, far | {"id": "7" * 3000}])
    )
    assert run("predict", crop, "--boxes", forged, "--out", out) == 0
    err = capsys.readouterr().err
    assert all(line.startswith(("lidarpose: warning: ", "0 of 2 people")) for line in err.splitlines())
    assert "\x1b" not in err and max(map(len, err.splitlines())) < 400


def test_predict_with_closed_stderr_or_stdout(crop, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", None)
        assert run("predict", crop, "--crop", "--out", "-") == 0
    assert len(json.loads(capsys.readouterr().out)["people"]) == 1
    monkeypatch.setattr(sys, "stdout", None)
    assert run("predict", crop, "--crop", "--out", "-") == 2
    assert "standard output, which is closed" in capsys.readouterr().err


def test_output_escapes_characters_missing_in_encoding(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="cp932"))
    monkeypatch.setattr(contact_sheet, "draw_dataset", lambda *args, **more: Path(os.fsdecode(b"caf\xe9 \xc2\xb7.png")))
    assert run("view", "streetlife") == 0
    assert written.getvalue().split() == [rb"caf\udce9", rb"\xb7.png"]


def test_out_of_memory_is_one_line(monkeypatch, capsys):
    # more than any machine has
    monkeypatch.setattr(contact_sheet, "draw_dataset", lambda *args, **more: np.empty(2**60, np.uint8))
    assert run("view", "streetlife") == 2
    assert "out of memory (Unable to allocate 1.00 EiB" in one_line(capsys)


@pytest.mark.filterwarnings("error")
def test_predict_warns_of_rounded_map_coordinates(crop, points, tmp_path, out, capsys):
    far = points + [500_000.0, 4_676_500.0, 0.0]
    for name, dtype, is_warned in (("narrow", np.float32, True), ("wide", np.float64, False)):
        np.save(tmp_path / f"{name}.npy", far.astype(dtype))
        assert run("predict", tmp_path / f"{name}.npy", "--crop", "--out", out) == 0
        assert capsys.readouterr().err.count("coordinates are rounded to 0.5 m") == is_warned


@pytest.mark.parametrize("scale, words", [(1e30, ""), (1e30, "--crop"), (1.7e308, "--boxes"), (1.7e308, "")])
def test_predict_rejects_or_drops_absurd_coordinates(crop, points, boxes, tmp_path, out, capsys, scale, words):
    flags = [words, boxes] if words == "--boxes" else words.split()
    np.save(tmp_path / "far.npy", np.resize([scale, -scale], (10, 3)))
    assert run("predict", tmp_path / "far.npy", *flags, "--out", out) == 2
    line = one_line(capsys)
    assert "expected points in meters, got only coordinates beyond 1,000,000,000 m" in line and len(line) < 300
    # among valid points they are dropped
    np.save(tmp_path / "some.npy", np.concatenate([points, np.full((3, 3), scale)]))
    assert run("predict", tmp_path / "some.npy", *flags, "--out", out) == 0
    assert f"dropped 3 of {len(points) + 3} points" in capsys.readouterr().err


def test_deeply_nested_json_is_one_line(tmp_path, capsys):
    deep = "[" * 100_000
    folder = tmp_path / "run"
    folder.mkdir()
    write(folder / "config.json", deep)
    assert run("pretrain", folder, "--resume") == 2
    assert "damaged" in one_line(capsys)
    save_file({"a": np.zeros(1)}, tmp_path / "deep.safetensors", metadata={"lidarpose": deep})
    assert run("export", tmp_path / "deep.safetensors", "--out", tmp_path / "x.onnx") == 2
    assert "its header cannot be read" in one_line(capsys)


# ---- invalid commands and files: (command, words of the error)

BAD_FILES = {
    "a.pcap": b"abcd",
    "a.obj": b"o x\nv 0 0 0\n",
    "cut.ply": _ply(np.zeros((99, 3)))[:-40],
    "nan.xyz": "nan nan nan\n" * 9,
    "word.txt": "1 2 3\n4 five 6\n",
    "latin.txt": b"1 2 3 \xe9\n",
    "keys.json": "{people: []}",
    "five.json": "5",
    "size.json": '{"people": [{"size": [1, 1, 1]}]}',
    "far.json": '[{"center": [1e300, 1, 1], "size": [1, 1, 1]}]',
}

BAD_COMMANDS = {
    "a recording": ("detect DIR/a.pcap", "got a recording (.pcap): read it with lidarpose predict"),
    "the standard input": ("predict -", "the standard input is not read"),
    "unknown suffix": ("predict DIR/a.obj --crop", ".pcd .ply"),
    "truncated": ("predict DIR/cut.ply --crop", "cut off"),
    "all NaN": ("predict DIR/nan.xyz --crop", "finite"),
    "a word": ("predict DIR/word.txt --crop", "five"),
    "boxes: no JSON": ("predict CROP --boxes DIR/keys.json", "line 1"),
    "boxes: a number": ("predict CROP --boxes DIR/five.json", "people"),
    "boxes: no center": ("predict CROP --boxes DIR/size.json", 'people[0]: expected the key "center"'),
    "boxes: far off": ("predict CROP --boxes DIR/far.json", "people[0].center"),
    "unknown command": ("predikt CROP", "predikt"),
    "no file": ("predict", "FILE"),
    "missing file": ("predict DIR/crob.npy", "did you mean crop.npy"),
    "a folder": ("detect DIR", "got a folder: give a file in it, or read all of it with lidarpose predict"),
    "boxes that are points": ("predict CROP --boxes DIR/latin.txt", "expected boxes as JSON in UTF-8, .npy rows or"),
    "bad passes before a bad file": ("predict DIR/crob.npy --tta 99", "tta must be"),
    "bad skeleton before a bad file": ("predict DIR/crob.npy --skeleton coco", "unknown skeleton"),
    "bad weights before a bad file": ("predict DIR/crob.npy --weights nope", "unknown bundled weights"),
    "boxes missing": ("predict CROP --boxes DIR/no.json", "no.json: no such file"),
    "boxes a folder": ("predict CROP --boxes DIR", "got a folder"),
    "both": ("predict CROP --crop --boxes BOXES", "got both"),
    "up": ("predict CROP --up w", "expected z, y, x, -z, -y, -x or a direction x,y,z, got 'w'"),
    "up direction": ("predict CROP --up -1,0", "expected z, y, x, -z, -y, -x or a direction x,y,z, got '-1,0'"),
    "up that points down": ("predict DIR/crob.npy --up -y", "did you mean crop.npy"),
    "up of no length": ("predict CROP --up 0,0,0", "or a direction x,y,z, got '0,0,0'"),
    "skeleton": ("predict CROP --skeleton smpl42", "did you mean smpl24"),
    "origin": ("predict CROP --sensor-origin 1,2", "x,y,z"),
    "signed origin": ("predict CROP --sensor-origin -1,a,2", "x,y,z"),
    "columns": ("predict CROP --columns 2", "columns"),
    "columns text": ("predict CROP --columns four", "four"),
    "weights file": ("predict CROP --weights CROP", "safetensors"),
    "weights missing": ("predict CROP --weights no/such.safetensors", "does not exist"),
    "device without numbers": ("predict CROP --device meta", "device 'meta' cannot be used"),
    "onnx file": ("predict CROP --weights BOXES --backend onnx", "something else"),
    "export what": ("export tyni", "did you mean tiny"),
    "export how": ("export --format tflite --out DIR/x", "known are onnx, torch"),
    "export nothing": ("export no/such.safetensors --out DIR/x.onnx", "does not exist"),
    "import nothing": ("import no/such.safetensors DIR/x.safetensors", "does not exist"),
    "import a missing pickle": ("import weights.pth DIR/x.safetensors", "does not exist"),
    "import as": ("import DAPT DIR/x.safetensors --config kitti", "waymo"),
    "import into another kind": ("import DAPT DIR/x.onnx", "give a name that ends in .safetensors"),
    "import without an out": ("import DAPT", "OUT"),
    "a calibration of no boxes": ("predict CROP --calib DIR/c.txt", "calib is for boxes"),
    "a calibration of no file": ("predict CROP --boxes BOXES --calib DIR/c.txt", "no such file; expected KITTI's"),
    "weights that pose nobody": (
        f"predict CROP --weights {weights_file('verifier.onnx')}",
        "contains a detection network",
    ),
    "a checkpoint for a detector": (
        f"evaluate detector heldout --detector {weights_file('detector.safetensors')} --out DIR/x",
        "expected an ONNX file, got a checkpoint",
    ),
    "unknown option": ("predict CROP --picure", "--picure"),
    "demo seed": ("demo --seed -1 --out DIR/d", "seed"),
    "demo weights": ("demo --weights tyni --out DIR/d", "did you mean tiny"),
    "demo into a file": ("demo --out CROP", "expected a folder, got"),
    "out of another kind": ("predict CROP --out DIR/x.parquet", "expected a folder or a file .json or .csv"),
    **{
        f"a folder named as a file: {words.split()[0]}": (f"{words} DIR/x.csv", "expected a folder, got")
        for words in (
            *("demo --out", "synth -n 2 --out", "prepare waymo raw", "pretrain", "finetune people --out"),
            *("train-detector", "evaluate small bench --out", "paper table1 --out"),
        )
    },
    "out of an unknown kind": ("predict CROP --out DIR/x.tsv", "expected a folder or a file .json or .csv"),
    "out is a file": ("predict CROP --out CROP", "got .npy"),
    "out below a file": ("predict CROP --out CROP/deep", "cannot write"),
    "out of a long name": (f"predict CROP --out {'x' * 300}.json", "choose a shorter name"),
    "out in a place of no files": ("predict CROP --out /proc/nothing", "cannot write"),
}


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_invalid_commands_are_one_line(crop, boxes, tmp_path, capsys, monkeypatch, case):
    words, expected = BAD_COMMANDS[case]
    monkeypatch.chdir(tmp_path)
    files = [write(tmp_path / name, content) for name, content in BAD_FILES.items() if f"DIR/{name}" in words]
    before = sorted(tmp_path.iterdir())
    for name, path in {"DIR": tmp_path, "CROP": crop, "BOXES": boxes, "DAPT": DAPT}.items():
        words = words.replace(name, str(path))
    assert run(*words.split()) == 2
    line = one_line(capsys)
    assert expected in line and all(str(file) in line for file in files)
    assert sorted(tmp_path.iterdir()) == before


def test_predict_checks_output_before_predicting(crop, out, monkeypatch, capsys):
    monkeypatch.setattr(predictor.Predictor, "predict_in", lambda *_, **__: pytest.fail("predicted first"))
    (out / "crop.poses.png").mkdir(parents=True)
    for folder, words in ((crop / "deep", "cannot write"), (out, "crop.poses.png")):
        assert run("predict", crop, "--out", folder, "--picture") == 2
        assert words in one_line(capsys)
    # no JSON is written without its picture
    assert [path.name for path in out.iterdir()] == ["crop.poses.png"]


def test_failed_demo_leaves_no_files(out, monkeypatch, capsys):
    there = []

    def load(*_, **__):
        there.extend(out.parent.rglob(f"{out.name}*"))
        raise InputError("stopped")

    monkeypatch.setattr(demo, "load", load)
    assert run("demo", "--out", out) == 2 and "stopped" in one_line(capsys) and there == []


# ---- as a program


def printing(crop):
    return f"import sys; from lidarpose.cli import main; sys.exit(main(['predict', {str(crop)!r}, '--out', '-']))"


def test_closed_pipe_is_no_error(crop):
    # buffered, so that the broken pipe is noticed only at exit
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": {**os.environ, "PYTHONUNBUFFERED": ""}}
    child = subprocess.Popen([sys.executable, "-c", printing(crop)], text=True, **settings)
    child.stdout.close()
    assert "Traceback" not in (err := child.stderr.read()) and "Exception ignored" not in err
    child.stderr.close()
    assert child.wait(60) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device here")
def test_full_output_device_is_one_line(crop):
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", printing(crop)], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and "error: cannot write the output (No space left on device)" in done.stderr
    assert "Traceback" not in done.stderr


def test_python_m_lidarpose_runs_command_line():
    done = subprocess.run([sys.executable, "-m", "lidarpose", "predict", "no.pcd"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


def test_demo_writes_pictures_and_prints_table(out, capsys):
    assert run("demo", "--out", out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["hdl-64e.png", "index.html", "os1-128.png", "vlp-32c.png"]
    lines = capsys.readouterr().out.splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("LiDAR"))
    for word in ("points", "distance", "MPJPE"):
        assert word in lines[head]
    assert len(lines) == head + 1 + 12 + 2 and lines[head + 13].endswith("ms per person")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example), run_name="__main__")
    assert any(path.suffix == ".png" for path in tmp_path.iterdir())
    assert "wrote" in capsys.readouterr().out


def test_notebook_runs_and_contains_no_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((EXAMPLES[0].parent / "03_notebook.ipynb").read_text("utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    names = {}
    for cell in cells:
        exec("".join(cell["source"]), names)
    assert Path("person.png").stat().st_size > 10_000
    assert re.search(r"MPJPE \d+ mm, expected \d+ mm", capsys.readouterr().out)


# ---- help and quiet


def test_add_command_parses_text_of_command():
    from lidarpose.cli.terminal import add_command, option_names

    text = """
do a thing
Does a thing,
 really.
$ thing a
$ thing b
<file> FILE+  files
-n,--count N = 3  how many
--far M  how far
--fast  at once
--kind:which {a,b}  one of them
[more]
--data A=B,...  as it is
--scans DIR&  again
 and again
--out FILE = REQUIRED  where
"""
    parser = argparse.ArgumentParser()
    command = add_command(parser.add_subparsers(), "thing", print, text)
    options = vars(parser.parse_args("thing x y --far 2 --scans p --scans q --out o --kind b --data 1,2".split()))
    assert options == {
        **{"file": ["x", "y"], "count": 3, "far": 2.0, "fast": False, "which": "b", "data": "1,2", "scans": ["p", "q"]},
        **{"out": "o", "quiet": False, "run": print},
    }
    help = command.format_help()
    assert "Does a thing, really." in help and "examples:\n  thing a\n  thing b" in help
    assert re.search(r"more:\n  --data A=B,\.\.\. +as it is\n  --scans DIR +again and again\n", help)
    assert option_names(text) == ["far", "fast", "kind", "data", "scans", "out"]
    for wrong in ("thing x", "thing --out o", "thing x --out o --kind c", "thing x --out o -n 1.5"):
        with pytest.raises(SystemExit):
            parser.parse_args(wrong.split())


def test_help_and_version(capsys):
    assert run() == 0
    assert re.search("predict +estimate the poses", capsys.readouterr().out)
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("lidarpose ")
    for command in ("predict", "detect", "demo", "synth", "prepare", "sensors", "view", "pretrain", "finetune"):
        assert run(command, "--help") == 0
        text = capsys.readouterr().out
        assert f"\n  lidarpose {command}" in text[text.index("\nexample") :]
        # no empty default, no metavar of one letter
        assert "()" not in text and " V\n" not in text and "--quiet" in text


def test_predict_prints_progress_lines_without_terminal(crop, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_EVERY", 0.001)
    words = ("predict", crop, "--crop", "--out", tmp_path / "a.json")
    assert run(*words) == 0 and "of 1 clouds" in capsys.readouterr().err
    assert run(*words, "--quiet") == 0 and capsys.readouterr().err == ""


def test_quiet_prints_errors_only(crop, tmp_path, capsys):
    words = ("predict", crop, "--crop", "--out", tmp_path / "a.json", "--tta", 1)
    assert run(*words, "-q") == 0
    captured = capsys.readouterr()
    assert captured.err == captured.out == "" and (tmp_path / "a.json").is_file()
    assert run("predict", "--quiet", tmp_path / "no.npy") == 2
    assert "no.npy" in capsys.readouterr().err
    # the option affects only its own command
    assert run(*words) == 0
    assert "1 of 1 person" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, problem",
    [
        ("--quiet predict a.pcd", "arguments: --quiet: options come after the command, lidarpose predict --quiet; see"),
        ("predct a.pcd", "invalid choice: 'predct', did you mean predict?; see lidarpose --help"),
        ("qqqq", "invalid choice: 'qqqq' (choose from"),
        ("detect a.pcd --picture", "unrecognized arguments: --picture; see lidarpose detect --help"),
        ("predict --background a b.npy", "FILE: give them before --background, which takes all values after it; see"),
        ("detect a.pcd --min_score=1", "--min_score=1, did you mean --min-score?; see lidarpose detect --help"),
        (
            "predict a.pcd --picture a.png",
            "--picture and --html take no file name, they are named as --out, NAME.png beside NAME.json",
        ),
    ],
)
def test_usage_errors_refer_to_help(words, problem, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2 and problem in capsys.readouterr().err


@pytest.mark.filterwarnings("error")
def test_stray_point_causes_no_rounding_warning(crop, points, tmp_path, out, capsys):
    np.save(tmp_path / "stray.npy", np.concatenate([points, [[5e6, 0, 0]]]).astype(np.float32))
    assert run("predict", tmp_path / "stray.npy", "--crop", "--out", out) == 0
    assert "rounded" not in capsys.readouterr().err


def test_import_rejects_pickle(tmp_path, capsys):
    path = tmp_path / "weights.pth"
    path.write_bytes(b"\x80\x04.")
    assert main(["import", str(path), str(tmp_path / "x.safetensors")]) == 2
    assert "got a pickle, which can run programs" in capsys.readouterr().err


def test_advice_after_empty_detection_unless_explained():
    assert "a lower --min-score finds more" in predicting._none_found(" -> x.json", ["dropped 3 points"])
    explained = predicting._none_found(" -> x.json", ["no people found with up z, but 4 people with up y: try --up y"])
    assert explained == "no people found -> x.json"
