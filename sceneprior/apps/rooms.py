"""Write rooms to a folder: scene files, an overview picture and latents."""

import contextlib
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sceneprior.core.files import PARTS, list_files, write_whole
from sceneprior.core.parallel import check_shared, map_blocks
from sceneprior.core.scene import Scene
from sceneprior.core.scene_json import FORMAT
from sceneprior.core.shell import ShellName
from sceneprior.paper.sampling import LATENTS_FILE, write_latents
from sceneprior.render.appearance import contact_sheet, png_bytes
from sceneprior.render.scene_files import check_names, format_of, save
from sceneprior.render.topdown import perspective, view_of

PAGE_FILE = "rooms.html"
BLOCK = 32
"""Rooms that a task writes."""
OVERVIEW_ROOMS = 24
"""Most rooms that the overview shows."""
OVERVIEW_TILE = (240, 320)
"""Height and width of one room of the overview, in pixels."""


def write_scene(scene: Scene, folder: Path, name: str, shell: ShellName = "none") -> None:
    """Write `<name>.glb`, `<name>.png` and `<name>.json`; see `save`.

    The JSON is written last, so that a JSON implies that the other two files exist.
    """
    for ending in (".glb", ".png", ".json"):
        save(scene, Path(folder) / f"{name}{ending}", shell)


def clear_scenes(folder: Path) -> None:
    """Make a folder, or delete its old scenes, so that they are not mistaken for new ones.

    Scene JSONs with their GLBs and PNGs, latents, the page, and the partial files of interrupted
    writers are deleted; all other files stay.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    for path in list_files(folder, "*.json"):
        if format_of(path) == FORMAT:
            for ending in (".glb", ".png", ".json"):
                path.with_suffix(ending).unlink(missing_ok=True)
    for name in (LATENTS_FILE, PAGE_FILE):
        (Path(folder) / name).unlink(missing_ok=True)
    for path in Path(folder).glob(PARTS):
        path.unlink(missing_ok=True)


def write_scenes(scenes: Sequence[Scene], folder: Path, shell: ShellName = "none") -> None:
    """Write scenes under their own names, replacing the scenes of a folder.

    `overview.png` shows all rooms, or the first `OVERVIEW_ROOMS` and says of how many;
    `latents.npz` is written if all scenes are decoded from latents.
    """
    check_names(scenes)
    with writing_scenes(folder, shell) as (write, written):
        map_blocks(write, scenes, BLOCK, "writing scenes")
        written += scenes


@contextlib.contextmanager
def writing_scenes(
    folder: Path, shell: ShellName = "none", with_meshes: bool = False
) -> Iterator[tuple[Callable[[list[Scene], int], list[Scene]], list[Scene]]]:
    """Replace the scenes of a folder, many at a time, once all are written: the old ones stay if
    no room is found. Its overview and latents are written last.

    Yields:
        A function for `then` of `Prior.sample`, which writes the rooms, and returns all of them
        `with_meshes` or else those of the overview; and an empty list, for what `sample` returns.
    """
    folder, scenes = Path(folder), list[Scene]()
    new, was_there = folder / ".new", folder.exists()
    shutil.rmtree(new, ignore_errors=True)  # left by a process that was killed
    new.mkdir(parents=True)
    kept = sys.maxsize if with_meshes else OVERVIEW_ROOMS
    try:
        yield partial(_write_some, folder=new, shell=shell, kept=kept), scenes
        write_whole(new / "overview.png", png_bytes(overview(scenes, shell)))
        write_latents(new, scenes)
        clear_scenes(folder)
        for path in new.iterdir():
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if not was_there:
            with contextlib.suppress(OSError):  # it holds the new rooms
                folder.rmdir()


def _write_some(
    scenes: Sequence[Scene], first: int, folder: Path, shell: ShellName, kept: int
) -> list[Scene]:
    from sceneprior.render.silhouettes.cpu.kernels import thread_count

    check_shared(folder)
    with ThreadPoolExecutor(thread_count()) as pool:
        # Drawing, compression and disk access run in parallel.
        [*pool.map(lambda scene: write_scene(scene, folder, scene.name, shell), scenes)]
    rooms = enumerate(scenes, first)
    return [scene if row < kept else scene.without_meshes() for row, scene in rooms]


def overview(
    scenes: Sequence[Scene], shell: ShellName = "none"
) -> UInt8[np.ndarray, "height width 3"]:
    """Contact sheet of the first rooms from above a corner, four per row, coloured by class; its
    first caption says how many there are if not all are shown.

    The walls behind the furniture are drawn if `shell` is `walls`, or the room has doors or
    windows; the floor is always drawn.
    """
    shown = scenes[:OVERVIEW_ROOMS]
    tiles = [perspective(scene, view=view_of(scene, OVERVIEW_TILE, shell)) for scene in shown]
    captions = [f"The first {len(shown)} of {len(scenes)} rooms", *[""] * (len(shown) - 1)]
    return contact_sheet(tiles, min(4, len(tiles)), captions if len(shown) < len(scenes) else ())
