"""Write rooms to a folder: scene files, an overview picture and latents."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from rich.console import Console
from rich.progress import Progress

from sceneprior.core.files import PARTS, list_files, write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.scene_json import FORMAT
from sceneprior.core.shell import ShellName
from sceneprior.paper.sampling import LATENTS_FILE, write_latents
from sceneprior.render.appearance import contact_sheet, png_bytes
from sceneprior.render.scene_files import check_names, format_of, save
from sceneprior.render.topdown import perspective, view_of

PAGE_FILE = "rooms.html"
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
    """Delete the old scenes of a folder, so that they are not mistaken for new ones.

    Scene JSONs with their GLBs and PNGs, latents, the page, and the partial files of interrupted
    writers are deleted; all other files stay.
    """
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
    clear_scenes(folder)
    with ThreadPoolExecutor(os.cpu_count()) as pool, Progress(console=Console(stderr=True)) as bar:
        # Drawing, compression and disk access run in parallel.
        done = pool.map(lambda scene: write_scene(scene, folder, scene.name, shell), scenes)
        for _ in bar.track(done, total=len(scenes), description="Writing scenes"):
            pass
    sheet = overview(scenes, shell)
    write_whole(Path(folder) / "overview.png", png_bytes(sheet))
    write_latents(folder, scenes)


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
