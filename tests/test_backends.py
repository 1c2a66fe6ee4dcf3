"""The ONNX and torch backends: agreement, decoding, choice of backend, and use without torch."""

import json
import os
import pickle
import re
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from lidarpose.errors import InputError, MissingExtra, missing_extra
from lidarpose.inference.backend import OnnxBackend, Raw, bundled_backend, estimates, person_parts
from lidarpose.inference.predictor import Predictor, load
from lidarpose.inference.tta import IDENTITY
from lidarpose.io.files import content_digest
from lidarpose.models import DEFAULT, bundled_path, decode, layers, onnx, weights_file
from lidarpose.models.checkpoint import Header, read_header, save_checkpoint
from lidarpose.models.config import BIN, NetworkConfig
from lidarpose.models.dapt.dapt_config import DaptConfig
from lidarpose.models.dapt.dapt_net import DaptNet
from lidarpose.models.dapt.import_weights import import_released
from lidarpose.models.onnx import usable_threads
from lidarpose.models.voxelize import view_features
from lidarpose.skeleton import BODY26, HUMAN15, SMPL24, WAYMO14

DAPT = Path(__file__).parent / "parity" / "dapt_tiny.safetensors"


def blob(count, seed=0):
    """Random points of about a person's width and height."""
    return np.random.default_rng(seed).normal(0, (0.15, 0.15, 0.4), (count, 3)) + (4.0, -3.0, 1.0)


@pytest.fixture(scope="module")
def models():
    return {name: load(backend=name, threads=1 if name == "onnx" else None, tta=1) for name in ("onnx", "torch")}


# ---- agreement


def ties(model, clouds, centers, origin):
    """(B, J, 3) bool: heatmaps whose two highest bins are equal except for rounding. Between the runtimes, the
    difference of two neighboring bins differs by at most 5e-6."""
    view = np.stack([view_features(center, origin) for center in centers])
    raw = model.backend.run([cloud - center for cloud, center in zip(clouds, centers, strict=True)], view)
    highest = np.sort(np.stack(raw.heatmaps, 2), -1)
    return highest[..., -1] - highest[..., -2] < 1e-5


@pytest.mark.long
def test_backends_agree_for_crops_of_all_sizes(models):
    # each size once: all centered crops of one point are the same, and their ties would count several times
    sizes = np.unique(np.geomspace(1, 5000, 290).round().astype(int))
    assert len(sizes) >= 200
    clouds = [blob(size, seed) for seed, size in enumerate(sizes)]
    equal = 0
    # batches of similar sizes, because rows are padded to the largest
    for start in range(0, len(sizes), 10):
        group = clouds[start : start + 10]
        centers = np.stack([cloud.mean(0) for cloud in group])
        origin = np.zeros(3) if start % 20 else None
        ours, due = (models[name].outputs(group, centers, origin) for name in ("onnx", "torch"))
        tied = ties(models["torch"], group, centers, origin)
        equal += tied.sum()
        assert np.abs(ours.joints - due.joints)[~tied].max() < 1e-4
        np.testing.assert_array_equal(ours.in_range[~tied.any(-1)], due.in_range[~tied.any(-1)])
        for name in ("confidence", "spread", "visible"):
            np.testing.assert_allclose(getattr(ours, name), getattr(due, name), rtol=1e-4, atol=1e-5)
        assert np.ptp(due.joints) > 0.1
    assert equal < 1e-3 * len(sizes) * 26 * 3


@pytest.mark.long
def test_backends_agree_after_second_pass(models):
    # the second pass is centered on the result of the first, which must not increase differences
    clouds = [blob(size, seed) for seed, size in enumerate((5, 6, 9, 17, 40, 99, 300, 1200, 5000) * 2)]
    ours, due = (models[name].predict(clouds, sensor_origin=(0, 0, 0)) for name in ("onnx", "torch"))
    for a, b in zip(ours, due, strict=True):
        assert np.abs(a.joints - b.joints).max() < 1e-4 and a.warnings == b.warnings
    assert (ours.model["backend"], due.model["backend"]) == ("onnx", "torch")
    # the bundled ONNX file and checkpoint contain the same network
    onnx = models["onnx"]
    assert onnx.backend.source == content_digest(bundled_path(), expected="a checkpoint")
    assert onnx.header == models["torch"].header == read_header(bundled_path())


