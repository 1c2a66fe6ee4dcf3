"""The installed wheel contains everything that prediction needs."""

import json
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest

import lidarpose
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config

ROOT = Path(__file__).parents[1]


def test_files_named_in_notice_exist():
    words = (word.strip(".,;:()") for word in (ROOT / "NOTICE").read_text("utf-8").split())
    paths = [word for word in words if word.startswith(("src/", "docs/", "tools/"))]
    assert len(paths) > 4 and [path for path in paths if not (ROOT / path).exists()] == []


@pytest.mark.slow
def test_wheel_installs_into_empty_environment_and_predicts(tmp_path):
    """Needs a package index. The new environment must not see any path of this repository."""
    source = tmp_path / "source"
    source.mkdir()
    for name in ("src", "README.md", "LICENSE", "NOTICE", "pyproject.toml", "setup.py"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    shutil.rmtree(source / "src" / "lidarpose.egg-info", ignore_errors=True)
    surroundings = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}

    def call(*command):
        done = subprocess.run(command, cwd=tmp_path, env=surroundings, capture_output=True, text=True, timeout=900)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", "dist", str(source))
    (wheel,) = (tmp_path / "dist").glob("lidarpose-*.whl")
    venv.create(tmp_path / "env", with_pip=True)
    scripts = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin")
    call(scripts / "python", "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel)

    person = Generator(scene=scene_config("wild").eased(0.0)).person(seed=3, index=5).sample
    np.save(tmp_path / "person.npy", person.points)
    call(
        scripts / "lidarpose", "predict", "person.npy", "--crop", "--picture", "--tta", "1", "--sensor-origin", "0,0,0"
    )
    (result,) = json.loads((tmp_path / "person.poses.json").read_text("utf-8"))["people"]
    here = lidarpose.load(tta=1).predict(person.points, sensor_origin=(0, 0, 0))
    np.testing.assert_allclose(result["joints"], here.joints, atol=1e-3)
    assert (tmp_path / "person.poses.png").stat().st_size > 10_000
    where = call(scripts / "python", "-c", "import lidarpose; print(lidarpose.__file__)")
    assert str(tmp_path / "env") in where
    names = {path.name for path in Path(where.strip()).parent.iterdir()}
    assert {"py.typed", "models", "inference"} <= names
