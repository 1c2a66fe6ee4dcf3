"""What the docs name is there, and the README is what a package index can show."""

import contextlib
import importlib.util
import io
import json
import os
import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from scripts import load_script

import lidarpose
from lidarpose.cli import main
from lidarpose.cli.command_line import make_parser
from lidarpose.cli.predicting import _FILES
from lidarpose.io.point_cloud import SUFFIXES
from lidarpose.models.detector.detector import open_detector
from lidarpose.synth.scene import SCENES

ROOT = Path(__file__).parents[1]
SOURCE = Path(lidarpose.__file__).parent
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    *DOCS.glob("*.md"),
    *DOCS.glob("cards/*.md"),
]
NAMED = sorted(set(re.findall(r"`([\w/]+\.py): ([\w.]+)", (DOCS / "method.md").read_text())))
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9_-]*")
COMMANDS = next(action.choices for action in make_parser()._actions if action.dest == "command")
LINK = re.compile(r"\[[^]]*\]\((?!https?:)([^)#]*)(#[^)]*)?\)")


def named(page):
    return page.relative_to(ROOT).as_posix()


def anchors(page):
    """The ids of a page's headings, as Markdown readers make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[ ]", "-", re.sub(r"[^\w\- ]", "", heading.lower())) for heading in headings}


def test_the_table_of_the_paper_s_method_is_read():
    assert len(NAMED) > 20


@pytest.mark.parametrize("path, name", NAMED, ids=[f"{path}:{name}" for path, name in NAMED])
def test_what_stands_beside_the_paper_is_there(path, name):
    file = next((p for p in (SOURCE / "models" / path, SOURCE / path) if p.is_file()), None)
    assert file is not None, path
    text = file.read_text()
    for part in name.split("."):
        assert re.search(rf"(class|def) {part}\b|self\.{part} = |^ *{part}: ", text, re.MULTILINE), part


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    for target, anchor in LINK.findall(page.read_text("utf-8")):
        path = (page.parent / target) if target else page
        assert path.exists(), target
        if anchor:
            assert anchor[1:] in anchors(path), f"{target}{anchor}"


@pytest.mark.parametrize("page", [p for p in PAGES if p.stem != "log"], ids=named)
def test_files_and_modules_that_pages_name_are_there(page):
    text = page.read_text("utf-8")
    for path in re.findall(r"\b((?:src|tools|benchmarks|tests|examples)/[\w./]+\.\w+)", text):
        assert (ROOT / path).is_file(), path
    for path in re.findall(r"`((?:\w+/)+\w+\.py)[`:]", text):
        assert any((root / path).is_file() for root in (ROOT, SOURCE, SOURCE / "models")), path
    for name in set(re.findall(r"`lidarpose((?:\.\w+)+)`", text)):
        module, _, attribute = ("lidarpose" + name).rpartition(".")
        there = importlib.util.find_spec(module) and (
            hasattr(importlib.import_module(module), attribute) or importlib.util.find_spec(f"{module}.{attribute}")
        )
        assert there, name


def test_there_are_eight_pages_and_each_is_in_the_site():
    site = (ROOT / "mkdocs.yml").read_text("utf-8")
    pages = {path.stem for path in DOCS.glob("*.md")}
    assert pages - {"index", "reference", "log"} == {
        "use", "recordings", "data", "synthesis", "train", "evaluate", "method", "results",
    }  # fmt: skip
    for path in [*DOCS.glob("*.md"), *DOCS.glob("cards/*.md")]:
        assert f"{path.relative_to(DOCS)}" in site, path.name


def test_the_readme_is_short_and_begins_with_the_command_and_the_picture():
    readme = (ROOT / "README.md").read_text("utf-8")
    assert len(readme.splitlines()) <= 120
    order = [readme.index(text) for text in ("pip install", "lidarpose predict", "images/real.png", "```python", "| `")]
    assert order == sorted(order)
    assert (DOCS / "images" / "real.png").stat().st_size <= 250_000


def test_the_readme_on_a_package_index_has_no_relative_links():
    index_readme = load_script(ROOT / "setup.py").index_readme
    readme = (ROOT / "README.md").read_text("utf-8")
    alone = index_readme(readme, None)
    assert not LINK.search(alone) and "![" not in alone and "lidarpose predict sweep.pcd" in alone
    linked = index_readme(readme, "https://example.org/lidarpose")
    assert not LINK.search(linked)
    assert "](https://example.org/lidarpose/raw/main/docs/images/real.png)" in linked
    assert "[Use](https://example.org/lidarpose/blob/main/docs/use.md)" in linked


def test_the_site_begins_with_the_readme_and_lists_every_public_name():
    hooks = load_script(ROOT / "tools" / "mkdocs_hooks.py")
    start = hooks.on_page_markdown((DOCS / "index.md").read_text("utf-8"))
    for target, _ in LINK.findall(start):
        assert (DOCS / target).is_file(), target
    reference = hooks.on_page_markdown((DOCS / "reference.md").read_text("utf-8"))
    for name in lidarpose.__all__:
        assert name == "__version__" or f"heading: lidarpose.{name}\n" in reference


def test_the_hashed_requirements_are_the_constraints_with_hashes_of_all_that_predicting_and_synthesis_need():
    lines = (ROOT / "requirements-hashed.txt").read_text("utf-8").replace("\\\n", " ").splitlines()
    entries = [line for line in lines if line and not line.startswith("#")]
    pins = {entry.split()[0] for entry in entries}
    assert all("--hash=sha256:" in entry for entry in entries)
    assert pins <= set((ROOT / "constraints.txt").read_text("utf-8").splitlines())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for requirement in project["dependencies"] + project["optional-dependencies"]["synth"]:
        assert any(pin.startswith(requirement.split(">=")[0] + "==") for pin in pins), requirement


# of pip, gcloud, torchrun and accelerate
OTHERS = {"--require-hashes", "--no-deps", "--nproc_per_node", "--num_processes", "--standalone", "--constraint"}


@pytest.fixture(scope="module")
def flags():
    """Every flag of every command, and of the scripts beside the package."""
    help_of_all = io.StringIO()
    with contextlib.redirect_stdout(help_of_all):
        for command in COMMANDS:
            with pytest.raises(SystemExit):
                main([command, "--help"])
    scripts = [*(ROOT / "tools").glob("*.py"), *(ROOT / "benchmarks").glob("*.py")]
    text = help_of_all.getvalue() + "".join(path.read_text("utf-8") for path in scripts)
    return set(FLAG.findall(text)) | OTHERS


@pytest.mark.parametrize("page", [p for p in PAGES if p.stem != "log"], ids=named)
def test_flags_that_pages_name_are_there(page, flags):
    assert set(FLAG.findall(page.read_text("utf-8"))) <= flags


def test_help_and_pages_list_every_point_format_and_the_default_score():
    assert tuple(_FILES.split()) == SUFFIXES
    use = (DOCS / "use.md").read_text("utf-8")
    for suffix in SUFFIXES:
        assert f"`{suffix}`" in use and f"`{suffix}`" in (ROOT / "README.md").read_text("utf-8")
    assert f"The default, {open_detector()[1]['default_score']:.2f}, is" in use


# what an editor is to know of the public names
SURFACE = """
from typing import assert_type

