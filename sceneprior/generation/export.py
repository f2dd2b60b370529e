"""Write rooms to a folder: their files, an overview and their latents."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from rich.console import Console
from rich.progress import Progress

from sceneprior.errors import InputError
from sceneprior.files import write_whole
from sceneprior.generation.sample import LATENTS_FILE, write_latents
from sceneprior.offscreen import Renderer
from sceneprior.pictures import contact_sheet, png_bytes
from sceneprior.scene import FORMAT, Scene
from sceneprior.scene_files import format_of, save_scene
from sceneprior.topdown import perspective

PAGE_FILE = "rooms.html"
OVERVIEW_ROOMS = 12
OVERVIEW_TILE = (240, 320)
"""Height and width of one room of the overview, in pixels."""


def write_scene(scene: Scene, folder: Path, name: str, renderer: Renderer) -> None:
    """Write `<name>.glb`, `<name>.png` and `<name>.json`; see `save_scene`.

    The JSON comes last: where it lies, the other two lie beside it.

    Raises:
        InputError: `name` is empty or holds a path separator.
    """
    if not name or Path(name).name != name:
        raise InputError(f"'{name}' cannot name a scene's files; use a plain name such as room_0.")
    for ending in (".glb", ".png", ".json"):
        save_scene(scene, Path(folder) / f"{name}{ending}", renderer)


def check_free(folder: Path, overwrite: bool = False) -> None:
    """Refuse a folder in which something would be written over unasked.

    Raises:
        InputError: it is a file, or holds something and `overwrite` is false.
    """
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder} is a file; name a folder.")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; add --overwrite or name another folder.")


def clear_scenes(folder: Path) -> None:
    """Delete the scenes that a folder holds, with their GLBs, PNGs, latents and page, and nothing
    else: the next reader would take them for new ones."""
    for path in Path(folder).glob("*.json"):
        if format_of(path) == FORMAT:
            for ending in (".glb", ".png", ".json"):
                path.with_suffix(ending).unlink(missing_ok=True)
    for name in (LATENTS_FILE, PAGE_FILE):
        (Path(folder) / name).unlink(missing_ok=True)


def write_scenes(
    scenes: Sequence[Scene],
    folder: Path,
    renderer: Renderer,
    overwrite: bool = False,
) -> None:
    """Write scenes to a folder (see `check_free`), each under its own name, `overview.png` of the
    first few, and `latents.npz` where each is decoded from a latent.

    Raises:
        InputError: the folder holds something and `overwrite` is false.
    """
    check_free(folder, overwrite)
    clear_scenes(folder)
    with ThreadPoolExecutor(os.cpu_count()) as pool, Progress(console=Console(stderr=True)) as bar:
        # Drawing, packing and waiting for the disk run beside each other; GL has one thread.
        each = pool.map if renderer.kind == "software" else map
        done = each(lambda scene: write_scene(scene, folder, scene.name, renderer), scenes)
        for _ in bar.track(done, total=len(scenes), description="Writing scenes"):
            pass
    sheet = overview(scenes[:OVERVIEW_ROOMS], renderer)
    write_whole(Path(folder) / "overview.png", png_bytes(sheet))
    write_latents(folder, scenes)


def overview(scenes: Sequence[Scene], renderer: Renderer) -> UInt8[np.ndarray, "height width 3"]:
    """Rooms (at least one) seen from above a corner, in rows of four, coloured by class."""
    tiles = [perspective(scene, renderer, OVERVIEW_TILE) for scene in scenes]
    return contact_sheet(tiles, min(4, len(tiles)))
