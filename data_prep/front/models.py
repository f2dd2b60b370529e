"""The furniture models of 3D-FUTURE: categories, meshes in metres, colours."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cachetools import LRUCache, cachedmethod

from sceneprior.files import file_stamp, is_name
from sceneprior.furniture import MODEL_FILE, model_categories, read_obj
from sceneprior.scene import Mesh

_NO_FURNITURE_M = 10.0
"""No piece of furniture is 10 m long; nearly all oversized models (100 times too large) are."""
_OVERSIZED = (50.0, 200.0)
"""A model's longest side, divided by the one its house states, where its file is in centimetres."""
_CACHE_BYTES = 512 * 2**20
"""Meshes a process keeps: some two thousand models of 3D-FUTURE's usual size."""


class ModelBank:
    """3D-FUTURE: categories of all models, meshes on demand; `cache_bytes` of them are kept.

    Raises:
        InputError: the folder is missing, or is not 3D-FUTURE's.
    """

    def __init__(self, folder: Path, cache_bytes: int = _CACHE_BYTES):
        self.folder = Path(folder)
        self._categories = model_categories(self.folder)
        self._meshes: LRUCache = LRUCache(
            cache_bytes, lambda mesh: mesh.vertices_m.nbytes + mesh.faces.nbytes
        )

    def category(self, model_id: str) -> str:
        """Lower case, "a / b" as "a/b"; "others" where the release says nothing."""
        return self._categories.get(model_id, "others")

    def has(self, model_id: str) -> bool:
        """Whether the release holds a mesh for this model."""
        return is_name(model_id) and (self.folder / model_id / MODEL_FILE).is_file()

    def load(self, model_id: str) -> Mesh:
        """The mesh in metres. A file is read again if it has changed, or fell out of the cache.

        About a hundred models of the release are 100 times too large. One with a side of more than
        10 m is, and is handed out at a hundredth; `unit_of` finds small ones by comparison.

        Raises:
            InputError: there is none, or it is damaged.
        """
        path = self.folder / model_id / MODEL_FILE
        return self._read(path, file_stamp(path))

    @cachedmethod(lambda self: self._meshes)
    def _read(self, path: Path, stamp: tuple[int, int]) -> Mesh:
        mesh = read_obj(path)
        if float(np.ptp(mesh.vertices_m, axis=0).max()) > _NO_FURNITURE_M:
            return Mesh(mesh.vertices_m / np.float32(100), mesh.faces)
        return mesh

    def color(self, model_id: str) -> tuple[int, int, int] | None:
        """One RGB colour for the whole model: the mean of its texture, or its material's; None
        where the release says nothing. For pictures only, so damage is no failure."""
        return _mean_of_texture(self.folder / model_id) or _material(self.folder / model_id)


def unit_of(mesh: Mesh, entry: dict[str, Any]) -> float:
    """Metres per unit of a loaded mesh, by what the house's furniture entry says of its size: 1,
    or 0.01 if the mesh is 50 to 200 times as long as stated.

    `size` and `bbox` mix orders of axes between entries, so only longest sides are compared. This
    finds what `ModelBank.load` cannot: a model in centimetres that is shorter than 10 m as metres.
    The factor belongs to the placement, not to the mesh, so that one model is one mesh whatever
    its houses say.
    """
    if not len(mesh.vertices_m):
        return 1.0
    longest = float(np.ptp(mesh.vertices_m, axis=0).max())
    for key in ("size", "bbox"):
        stated = _longest(entry.get(key))
        if stated and _OVERSIZED[0] <= longest / stated <= _OVERSIZED[1]:
            return 0.01
    return 1.0


def _longest(size: Any) -> float | None:
    try:
        sides = [float(side) for side in size]
    except (TypeError, ValueError, OverflowError):
        return None
    return max(sides) if len(sides) == 3 and all(1e-3 < side < 1e3 for side in sides) else None


def _mean_of_texture(folder: Path) -> tuple[int, int, int] | None:
    from PIL import Image

    try:
        with Image.open(folder / "texture.png") as image:
            pixels = np.asarray(image.convert("RGB").resize((16, 16), Image.Resampling.BOX))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return _rgb(pixels.reshape(-1, 3).mean(axis=0))


def _material(folder: Path) -> tuple[int, int, int] | None:
    try:
        lines = (folder / "model.mtl").read_text(errors="replace").splitlines()
        shades = [[float(word) for word in line.split()[1:4]] for line in lines if "Kd " in line]
        return _rgb(np.clip(np.mean(shades, axis=0), 0, 1) * 255) if shades else None
    except (OSError, ValueError):
        return None


def _rgb(color: Sequence[float] | np.ndarray) -> tuple[int, int, int] | None:
    if len(color) != 3 or not np.isfinite(color).all():
        return None
    red, green, blue = (round(float(channel)) for channel in color)
    return red, green, blue