@pytest.mark.parametrize("name", ["onnx", "torch"])
def test_predict_is_equal_in_batches_and_after_pickling(models, name):
    clouds = [blob(40), blob(900, 1), blob(7, 2)]
    alone = [models[name].predict(cloud).joints for cloud in clouds]
    np.testing.assert_allclose(models[name].predict(clouds).to_numpy(), alone, atol=1e-4)
    other = pickle.loads(pickle.dumps(models[name]))
    np.testing.assert_array_equal(other.predict(clouds[0]).joints, alone[0])


def test_load_compile_uses_torch_compile_and_reports_failure(models, monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda module, **settings: asked.append(settings) or module)
    compiled = load(compile=True, tta=1)
    assert compiled.backend.name == "torch" and asked == []
    for count in (300, 60):
        np.testing.assert_array_equal(compiled.predict(blob(count)).joints, models["torch"].predict(blob(count)).joints)
    assert asked == [{"dynamic": True}]
    failing = mock.Mock(side_effect=torch._dynamo.exc.TorchDynamoException("no\ncompiler"))
    monkeypatch.setattr(torch, "compile", lambda module, **settings: failing)
    with pytest.raises(InputError, match="torch.compile failed .no compiler.: omit compile"):
        load(compile=True).predict(blob(30))


@pytest.mark.slow
def test_compiled_network_gives_equal_joints(models):
    compiled = load(compile=True, tta=1)
    for count in (300, 60, 5):
        due = models["torch"].predict(blob(count)).joints
        np.testing.assert_allclose(compiled.predict(blob(count)).joints, due, atol=1e-4)


# ---- from raw outputs to joints


@pytest.mark.parametrize("kind", layers.REACH)
def test_numpy_and_torch_decoders_agree(kind):
    bins = round(2 * layers.REACH[kind] / BIN)
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 3, (50, 26, 3, bins)).astype(np.float32)
    logits[..., 0] += 4 * (rng.random((50, 26, 3)) < 0.2)
    raw = raw_of(logits)
    out = estimates(raw, decode.window, BODY26)
    due = raw.vote + layers.decode(torch.from_numpy(logits)).numpy()
    np.testing.assert_allclose(out.joints, due, atol=2e-6)
    ends = (logits.argmax(-1) % (bins - 1) == 0).any(-1)
    np.testing.assert_array_equal(out.in_range, ~ends)
    assert 0.1 < ends.mean() < 0.9


def raw_of(logits, **more):
    """Random raw outputs with the heatmaps `logits` (B, J, 3, W)."""
    rng = np.random.default_rng(1)
    shape = logits.shape[:2]
    names = ("confidence", "log_spread", "visible")
    outputs = {name: rng.normal(size=shape).astype(np.float32) for name in names}
    outputs["vote"] = rng.normal(size=(*shape, 3)).astype(np.float32)
    return Raw.from_pose(outputs | {"heatmap": logits} | more)


@pytest.mark.long
def test_predictor_uses_selected_decoder(models):
    cloud = blob(400)
    center = cloud.mean(0)
    raw = models["onnx"].backend.run([cloud - center], np.zeros((1, 5), np.float32))
    joints = {}
    for name in ("window", "argmax", "dark"):
        model = Predictor(models["onnx"].backend, name="x", decode=name)
        joints[name] = model.outputs([cloud], center[None], None).joints
        np.testing.assert_allclose(joints[name], estimates(raw, decode.decoder(name), BODY26).joints, atol=1e-6)
        assert load(decode=name).model["decode"] == model.predict(cloud).model["decode"] == name
    # a refined peak is near the highest bin
    assert 0 < np.abs(joints["window"] - joints["argmax"]).max() < 4 * BIN
    assert 0 < np.abs(joints["dark"] - joints["argmax"]).max() <= BIN
    np.testing.assert_array_equal(joints["window"], models["onnx"].outputs([cloud], center[None], None).joints)


