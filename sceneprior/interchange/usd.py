"""Export as USD stages with rigid bodies."""

from collections.abc import Sequence
from pathlib import Path

from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName, shell_meshes
from sceneprior.render.scene_usd import scene_to_usd


def write_usd(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    """Write `<name>.usda` for each scene; see `scene_to_usd`."""
    for scene in scenes:
        text = scene_to_usd(scene, shell_meshes(scene, shell), physics=True)
        write_whole(folder / f"{scene.name}.usda", text)
