"""Rooms as MuJoCo's MJCF."""

from collections.abc import Sequence
from pathlib import Path

from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.render.scene_mjcf import scene_to_mjcf


def write_mujoco(scenes: Sequence[Scene], folder: Path) -> None:
    """Write `<name>.xml` for each scene; see `scene_to_mjcf`."""
    for scene in scenes:
        write_whole(folder / f"{scene.name}.xml", scene_to_mjcf(scene))