def test_estimates_of_extreme_outputs_stay_in_range():
    huge = np.resize(np.array([-1e4, 1e4, 0.0], np.float32), (1, 26))
    logits = np.zeros((1, 26, 3, 24), np.float32)
    logits[..., 5] = 1e4
    out = estimates(raw_of(logits, confidence=huge, log_spread=huge, visible=huge), decode.window, BODY26)
    for value in (out.confidence, out.visible):
        np.testing.assert_array_equal(value, np.resize([0, 1, 0.5], (1, 26)))
    assert np.isfinite(out.spread).all() and (out.spread >= 0).all() and np.isfinite(out.joints).all()
    # without heatmaps, in_range is None
    raw = raw_of(np.zeros((2, 26, 3, 0), np.float32))
    out = estimates(raw, decode.window, BODY26)
    np.testing.assert_array_equal(out.joints, raw.vote)
    assert out.in_range is None and out.confidence.shape == (2, 26)


def test_estimates_take_confidence_from_heatmaps():
    # bins of 2 cm; every other joint has 3/4 of its weight at bin 50 and 1/4 30 cm away, the others all of it at bin 50
    sure = np.full((1, 26, 100), -1e4, np.float32)
    sure[..., 50] = 0
    logits = sure.copy()
    logits[0, ::2, 65] = -np.log(3)
    raw = Raw(vote=np.zeros((1, 26, 3)), heatmaps=(logits, sure, sure), low=np.full(3, -1.0), step=np.full(3, 0.02))
    out = estimates(raw, decode.window, BODY26)
    np.testing.assert_allclose(out.joints, 0, atol=1e-9)
    np.testing.assert_allclose(out.confidence, np.resize([0.75, 1], (1, 26)), atol=1e-6)
    np.testing.assert_allclose(out.spread, np.resize([0.15, 0], (1, 26)), atol=1e-6)
    assert out.visible is None and out.in_range.all()


class Scripted:
    """A backend with fixed outputs: joints at the bins `mode` of its heatmaps, relative to `joints`."""

    name, batch = "scripted", 64

    def __init__(self, mode, joints=None):
        self.mode = mode
        self.header = Header(
            config=NetworkConfig(size="x", channels=(4, 4, 4), head_channels=4, blocks=(0, 0, 0)), card={}
        )
        self.joints = joints
        self.centers = []

    def run(self, clouds, view):
        self.centers.append(np.stack([-cloud.mean(0) for cloud in clouds]))
        logits = np.zeros((len(clouds), 26, 3, 24), np.float32)
        np.put_along_axis(logits, np.broadcast_to(self.mode, logits.shape[:3])[..., None], 9.0, -1)
        votes = np.zeros((len(clouds), 26, 3), np.float32) if self.joints is None else self.joints
        return raw_of(logits, vote=np.broadcast_to(votes, logits.shape[:3]))


def one_pass(backend):
    """A predictor whose result is the pass centered on the pelvis, without test-time augmentation."""
    model = Predictor(backend, name="x")
    model._averaged, model._first = False, IDENTITY
    return model


def test_predict_reports_joints_out_of_heatmap_range():
    mode = np.full((26, 3), 10)
    ends = {("left_wrist", 0): 0, ("head", 2): 23, ("nose", 1): 0, ("neck", 1): 23, ("left_hand", 0): 0}
    for (joint, axis), end in ends.items():
        mode[BODY26.index(joint), axis] = end
    pose = one_pass(Scripted(mode)).predict(blob(30))
    assert set(pose.out_of_range) == {"neck", "head", "left_wrist", "left_hand"}
    np.testing.assert_array_equal(pose.in_range, [joint not in pose.out_of_range for joint in pose.skeleton.joints])
    (warning,) = pose.warnings
    assert warning.startswith("at the edge of the heatmap's range") and warning.endswith(" and 1 more")
    entry = json.loads(pose.to_json())["people"][0]
    assert entry["out_of_range"] == pose.out_of_range and len(entry["visible"]) == 24
    assert all(0 <= value <= 1 for value in entry["visible"])
    # with test-time augmentation, whose first pass is mirrored
    mode[:] = 10
    for joint in ("left_wrist", "right_wrist", "head"):
        mode[BODY26.index(joint), 2] = 23
    for tta in (1, 4):
        pose = Predictor(Scripted(mode), name="x", tta=tta).predict(blob(30))
        assert set(pose.out_of_range) == {"left_wrist", "right_wrist", "head"}
    # no warning if all joints are in range
    pose = Predictor(Scripted(np.full((26, 3), 10)), name="x").predict(blob(30))
    assert pose.warnings == () and pose.out_of_range == [] and pose.in_range.all()
    # no warning for a person without joints
    pose = Predictor(Scripted(mode), name="x").predict(blob(3))
    assert pose.visible is None and pose.in_range is None and pose.out_of_range == []
    entry = json.loads(pose.to_json())["people"][0]
    assert entry["joints"] is None and entry["visible"] == entry["out_of_range"] == entry["confidence"] == []


