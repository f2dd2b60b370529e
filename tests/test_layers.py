"""The layer table of docs/architecture.md, read off the imports of every file."""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import sceneprior

ROOT = Path(__file__).parents[1]
FILES = sorted(path for name in ("sceneprior", "data_prep") for path in (ROOT / name).rglob("*.py"))

ALLOWED = {
    "core": {"core"},
    "furniture": {"core", "furniture"},
    "render": {"core", "render"},
    "training": {"core", "render", "training"},
    "data_prep": {"core", "furniture", "render", "data_prep"},
    "paper": {"core", "render", "training", "paper"},
    "lifted": {"core", "render", "training", "paper", "lifted"},
    "baselines": {"core", "render", "training", "paper", "baselines"},
    "evaluation": {"core", "render", "evaluation"},
    "interchange": {"core", "render", "interchange"},
    "apps": {
        "core", "furniture", "render", "training", "paper", "lifted", "baselines", "evaluation",
        "interchange", "apps",
    },
    "__main__": {"apps"},
}  # fmt: skip
"""Folders whose modules a folder may import."""
MAY_TOO = {
    # Commands that prepare data import `data_prep` when they run.
    "sceneprior/apps/cli/": {"data_prep"},
}

BUDGET = {
    "data_prep": (12797, 60),
    "sceneprior/core": (6725, 30),
    "sceneprior/furniture": (591, 4),
    "sceneprior/render": (4618, 23),
    "sceneprior/training": (1565, 9),
    "sceneprior/paper": (2749, 13),
    "sceneprior/lifted": (9102, 45),
    "sceneprior/baselines": (2923, 14),
    "sceneprior/evaluation": (4478, 21),
    "sceneprior/interchange": (928, 5),
    "sceneprior/apps": (7407, 42),
}
"""Most lines and modules of a folder. They go down freely, and up only in a commit that says what
it bought and what went for it."""

OWNERS = {
    "h5py": [
        "sceneprior/core/shard", "sceneprior/core/files.py", "data_prep/readers/annotations.py",
    ],
    "pyrender": ["sceneprior/render/offscreen/"],
    "OpenGL": ["sceneprior/render/offscreen/"],
    "numba": [
        "sceneprior/render/silhouettes/", "sceneprior/render/offscreen/zbuffer.py",
        "sceneprior/lifted/lifting/", "data_prep/tracks/",
    ],
    "triton": ["sceneprior/render/silhouettes/"],
    "lightning": [
        "sceneprior/training/", "sceneprior/paper/stages.py", "sceneprior/lifted/sampler/",
        "sceneprior/baselines/",
    ],
    "safetensors": ["sceneprior/apps/priors/"],
    "huggingface_hub": ["sceneprior/apps/priors/"],
    "pxr": ["sceneprior/render/scene_simulators.py"],
    "yaml": ["sceneprior/core/settings.py", "sceneprior/furniture/tables.py"],
    "pydantic": [
        "sceneprior/core/", "sceneprior/training/", "sceneprior/paper/", "sceneprior/lifted/",
        "sceneprior/baselines/", "sceneprior/apps/decoders.py", "sceneprior/apps/experiments/",
        "sceneprior/evaluation/", "data_prep/",
    ],
    "typer": ["sceneprior/apps/cli/", "data_prep/cli.py"],
    "jinja2": ["sceneprior/evaluation/"],
    "efficientnet_lite_pytorch": ["sceneprior/evaluation/"],
    "skimage": ["sceneprior/core/surfaces", "sceneprior/lifted/lifting/part_loss"],
    "manifold3d": ["sceneprior/core/parts.py", "sceneprior/core/shell.py"],
    "fast_simplification": ["sceneprior/core/surfaces.py"],
    "sklearn": ["sceneprior/evaluation/", "sceneprior/lifted/sampler/prototype_statistics"],
    "scipy.optimize": [
        "sceneprior/core/boxes.py", "sceneprior/lifted/shape_morphing.py",
        "sceneprior/paper/matching.py", "sceneprior/evaluation/",
    ],
    "cv2": ["data_prep/readers/posed/cameras.py", "sceneprior/evaluation/metrics/"],
    "viser": ["sceneprior/apps/viewer/"],
    "mujoco": ["sceneprior/evaluation/metrics/physics.py"],
    "coacd": ["sceneprior/core/colliders.py"],
}  # fmt: skip


@cache
def imports(path: Path) -> set[str]:
    """Full names of every module a file imports, wherever in the file."""
    return imported(path.read_text())


def imported(source: str) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


def layer_of(module: str) -> str | None:
    """`sceneprior.paper.losses` -> losses; None for what is not ours."""
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


def allowed(path: str, layer: str) -> set[str]:
    more = [folders for start, folders in MAY_TOO.items() if path.startswith(start)]
    return ALLOWED[layer].union(*more)


def test_every_module_has_a_row():
    layers = {layer_of_file(path) for path in FILES} - {None}
    assert layers == set(ALLOWED)


def test_imports_look_down_only():
    beyond = {}
    for path in FILES:
        layer = layer_of_file(path)
        if layer is not None:
            used = {layer_of(module) for module in imports(path)} - {None}
            beyond[name_of(path)] = used - allowed(name_of(path), layer)
    assert not {name: sorted(folders) for name, folders in beyond.items() if folders}


