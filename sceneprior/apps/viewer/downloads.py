"""The shown room as one file to download, in each format that `export` and `save` write."""

import io
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from sceneprior.core.scene import Scene
from sceneprior.core.shell import ShellName
from sceneprior.interchange.export import SIMULATORS, export_scenes
from sceneprior.render.scene_files import check_names, save

SAVED = {"GLB": ".glb", "JSON": ".json"}
"""Formats of `save`, by the names that the page shows."""
EXPORTED = {
    "OBJ": "obj", "USD": "usd", "MuJoCo (MJCF)": "mujoco", "Habitat": "habitat",
    "SceneEval": "sceneeval", "ATISS": "atiss", "3D-FRONT": "threed-front",
}  # fmt: skip
"""Formats of `export_scenes`."""
FORMATS = (*SAVED, *EXPORTED)
_DATE = (1980, 1, 1, 0, 0, 0)


def download(scene: Scene, form: str, shell: ShellName) -> tuple[str, bytes, list[str]]:
    """A file's name, its bytes, and notes for the user; several files are zipped.

    Args:
        form: One of `FORMATS`.
        shell: Parts of the room itself to write, in the formats that leave a choice.

    Raises:
        InputError: the room cannot be written, or a package for it is not installed.
    """
    check_names([scene])
    notes: list[str] = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        if form in SAVED:
            save(scene, folder / f"{scene.name}{SAVED[form]}", shell=shell)
        else:
            to = EXPORTED[form]
            chosen = shell if to in (*SIMULATORS, "obj") else None
            notes = export_scenes([scene], to, folder, chosen)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if len(files) == 1 and files[0].parent == folder:
            return files[0].name, files[0].read_bytes(), notes
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in files:  # all with one date: the same room is the same file
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix(), _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, path.read_bytes())
    return f"{scene.name}_{EXPORTED[form]}.zip", packed.getvalue(), notes
