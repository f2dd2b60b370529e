"""Export of rooms to other formats, by name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.interchange.atiss import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.render.scene_files import check_names, save_scene

OF_CLASSES: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {
    "atiss": write_atiss,
    "threed-front": write_front,
}
"""Formats in which every object needs a furniture class, so that void objects are left out."""
ENDINGS = {"obj": ".obj", "usd": ".usda"}
"""Formats with one file per room."""
FORMATS = (*OF_CLASSES, *ENDINGS)


def export_scenes(scenes: Sequence[Scene], to: str, folder: Path) -> list[str]:
    """Write rooms to a folder in one of `FORMATS`, all with y up and in metres.

    Returns notes for the user on objects that were left out.
    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    check_names(scenes)
    if to in ENDINGS:
        for scene in scenes:
            save_scene(scene, Path(folder) / f"{scene.name}{ENDINGS[to]}")
        return []
    named = [
        replace(scene, objects=tuple(o for o in scene.objects if o.label != "void"))
        for scene in scenes
    ]
    OF_CLASSES[to](named, Path(folder))
    left_out = sum(len(a.objects) - len(b.objects) for a, b in zip(scenes, named, strict=True))
    if left_out:
        return [f"Objects of class void are left out ({left_out}): {to} has no such class."]
    return []