def test_no_import_circle():
    """Imports inside functions count; those for type checkers do not."""
    modules = {name_of(path).removesuffix(".py").replace("/", "."): path for path in FILES}
    packages = {name.removesuffix(".__init__") for name in modules if name.endswith("__init__")}
    graph = {}
    for name, path in modules.items():
        run = "\n".join(
            ast.unparse(node)
            for node in ast.parse(path.read_text()).body
            if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        )
        graph[name] = (imported(run) & modules.keys()) - packages - {name}
    TopologicalSorter(graph).prepare()  # raises a CycleError, which names the modules


def test_folders_keep_their_budget():
    """Lines and modules of each folder, as `wc -l` counts them."""
    beyond = []
    for folder, (lines, modules) in BUDGET.items():
        files = [path for path in FILES if name_of(path).startswith(f"{folder}/")]
        found = sum(len(path.read_text().splitlines()) for path in files), len(files)
        if found[0] > lines or found[1] > modules:
            beyond.append(f"{folder}: {found} of {(lines, modules)}")
    assert not beyond
    outside = {name_of(path).rpartition("/")[0] for path in FILES} - {"sceneprior"}
    assert all(any(f"{name}/".startswith(f"{folder}/") for folder in BUDGET) for name in outside)


def test_each_heavy_library_has_one_front_door():
    for library, doors in OWNERS.items():
        users = [
            name_of(path)
            for path in FILES
            if any(f"{module}.".startswith(f"{library}.") for module in imports(path))
        ]
        strangers = [user for user in users if not any(map(user.startswith, doors))]
        assert strangers == [], f"{library} has one front door"
        unused = [door for door in doors if not any(user.startswith(door) for user in users)]
        assert unused == [], f"a front door of {library} that nothing uses"


def test_what_methods_share_names_no_baseline():
    for path in FILES:
        if layer_of_file(path) in ("training", "paper"):
            named = re.findall(
                r"(?i)lstm|atiss|sync2gen|set_?flow|gan(?:config|stage)", path.read_text()
            )
            assert named == [], name_of(path)


def test_the_rules_can_fail(tmp_path):
    """A table that forbids nothing would pass, too."""
    for layer, below in ALLOWED.items():
        assert not any(layer in ALLOWED[other] for other in below - {layer}), "a circle"
    assert "lifted" not in allowed("sceneprior/paper/prior.py", "paper")
    assert "render" not in allowed("sceneprior/core/scene.py", "core")
    path = tmp_path / "file.py"
    path.write_text("def f():\n    from scipy.optimize import linear_sum_assignment\n")
    assert "scipy.optimize" in imports(path)


def test_the_wheel_carries_every_package():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent for path in FILES if path.name == "__init__.py"}
    missing = {".".join(folder.relative_to(ROOT).parts) for folder in folders} - set(listed)
    assert not missing


def loaded_after(code: str, levels: int = 1) -> set[str]:
    """The first `levels` of the dotted names in sys.modules, after code ran in a fresh process."""
    code += "\nimport sys; print('|' + ' '.join("
    code += f"{{'.'.join(name.split('.')[:{levels}]) for name in sys.modules}}))"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(answer.stdout.rpartition("|")[2].split())


def test_importing_the_package_loads_nothing_heavy():
    loaded = loaded_after("import sceneprior")
    assert "sceneprior" in loaded
    assert not loaded & {"torch", "numpy", "typer", "numba", "lightning", "h5py"}


TRAINING = {"lightning", "torchmetrics", "h5py", "sklearn", "matplotlib", "pandas"}
"""Modules for training and evaluation, which sampling rooms must not import."""


def test_drawing_a_room_reads_its_own_method_alone_and_nothing_that_trains():
    code = "import sceneprior; sceneprior.load('demo-bedroom').sample(1)"
    every = loaded_after(code, 3)
    assert {"torch", "manifold3d"} <= every
    # sympy stands for torch's compiler, the slowest to import of all.
    assert not every & (TRAINING | {"sympy", "numba", "trimesh", "pyrender"})
    loaded = {name for name in every if name.startswith(("sceneprior", "data_prep"))}
    folders = {".".join(name.split(".")[:2]) for name in loaded}
    assert folders == {
        "sceneprior", "sceneprior.core", "sceneprior.training", "sceneprior.paper",
        "sceneprior.lifted", "sceneprior.apps",
    }  # fmt: skip
    assert "sceneprior.paper.stages" not in loaded and "sceneprior.paper.config" not in loaded
    assert not {"sceneprior.apps.experiments", "sceneprior.apps.reconstruction"} & loaded


def test_writing_rooms_takes_the_z_buffer_and_no_gl(tmp_path):
    command = ["synthesize", "--run", "demo-bedroom", "-n", "1", "--out", str(tmp_path / "rooms")]
    loaded = loaded_after(
        f"import sys\nsys.argv = ['sceneprior', *{command!r}]\n"
        "from sceneprior.apps.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    )
    assert {"numba", "trimesh"} <= loaded
    assert not loaded & (TRAINING | {"sympy", "pyrender", "OpenGL"})


@pytest.mark.parametrize("arguments", [["--help"], ["fit", "--help"], ["prep-front", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    code = (
        "import sys\n"
        f"sys.argv = ['sceneprior', *{arguments!r}]\n"
        "from sceneprior.apps.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    )
    loaded = loaded_after(code)
    assert "typer" in loaded
    heavy = {"torch", "numpy", "lightning", "trimesh", "numba", "scipy", "h5py", "pyrender", "cv2"}
    assert not loaded & heavy
