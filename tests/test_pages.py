"""The guides' commands run as they are printed, in the order of their page, in a scratch folder.

Names that a page mentions (`out/demo/run`, `captures`, `SHARDS`) are toy data there (`TOYS`). What
takes minutes is cut short by options after the printed ones (`cut_short`). Commands that run in
another test, or not at all, are listed with the reason (`ELSEWHERE`); `tests/test_docs.py` looks at
the options of all.
"""

import contextlib
import json
import os
import runpy
import shlex
import shutil
import signal
import socket
import sys
import threading
import urllib.request
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from capture_files import write_grounded_sam2_images, write_polycam
from model_folder import blocks, write_models
from pages import PAGES, ROOT, Block, blocks_of, commands_of, name_of
from PIL import Image
from posed_files import PosedRoom, furniture
from toy_metrics import without_classifiers

from data_prep.homes.make import make_homes
from sceneprior.apps import cli
from sceneprior.apps.config import load_config
from sceneprior.core.classes import label_set
from sceneprior.core.views import image_from_shards

RUN_HERE = [
    "README.md", "configs/README.md", "docs/index.md", "docs/tutorial.md", "docs/concepts.md",
    "docs/uses.md", "docs/reconstruction.md", "docs/evaluation.md", "docs/cluster.md",
    "docs/comparing.md", "docs/baselines_2d.md", "docs/baselines_3d.md",
    "docs/baselines_single_view.md", "docs/paper_map.md", "docs/requests.md", "docs/simulators.md",
    "docs/captures.md", "docs/training.md",
]  # fmt: skip
WHOLE_PAGES = {
    "docs/posed_data.md": "tests/data_prep/readers/test_posed_docs.py",
    "docs/public_data.md": "tests/data_prep/readers/test_data_sets.py",
    "docs/own_room_types.md": "tests/data_prep/front/test_own_room_types.py",
}
"""Guides that tests of their own run as printed, on data of their own."""
TABLES = ("docs/results.md", "docs/performance.md", "docs/experiments/", "docs/silhouettes.md")
"""Pages whose commands made the tables on them, in hours, from data that are not here."""
ELSEWHERE = {
    "make demo": "tests/apps/experiments/test_demo.py runs the command that it is",
    "make test": "this is it",
    "compare/paper.yaml": "tests/apps/experiments/test_compare.py compares toys",
    "compare/tuned.yaml": "tests/apps/experiments/test_compare.py compares toys",
    "compare/single_view.yaml": "tests/apps/experiments/test_compare.py compares toys",
    "--devices 2": "tests/training/test_processes.py trains in two processes",
    "--devices 4 --resume": "tests/training/test_slurm.py is stopped and queued again as there",
    "python benchmarks/": "a measurement, of runs that take hours",
}
"""Part of a command -> the reason why such commands are not run here."""
ROOM = "toy/test_00"
"""Value of `ROOM` on a page."""


class Toys(NamedTuple):
    """Folders that tests share, and may not change."""

    shards: Path
    run: Path
    sampler_run: Path


@pytest.fixture(scope="session")
def toys(toy_shards: Path, toy_run: Path, sampler_run: Path) -> Toys:
    return Toys(toy_shards, toy_run, sampler_run)


def write_masks(path: Path, toys: Toys) -> None:
    """`mine.png`, its `classes.csv`, and the same as `coco.json`: of 480 x 360 pixels."""
    image = image_from_shards(toys.shards, ROOM, 0)
    names = [label_set(image.label_set)[label] for label in image.object_class]
    ids = np.kron(image.instance_ids, np.ones((5, 5))).astype(np.uint8)
    Image.fromarray(ids).save("mine.png")
    rows = [f"{k},{name}" for k, name in enumerate(names, start=1)]
    Path("classes.csv").write_text("\n".join(["id,class", *rows, ""]))
    height, width = ids.shape
    annotations = []
    for k, box in enumerate(image.boxes):
        x1, y1, x2, y2 = (box * (width, height, width, height)).tolist()
        outline = [x1, y1, x2, y1, x2, y2, x1, y2]
        annotations.append(
            {"id": k, "image_id": 1, "category_id": k, "segmentation": [outline], "iscrowd": 0}
        )
    written = {
        "images": [{"id": 1, "height": height, "width": width}],
        "annotations": annotations,
        "categories": [{"id": k, "name": name} for k, name in enumerate(names)],
    }
    Path("coco.json").write_text(json.dumps(written))


