"""Reads Hypersim: synthetic scenes with camera trajectories; cameras may be tilt-shift.

    <folder>/metadata_camera_parameters.csv     projection of each scene (contrib/mikeroberts3000)
    <folder>/<scene>/_detail/metadata_scene.csv meters_per_asset_unit
        _detail/cam_XX/camera_keyframe_{positions,orientations}.hdf5
        _detail/mesh/metadata_semantic_instance_bounding_box_object_aligned_2d_*.hdf5
        images/scene_cam_XX_geometry_hdf5/frame.IIII.{semantic_instance,semantic}.hdf5

The world is in asset units, z up; cameras have OpenGL's axes. A scene is a room, and all its
trajectories are its views.

Source: the README, scene_generate_images_bounding_box.py and contrib/mikeroberts3000 of
apple/ml-hypersim.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import rq

from data_prep.engine.source import RoomTask
from data_prep.readers.annotations import ids_and_classes, read_hdf5, read_records
from data_prep.readers.frames import GL_TO_CV, Y_UP, choose_frames, sampled
from data_prep.readers.reader import FoundRoom, Reader
from data_prep.readers.rooms import FramedRoom, corners_of, numbered
from sceneprior.core.cameras import rigid
from sceneprior.core.checked import plain
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_folders

CAMERAS = "metadata_camera_parameters.csv"
_BOXES = "metadata_semantic_instance_bounding_box_object_aligned_2d_{}.hdf5"
_HINT = "download the scene again"


@dataclass(frozen=True, kw_only=True)
class Hypersim(Reader):
    """Hypersim's scenes."""

    name: ClassVar = "hypersim"

    def options(self) -> dict[str, Any]:
        _camera_rows(self.folder / CAMERAS)
        return super().options()

    def scenes(self) -> list[str]:
        return [
            path.name
            for path in list_folders(self.folder)
            if re.fullmatch(r"ai_\d{3}_\d{3}", path.name) and (path / "_detail").is_dir()
        ]

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """The scene as one room."""
        return {scene: FoundRoom(_camera(self.folder / CAMERAS, scene)[0])}

    def read(self, task: RoomTask) -> FramedRoom:
        scene = self.folder / task.house
        size, cam_from_uv = _camera(self.folder / CAMERAS, task.house)
        intrinsics, tilt = pinhole(cam_from_uv, size)
        path = scene / "_detail" / "metadata_scene.csv"
        settings = {row.get("parameter_name"): row for row in read_records(path, _HINT)}
        row = settings.get("meters_per_asset_unit", {})
        unit = float(_numbers(row, ["parameter_value"], f"{path}, meters_per_asset_unit,")[0])
        if unit <= 0:
            raise InputError(f"{path}: meters_per_asset_unit is {unit:g}; it is damaged.")
        images, poses = _trajectories(scene, unit)
        with_ids = [k for k, paths in enumerate(images) if all(path.is_file() for path in paths)]
        frames, notes = choose_frames(str(scene), poses, with_ids, self.max_views)
        lines, inside = straight_grid(sampled(size, self.max_side, intrinsics)[0], intrinsics, size)
        intrinsics[0, 1] = 0
        intrinsics = sampled(size, self.max_side, intrinsics)[1]
        arrays = [
            [np.where(inside, _image(path, size)[lines], -1) for path in images[k]] for k in frames
        ]
        instances, semantics = (np.stack(kind) for kind in zip(*arrays, strict=True))
        del arrays
        ids, classes, stuff = ids_and_classes(instances, semantics, str(scene))
        cameras = Y_UP @ poses[frames] @ GL_TO_CV
        cameras[:, :3, :3] = cameras[:, :3, :3] @ tilt.T
        boxes = _boxes(scene / "_detail" / "mesh", unit)
        return FramedRoom(
            **numbered(ids, classes, self.label_set, task.room_id, boxes, stuff, notes),
            camera_to_world=cameras,
            intrinsics=intrinsics,
        )


def _camera_rows(path: Path) -> dict[str, dict[str, str]]:
    """Rows of the table of cameras by scene."""
    if not path.is_file():
        raise InputError(
            f"{path} is missing: the projection of each scene. Copy it from "
            "contrib/mikeroberts3000 of Hypersim's code (github.com/apple/ml-hypersim)."
        )
    rows = read_records(path, _HINT)
    if not rows or not {"scene_name", "M_cam_from_uv_00"} <= set(rows[0]):
        raise InputError(
            f"{path} has no columns scene_name and M_cam_from_uv_00 to _22; copy it again from "
            "contrib/mikeroberts3000 of Hypersim's code."
        )
    return {row["scene_name"]: row for row in rows}


def _camera(path: Path, scene: str) -> tuple[tuple[int, int], np.ndarray]:
    """(height, width) of a scene's images, and the projection of its cameras (`pinhole`)."""
    rows = _camera_rows(path)
    if scene not in rows:
        raise InputError(f"{path} has no row for {plain(scene)}.")
    where = f"{CAMERAS}, {scene}"
    names = ["settings_output_img_height", "settings_output_img_width"]
    height, width = _numbers(rows[scene], names, where)
    names = [f"M_cam_from_uv_{i}{j}" for i in range(3) for j in range(3)]
    matrix = _numbers(rows[scene], names, where).reshape(3, 3)
    if not np.linalg.det(matrix) < -1e-6:  # a camera looks along -z
        raise InputError(f"{where}: M_cam_from_uv is no projection; it is damaged.")
    return (int(height), int(width)), matrix


