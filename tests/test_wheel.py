"""A built wheel works outside the repository: it carries the configs, the recipes, the page. An
editable install works beside the clone, too."""

import os
import site
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the wheel's contents and nothing else of ours."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    # Build from a copy: setuptools writes build/ and egg-info where it builds.
    subprocess.run(["git", "clone", "-q", str(ROOT), str(source)], check=True)
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, source], check=True
    )
    (wheel,) = folder.glob("*.whl")
    target = folder / "site"
    subprocess.run([*pip, "install", "--no-deps", "--target", target, wheel], check=True)
    return target


def test_an_editable_install_works_in_the_folder_that_holds_the_clone(tmp_path):
    clone, prefix = tmp_path / "sceneprior", tmp_path / "prefix"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    subprocess.run(
        [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", "install", "--no-deps",
         "--no-build-isolation", "--ignore-installed", "--prefix", prefix, "--editable", clone],
        check=True,
    )  # fmt: skip
    (path_file,) = prefix.rglob("*.pth")
    # -S: this environment has an editable install of its own, whose place on the path comes later.
    folders = [str(path_file.parent), *site.getsitepackages()]
    code = (
        f"import site; [site.addsitedir(folder) for folder in {folders!r}]; import sceneprior\n"
        "from sceneprior.apps.config import load_config\n"
        "assert load_config('bedroom.yaml').model.max_objects == 13\n"
        "print(sceneprior.load.__module__, sceneprior.__file__)"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=tmp_path, capture_output=True, text=True,
        env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"sceneprior.apps.api {clone / 'sceneprior/__init__.py'}\n"


def run(installed: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(installed)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True
    )


def test_shipped_configs_are_found_by_name(installed, tmp_path):
    code = (
        "import sceneprior, data_prep.front.recipe\n"
        "from sceneprior.apps.config import load_config\n"
        "assert load_config('bedroom.yaml').model.max_objects == 13\n"
        "assert data_prep.front.recipe.load_recipe('bedroom')\n"
        "print(sceneprior.__file__)"
    )
    done = run(installed, "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(installed)


def test_homes_become_shards_and_the_page_template_is_there(installed, tmp_path):
    assert len(list(installed.glob("sceneprior/evaluation/*.jinja"))) == 5
    page = installed / "sceneprior/apps/viewer"
    assert (page / "page.css").is_file() and (page / "map.svg").is_file()
    viewer = installed / "sceneprior/evaluation/model_viewer"
    assert list(viewer.glob("*.js")) and len(list(viewer.glob("LICENSE.*"))) == 4
    done = run(installed, "-m", "sceneprior", "make-homes", "homes", "--rooms", "4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = run(
        installed, "-m", "sceneprior", "prep-front", "--front", "homes/3D-FRONT",
        "--future", "homes/3D-FUTURE-model", "--splits", "homes/splits/bedroom.csv",
        "--out", "shards", "--workers", "1", "--views-per-m2", "0.5", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "shards/index.json").is_file()


def test_a_prior_of_the_package_makes_rooms(installed, tmp_path):
    done = run(
        installed, "-m", "sceneprior", "synthesize", "--run", "procthor-bedroom", "-n", "2",
        "--out", "rooms", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout == "Wrote 2 rooms to rooms (from: sampler)\n"
    assert len(list((tmp_path / "rooms").glob("*.glb"))) == 2
