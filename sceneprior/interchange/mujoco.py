"""Export as MuJoCo's MJCF."""

from collections.abc import Sequence
from pathlib import Path

from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName, shell_of
from sceneprior.render.scene_mjcf import scene_to_mjcf


def write_mujoco(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    """Write `<name>.xml` for each scene; see `scene_to_mjcf`. The floor is always written."""
    for scene in scenes:
        room = shell_of(scene) if shell == "walls" else None
        write_whole(folder / f"{scene.name}.xml", scene_to_mjcf(scene, room))