def _numbers(row: dict[str, str], names: list[str], where: str) -> np.ndarray:
    try:
        values = np.array([float(row[name]) for name in names])
    except (KeyError, TypeError, ValueError):
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise InputError(f"{where} has no numbers in {names[0]} to {names[-1]}; it is damaged.")
    return values


def _trajectories(scene: Path, unit: float) -> tuple[list[tuple[Path, Path]], np.ndarray]:
    """Paths of each frame's id image and class image, and camera-to-world matrices in metres."""
    images: list[tuple[Path, Path]] = []
    poses: list[np.ndarray] = []
    for folder in list_folders(scene / "_detail", "cam_*"):
        positions, turns = (
            read_hdf5(folder / f"camera_keyframe_{name}.hdf5", ("dataset",), _HINT)[0]
            for name in ("positions", "orientations")
        )
        count = len(positions)
        if positions.shape != (count, 3) or turns.shape != (count, 3, 3):
            raise InputError(
                f"{folder}: camera_keyframe_positions have the shape {positions.shape} and "
                f"orientations {turns.shape}, expected (n, 3) and (n, 3, 3); {_HINT}."
            )
        poses.append(rigid(turns, positions * unit))
        pictures = scene / "images" / f"scene_{folder.name}_geometry_hdf5"
        for k in range(count):
            start = pictures / f"frame.{k:04d}"
            images.append((Path(f"{start}.semantic_instance.hdf5"), Path(f"{start}.semantic.hdf5")))
    if not images:
        raise InputError(f"{scene} has no trajectory in _detail/cam_XX; {_HINT}.")
    return images, np.concatenate(poses)


def _image(path: Path, size: tuple[int, int]) -> np.ndarray:
    (image,) = read_hdf5(path, ("dataset",), _HINT)
    if image.shape != size or image.dtype.kind not in "iu":
        raise InputError(
            f"{path} holds {image.dtype} of the shape {image.shape}, expected integers of {size}; "
            f"{_HINT}."
        )
    return image.astype(np.int32)


def _boxes(folder: Path, unit: float) -> dict[int, np.ndarray]:
    """Boxes in metres with y up, by instance + 1, for instances with a valid box."""
    positions, axes, extents = (
        read_hdf5(folder / _BOXES.format(name), ("dataset",), _HINT)[0]
        for name in ("positions", "orientations", "extents")
    )
    count = len(positions)
    if axes.shape != (count, 3, 3) or not positions.shape == extents.shape == (count, 3):
        raise InputError(f"{folder}: its arrays of 3D boxes do not belong together; {_HINT}.")
    turn = Y_UP[:3, :3]
    rows = zip(positions * unit, axes, extents * unit / 2, strict=True)
    return {
        k + 1: corners_of(center @ turn.T, (turn @ columns).T, half)
        for k, (center, columns, half) in enumerate(rows)
        if np.isfinite([*center, *columns.ravel(), *half]).all() and (half > 0).all()
    }


def pinhole(cam_from_uv: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection of Hypersim into intrinsics, with skew, and a rotation of the camera.

    `cam_from_uv` (3, 3) maps (u, v, 1), both in [-1, 1] with v upwards, to a ray in OpenGL's camera
    axes. A camera with a tilted image plane equals a rotated pinhole camera, since any invertible
    matrix is an upper triangular matrix times a rotation.

    Returns:
        Intrinsics, (3, 3), pixel centres at i + 0.5; and the rotation, (3, 3), from OpenCV's axes
        of the scene's camera to those of the pinhole.

    Example: no tilt, 90 degrees wide.

        >>> intrinsics, tilt = pinhole(np.diag([1.0, 0.75, -1.0]), (768, 1024))
        >>> intrinsics.round(6).tolist()
        [[512.0, 0.0, 512.0], [0.0, 512.0, 384.0], [0.0, 0.0, 1.0]]
    """
    height, width = size
    uv_from_pixel = np.array([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1.0]])
    pixel_from_ray = np.linalg.inv(GL_TO_CV[:3, :3] @ cam_from_uv @ uv_from_pixel)
    intrinsics, turn = rq(pixel_from_ray)
    signs = np.diag(np.sign(np.diag(intrinsics)))
    intrinsics, turn = intrinsics @ signs, signs @ turn
    return intrinsics / intrinsics[2, 2], turn


def straight_grid(
    lines: tuple[np.ndarray, ...], intrinsics: np.ndarray, size: tuple[int, int]
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Remove the skew of `intrinsics` by shifting the rows of an image.

    An image plane that is tilted about both axes has a skewed pixel grid, which shards cannot
    store: u = fx * x / z + skew * y / z + cx. Within its row, each pixel takes the value of the
    pixel to which the skew moves it.

    Args:
        lines: Rows (h, 1) and columns (1, w) of an image of `size`, (height, width).

    Returns:
        Rows and columns to read, (h, w); and True for the pixels within the image, (h, w).
    """
    rows, columns = lines
    shift = intrinsics[0, 1] * (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    columns = np.floor(columns + 0.5 + shift).astype(np.int64)
    inside = (columns >= 0) & (columns < size[1])
    return (np.broadcast_to(rows, columns.shape), columns.clip(0, size[1] - 1)), inside
