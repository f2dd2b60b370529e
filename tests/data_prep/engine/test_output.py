"""Full disks, folders that cannot be written, workers that died: a sentence, and no halves."""

import errno
import os
import resource
import stat
import subprocess
import sys

import pytest
from front_files import bedroom
from front_jobs import digests, front_job, three_houses
from refusals import refused
from toy_source import ToySource

from data_prep.engine.build import Job, build_shards, claimed
from sceneprior.core import files


def test_a_folder_that_cannot_be_written(front, tmp_path):
    three_houses(front)
    (tmp_path / "file").write_text("")
    with refused("engine/folder below a file", tmp=tmp_path):
        build_shards(front_job(front, tmp_path / "file" / "shards"))
    assert (tmp_path / "file").read_text() == ""


@pytest.mark.parametrize("after", [0, 1, 2, 4, 5, 7, 9])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS], ids=["full", "read-only"])
def test_a_disk_that_fills_up(tmp_path, monkeypatch, number, after):
    """From the `after`-th file on nothing can be written; then there is room again."""
    out, whole = tmp_path / "shards", tmp_path / "whole"
    source = ToySource(12)
    build_shards(Job(source, whole))
    expected = digests(whole)
    count = 0

    def full(descriptor):
        nonlocal count
        count += stat.S_ISREG(os.fstat(descriptor).st_mode)
        if count > after:
            raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with refused(f"engine/disk error {number} after {after} files", tmp=tmp_path):
            build_shards(Job(source, out))
    found = digests(out) if out.exists() else {}
    assert len(found) == after and found.items() <= expected.items()
    build_shards(Job(source, out))
    assert digests(out) == expected


@pytest.mark.parametrize("workers", [1, 2])
def test_the_kernel_refuses_large_files(front, tmp_path, workers):
    """A real limit in a real process: no file may grow beyond 20 kB, and shards do."""
    three_houses(front)
    front.house("more", *(bedroom(f"Bedroom-{k}") for k in range(2)))
    out = tmp_path / "shards"
    command = [
        sys.executable, "-m", "sceneprior", "prep-front", "--front", front.front, "--out", out,
        "--future", front.future, "--workers", str(workers), "--renderer", "software",
        "--views-per-m2", "0.5",
    ]  # fmt: skip
    limit = (20_000, 20_000)
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"NUMBA_CACHE_DIR": ""},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "(rooms " in done.stderr and "cannot be written (File too large)" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(out.rglob("*.part")) and not list(out.rglob("*.h5"))
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_a_worker_left_that_died_on_the_way_is_cleared_away_at_the_end(tmp_path):
    out = tmp_path / "shards"
    with claimed(out):
        (out / "whole").touch()
        (out / "train").mkdir()
        (out / "train" / "toys_0001.report.json.21dc0a4f.part").write_bytes(b"half")
    assert [path.name for path in out.rglob("*") if path.is_file()] == ["whole"]
