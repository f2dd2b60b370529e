"""The same shards from a Dask cluster: a scheduler and two workers in processes of their own."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from front_files import bedroom
from front_jobs import digests, front_job

from data_prep.engine import cluster as module
from data_prep.engine.build import build_shards
from data_prep.engine.cluster import cluster
from sceneprior.core.errors import InputError


@pytest.fixture(scope="module")
def dask(tmp_path_factory):
    """Starts processes of a cluster on free ports: dask("scheduler"), dask("worker", address)."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed ([cluster])")
    folder = tmp_path_factory.mktemp("dask")
    processes = []

    def start(what, *words):
        log = (folder / f"{len(processes)}.log").open("w")
        command = [sys.executable, "-m", "dask", what, *words]
        process = subprocess.Popen(
            command, cwd=folder, stdout=log, stderr=log, start_new_session=True
        )
        processes.append(process)
        return process

    def scheduler():
        path = folder / f"scheduler{len(processes)}.json"
        process = start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
            "--scheduler-file", str(path),
        )  # fmt: skip
        deadline = time.monotonic() + 400
        while time.monotonic() < deadline:
            try:
                return json.loads(path.read_text())["address"], process
            except (OSError, ValueError):
                time.sleep(0.05)
        raise TimeoutError("no scheduler came up")

    def worker(address):
        # Without a nanny a killed worker stays away; two threads must not disturb each other.
        return start(
            "worker", address, "--nthreads", "2", "--no-nanny", "--no-dashboard",
            "--local-directory", str(folder),
        )  # fmt: skip

    yield scheduler, worker
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_the_bytes_are_those_of_this_machine_even_if_a_worker_dies(
    front, tmp_path, dask, monkeypatch
):
    scheduler, worker = dask
    address, _ = scheduler()
    workers = [worker(address), worker(address)]
    for k in range(10):
        front.house(f"house{k}", *(bedroom(f"Bedroom-{k}-{i}") for i in range(6)))
    (front.front / "broken.json").write_text("{")
    alone, one, two = tmp_path / "alone", tmp_path / "one", tmp_path / "two"
    build_shards(front_job(front, alone))
    expected = digests(alone)
    monkeypatch.chdir(tmp_path)  # relative paths mean this process's folder, not a worker's
    summary = build_shards(front_job(front, one.relative_to(tmp_path), scheduler=address))
    assert summary.shards_made == 8 and summary.statuses == {"prepared": 60, "failed": 1}
    assert digests(one) == expected

    def kill_one(*arguments):
        for result in real(*arguments):
            workers[0].kill()
            yield result

    real = module.in_order
    with pytest.MonkeyPatch.context() as patch:
        calls = iter([real, real, kill_one])  # renderer's kind, survey, shards
        patch.setattr(module, "in_order", lambda *arguments: next(calls)(*arguments))
        build_shards(front_job(front, two, scheduler=address))
    assert workers[0].wait(timeout=10) == -signal.SIGKILL and workers[1].poll() is None
    assert digests(two) == expected

    # Sentences pass from a worker as they are, and an unknown release is not worked with.
    with pytest.raises(InputError, match=r"^Room broken failed: broken\.json is not JSON"):
        build_shards(front_job(front, tmp_path / "three", scheduler=address, strict=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "__version__", "9.9")
        with pytest.raises(InputError, match=r"has sceneprior 0\.\d+.*, and this is 9\.9: sh"):
            build_shards(front_job(front, tmp_path / "four", scheduler=address))
    assert not (tmp_path / "three").exists() and not (tmp_path / "four").exists()


def test_a_scheduler_that_dies(front, tmp_path, dask):
    scheduler, worker = dask
    address, process = scheduler()
    worker(address)
    front.house("house", *(bedroom(f"Bedroom-{i}") for i in range(40)))

    def kill_it(*arguments):
        for result in real(*arguments):
            process.kill()
            yield result

    real = module.in_order
    job = front_job(front, tmp_path / "shards", scheduler=address)
    with pytest.MonkeyPatch.context() as patch:
        calls = iter([real, real, kill_it])
        patch.setattr(module, "in_order", lambda *arguments: next(calls)(*arguments))
        with pytest.raises(InputError, match=r"The cluster at .* was lost .*Finished shards"):
            build_shards(job)
    assert build_shards(replace(job, scheduler=None)).shards_kept >= 1


def test_a_cluster_that_is_not_there(dask, monkeypatch):
    scheduler, _ = dask
    monkeypatch.setattr(module, "_CONNECT_S", 1)
    monkeypatch.setattr(module, "_WORKERS_S", 0.2)
    address, _ = scheduler()
    with (
        pytest.raises(InputError, match=rf"{address} has no workers; start some with `dask worker"),
        cluster(address),
    ):
        pass
    with (
        pytest.raises(InputError, match=r"No Dask scheduler answers at tcp://127.0.0.1:9"),
        cluster("tcp://127.0.0.1:9"),
    ):
        pass
    with (
        pytest.raises(InputError, match=r"No Dask scheduler answers at nonsense://x"),
        cluster("nonsense://x"),
    ):
        pass


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(InputError, match=r"needs dask\.distributed; install it with .*\[cluster\]"),
        cluster("tcp://127.0.0.1:9"),
    ):
        pass
