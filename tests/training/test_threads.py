"""The number of threads that the environment sets changes no result."""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tiny_runs import tiny_lifted_settings

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
DECOMPOSED = """
import sys; sys.argv = ["sceneprior", "--version"]
from sceneprior.apps.cli import main
try: main()
except SystemExit: pass
import numpy as np, torch
from sceneprior.lifted.prototypes import embed_posed
embed_posed(np.random.default_rng(0).random((32, 8, 8, 8)) < 0.5, 32).tofile("codes")
"""
"""Codes in the process of a command: the eigenvectors of alike eigenvalues hang on every bit."""


def test_threads_wait_without_spinning_unless_the_user_says_otherwise():
    say = [sys.executable, "-c", "import sceneprior, os; print(os.environ['OMP_WAIT_POLICY'])"]
    for own, wanted in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"} | own
        said = subprocess.run(say, capture_output=True, text=True, check=True, env=environment)
        assert said.stdout.strip() == wanted


@pytest.mark.slow
def test_results_are_the_same_on_any_number_of_threads(toy_shards, toy_run, tmp_path):
    shards, images = tmp_path / "shards", ["--run", toy_run, "--shards", toy_shards, "--limit", 2]
    settings = tiny_lifted_settings(shards, shape__epochs=1)
    settings |= {"sampler": {"epochs": 1, "width": 16, "layers": 1, "heads": 2, "val_every": 1}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    calls = {
        "-c": [DECOMPOSED],
        "fit": ["--config", "../config.yaml", "--logger", "csv", "--run", "run"],
        "reconstruct": [*images, "--split", "test", "--out", "rooms"],
        "eval-svr": [*images, "--out", "scores.json"],
    }
    made = []
    for threads in ("1", "2"):
        # Without what was lifted from masks, which is cached beside the shards.
        shutil.rmtree(shards, ignore_errors=True)
        shutil.copytree(toy_shards, shards, ignore=shutil.ignore_patterns("lifted_*"))
        (folder := tmp_path / threads).mkdir()
        environment = os.environ | dict.fromkeys(THREADS, threads)
        for name, arguments in calls.items():
            called = [sys.executable, *(() if name == "-c" else ("-m", "sceneprior")), name]
            command = [*called, *map(str, arguments)]
            subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
        made.append(hashes(folder))
    one, two = made
    wanted = {"codes", "run/sampler/final.ckpt", "scores.json", "rooms/toy_test_00_view0.glb"}
    assert wanted < one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def hashes(folder: Path) -> dict[str, str]:
    """Hashes of all files, without the CPU time that scores hold."""
    clock = re.compile(rb'"cpu_seconds_an_image".*')
    return {
        str(path.relative_to(folder)): hashlib.sha256(clock.sub(b"", path.read_bytes())).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
