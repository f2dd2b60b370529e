"""Export of rooms to other formats, by name."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_whole
from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName, shell_meshes, shell_of
from sceneprior.interchange.box_lists import write_atiss
from sceneprior.interchange.front import write_front
from sceneprior.interchange.habitat import write_habitat
from sceneprior.interchange.sceneeval import write_sceneeval
from sceneprior.render.scene_files import check_names, save
from sceneprior.render.scene_simulators import scene_to_mjcf, scene_to_usd


def _write_mujoco(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    for scene in scenes:  # the floor is always written
        room = shell_of(scene) if shell == "walls" else None
        write_whole(folder / f"{scene.name}.xml", scene_to_mjcf(scene, room))


def _write_usd(scenes: Sequence[Scene], folder: Path, shell: ShellName) -> None:
    for scene in scenes:
        text = scene_to_usd(scene, shell_meshes(scene, shell), physics=True)
        write_whole(folder / f"{scene.name}.usda", text)


CLASS_FORMATS: Mapping[str, Callable[[Sequence[Scene], Path], None]] = {
    "atiss": write_atiss,
    "threed-front": write_front,
}
"""Formats that require a furniture class for each object, so that void objects are left out."""
SIMULATORS: Mapping[str, Callable[[Sequence[Scene], Path, ShellName], None]] = {
    "mujoco": _write_mujoco,
    "usd": _write_usd,
    "habitat": write_habitat,
}
"""Simulator formats; before export, objects are made stable (`core/contact_resolution.py`)."""
FORMATS = (*CLASS_FORMATS, *SIMULATORS, "sceneeval", "obj")
GROWN_M = 0.01
"""Threshold in metres: a note mentions walls that furniture pushed outwards by more."""


def export_scenes(
    scenes: Sequence[Scene], to: str, folder: Path, shell: ShellName | None = None
) -> list[str]:
    """Write rooms to a folder in one of `FORMATS`, in metres, with y up (z in `mujoco` and
    `sceneeval`).

    Args:
        shell: The parts of the shell to write; None writes walls for simulators, and nothing in
            other formats.

    Returns:
        Notes for the user on omissions and changes.
    """
    if to not in FORMATS:
        raise InputError(f"No format '{to}'; choose from {', '.join(FORMATS)}, or scenes.")
    check_names(scenes)
    if to == "obj":
        for scene in scenes:
            save(scene, Path(folder) / f"{scene.name}.obj", shell=shell or "none")
        return []
    if to in SIMULATORS:
        standing, notes = make_all_stable(scenes)
        SIMULATORS[to](standing, Path(folder), shell or "walls")
        return notes if shell in ("floor", "none") else [*notes, *_moved_walls(standing)]
    if shell is not None:
        raise InputError(f"The format {to} has no choice of walls and floors; leave out --shell.")
    if to == "sceneeval":
        write_sceneeval(scenes, Path(folder))
        return []
    named = [
        replace(scene, objects=tuple(o for o in scene.objects if o.label != "void"))
        for scene in scenes
    ]
    CLASS_FORMATS[to](named, Path(folder))
    left_out = sum(len(a.objects) - len(b.objects) for a, b in zip(scenes, named, strict=True))
    if left_out:
        return [f"Objects of class void are left out ({left_out}): {to} has no such class."]
    return []


def make_all_stable(scenes: Sequence[Scene]) -> tuple[list[Scene], list[str]]:
    """Make all objects of the scenes stand; also return a note on the changes, if any."""
    pairs = [make_stable(scene) for scene in scenes]
    changes = sum((counts for _, counts in pairs), Counter[str]())
    standing = [scene for scene, _ in pairs]
    listed = ", ".join(f"{count} {change}" for change, count in changes.items() if count)
    if not listed:
        return standing, []
    total = sum(len(scene.objects) for scene in scenes)
    return standing, [
        f"Changed so that nothing falls over or overlaps: {listed} (of {total} objects)."
    ]


def _moved_walls(scenes: Sequence[Scene]) -> list[str]:
    grown_m = [shell_of(scene).grown_m for scene in scenes]
    rooms = sum(far > GROWN_M for far in grown_m)
    if not rooms:
        return []
    return [
        f"Walls of {rooms} rooms stand further out than floor_m, by up to {max(grown_m):.2f} m, "
        "because furniture stands there."
    ]