import numpy as np

import lidarpose

model = lidarpose.load()
cloud = lidarpose.read_points("person.ply")
points = np.zeros((10, 3))
clouds: list[np.ndarray] = [points]
boxes = lidarpose.detect(points)
assert_type(model.predict(points), lidarpose.PersonPose)
assert_type(model.predict(cloud, find=False), lidarpose.PersonPose)
assert_type(model.predict([[0.0, 0.0, 1.0]]), lidarpose.PersonPose)
assert_type(model.predict(clouds), lidarpose.Poses)
assert_type(model.predict([]), lidarpose.Poses)
assert_type(model.predict(points, boxes=boxes), lidarpose.Poses)
assert_type(model.predict(points, find=True), lidarpose.Poses)
people = lidarpose.predict("sweep.pcd", sensor_origin=points[0])
lidarpose.predict("sweep.pcd", boxes=boxes, sensor_origin=[0, 0, 1.8])
assert_type([person for person in people], list[lidarpose.PersonPose])
assert_type(people["a"], lidarpose.PersonPose)
assert_type(people[1:], lidarpose.Poses)
assert_type(float(people[0].joints[0, 0]), float)
"""


@pytest.mark.slow
def test_python_blocks_of_pages_and_the_public_names_pass_type_checking(tmp_path, monkeypatch):
    api = pytest.importorskip("mypy.api")
    files = []
    for page in PAGES:
        blocks = re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
        for number, block in enumerate(blocks):
            files.append(tmp_path / f"{page.stem.lower()}_{number}.py")
            files[-1].write_text(block, "utf-8")
    notebook = json.loads((ROOT / "examples" / "03_notebook.ipynb").read_text("utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for name, code in (("notebook.py", "\n".join(cells)), ("surface.py", SURFACE)):
        files.append(tmp_path / name)
        files[-1].write_text(code, "utf-8")
    assert {"readme_0.py", "use_0.py"} <= {file.name for file in files}
    monkeypatch.setenv("MYPYPATH", str(SOURCE.parent))
    config = ["--config-file", str(ROOT / "pyproject.toml"), "--follow-imports", "silent", "--cache-dir", os.devnull]
    out, errors, code = api.run([*config, *map(str, files)])
    assert code == 0, out + errors


def test_every_setting_of_a_scene_is_in_the_docs():
    scene, page = SCENES["wide"], (DOCS / "synthesis.md").read_text()
    names = {field.name for config in (scene, scene.noise, scene.crop) for field in fields(config)}
    names = names - {"name", "noise", "crop"} | {"noise.clutter", "keep"}
    assert not {name for name in names if f"`{name}`" not in page and f"`{name}=" not in page}
