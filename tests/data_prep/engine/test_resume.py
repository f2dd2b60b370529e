"""A run that dies, at whatever moment, and is run again leaves what an undisturbed run leaves."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from front_files import bedroom
from front_jobs import digests, front_job

from data_prep.engine.build import build_shards
from sceneprior.core import files


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
    """The whole command is stopped; Ctrl-C gives exit code 130, and only whole shards remain."""
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(40)))
    script = tmp_path / "run.py"
    script.write_text(
        "import typer\nfrom data_prep.cli import add_commands\n"
        "from sceneprior.apps.cli.options import with_workers\n"
        "app = typer.Typer()\nadd_commands(app, with_workers)\n"
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
