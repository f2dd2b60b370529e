"""A map over tasks: results in order wherever it works, failures by name, processes that die."""

import pickle
import sys
from pathlib import Path
from typing import NamedTuple

import parallel_tasks
import pytest
from refusals import refused

from sceneprior.core import parallel
from sceneprior.core.parallel import map_blocks, on_workers, run_tasks


def tasks(*arguments):
    return {f"room {number}": (number, *arguments) for number in range(6)}


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_failures_by_name(tmp_path, workers):
    with on_workers(workers):
        assert run_tasks(parallel_tasks.square, tasks()) == [0, 1, 4, 9, 16, 25]
        with refused("core/tasks that failed", tmp=tmp_path):
            run_tasks(parallel_tasks.fail_at_two, tasks(tmp_path))
    assert len(list(tmp_path.iterdir())) == 6, "the others go on"


class Named(NamedTuple):
    name: str
    number: int


def test_items_of_one_name_are_all_mapped():
    items = [Named("same", number) for number in range(5)]
    found = map_blocks(lambda some, first: [(item.number, first) for item in some], items, 2)
    assert found == [(0, 0), (1, 0), (2, 2), (3, 2), (4, 4)]


def test_after_many_failures_no_other_task_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "MOST_FAILED", 1)
    with pytest.raises(Exception, match="Two"):
        run_tasks(parallel_tasks.fail_at_two, tasks(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2"]


def test_a_task_whose_process_dies_is_run_again_and_in_the_end_named(tmp_path):
    with on_workers(2):
        assert run_tasks(parallel_tasks.die_at_two, tasks(tmp_path, 2)) == [0, 1, 2, 3, 4, 5]
        (tmp_path / "2").unlink()
        with refused("core/task that kills"):
            run_tasks(parallel_tasks.die_at_two, tasks(tmp_path, 99))
    done = [path.name for path in tmp_path.iterdir() if not path.name.startswith("death")]
    assert sorted(done) == ["0", "1", "3", "4", "5"]


def test_what_a_worker_opens_is_kept_for_one_command(tmp_path):
    call = pickle.dumps((parallel.once, Path.read_text, tmp_path / "read"))
    found = []
    for command, text in (("a", "1"), ("a", "2"), ("b", "3")):
        (tmp_path / "read").write_text(text)
        found.append(parallel._run_there(command, Path.cwd(), call).result)
    assert found == ["1", "1", "3"]


def test_only_a_few_tasks_are_submitted_at_a_time(monkeypatch):
    """Arguments and results of ten thousand rooms would fill a scheduler's memory."""
    waiting, most = 0, 0
    submit = parallel._Processes.submit

    def counted(self, *call):
        nonlocal waiting, most
        waiting += 1
        most = max(most, waiting)
        future = submit(self, *call)

        def done(_):
            nonlocal waiting
            waiting -= 1

        future.add_done_callback(done)
        return future

    monkeypatch.setattr(parallel._Processes, "submit", counted)
    with on_workers(2):
        run_tasks(parallel_tasks.square, {f"{k}": (k,) for k in range(40)})
    assert most <= 4


def test_a_scheduler_that_cannot_be_used(monkeypatch):
    monkeypatch.setattr(parallel, "_CONNECT_S", 1)
    with refused("core/no scheduler"), on_workers(scheduler="tcp://127.0.0.1:9"):
        pass
    with refused("core/no address"), on_workers(scheduler="head"):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with refused("core/no dask"), on_workers(scheduler="tcp://127.0.0.1:9"):
        pass
