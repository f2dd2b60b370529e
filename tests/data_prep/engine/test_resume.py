"""A run that dies, at whatever moment, and is run again leaves what an undisturbed run leaves."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from front_files import bedroom
from front_jobs import digests, front_job

from data_prep.engine.build import build_shards
from sceneprior.core import files

KILLS = 10

# Forks one run of the job for each line on stdin: a process group in which everything is imported,
# so that kills fall into the work. The workers are forked, too (nothing here holds a GL context).
_SERVER = """
import os, pickle, sys
from dataclasses import replace
from pathlib import Path
import data_prep.engine.workers
from data_prep.engine.build import build_shards

data_prep.engine.workers._START_METHOD = "fork"
job = pickle.loads(Path(sys.argv[1]).read_bytes())
build_shards(replace(job, out=job.out.with_name("undisturbed"), workers=1))
print("ready", flush=True)
while sys.stdin.readline():
    child = os.fork()
    if not child:
        os.setsid()
        os.dup2(os.open(sys.argv[1] + ".log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        print(os.getpid(), flush=True)
        build_shards(job)
        os._exit(0)
    sys.stdin.readline()  # until it is waited for, the number of a finished process stays its own
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Runs:
    """Starts a job again and again."""

    def __init__(self, job, folder: Path):
        import pickle

        (folder / "job.pickle").write_bytes(pickle.dumps(job))
        (folder / "server.py").write_text(_SERVER)
        self._process = subprocess.Popen(
            [sys.executable, folder / "server.py", folder / "job.pickle"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._log = folder / "job.pickle.log"
        assert self._read() == "ready"

    def _read(self) -> str:
        return self._process.stdout.readline().strip()

    def _tell(self, word: str) -> None:
        self._process.stdin.write(word + "\n")
        self._process.stdin.flush()

    def run(self, kill_after_s: float | None = None, whole_group: bool = True) -> tuple[int, float]:
        """Exit status and seconds of one run; after `kill_after_s` it is killed."""
        self._tell("go")
        group = int(self._read())
        start = time.monotonic()
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            (os.killpg if whole_group else os.kill)(group, signal.SIGKILL)
        self._tell("wait")
        status = int(self._read())
        seconds = time.monotonic() - start
        while True:  # workers see that their parent died a moment later
            try:
                os.killpg(group, 0)
            except ProcessLookupError:
                return status, seconds
            time.sleep(0.005)

    def close(self) -> None:
        self._process.stdin.close()
        print(self._log.read_text()[-4000:])  # pytest shows it if the test fails
        self._process.wait(timeout=400)


@pytest.fixture
def runs(front, tmp_path):
    for k in range(16):
        front.house(f"house{k:02d}", *(bedroom(f"Bedroom-{k}-{i}") for i in range(4)))
    rules = ("views.image_size=[60, 80]", "views.at_least=3", "views.per_m2=0.1")
    server = Runs(front_job(front, tmp_path / "shards", workers=2, rules=rules), tmp_path)
    yield server
    server.close()


@pytest.mark.slow
def test_ten_random_kills(runs, tmp_path):
    """kill -9 of main process and workers, or of the main process alone, at random moments."""
    out = tmp_path / "shards"
    expected = digests(tmp_path / "undisturbed")
    assert len(expected) == 9 * 2 + 2 + 4  # shards with reports, models, and four JSON and CSV
    status, seconds = runs.run()
    assert status == 0 and digests(out) == expected
    out.rename(tmp_path / "first")
    rng = np.random.default_rng(0)
    killed = halfway = 0
    while killed < KILLS:
        delay = float(rng.uniform(0, 0.6 * seconds))
        status, _ = runs.run(delay, whole_group=killed % 3 != 2)
        killed += status == -signal.SIGKILL
        found = digests(out) if out.exists() else {}
        # At every moment: what has its final name is whole.
        assert {n: d for n, d in found.items() if not n.endswith(".part")}.items() <= (
            expected.items()
        )
        print(f"{status} after {delay:.2f} of {seconds:.2f} s, {len(found)} files")
        halfway += 0 < len(found) < len(expected)
        if status == 0:  # done before it could be killed: begin anew
            assert found == expected
            out.rename(tmp_path / f"done{killed}-{time.monotonic_ns()}")
    assert halfway >= 3
    assert runs.run()[0] == 0
    assert digests(out) == expected


class Died(BaseException):
    """Stands for kill -9: whatever the process does from here on must not happen."""


class Disk:
    """Counts what a run does to the disk; at the `last` step the process dies half-way through."""

    def __init__(self, monkeypatch, last: int):
        self.steps, self.last = 0, last
        for owner, name in (
            (files.os, "fsync"), (Path, "replace"), (Path, "unlink"), (Path, "mkdir"),
            (Path, "rmdir"),
        ):  # fmt: skip
            monkeypatch.setattr(owner, name, self._counted(getattr(owner, name), name))

    def _counted(self, action, name):
        def act(*arguments, **options):
            self.steps += 1
            if self.steps == self.last and name == "fsync":
                descriptor = arguments[0]
                status = os.fstat(descriptor)
                if stat.S_ISREG(status.st_mode):
                    os.truncate(descriptor, status.st_size // 2)
            if self.steps >= self.last:
                raise Died
            return action(*arguments, **options)

        return act


def test_a_process_may_die_at_any_step(front, tmp_path):
    """Every write, rename and deletion once as the last thing that the process did."""
    front.house("house", bedroom("Bedroom-1"), bedroom("Bedroom-2"))
    rules = ("views.image_size=[30, 40]", "views.at_least=1", "views.per_m2=0.1")

    def dies_at(step: int, out: Path) -> bool:
        with pytest.MonkeyPatch.context() as patch:
            disk = Disk(patch, step)
            try:
                build_shards(front_job(front, out, rules=rules))
            except Died:
                return True
        assert disk.steps < step
        return False

    build_shards(front_job(front, tmp_path / "undisturbed", rules=rules))
    expected = digests(tmp_path / "undisturbed")
    step, parts, finishes = 1, 0, 0
    while dies_at(step, tmp_path / f"{step}"):
        out = tmp_path / f"{step}"
        finished = (out / "index.json").exists()
        parts += len(list(out.rglob("*.part")))
        build_shards(front_job(front, out, rules=rules))
        assert digests(out) == expected, f"step {step}"
        finishes += finished
        step += 1
    # 10 files, each synced and renamed; index.json comes last.
    assert step > 40 and parts >= 10 and finishes <= 2


def test_a_damaged_folder_is_not_taken_for_finished(front, tmp_path):
    """While a missing shard is made again, no index.json says that all is there."""
    front.house("house", bedroom("Bedroom-1"), bedroom("Bedroom-2"), bedroom("Bedroom-3"))
    out = tmp_path / "shards"
    build_shards(front_job(front, out))
    expected = digests(out)
    (out / "train" / "bedroom_0000.h5").unlink()
    with pytest.MonkeyPatch.context() as patch:
        Disk(patch, 6)
        with pytest.raises(Died):
            build_shards(front_job(front, out))
    assert not (out / "index.json").exists() and not (out / "report.json").exists()
    build_shards(front_job(front, out))
    assert digests(out) == expected


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill"])
def test_the_command_is_stopped_and_gone_on_with(front, tmp_path, start, how):
    """As a user meets it; after Ctrl-C with exit code 130 and nothing but whole shards."""
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(40)))
    script = tmp_path / "run.py"
    script.write_text(
        "import typer\nfrom data_prep.cli import add_commands\n"
        "app = typer.Typer()\nadd_commands(app)\n"
        "if __name__ == '__main__':\n    app()\n"
    )
    out = tmp_path / "shards"
    command = [
        sys.executable, str(script), "prep-front", "--front", str(front.front), "--out", str(out),
        "--future", str(front.future), "--workers", "2", "--renderer", "software",
        "--views-per-m2", "3",
    ]  # fmt: skip
    process = start(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 400
    while not list(out.glob("**/*.h5")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, how)
    _, errors = process.communicate(timeout=400)
    assert "Traceback" not in errors and not (out / "index.json").exists()
    if how == signal.SIGINT:
        assert process.returncode == 130, errors
        assert "Stopped; finished shards are kept" in errors and not list(out.glob("**/*.part"))
    kept = digests(out, "**/*.h5")
    assert 1 <= len(kept) < 6
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert f"{6 - len(kept)} shards made, {len(kept)} already there" in done.stdout
    assert digests(out, "**/*.h5").items() >= kept.items() and not list(out.glob("**/*.part"))