def test_second_pass_is_centered_on_pelvis_rounded_to_1_cm():
    joints = np.zeros((26, 3), np.float32)
    joints[0] = 0.1234, -0.0567, 0.301
    scripted = Scripted(np.full((26, 3), 11), joints)
    one_pass(scripted).predict(blob(30))
    first, second = scripted.centers[:2]
    moved = second - first
    # the center of a bin is half a bin from the vote
    np.testing.assert_allclose(moved, np.round((joints[:1] - BIN / 2) / 0.01) * 0.01, atol=1e-6)
    # the result of a mirrored first pass is mirrored back
    Predictor(scripted, name="x").predict(blob(30))
    mirror = [1, -1, 1]
    moved = scripted.centers[-1] - scripted.centers[-2] * mirror
    np.testing.assert_allclose(moved, np.round((joints[:1] - BIN / 2) * mirror / 0.01) * 0.01, atol=1e-6)


# ---- choice of backend


@pytest.mark.long
def test_load_chooses_backend(tmp_path):
    path = tmp_path / "mine.safetensors"
    path.write_bytes(bundled_path("tiny").read_bytes())
    (tmp_path / "mine.onnx").write_bytes(bundled_path("tiny", ".onnx").read_bytes())
    chosen = {
        "onnx": [{}, {"weights": tmp_path / "mine.onnx"}, {"weights": str(path), "backend": "onnx"}, {"device": "cpu"}],
        "torch": [{"backend": "torch"}, {"weights": path}, {"compile": True}, {"weights": str(path)}],
    }
    for name, calls in chosen.items():
        for call in calls:
            model = load(**call)
            assert model.backend.name == model.model["backend"] == name, call
            assert model.model["name"] == ("mine" if "weights" in call else DEFAULT)


BAD = {
    "backend": ({"backend": "tensorrt"}, "unknown backend 'tensorrt': known are onnx, torch"),
    "decoder": ({"decode": "mean"}, "unknown decoder 'mean'"),
    "weights": ({"weights": "tyni"}, "did you mean tiny"),
    "threads": ({"threads": 0}, "threads must be a whole number"),
    "threads of torch": ({"backend": "torch", "threads": -3}, "threads must be a whole number"),
    "threads and torch": ({"backend": "torch", "threads": 3}, "threads is an option of the backend onnx"),
    "onnx elsewhere": ({"backend": "onnx", "device": "cuda"}, "device 'cuda' needs the backend torch"),
    "onnx compiled": ({"backend": "onnx", "compile": True}, "torch.compile needs the backend torch"),
    "onnx file elsewhere": ({"weights": bundled_path(suffix=".onnx"), "device": "cuda"}, "needs the backend torch"),
    "onnx file by torch": ({"weights": bundled_path(suffix=".onnx"), "backend": "torch"}, "torch runs a .safetensors"),
    "device": ({"device": "hal9000"}, "device 'hal9000' cannot be used"),
    "unknown device": ({"device": "gpu", "backend": "torch"}, "device 'gpu' cannot be used (torch has no such device)"),
    "missing": ({"weights": "no/such.onnx"}, "no such file"),
    "missing checkpoint": ({"weights": "no/such.safetensors"}, "does not exist"),
    "missing path": ({"weights": Path("nothing")}, "does not exist"),
    "no stem": ({"weights": ".safetensors"}, "does not exist"),
    "no checkpoint": ({"weights": __file__}, "expected a checkpoint (.safetensors), but the file is something else"),
    "a folder": ({"weights": Path(__file__).parent}, "is a folder"),
    "None": ({"weights": None}, "expected weights as tiny, small or the path of a file"),
    "a number": ({"weights": 0.5}, "expected weights as tiny, small or the path of a file"),
}


