"""The layer table of docs/architecture.md, read off the imports of every file."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import sceneprior

ROOT = Path(__file__).parents[1]
FILES = sorted(path for name in ("sceneprior", "data_prep") for path in (ROOT / name).rglob("*.py"))

ROWS = {
    "geometry": 0, "silhouettes": 0, "classes": 0, "errors": 0, "files": 0,
    "settings": 0,
    "scene": 1, "views": 1, "offscreen": 1, "shards": 1, "furniture": 1, "instances": 1,
    "pictures": 1, "topdown": 1, "scene_files": 1,
    "data": 2, "models": 2, "losses": 2, "lifting": 2,
    "data_prep": 3, "training": 3, "sampler": 3,
    "baselines": 4, "evaluation": 4, "interchange": 4, "priors": 4,
    "config": 5,
    "generation": 6, "reconstruction": 6, "experiments": 6,
    "api": 7, "viewer": 7,
    "cli": 8, "__main__": 8,
}  # fmt: skip
FOUNDATION = {name for name, row in ROWS.items() if row <= 1}
"""Rows 0 and 1: all that preparing and judging may stand on, beside themselves."""

OWNERS = {
    "h5py": ["sceneprior/shards.py"],
    "pyrender": ["sceneprior/offscreen/"],
    "OpenGL": ["sceneprior/offscreen/"],
    "numba": ["sceneprior/silhouettes/", "sceneprior/lifting/", "sceneprior/offscreen/zbuffer.py"],
    "triton": ["sceneprior/silhouettes/"],
    "lightning": ["sceneprior/training/", "sceneprior/sampler/", "sceneprior/baselines/"],
    "wandb": ["sceneprior/training/"],
    "safetensors": ["sceneprior/priors/"],
    "huggingface_hub": ["sceneprior/priors/"],
    "pxr": ["sceneprior/scene_files.py"],
    "yaml": ["sceneprior/settings.py", "data_prep/homes/furniture.py"],
    "pydantic": [
        "sceneprior/settings.py", "sceneprior/scene.py", "sceneprior/models/",
        "sceneprior/training/", "sceneprior/sampler/", "sceneprior/baselines/",
        "sceneprior/config.py",
        "sceneprior/experiments/comparison.py", "data_prep/",
    ],
    "typer": [
        "sceneprior/cli/", "data_prep/cli.py", "data_prep/homes/command.py",
        "data_prep/inspection/command.py",
    ],
    "jinja2": ["sceneprior/evaluation/"],
    "efficientnet_lite_pytorch": ["sceneprior/evaluation/"],
    "skimage": ["sceneprior/geometry/isosurface.py"],
    "fast_simplification": ["sceneprior/geometry/isosurface.py"],
    "sklearn": [
        "sceneprior/evaluation/", "sceneprior/lifting/shapes", "sceneprior/sampler/stage",
    ],
    "scipy.optimize": [
        "sceneprior/losses/matching.py", "sceneprior/evaluation/", "data_prep/inspection/causes.py",
    ],
    "cv2": ["data_prep/"],
    "viser": ["sceneprior/viewer/"],
    "distributed": ["data_prep/engine/cluster.py"],
    "dask": ["data_prep/engine/cluster.py"],
}  # fmt: skip


def imports(path: Path) -> set[str]:
    """Full names of every module a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layer"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


def layer_of(module: str) -> str | None:
    """`sceneprior.losses.shape` -> losses; None for what is not ours."""
    parts = module.split(".")
    if parts[0] == "data_prep":
        return "data_prep"
    if parts[0] != "sceneprior" or len(parts) == 1 or parts[1] in sceneprior.__all__:
        return None
    return parts[1]


def layer_of_file(path: Path) -> str | None:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return layer_of(".".join(parts)) if parts[-1] != "__init__" or len(parts) > 2 else None


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def allowed(layer: str) -> set[str]:
    if layer == "data_prep":
        return FOUNDATION | {layer}  # recipes are read and checked as settings are
    if layer == "evaluation":
        return (FOUNDATION - {"settings"}) | {layer}
    below = {name for name, row in ROWS.items() if row <= ROWS[layer]}
    return below if layer in ("cli", "__main__") else below - {"data_prep"}


