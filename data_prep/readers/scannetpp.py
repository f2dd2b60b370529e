"""Reads ScanNet++: ids are drawn from the annotated mesh, at the poses of the pictures.

    <folder>/<scene>/scans/{mesh_aligned_0.05.ply, segments.json, segments_anno.json}
    <folder>/<scene>/dslr/colmap/{cameras,images}.txt, or dslr/nerfstudio/transforms.json, or the
        same of the iphone, or iphone/pose_intrinsic_imu.json
    <folder>/scannetv2-labels.combined.tsv     optional: ScanNet's table of labels

Meshes are in metres, z up. COLMAP's models and `aligned_pose` of the iPhone are in the mesh's
world; nerfstudio's files have OpenGL's camera axes, in a world whose x and y are swapped and whose
z is reversed. Masks are rendered for a pinhole without distortion; the pictures themselves are not
read.

Source: common/scene_release.py, common/utils/anno.py, semantic/transforms/mesh.py and
iphone/arkit_pcl.py of scannetpp/scannetpp; its issue 160, and nerfstudio's colmap_to_json.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field, RootModel

from data_prep.engine.plan import digest
from data_prep.engine.source import RoomTask
from data_prep.readers.annotations import LABEL_SET, LIKE_NYU40, TABLE, Labels, read_labels
from data_prep.readers.frames import GL_TO_CV, Y_UP, choose_frames, shrunk
from data_prep.readers.posed.captures import read_model
from data_prep.readers.posed.recording import PosedFrame, frame_intrinsics
from data_prep.readers.posed.transforms import FILE_NAME, read_recording
from data_prep.readers.reader import FoundRoom, Reader
from data_prep.readers.rooms import FramedRoom, focal_and_center, numbered
from data_prep.readers.scan_files import AnnotatedMesh, read_annotated_mesh
from sceneprior.core.checked import checked
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_folders, read_json
from sceneprior.render.offscreen.zbuffer import rasterize

_IPHONE = "iphone/pose_intrinsic_imu.json"
_IPHONE_SIZE = (1440, 1920)
"""(height, width) of the iPhone's pictures, which its file does not state."""
_FROM_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
_OUTSIDE_M = 1.0
"""Distance from the mesh's bounding box beyond which a camera is outside the scene."""
_MESH = "scans/mesh_aligned_0.05.ply"


class _Frame(BaseModel):
    aligned_pose: Annotated[list[list[float]], Field(min_length=4, max_length=4)]
    intrinsic: Annotated[list[list[float]], Field(min_length=3, max_length=3)]


@dataclass(frozen=True, kw_only=True)
class ScanNetPP(Reader):
    """ScanNet++; a scene is a room."""

    name: ClassVar = "scannetpp"

    def options(self) -> dict[str, Any]:
        labels = digest(repr(sorted(_labels(self.folder).nyu40.items())))
        return {**super().options(), "labels": labels}

    def scenes(self) -> list[str]:
        return [path.name for path in list_folders(self.folder) if (path / _MESH).is_file()]

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """The scene as one room."""
        _, _, size = _cameras(self.folder / scene)
        return {scene: FoundRoom(size)}

    def read(self, task: RoomTask) -> FramedRoom:
        """Draw the ids of all views; unannotated surfaces, and holes of the mesh, are unknown."""
        scene = self.folder / task.house
        poses, intrinsics, size = _cameras(scene)
        frames, notes = choose_frames(str(scene), poses, range(len(poses)), self.max_views)
        scan = read_annotated_mesh(
            scene / _MESH,
            scene / "scans/segments.json",
            scene / "scans/segments_anno.json",
            Y_UP,
        )
        cameras, mesh = Y_UP @ poses[frames], scan.mesh
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        eyes = cameras[:, :3, 3]
        outside = ((eyes < low - _OUTSIDE_M) | (eyes > high + _OUTSIDE_M)).any(axis=1)
        if outside.any():
            raise InputError(
                f"{scene}: {outside.sum()} of {len(frames)} cameras are more than "
                f"{_OUTSIDE_M:g} m outside of {Path(_MESH).name}; poses and mesh are not of one "
                "release, or the poses have another convention. Download both again."
            )
        labels = _labels(self.folder)
        vertex_ids, vertex_stuff, classes = _ids(scan, labels)
        stored = shrunk(size, self.max_side)
        scale = np.array([stored[1] / size[1], stored[0] / size[0], 1.0])
        lenses = intrinsics[frames] * scale[:, None]
        faces = np.stack(
            [
                rasterize(mesh.vertices_m, mesh.faces, camera, focal_and_center(K), stored)[0]
                for camera, K in zip(np.linalg.inv(cameras), lenses, strict=True)
            ]
        )
        # The last entry is for pixels without a face.
        ids = np.append(_most_common(vertex_ids[mesh.faces]), np.int32(-1))[faces]
        stuff = np.append(_most_common(vertex_stuff[mesh.faces]), np.uint8(0))[faces]
        points = {k: mesh.vertices_m[item.part] for k, item in enumerate(scan.objects, start=1)}
        points = {k: own for k, own in points.items() if len(own)}
        floors = [it.part for it in scan.objects if labels.nyu40_class(it.category) == "floor"]
        heights = mesh.vertices_m[np.concatenate([np.zeros(0, np.int64), *floors]), 1]
        return FramedRoom(
            **numbered(
                ids, classes, self.label_set, task.room_id, points, stuff, (*scan.notes, *notes)
            ),
            camera_to_world=cameras,
            intrinsics=lenses,
            floor_y=float(np.median(heights)) if len(heights) else None,
            ceiling_y=float(high[1]),
        )


