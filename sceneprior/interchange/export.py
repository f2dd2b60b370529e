"""The formats that rooms are exported to, by name."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sceneprior.errors import InputError
from sceneprior.files import is_name
from sceneprior.interchange.atiss import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.scene import Scene
from sceneprior.scene_files import save_scene


def _one_by_one(ending: str) -> Callable[[Sequence[Scene], Path], None]:
    def write(scenes: Sequence[Scene], folder: Path) -> None:
        for scene in scenes:
            save_scene(scene, folder / f"{scene.name}{ending}")

    return write


FORMATS: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {
    "atiss": write_atiss,
    "threed-front": write_front,
    "obj": _one_by_one(".obj"),
    "usd": _one_by_one(".usda"),
}


def export_scenes(scenes: Sequence[Scene], to: str, folder: Path) -> None:
    """Write rooms to a folder in one of `FORMATS`; axes and unit are ours in all: y up, metres.

    Raises:
        InputError: an unknown format, or rooms that have no names of their own.
    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    names = [scene.name for scene in scenes]
    for name in names:
        if not is_name(name) or names.count(name) > 1:
            raise InputError(
                f"Two rooms are called '{name}', or none can be; give each a name of its own."
            )
    FORMATS[to](scenes, Path(folder))