@pytest.mark.parametrize("case", BAD)
def test_load_rejects_invalid_options(case):
    settings, words = BAD[case]
    with pytest.raises(InputError) as raised:
        load(**settings)
    assert words in str(raised.value) and "\n" not in str(raised.value)


def test_load_sets_onnx_threads():
    assert 1 <= usable_threads() <= 8
    for asked, used in ((3, 3), (None, usable_threads())):
        assert load(threads=asked).backend.threads == used


@given(st.integers(0, 200), st.integers(1, 16))
def test_person_parts_are_even_over_threads(count, threads):
    rows = [range(count)[part] for part in person_parts(count, threads)]
    assert [row for part in rows for row in part] == list(range(count))
    sizes = [len(part) for part in rows]
    assert max(sizes) <= 8 and max(sizes) - min(sizes) <= 1
    assert len(sizes) % threads == 0 or len(sizes) == max(count, 1) < threads


@pytest.mark.parametrize("threads", [1, 3])
def test_onnx_backend_batch_equals_single_people(threads):
    backend = OnnxBackend(weights_file("tiny.onnx"), threads=threads)
    rng = np.random.default_rng(0)
    clouds = [rng.normal(0, 0.3, (n, 3)) for n in (5, 400, 0, 60, 61, 62, 7, 200, 90, 30, 12)]
    view = rng.normal(size=(len(clouds), 5))
    together = backend.run(clouds, view)
    for i, cloud in enumerate(clouds):
        alone = backend.run([cloud], view[i : i + 1])
        np.testing.assert_allclose(together.vote[i], alone.vote[0], atol=1e-5)
        np.testing.assert_allclose(together.heatmaps[2][i], alone.heatmaps[2][0], atol=1e-3)


