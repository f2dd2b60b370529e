"""The shown room: the page's state, rooms of a folder, and files for download."""

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sceneprior.apps.retrieval.cad_models import CadModels
from sceneprior.apps.retrieval.retrieve import retrieve
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import ShellName, floor_rectangle
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.interchange.export import SIMULATORS, export_scenes
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.render.scene_files import check_names, save

FORMATS = {
    "GLB": ".glb", "JSON": ".json", "OBJ": "obj", "USD": "usd", "MuJoCo (MJCF)": "mujoco",
    "Habitat": "habitat", "SceneEval": "sceneeval", "ATISS": "atiss", "3D-FRONT": "threed-front",
}  # fmt: skip
"""Formats of downloads: endings for `save`, or formats of `export_scenes`."""
NOTHING_ASKED = RoomRequest()


def name_and_size(item: SceneObject) -> str:
    """Text of an object's label: class name, and width, height and depth in metres.

    >>> name_and_size(SceneObject("double_bed", (0.0, 0.5, 0.0), (1.8, 1.0, 2.1)))
    'double bed 1.80 x 1.00 x 2.10 m'
    """
    return item.label.replace("_", " ") + " {:.2f} x {:.2f} x {:.2f} m".format(*item.size_m)


@dataclass(frozen=True)
class Shown:
    """The page's state: the shown room, and the request that it answers or that the next one
    will."""

    scene: Scene
    origin: str
    """Origin of the room, in words."""
    request: RoomRequest = NOTHING_ASKED
    line: str = ""
    """The request as the text of the page's field."""
    locked: frozenset[int] = frozenset()
    """Indices of the objects that the next completion keeps."""
    picked: int | None = None
    """Index of the object that was clicked last."""

    def toggled(self, item: int) -> "Shown":
        """The same room with an object locked, or unlocked if it was."""
        return replace(self, locked=self.locked ^ {item})

    def given(self) -> Scene:
        """The scene of the locked objects alone."""
        objects = tuple(self.scene.objects[item] for item in sorted(self.locked))
        return replace(self.scene, objects=objects, extra={}, latent=None)

    def dragged(self, item: int, x_m: float, z_m: float) -> "Shown":
        """The room after an object was moved along the floor, which locks it; the object stays in
        the rectangle around the floor."""
        moved = self.scene.objects[item]
        low, high = (np.array(corner) for corner in floor_rectangle(self.scene))
        half, center = np.array(moved.size_m)[::2] / 2, np.array(moved.center_m)[::2]
        to = np.maximum(np.minimum(center + np.array([x_m, z_m]), high - half), low + half)
        x_m, z_m = (to - center).tolist()
        return replace(
            self.with_object(item, moved.moved((x_m, 0.0, z_m))), locked=self.locked | {item}
        )

    def with_object(self, item: int, other: SceneObject) -> "Shown":
        """The room with another object in place of one; what its file says of wishes is dropped."""
        objects = list(self.scene.objects)
        objects[item] = other
        extra = {key: value for key, value in self.scene.extra.items() if key != "wishes"}
        scene = replace(self.scene, objects=tuple(objects), extra=extra, latent=None)
        return replace(self, scene=scene)

    def with_models(self, models: CadModels) -> "Shown":
        """The room with a CAD model in place of the picked object, or of all if none is picked."""
        rows = range(len(self.scene.objects))
        keep = [row for row in rows if self.picked is not None and row != self.picked]
        return replace(self, scene=retrieve(self.scene, models, keep, alike=True))


class Folder:
    """A folder of scenes, made by any method."""

    def __init__(self, scenes: Sequence[Scene]):
        self.scenes = tuple(scenes)

    @property
    def label_set(self) -> str:
        """The label set of all scenes; several are an InputError."""
        return common_label_set(self.scenes)

    def room(self, row: int) -> Shown:
        """The scene at an index."""
        scene = self.scenes[row]
        return Shown(scene, f"{scene.name}, {row + 1} of {len(self.scenes)}")


def download(scene: Scene, form: str, shell: ShellName) -> tuple[str, bytes, list[str]]:
    """The name of a room's file, its bytes, and notes for the user; several files are zipped.

    Args:
        form: One of `FORMATS`.
        shell: Parts of the room itself to write, in the formats that leave a choice.

    Raises:
        InputError: the room cannot be written, or a package for it is not installed.
    """
    check_names([scene])
    to, notes = FORMATS[form], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        if to.startswith("."):
            save(scene, folder / f"{scene.name}{to}", shell=shell)
        else:
            chosen = shell if to in (*SIMULATORS, "obj") else None
            notes = [note for kind in export_scenes([scene], to, folder, chosen) for note in kind]
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if len(files) == 1 and files[0].parent == folder:
            return files[0].name, files[0].read_bytes(), notes
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for path in files:
                # The entry has no date of today, so that the same room is the same file.
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
                archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return f"{scene.name}_{to}.zip", packed.getvalue(), notes