def write_captures(path: Path, toys: Toys) -> None:
    for k in range(12):  # one in ten is a test room, at least
        PosedRoom(path / f"room{k}", furniture(0.1 * k - 0.5)).write()
    Path("classes.txt").write_text("bed\nchair\n")


def write_phone(path: Path, toys: Toys) -> None:
    """Polycam's poses, and the masks of a segmenter of single images."""
    for k in range(12):
        room = PosedRoom(path / f"room{k}", furniture(0.1 * k - 0.5)).write()
        write_polycam(room)
        write_grounded_sam2_images(room)
    Path("classes.txt").write_text("bed\nchair\n")


def write_homes(path: Path, toys: Toys) -> None:
    """`3D-FRONT` and `3D-FUTURE-model`."""
    make_homes(Path("homes"), 10, "bedroom", seed=0)
    for name in ("3D-FRONT", "3D-FUTURE-model"):
        Path(name).symlink_to(Path("homes") / name)


def write_scenes(path: Path, toys: Toys) -> None:
    run_here(["synthesize", "--run", str(toys.run), "-n", "4", "--out", str(path)])


def write_models_of_homes(path: Path, toys: Toys) -> None:
    shape = blocks(((0, 0.5, 0), (1, 1, 1)))
    write_models(path, {"bed": ("King-size Bed", shape), "ward": ("Wardrobe", shape)})


def write_about(path: Path, toys: Toys) -> None:
    path.write_text("Toys, made by hand; CC0.\n")


def write_scores(path: Path, toys: Toys) -> None:
    run = ["--run", "out/demo/run", "-n", "8", "--resamples", "0"]
    run_here(["eval-fid", *run, "--out", str(path)])


def copy_of(part: str) -> Callable[[Path, Toys], None]:
    def copy(path: Path, toys: Toys) -> None:
        shutil.copytree(getattr(toys, part), path, dirs_exist_ok=True)

    return copy


TOYS: dict[str, Callable[[Path, Toys], None]] = {
    "out/demo/shards": copy_of("shards"), "SHARDS": copy_of("shards"),
    "out/demo/run": copy_of("sampler_run"), "RUN": copy_of("run"),
    "out/demo/scenes": write_scenes, "DIR": write_scenes,
    "out/demo/homes/3D-FUTURE-model": write_models_of_homes,
    "mine.png": write_masks, "coco.json": write_masks,
    "captures": write_captures, "phone": write_phone, "3D-FRONT": write_homes,
    "about.md": write_about, "out/demo/scores.json": write_scores,
}  # fmt: skip
"""A name that a command of a page reads -> what writes it."""

TINY = {
    "layout.epochs": 1, "shape.epochs": 1, "sampler.epochs": 1, "training.epochs": 1,
    "data.workers": 0, "data.augment_rotations": False,
    "data.views_per_room": 2, "data.mask_step": 2, "model.width": 32, "model.decoder.hidden": 32,
    "model.shape.width": 8, "model.shape.level": 1, "model.shape.prototypes": 20,
    "model.shape.codes": 6, "model.shape.cells": 8, "sampler.width": 16, "sampler.layers": 1,
}  # fmt: skip
"""Keys of a run that are made small, where it has them."""


