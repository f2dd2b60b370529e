"""Export of rooms to other formats, by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.interchange.atiss import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.render.scene_files import check_names, save_scene


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


OF_CLASSES = ("atiss", "threed-front")
"""Formats in which every object needs a furniture class, so that void objects are left out."""


def export_scenes(scenes: Sequence[Scene], to: str, folder: Path) -> list[str]:
    """Write rooms to a folder in one of `FORMATS`; in all of them y is up, in metres.

    Returns:
        Notes for the user on objects that were left out.
    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    check_names(scenes)
    named, notes = list(scenes), []
    if to in OF_CLASSES:
        named = [
            replace(scene, objects=tuple(o for o in scene.objects if o.label != "void"))
            for scene in scenes
        ]
        left_out = sum(len(a.objects) - len(b.objects) for a, b in zip(scenes, named, strict=True))
        if left_out:
            notes = [f"Objects of class void are left out ({left_out}): {to} has no such class."]
    FORMATS[to](named, Path(folder))
    return notes