def test_every_module_has_a_row():
    layers = {layer_of_file(path) for path in FILES} - {None}
    assert layers == set(ROWS)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_look_down_only(path):
    layer = layer_of_file(path)
    if layer is None:
        return
    used = {layer_of(module) for module in imports(path)} - {None}
    assert used <= allowed(layer), f"{name_of(path)} imports {sorted(used - allowed(layer))}"


@pytest.mark.parametrize("library", OWNERS)
def test_each_heavy_library_has_one_front_door(library):
    users = [
        name_of(path)
        for path in FILES
        if any(f"{module}.".startswith(f"{library}.") for module in imports(path))
    ]
    strangers = [user for user in users if not any(map(user.startswith, OWNERS[library]))]
    assert strangers == []


PAPER = [path for path in FILES if layer_of_file(path) in ("models", "losses", "training")]


@pytest.mark.parametrize("path", PAPER, ids=name_of)
def test_the_papers_modules_name_no_baseline(path):
    named = re.findall(r"(?i)lstm|atiss|sync2gen|gan(?:config|stage)", path.read_text())
    assert named == []


def test_the_rules_can_fail(tmp_path):
    """A table that forbids nothing would pass, too."""
    assert "training" not in allowed("models") and "models" not in allowed("evaluation")
    assert "generation" not in allowed("evaluation") and "evaluation" in allowed("generation")
    assert "config" not in allowed("baselines") and "data_prep" not in allowed("generation")
    path = tmp_path / "file.py"
    path.write_text("def f():\n    from scipy.optimize import linear_sum_assignment\n")
    assert "scipy.optimize" in imports(path)


def test_the_wheel_carries_every_package():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent for path in FILES if path.name == "__init__.py"}
    missing = {".".join(folder.relative_to(ROOT).parts) for folder in folders} - set(listed)
    assert not missing


def loaded_after(code: str) -> set[str]:
    """Top-level names in sys.modules after running code in a fresh process."""
    code += "\nimport sys; print('|' + ' '.join({name.split('.')[0] for name in sys.modules}))"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(answer.stdout.rpartition("|")[2].split())


def test_importing_the_package_loads_nothing_heavy():
    loaded = loaded_after("import sceneprior")
    assert "sceneprior" in loaded
    assert not loaded & {"torch", "numpy", "typer", "numba", "lightning", "h5py"}


TRAINING = {"lightning", "torchmetrics", "h5py", "sklearn", "matplotlib", "pandas"}
"""What trains and evaluates; making rooms has nothing to do with it."""


def test_making_rooms_loads_nothing_that_trains():
    code = "import sceneprior; sceneprior.load('demo-bedroom').sample(2)"
    loaded = loaded_after(code)
    assert {"torch", "skimage"} <= loaded
    # sympy stands for torch's compiler, the slowest to import of all.
    assert not loaded & (TRAINING | {"sympy", "numba", "trimesh", "pyrender"})


def test_writing_rooms_takes_the_z_buffer_and_no_gl(tmp_path):
    command = ["synthesize", "--run", "demo-bedroom", "-n", "1", "--out", str(tmp_path / "rooms")]
    loaded = loaded_after(
        f"import sys\nsys.argv = ['sceneprior', *{command!r}]\n"
        "from sceneprior.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    )
    assert {"numba", "trimesh"} <= loaded
    assert not loaded & (TRAINING | {"sympy", "pyrender", "OpenGL"})


@pytest.mark.parametrize("arguments", [["--help"], ["fit", "--help"], ["prep-front", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    code = (
        "import sys\n"
        f"sys.argv = ['sceneprior', *{arguments!r}]\n"
        "from sceneprior.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    )
    loaded = loaded_after(code)
    assert "typer" in loaded
    heavy = {"torch", "numpy", "lightning", "trimesh", "numba", "scipy", "h5py", "pyrender", "cv2"}
    assert not loaded & heavy
