"""Export of rooms to other formats, by name."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.core.standing import stand
from sceneprior.interchange.atiss import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.interchange.mujoco import write_mujoco
from sceneprior.render.scene_files import check_names, save_scene

OF_CLASSES: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {
    "atiss": write_atiss,
    "threed-front": write_front,
}
"""Formats in which every object needs a furniture class, so that void objects are left out."""
SIMULATORS: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {"mujoco": write_mujoco}
"""Formats of simulators, for which objects stand first (`core/standing.py`)."""
ENDINGS = {"obj": ".obj", "usd": ".usda"}
"""Formats with one file per room."""
FORMATS = (*OF_CLASSES, *SIMULATORS, *ENDINGS)


def export_scenes(scenes: Sequence[Scene], to: str, folder: Path) -> list[str]:
    """Write rooms to a folder in one of `FORMATS`, in metres; y is up, except in MuJoCo (z).

    Returns notes for the user on objects that were left out or moved.
    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    check_names(scenes)
    if to in ENDINGS:
        for scene in scenes:
            save_scene(scene, Path(folder) / f"{scene.name}{ENDINGS[to]}")
        return []
    if to in SIMULATORS:
        standing, told = stand_all(scenes)
        SIMULATORS[to](standing, Path(folder))
        return told
    named = [
        replace(scene, objects=tuple(o for o in scene.objects if o.label != "void"))
        for scene in scenes
    ]
    OF_CLASSES[to](named, Path(folder))
    left_out = sum(len(a.objects) - len(b.objects) for a, b in zip(scenes, named, strict=True))
    if left_out:
        return [f"Objects of class void are left out ({left_out}): {to} has no such class."]
    return []


def stand_all(scenes: Sequence[Scene]) -> tuple[list[Scene], list[str]]:
    """The scenes with their objects standing, and a note on what changed, if anything did."""
    pairs = [stand(scene) for scene in scenes]
    changes = sum((told for _, told in pairs), Counter[str]())
    standing = [scene for scene, _ in pairs]
    if not (said := ", ".join(f"{count} {change}" for change, count in changes.items() if count)):
        return standing, []
    total = sum(len(scene.objects) for scene in scenes)
    return standing, [f"So that nothing falls over or overlaps, of {total} objects: {said}."]