@pytest.mark.parametrize("setting, most", [("1", 1), ("2,4", 2), ("0", 8), ("many", 8), ("", 8), ("99", 8)])
def test_usable_threads_respects_omp_num_threads(monkeypatch, setting, most):
    monkeypatch.setattr(onnx.os, "sched_getaffinity", lambda _: range(64), raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", setting)
    assert usable_threads() == most


def test_load_accepts_torch_device_and_none():
    for device in (torch.device("cpu"), None):
        assert load("tiny", device=device).backend.name == "onnx"


def test_load_reports_broken_onnx_runtime(monkeypatch):
    # a cached network would not load the runtime
    bundled_backend.cache_clear()
    import_module = mock.Mock()
    monkeypatch.setattr(onnx, "import_module", import_module)
    for error in (ImportError("DLL load failed:\nnot found"), OSError("libgomp.so.1: cannot open")):
        import_module.side_effect = error
        with pytest.raises(InputError, match=r"^ONNX Runtime cannot be loaded \(.*\): reinstall it, pip") as raised:
            load()
        assert "\n" not in str(raised.value)
    stopped = import_module.side_effect = ImportError("initialization failed")
    stopped.__cause__ = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        load()


# ---- the paper's network


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    path = tmp_path_factory.mktemp("dapt") / "released.safetensors"
    import_released(DAPT, path)
    return path


@pytest.fixture(scope="module")
def dapt(released):
    return load(released)


def test_dapt_predicts_its_own_skeleton(dapt):
    assert dapt.backend.name == "torch" and dapt.skeleton is WAYMO14
    people = dapt.predict([blob(80), blob(3), blob(20, 1)])
    assert people.skeleton is WAYMO14 and [person.joints is None for person in people] == [False, True, False]
    pose = people[0]
    assert pose.joints.shape == (14, 3) and pose.visible is None
    assert (pose.confidence >= 0).all() and (pose.confidence <= 1).all() and (pose.spread > 0).all()
    assert json.loads(pose.to_json())["people"][0]["visible"] == []
    with pytest.raises(InputError, match="waymo14 has no pelvis, .* which smpl24 needs"):
        dapt.predict(blob(80), skeleton="smpl24")


def test_dapt_joints_are_in_skeleton_order(dapt):
    network, config = dapt.backend.network, dapt.header.config
    cloud = blob(60) - blob(60).mean(0)
    raw = network.outputs([cloud])
    joints = dapt.outputs([cloud], np.zeros((1, 3)), None).joints[0]
    for joint in WAYMO14.joints:
        logits = [raw[f"logits_{axis}"][0, config.joints.index(joint)] for axis in "xyz"]
        expected = [decode.window(row, low=config.low[k], step=config.step[k]) for k, row in enumerate(logits)]
        np.testing.assert_allclose(joints[WAYMO14.index(joint)], expected, atol=1e-6)
    assert config.joints != WAYMO14.joints


def test_dapt_second_pass_is_centered_on_hips(dapt, monkeypatch):
    transformed, calls = dapt._transformed, []

    def recorded(transform, clouds, centers, *rest):
        assert transform == IDENTITY
        calls.append((centers, transformed(transform, clouds, centers, *rest)))
        return calls[-1][1]

    monkeypatch.setattr(dapt, "_transformed", recorded)
    pose = dapt.predict(blob(200), skeleton="waymo14")
    (first, estimated), (second, answer) = calls[:2]
    # as in the released code, the first pass is used only for the center
    np.testing.assert_allclose(pose.joints, answer.joints[0] + second[0], atol=1e-6)
    hips = estimated.joints[:, [WAYMO14.index("left_hip"), WAYMO14.index("right_hip")]].mean(1)
    np.testing.assert_allclose(second - first, hips, atol=0.00501)


def test_dapt_ignores_far_points(dapt):
    cloud = blob(100)
    far = np.concatenate([cloud, cloud[:1] + (0, 0, 900.0)])
    a, b = (dapt.outputs([points], cloud.mean(0)[None], None).joints for points in (cloud, far))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_dapt_regression_network_has_no_confidence(tmp_path):
    torch.manual_seed(0)
    small = {"encoder_depths": (1, 1), "encoder_channels": (16, 16), "encoder_heads": (2, 2), "decoder_depths": (1,)}
    small |= {"decoder_channels": (16,), "decoder_heads": (2,), "anchor_channels": (16, 16), "strides": (4,)}
    config = DaptConfig(name="regress", joints=HUMAN15.joints, coordinates=True, grid=0.05, **small)
    save_checkpoint(tmp_path / "a.safetensors", DaptNet(config), card={})
    pose = load(tmp_path / "a.safetensors").predict(blob(50))
    assert pose.skeleton is HUMAN15 and pose.joints.shape == (15, 3)
    assert pose.confidence is None and pose.spread is None and pose.in_range is None and pose.out_of_range == []
    assert json.loads(pose.to_json())["people"][0]["confidence"] == []
    pose.picture(tmp_path / "a.png")


@pytest.mark.parametrize(
    "settings, words", [({"backend": "onnx"}, "not run as ONNX"), ({"compile": True}, "not supported")]
)
def test_load_rejects_options_not_supported_by_dapt(released, settings, words):
    with pytest.raises(InputError, match=words):
        load(released, **settings)


# ---- without torch


def program(modules, code, cwd):
    """Run code in a process that cannot import `modules`, in the folder `cwd` with a file crop.npy."""
    np.save(cwd / "crop.npy", blob(300))
    head = f"import sys\nsys.modules.update(dict.fromkeys({modules!r}))\nfrom lidarpose.cli import main\n"
    command = [sys.executable, "-c", head + textwrap.dedent(code)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=120)


EXTRAS = ("torch", "accelerate", "onnx", "onnxscript", "numba", "threadpoolctl", "pyarrow")


@pytest.mark.long
def test_base_install_runs_predict_and_info(tmp_path):
    code = """
        import numpy as np
        assert main(["predict", "crop.npy", "--crop", "--picture", "--decode", "dark"]) == 0
        assert main(["info"]) == 0
        import lidarpose
        assert lidarpose.load().predict(np.load("crop.npy")).joints.shape == (24, 3)
        # as help() and `import *` do
        names = [name for name in dir(lidarpose) if getattr(lidarpose, name) is not None]
        assert set(lidarpose.__all__) < set(names) and "export" not in names
        """
    done = program(EXTRAS, code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "not installed" in done.stdout and "ONNX Runtime" in done.stdout and "tiny" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"crop.npy", "crop.poses.json", "crop.poses.png"}


# command -> the extra that it needs; the command DAMAGED fails with or without extras
LACKING = {
    "predict crop.npy --backend torch": "train",
    "predict crop.npy --device cuda": "train",
    f"predict crop.npy --weights {bundled_path()}": "train",
    "export --out x.onnx": "export",
    "import x.safetensors y.safetensors": "train",
    "pretrain run": "(train|synth)",
    "demo": "synth",
}
DAMAGED = "predict crop.npy --weights bad.safetensors"


@pytest.mark.long
def test_commands_name_missing_extra(tmp_path):
    (tmp_path / "bad.safetensors").write_bytes(b"no weights at all")
    code = f"""
        for words in {[*LACKING, DAMAGED]!r}:
            assert main(words.split()) == 2, words
        import lidarpose
        for call in (lambda: lidarpose.export, lambda: lidarpose.import_dapt, lambda: lidarpose.load(backend="torch")):
            try:
                call()
            except lidarpose.LidarPoseError as error:
                print(error)
        """
    done = program(EXTRAS, code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"crop.npy", "bad.safetensors"}
    *lines, damaged = done.stderr.splitlines()
    assert "something else" in damaged
    for line, extra in zip(lines, LACKING.values(), strict=True):
        assert re.fullmatch(rf"lidarpose: error: .*: in the clone, pip install \"\.\[{extra}\]\"", line), line
    needs = [re.search(r"(.*) needs .*\[(.*)\]", line).groups() for line in done.stdout.splitlines()]
    assert needs[:2] == [("lidarpose.export", "export"), ("lidarpose.import_dapt", "train")]
    assert needs[2] == (f"running {DEFAULT}.safetensors with torch", "train")


@pytest.mark.long
def test_predict_and_demo_do_not_import_unneeded_modules(tmp_path):
    heavy = ("torch", "numba", "pandas", "matplotlib", "tqdm", "onnx", "scipy", "sympy")
    code = f"""
        main(["predict", "crop.npy", "--crop"])
        print(*[name for name in {heavy} if name in sys.modules])
        sys.modules["torch"] = None
        import lidarpose.cli.demo, lidarpose.synth.generator, lidarpose.synth.shard_job, lidarpose.viz.html
        """
    done = program((), code, tmp_path)
    assert done.stdout.strip() == "" and done.returncode == 0, done.stderr


def test_missing_extra_ignores_other_modules():
    error = ModuleNotFoundError("No module named 'lidarpose.nothing'", name="lidarpose.nothing")
    assert missing_extra(error, "this") is error
    assert isinstance(missing_extra(ModuleNotFoundError(name="torch.nn"), "this"), MissingExtra)


def test_pose_to_skeleton_keeps_per_joint_fields(models):
    pose = models["onnx"].predict(blob(300), skeleton="body26").pose
    picked = pose.to(SMPL24)
    pick = BODY26.map_to(SMPL24)
    for name in ("confidence", "spread", "visible", "in_range"):
        np.testing.assert_array_equal(getattr(picked, name), getattr(pose, name)[pick])
    with pytest.raises(InputError, match="Pose.visible must be"):
        replace(pose, visible=pose.visible[:3])
    with pytest.raises(InputError, match="in_range must be true or false"):
        replace(pose, in_range=pose.visible)


def test_onnx_runtime_writes_no_telemetry(tmp_path):
    """By default, ONNX Runtime writes telemetry into the home folder when it opens a network."""
    code = "import lidarpose, numpy; lidarpose.load('tiny', tta=1).predict(numpy.ones((9, 3)))"
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    subprocess.run([sys.executable, "-c", code], env=environment | {"HOME": str(tmp_path)}, check=True, timeout=120)
    assert not list((tmp_path / ".cache").rglob("*onnxruntime*"))
