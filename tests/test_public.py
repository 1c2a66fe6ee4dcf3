"""Public names, the libraries that importing them loads, and the allowed imports between packages."""

import ast
import graphlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import lidarpose
from lidarpose import _renamed

SOURCE = Path(lidarpose.__file__).parent
MODULES = sorted(SOURCE.rglob("*.py"))

# lowest layer first: a package may import from its own layer and the lower ones
LAYERS = (
    {"skeleton", "geometry", "sample", "arrays", "errors", "_version", "_renamed", "progress"},
    {"io"},
    {"body", "lidar"},
    {"data"},
    {"synth"},
    {"models"},
    {"viz"},
    {"tracking"},
    {"inference"},
    {"recording"},
    {"eval"},
    {"train"},
    {"paper"},
    {"cli", "metrics", "evaluation", "__init__", "__main__"},
)
NO_TORCH = ({"torch", "safetensors"}, set().union(*LAYERS[:5]))
FORBIDDEN = {
    ("body", "lidar"),
    ("lidar", "body"),
    *(("models", package) for package in ("body", "lidar", "data", "synth")),
}


def loaded_by(code):
    """The heavy libraries that a program imports."""
    heavy = ("torch", "numba", "numpy", "pandas", "matplotlib", "matplotlib.pyplot", "lzf")
    tail = f"\nimport sys; print(*[name for name in {heavy} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code + tail], capture_output=True, text=True, timeout=60, check=True
    )
    return set(done.stdout.split("\n")[-2].split())


def test_import_and_help_load_no_heavy_libraries():
    command = "\ntry: main(['predict', '--help'])\nexcept SystemExit: pass"
    assert loaded_by(f"import lidarpose; dir(lidarpose)\nfrom lidarpose.cli import main{command}") == set()


def test_public_functions_do_not_import_torch():
    predicting = "lidarpose.load, lidarpose.predict, lidarpose.Poses, lidarpose.read_points, lidarpose.read_boxes"
    assert loaded_by(f"import lidarpose; {predicting}, lidarpose.Sample") <= {"numpy"}
    assert "torch" not in loaded_by("import lidarpose; lidarpose.cast_rays, lidarpose.sample_poses")


def test_drawing_does_not_import_pyplot():
    assert "matplotlib" not in loaded_by("from lidarpose.viz import draw, html")
    drawing = (
        "import numpy as np; from lidarpose.viz import draw; draw.draw_people([draw.Panel(points=np.ones((9, 3)))])"
    )
    assert loaded_by(drawing) == {"numpy", "matplotlib"}


def test_all_public_names_exist():
    assert set(lidarpose.__all__) <= set(dir(lidarpose))
    for name in lidarpose.__all__:
        assert getattr(lidarpose, name) is not None


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'pose'"):
        lidarpose.pose  # noqa: B018
    assert not hasattr(lidarpose, "__wrapped__")


def test_public_names_are_not_shadowed_by_modules():
    packages = {path.stem for path in SOURCE.glob("*.py")} | {path.name for path in SOURCE.iterdir() if path.is_dir()}
    assert not packages & set(lidarpose.__all__)


@pytest.mark.parametrize("old, new", _renamed.RENAMED.items())
def test_old_module_paths_import_moved_modules(old, new):
    spec = importlib.import_module(f"lidarpose.{new}").__spec__
    with pytest.warns(DeprecationWarning, match=f"lidarpose.{new}"):
        sys.modules.pop(f"lidarpose.{old}", None)
        module = importlib.import_module(f"lidarpose.{old}")
    assert module is importlib.import_module(f"lidarpose.{new}") and module.__spec__ is spec


# ---- the layers


def package(module):
    """ "lidarpose.models.voxelize" -> "models"."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def layer(name):
    return next(i for i, packages in enumerate(LAYERS) if name in packages)


def imports(path):
    """All modules that a file imports, including imports inside functions but not those under TYPE_CHECKING."""
    tree = ast.parse(path.read_text())
    typing_only = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    tree.body = [node for node in tree.body if node not in typing_only]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # `from lidarpose import x` may mean the module x
            if node.module == "lidarpose":
                yield from (f"lidarpose.{alias.name}" for alias in node.names)
            else:
                yield node.module


def where(path):
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def test_every_package_has_a_layer():
    assert {where(path) for path in MODULES} <= set().union(*LAYERS)


def test_imports_follow_layer_order():
    for path in MODULES:
        here = where(path)
        for name in imports(path):
            library = name.split(".")[0]
            if library in NO_TORCH[0]:
                assert here not in NO_TORCH[1], f"{path} imports {name}"
            # everything except synthesis must work without the extra
            if library == "numba":
                assert path.stem.endswith("_kernels"), f"{path} imports {name}"
            if library == "lidarpose":
                there = package(name)
                assert layer(there) <= layer(here), f"{path} imports {name}, which is a layer above"
                assert (here, there) not in FORBIDDEN, f"{path} imports {name}"


def test_modules_have_no_import_cycles():
    names = {path: ".".join(("lidarpose", *path.relative_to(SOURCE).with_suffix("").parts)) for path in MODULES}
    below = {name.removesuffix(".__init__"): set(imports(path)) for path, name in names.items()}
    # `from lidarpose.x import y` in x/__init__.py is not a cycle
    below = {name: wanted - {name} for name, wanted in below.items()}
    # raises CycleError, which names the modules
    assert len(list(graphlib.TopologicalSorter(below).static_order())) >= len(MODULES)


def test_packages_have_no_import_cycles():
    below = {}
    for path in MODULES:
        wanted = {package(name) for name in imports(path) if name.split(".")[0] == "lidarpose"}
        # `from lidarpose import Name` loads the name's own package
        below.setdefault(where(path), set()).update(wanted - {where(path), "__init__"})
    assert list(graphlib.TopologicalSorter(below).static_order())
