"""Rooms prepared, lifted, drawn, given models, settled, reconstructed and evaluated by workers that
are killed meanwhile: the same bytes as in one process."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time

import pytest
from front_jobs import digests

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from sceneprior.apps.api import load
from sceneprior.apps.cli.rooms import retrieve
from sceneprior.apps.reconstruction import reconstruct, score
from sceneprior.apps.rooms import write_scenes, writing_scenes
from sceneprior.core.files import write_json
from sceneprior.core.parallel import on_workers
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.interchange.export import export_scenes
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.render.scene_files import load_scene_folder

pytestmark = pytest.mark.slow
RULES = ("views.per_m2=0.3", "views.image_size=[60, 80]", "views.at_least=3")


def work(data, toys, out):
    splits = data / "splits" / "bedroom.csv"
    recipe = load_recipe("bedroom", RULES)
    source = FrontSource(data / "3D-FRONT", data / "3D-FUTURE-model", recipe, splits)
    build_shards(Job(source, out / "shards", renderer="software"))
    LiftedDataset(out / "shards", "train", ShapeGrid(8, 0.1))
    with writing_scenes(out / "rooms") as (write, scenes):
        scenes += load("procthor-bedroom").sample(70, seed=3, then=write)
    rooms = load_scene_folder(out / "rooms", with_materials=True)
    export_scenes(rooms[:20], "mujoco", out / "mujoco")
    options = EvalOptions(resamples=10)
    write_json(out / "scores.json", evaluate_synthesis(rooms[:8], out / "shards", options))
    write_scenes(rooms[:6], out / "some")
    retrieve(out / "some", out / "cad", data / "3D-FUTURE-model", data)
    scores = score.evaluate_run(str(toys[0]), toys[1], "objects", 1, "test", 0, 2, None, toys[1])
    assert scores.pop("cpu_seconds_an_image") > 0
    write_json(out / "svr.json", scores)


@pytest.fixture(scope="module")
def homes(tmp_path_factory, toy_run, toy_shards):
    folder = tmp_path_factory.mktemp("homes")
    make_homes(folder / "data", 20, "bedroom", 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruct, "BATCH", 3)
        patch.setattr(score, "BLOCK", 3)
        patch.setattr("sceneprior.apps.retrieval.retrieve.BLOCK", 2)
        work(folder / "data", (toy_run, toy_shards), folder / "alone")
        yield folder


@contextlib.contextmanager
def cluster():
    from distributed import LocalCluster

    made = LocalCluster(n_workers=2, threads_per_worker=2, dashboard_address=None)
    with made, on_workers(scheduler=made.scheduler_address):
        yield lambda: made.workers[0].pid


@contextlib.contextmanager
def processes():
    with on_workers(2):
        yield lambda: multiprocessing.active_children()[0].pid


@pytest.mark.parametrize("open_workers", [processes, cluster])
def test_the_bytes_are_those_of_one_process_though_workers_die(
    homes, open_workers, toy_run, toy_shards
):
    out, killed = homes / open_workers.__name__, []

    def kill(a_worker):
        for pattern in ("shards/**/*.h5", "rooms/*.json"):
            while not list(out.glob(pattern)):
                time.sleep(0.02)
            with contextlib.suppress(ProcessLookupError):
                os.kill(a_worker(), signal.SIGKILL)
                killed.append(pattern)

    with open_workers() as a_worker:
        killer = threading.Thread(target=kill, args=(a_worker,), daemon=True)
        killer.start()
        work(homes / "data", (toy_run, toy_shards), out)
    killer.join(60)
    assert len(killed) == 2
    assert digests(out) == digests(homes / "alone")
