"""Numba's kernels are compiled once for a user, also where the package may not be written to."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import sceneprior

CALL = (
    "from sceneprior.render.offscreen import zbuffer\n"
    "zbuffer._project(*(1.0,) * 7, True)\n"
    "stats = zbuffer._project.stats\n"
    "print(zbuffer.__file__, stats.cache_path, len(stats.cache_hits), len(stats.cache_misses))"
)


def test_kernels_of_a_read_only_package_are_kept_for_the_user(tmp_path):
    package = tmp_path / "sceneprior"
    ignored = shutil.ignore_patterns("__pycache__", "*.prior", "model_viewer")
    shutil.copytree(Path(sceneprior.__file__).parent, package, ignore=ignored)
    # A file in the folder's place, since root may write to read-only folders.
    (package / "render" / "offscreen" / "__pycache__").touch()
    cache = tmp_path / "cache"
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    for hits, misses in ((0, 1), (1, 0)):
        done = subprocess.run(
            [sys.executable, "-c", CALL],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
        )  # fmt: skip
        file, kept, *counts = done.stdout.split()
        assert Path(file).is_relative_to(package)
        assert Path(kept).is_relative_to(cache)
        assert counts == [str(hits), str(misses)]