def cut_short(words: list[str], toys: Toys) -> list[str]:
    """Options after the printed ones that make a command take seconds."""
    match words[0]:
        case "fit":
            at = words.index("--config")
            sets = tuple(b for a, b in pairwise(words) if a == "--set")
            config = load_config(words[at + 1], sets)
            if not (shards := Path(config.data.shards)).exists():
                shutil.copytree(toys.shards, shards)
            data = config.model_dump(by_alias=True)
            kept = {key: value for key, value in TINY.items() if has(data, key.split("."))}
            return [word for key, value in kept.items() for word in ("--set", f"{key}={value}")]
        case "eval-fid" | "evaluate":
            return ["--resamples", "2"] + (["-n", "8"] if "--run" in words else [])
        case "compare" if "--against" in words:
            return ["-n", "4"]
        case "prep-front":
            return ["--views-per-m2", "0.5", "--workers", "1"]
        case "prep-posed":
            return ["--workers", "1"]
        case "view":
            return ["--port", str(free_port())]
    return []


def has(data: object, keys: list[str]) -> bool:
    if not keys:
        return True
    return isinstance(data, dict) and keys[0] in data and has(data[keys[0]], keys[1:])


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def run_here(arguments: list[str]) -> None:
    """`sceneprior ...` in this process, where torch is imported already; it must end well."""
    before, sys.argv = sys.argv, ["sceneprior", *arguments]
    try:
        cli.main()
    except SystemExit as end:
        assert not end.code, f"sceneprior {' '.join(arguments)}: status {end.code}"
    finally:
        sys.argv = before


def run_view(arguments: list[str]) -> None:
    """`view` in this process: once its page has come, it is ended as Ctrl-C does."""
    pytest.importorskip("viser", reason="the extra `view` is not installed")
    address, came, ended = f"http://localhost:{arguments[-1]}", [], threading.Event()

    def look_and_stop() -> None:
        while not came and not ended.wait(0.2):
            with contextlib.suppress(OSError), urllib.request.urlopen(address, timeout=5) as page:
                came.append(page.status)
        if not ended.wait(0.5):
            os.kill(os.getpid(), signal.SIGINT)

    looks = threading.Thread(target=look_and_stop)
    looks.start()
    try:
        run_here(arguments)
    finally:
        ended.set()
        looks.join()
    assert came == [200]


def carry_out(words: list[str], toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run one printed command."""
    for before, word in pairwise(words):
        if before != "--out" and word in TOYS and not Path(word).exists():
            Path(word).parent.mkdir(parents=True, exist_ok=True)
            TOYS[word](Path(word), toys)
    program, *arguments = [ROOM if word == "ROOM" else word for word in words]
    if program == "export":
        for word in arguments:
            monkeypatch.setenv(*word.split("="))
    elif program == "python":
        monkeypatch.setattr(sys, "argv", arguments)
        runpy.run_path(str(ROOT / arguments[0]), run_name="__main__")
    else:
        assert program == "sceneprior", program
        arguments += cut_short(arguments, toys)
        (run_view if arguments[0] == "view" else run_here)(arguments)


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN_HERE)
def test_commands_run_as_printed(page: str, toys: Toys, tmp_path: Path, monkeypatch, few_attempts):
    without_classifiers(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("SCENEPRIOR_RENDERER", "software")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for block in blocks_of(ROOT / page):
            if block.language == "json":
                Path("given.json").write_text(block.text)  # which docs/uses.md completes
        for block in blocks_of(ROOT / page):
            if is_shell(block):
                for words in commands_of(block.text):
                    if not any(part in shlex.join(words) for part in ELSEWHERE):
                        carry_out(words, toys, monkeypatch)
    finally:
        signal.signal(signal.SIGINT, before)
    if page == "docs/concepts.md":
        drawn, shown = Path("out/concepts").iterdir(), ROOT / "docs/images/concepts"
        assert {path.name for path in drawn} == {path.name for path in shown.glob("*.png")}


def test_every_page_with_commands_runs_somewhere():
    """Here, or whole in a test that names it."""
    pages = {name_of(page) for page in PAGES if any(map(is_shell, blocks_of(page)))}
    left = {page for page in pages - set(RUN_HERE) if not page.startswith(TABLES)}
    assert left == set(WHOLE_PAGES)
    for page, test in WHOLE_PAGES.items():
        assert Path(page).name in (ROOT / test).read_text()


def is_shell(block: Block) -> bool:
    return block.language in ("", "bash", "sh") and not block.not_run