def _cameras(scene: Path) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Camera to world, (n, 4, 4), OpenCV axes in the mesh's world; intrinsics, (n, 3, 3); and the
    (height, width) of the pictures: those of the DSLR if its poses are there."""
    for device in ("dslr", "iphone"):
        model = [scene / device / "colmap" / f"{name}.txt" for name in ("cameras", "images")]
        poses_path = scene / device / "nerfstudio" / FILE_NAME
        if all(path.is_file() for path in model):
            return _in_mesh(model[1], np.eye(4), read_model(model))
        if poses_path.is_file():
            frames = read_recording(poses_path.parent).frames
            return _in_mesh(poses_path, _FROM_NERFSTUDIO, frames)
    path = scene / _IPHONE
    if not path.is_file():
        raise InputError(
            f"{scene} has no poses; expected dslr/colmap, dslr/nerfstudio, iphone/colmap, "
            f"iphone/nerfstudio or {_IPHONE}. Download one of them."
        )
    frames_by_name = checked(RootModel[dict[str, _Frame]], read_json(path), str(path)).root
    rows = [frame for _, frame in sorted(frames_by_name.items())]
    try:
        aligned = np.array([row.aligned_pose for row in rows]).reshape(-1, 4, 4)
        matrices = np.array([row.intrinsic for row in rows]).reshape(-1, 3, 3)
    except ValueError:
        raise InputError(
            f"{path}: aligned_pose and intrinsic are not 4 x 4 and 3 x 3 numbers in all frames; "
            "download it again."
        ) from None
    return aligned, matrices, _IPHONE_SIZE


def _in_mesh(
    path: Path, mesh_from_world: np.ndarray, images: Sequence[PosedFrame]
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Result of `_cameras`, from the pictures of a file."""
    lenses, size = [], (0, 0)
    for image in images:
        if image.camera.w is None or image.camera.h is None:
            raise InputError(f"{path} has no w and h, the size of the pictures.")
        K, size = frame_intrinsics(image, (1, 1))
        lenses.append(K)
    poses = np.stack([image.camera_to_world for image in images])
    return mesh_from_world @ poses @ GL_TO_CV, np.stack(lenses), size


def _labels(folder: Path) -> Labels:
    """NYU40 classes of labels, from ScanNet's table, if it exists, and from ours."""
    table = folder / TABLE
    own = {name: name for name in label_set(LABEL_SET)[1:]} | LIKE_NYU40
    listed = read_labels(table).nyu40 if table.is_file() else {}
    return Labels(listed | own, TABLE)


def _ids(scan: AnnotatedMesh, labels: Labels) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
    """Number of each vertex, (V,) int32: k + 1 for group k, 0 for the room itself, -1 for no group;
    index into `STUFF` of each vertex, uint8; and the classes. A vertex that several groups share
    belongs to the smallest of them."""
    numbers = np.full(len(scan.mesh.vertices_m), -1, dtype=np.int32)
    stuff = np.zeros(len(numbers), dtype=np.uint8)
    classes = {}
    for k, item in sorted(enumerate(scan.objects, start=1), key=lambda pair: -len(pair[1].part)):
        is_shell = labels.is_shell(item.category)
        numbers[item.part] = 0 if is_shell else k
        stuff[item.part] = labels.stuff(item.category)
        if not is_shell and len(item.part):
            name = labels.label(item.category)
            classes[k] = item.category if name == "void" else name
    return numbers, stuff, classes


def _most_common(corners: np.ndarray) -> np.ndarray:
    """Value of the majority of each face's corners, (F,); the first corner's if all differ."""
    first, second, third = corners.T
    return np.where(second == third, second, first)
