"""Reads BlenderProc's renders of 3D-FRONT, the input of the paper's authors.

    <folder>/cam_K.npy                 intrinsics, the centre of the first pixel at (0, 0)
    <folder>/<house>/<number>.hdf5     a frame: instance_segmaps, instance_attribute_maps, cam_Ts
    <folder>/model_info.json           3D-FUTURE's list of models, or
    <folder>/blender_label_mapping.csv the table `id,name` that the frames were rendered with

BlenderProc swaps y and z of 3D-FRONT's rooms, so its world is their mirror image. As the authors
do, images and cameras are mirrored back, so that rooms agree with those of `prep-front`.

Source: BlenderProc's Front3DLoader, SegMapRendererUtility and WriterUtility; the authors' scripts
render_dataset_improved_mat.py (BlenderProc-3DFront) and 1_process_viewdata.py (ScenePriors).
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field, RootModel, model_validator

from data_prep.engine.plan import digest
from data_prep.engine.source import RoomTask
from data_prep.front.recipe import Recipe
from data_prep.readers.annotations import read_hdf5, read_records
from data_prep.readers.frames import GL_TO_CV, choose_frames, sampled
from data_prep.readers.reader import FoundRoom, Reader, by_number
from data_prep.readers.rooms import FramedRoom, numbered
from sceneprior.core.checked import checked, plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, list_folders, read_arrays
from sceneprior.core.furniture import INFO_FILES, model_categories, tidy_category

LABELS = "blender_label_mapping.csv"
_FROM_BLENDER = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_MIRROR = np.diag([-1.0, 1, 1, 1])
_HINT = (
    "a frame has BlenderProc's instance_segmaps, instance_attribute_maps and cam_Ts, the camera to "
    "world; render it again with a script that stores them, as the authors' does"
)


class _Part(BaseModel):
    """A piece of furniture, or a part of one, in a frame."""

    idx: Annotated[int, Field(ge=0)]
    """Value in the frame's image of ids."""
    inst_mark: str
    """Name of the piece; its parts share it, and it is the same in all frames of a house."""
    room_id: Annotated[str, Field(coerce_numbers_to_str=True)]
    jid: str = ""
    category_id: int = 0

    @model_validator(mode="before")
    @classmethod
    def _tidied(cls, row: Any) -> Any:
        if not isinstance(row, dict):
            return row
        return {key.removeprefix("cp_"): value for key, value in row.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class BlenderProc(Reader):
    """BlenderProc's frames; a house is a scene with several rooms."""

    name: ClassVar = "blenderproc"
    recipe: Recipe
    """Recipe for classes and room types; its other rules would need the house files."""

    @property
    def label_set(self) -> str:
        return self.recipe.label_set

    @property
    def room_type(self) -> str:
        return self.recipe.name

    def options(self) -> dict[str, Any]:
        models = sorted(_categories(self.folder).items(), key=repr)
        return {
            **super().options(),
            **self.recipe.model_dump(include={"name", "label_set", "categories", "room_types"}),
            "models": digest(repr(models)),
            "intrinsics": _intrinsics(self.folder).tolist(),
        }

    def scenes(self) -> list[str]:
        return [path.name for path in list_folders(self.folder) if list_files(path, "*.hdf5")]

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """Rooms of the recipe's types; a frame belongs to the room with most furniture pixels."""
        frames: dict[str, list[str]] = {}
        size = (0, 0)
        for path in by_number(list_files(self.folder / scene, "*.hdf5")):
            image, parts = _read_frame(path)
            if size not in ((0, 0), image.shape):
                raise InputError(
                    f"{path} is {image.shape[1]} x {image.shape[0]} pixels, but the frames before "
                    f"it {size[1]} x {size[0]}; cam_K.npy is that of one size."
                )
            size = image.shape
            pixels = np.bincount(image.ravel())
            areas = Counter[str]()
            for part in parts:
                areas[part.room_id] += int(pixels[part.idx]) if part.idx < len(pixels) else 0
            if areas := +areas:  # keeps the areas of visible furniture
                room = max(sorted(areas), key=lambda name: areas[name])
                frames.setdefault(room, []).append(path.name)
        return {
            f"{scene}_{room}": FoundRoom(size, {"room": room, "frames": names})
            for room, names in sorted(frames.items())
            if self.recipe.of_type(room.partition("-")[0])
        }

    def read(self, task: RoomTask) -> FramedRoom:
        """Read the frames of one room; other rooms' furniture, behind doors, is unknown."""
        paths = [self.folder / task.house / name for name in task.extra["frames"]]
        read = [(path, *read_hdf5(path, ("cam_Ts",), _HINT)) for path in paths]
        for path, pose in read:
            if pose.size != 16 or pose.dtype.kind not in "fiu":
                raise InputError(
                    f"{path}: cam_Ts is {shown(pose.shape)}, not a 4 x 4 matrix; {_HINT}."
                )
        # Blender's world and OpenGL's camera axes, metres.
        poses = np.stack([pose.reshape(4, 4).astype(np.float64) for _, pose in read])
        frames, notes = choose_frames(task.room_id, poses, range(len(paths)), self.max_views)
        categories = _categories(self.folder)
        numbers: dict[str, int] = {}
        classes: dict[int, str] = {}
        images, intrinsics = [], []
        for frame in frames:
            image, parts = _read_frame(paths[frame])
            table = np.zeros(int(image.max()) + 1, dtype=np.int32)
            for part in parts:
                if part.idx >= len(table):
                    continue  # hidden in this frame
                if part.room_id != task.extra["room"]:
                    table[part.idx] = -1
                    continue
                table[part.idx] = number = numbers.setdefault(part.inst_mark, len(numbers) + 1)
                category = categories.get(part.jid, categories.get(part.category_id, "others"))
                classes[number] = self.recipe.class_of(category)
            K = _MIRROR[:3, :3] @ _intrinsics(self.folder) @ _MIRROR[:3, :3]
            K[0, 2] += image.shape[1]
            lines, K = sampled(image.shape, self.max_side, K)
            images.append(table[image[:, ::-1]][lines])
            intrinsics.append(K)
        mirrored = _FROM_BLENDER @ poses[frames] @ _MIRROR @ GL_TO_CV
        return FramedRoom(
            **numbered(np.stack(images), classes, self.label_set, task.room_id, notes=notes),
            camera_to_world=mirrored,
            intrinsics=np.stack(intrinsics),
            floor_y=0.0,
        )


def _read_frame(path: Path) -> tuple[np.ndarray, list[_Part]]:
    """Image of ids, (H, W), and the pieces of furniture that a frame lists."""
    image, text = read_hdf5(path, ("instance_segmaps", "instance_attribute_maps"), _HINT)
    if image.ndim != 2 or image.dtype.kind not in "ui" or not image.size or image.min() < 0:
        raise InputError(f"{path}: instance_segmaps is no image of ids; {_HINT}.")
    try:
        rows = json.loads(bytes(text[()]))
    except (ValueError, TypeError, RecursionError) as error:
        reason = plain(str(error), 120)
        raise InputError(
            f"{path}: instance_attribute_maps is not JSON ({reason}); {_HINT}."
        ) from None
    where = f"{path}, instance_attribute_maps"
    parts = checked(RootModel[list[_Part]], rows, where, hint=_HINT).root
    return image, [part for part in parts if part.inst_mark and "layout" not in part.inst_mark]


def _intrinsics(folder: Path) -> np.ndarray:
    """Intrinsics of all frames, (3, 3), with the centre of the first pixel at (0.5, 0.5)."""
    path = folder / "cam_K.npy"
    hint = "it is the camera matrix that the authors' script writes beside the houses"
    K = read_arrays(path, hint).get("", np.zeros(0))
    K = K.astype(np.float64) if K.dtype.kind in "iuf" else np.zeros(0)
    if K.shape != (3, 3) or not (np.abs(K) < 1e6).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(f"{path} holds no camera matrix of 3 x 3 numbers.")
    K[:2, 2] += 0.5
    return K


def _categories(folder: Path) -> dict[Any, str]:
    """3D-FUTURE's category by model id or by class id, whichever the folder has a table of."""
    if any((folder / name).is_file() for name in INFO_FILES):
        return dict(model_categories(folder))
    path = folder / LABELS
    if not path.is_file():
        raise InputError(
            f"{folder} has neither 3D-FUTURE's {INFO_FILES[0]} nor BlenderProc's {LABELS} "
            "(resources/front_3D), which say what each piece is; copy one of them there."
        )
    what = "BlenderProc's table of the columns id and name"
    rows = read_records(path, f"it is {what}")
    try:
        return {int(row["id"]): tidy_category(row["name"]) for row in rows}
    except (ValueError, KeyError) as error:
        reason = f"{type(error).__name__}: {plain(str(error), 120)}"
        raise InputError(f"{path} is not {what} ({reason}).") from None
