"""Reads one scan folder: objects in the room frame, and cameras."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_prep.readers.frames import (
    Y_UP,
    FrameChoice,
    choose_frames,
    first_fault,
    mask_intrinsics,
    room_cameras,
)
from data_prep.readers.heading import turn_matrix
from data_prep.readers.scannet.annotations import (
    axis_alignment,
    object_parts,
    read_groups,
    read_mesh,
    read_properties,
    read_segments,
    surface_of,
)
from data_prep.readers.scannet.labels import Labels
from data_prep.readers.scannet.masks import MASK_FILES, MaskArchive
from data_prep.readers.scannet.sens import read_recording
from sceneprior.core.checked import plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh

FULL_SIZE = (968, 1296)
QUARTER_SIZE = (242, 324)
"""(height, width) of ScanNet's colour frames, and a quarter of it, the paper's rendering size."""


@dataclass(frozen=True)
class ScanSettings:
    """Settings that turn a recording into views."""

    frame_step: int = 15
    """Step between candidate frames; ScanNet's common export takes every 15th."""
    max_views: int = 100
    """Maximum number of views; more candidates are thinned evenly (paper: 100)."""
    masks: str = "filt"
    """`filt`: cleaned by ScanNet along depth and colour edges; `raw`: the projected mesh."""
    image_size: tuple[int, int] = QUARTER_SIZE
    """(height, width) of stored images. It is the same for all rooms, even those recorded at
    640 x 480, because batches mix rooms. `FULL_SIZE` keeps every pixel."""

    def __post_init__(self) -> None:
        if self.masks not in MASK_FILES:
            raise InputError(f"masks is '{self.masks}'; choose {' or '.join(MASK_FILES)}.")
        for name in ("frame_step", "max_views"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least 1.")


@dataclass(frozen=True)
class Instance:
    """One annotated object with the box of its vertices, in the room frame."""

    object_id: int
    """Id of the object; its value in the masks is one more."""
    label: str
    """Class of the label set `scannet`; `void` outside its 19 classes."""
    is_shell: bool
    """True for a part of the room (wall, floor, ...), false for furniture."""
    stuff: int
    """Index into `STUFF`."""
    lower_m: np.ndarray
    upper_m: np.ndarray
    """(3,) float64 corners of the axis-aligned box."""
    vertices: np.ndarray
    """Indices of the object's vertices in the scan's mesh."""
    surface: Mesh | None
    """Scanned surface of the object in the room frame; None for an object without a class."""


@dataclass(frozen=True)
class Scan:
    """A scan: objects and cameras in memory, masks still in their zip."""

    folder: Path
    instances: tuple[Instance, ...]
    """Objects in the order of their ids, without those that have no vertices."""
    mesh: Mesh
    """The whole scanned mesh in the room frame, with its unannotated parts."""
    floor_m: np.ndarray
    """(4, 2) x, z of the bounding rectangle of the objects."""
    height_m: float
    """Height of the scan's highest vertex above the floor."""
    room_from_scan: np.ndarray
    """(4, 4) float64, from the mesh's world."""
    is_aligned: bool
    """True if the scan has an axisAlignment."""
    frames: tuple[int, ...]
    """Frame number of each view."""
    world_to_camera: np.ndarray
    """(views, 4, 4) float64, from the room frame."""
    intrinsics: np.ndarray
    """(3, 3) float64, in pixels of an image of `settings.image_size`."""
    masks: Path
    settings: ScanSettings
    notes: tuple[str, ...]

    @property
    def scan_id(self) -> str:
        """Id of the scan, such as `scene0000_00`; each scan of a space is a separate room."""
        return self.folder.name


def read_scan(
    folder: Path, labels: Labels, settings: ScanSettings | None = None, turned_deg: float = 0.0
) -> Scan:
    """Read all of a scan except its pictures.

    The room frame is that of axisAlignment, with (x, y, z) mapped to (y, z, x) so that y is up, and
    then turned by `turned_deg` about y. The floor, y = 0, is at the lowest point of the boxes of
    objects with a class; the origin is the centre of their bounding rectangle in x and z. ScanNet
    has no floor plans, and its annotated floors cover only the parts that the camera saw. If no
    object has a class, the box of the whole mesh is used instead.
    """
    folder, settings = Path(folder), settings or ScanSettings()
    name = folder.name
    properties_path = folder / f"{name}.txt"
    properties = read_properties(properties_path)
    aligned = Y_UP @ axis_alignment(properties_path, properties)
    if turned_deg:
        aligned = turn_matrix(turned_deg) @ aligned
    groups, notes = read_groups(folder / f"{name}.aggregation.json")
    is_aligned = "axisAlignment" in properties
    if not is_aligned:
        notes.append(
            f"{properties_path.name} has no axisAlignment, which ScanNet v2's file has: the "
            "direction of the walls is found from masks"
        )
    segments_path = folder / f"{name}_vh_clean_2.0.010000.segs.json"
    mesh_path = folder / f"{name}_vh_clean_2.ply"
    segments, mesh = read_segments(segments_path), read_mesh(mesh_path)
    if len(segments) != len(mesh.vertices_m):
        raise InputError(
            f"{segments_path} has {len(segments)} segIndices, but {mesh_path.name} "
            f"{len(mesh.vertices_m)} vertices; they are not of one release, or the mesh is "
            "truncated. Download both again."
        )
    vertices = mesh.vertices_m @ aligned[:3, :3].T + aligned[:3, 3]
    parts = object_parts(groups, segments)
    bounds = [
        (vertices[part].min(axis=0), vertices[part].max(axis=0)) if len(part) else None
        for part in parts
    ]
    whole = vertices.min(axis=0), vertices.max(axis=0)
    boxed = [
        box
        for group, box in zip(groups, bounds, strict=True)
        if box is not None and labels.label(group.category) != "void"
    ] or [whole]
    lower = np.min([box[0] for box in boxed], axis=0)
    upper = np.max([box[1] for box in boxed], axis=0)
    origin = np.array([(lower[0] + upper[0]) / 2, lower[1], (lower[2] + upper[2]) / 2])
    room_from_scan = aligned.copy()
    room_from_scan[:3, 3] -= origin

    mesh = Mesh(vertices - origin, mesh.faces)
    instances = []
    for group, box, part in zip(groups, bounds, parts, strict=True):
        if not labels.knows(group.category):
            notes.append(
                f"object {group.object_id}: {shown(group.category)} is not in {labels.source}, so "
                "void"
            )
        if box is None:
            notes.append(
                f"object {group.object_id} ({plain(group.category)}) has no vertices; left out"
            )
            continue
        kind, is_shell = labels.label(group.category), labels.is_shell(group.category)
        corners = box[0] - origin, box[1] - origin
        surface = None if kind == "void" else surface_of(mesh, part)
        stuff = labels.stuff(group.category)
        instances.append(Instance(group.object_id, kind, is_shell, stuff, *corners, part, surface))
    half = (upper - lower)[[0, 2]] / 2
    choice, world_to_camera, intrinsics, masks = _read_cameras(folder, room_from_scan, settings)
    notes += choice.notes("mask")
    return Scan(
        folder=folder,
        instances=tuple(instances),
        mesh=mesh,
        floor_m=np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half,
        height_m=float(whole[1][1] - origin[1]),
        room_from_scan=room_from_scan,
        is_aligned=is_aligned,
        frames=choice.frames,
        world_to_camera=world_to_camera,
        intrinsics=intrinsics,
        masks=masks,
        settings=settings,
        notes=tuple(notes),
    )


def _read_cameras(
    folder: Path, room_from_scan: np.ndarray, settings: ScanSettings
) -> tuple[FrameChoice, np.ndarray, np.ndarray, Path]:
    """Choose the frames; returns them, world_to_camera, the intrinsics, and the mask archive."""
    mask_path = _mask_path(folder, settings.masks)
    sens_path = folder / f"{folder.name}.sens"
    sens = read_recording(sens_path)
    with MaskArchive(mask_path) as masks:
        frames, mask_size = masks.frames, masks.image_size
    choice = choose_frames(sens.camera_to_world, frames, settings.frame_step, settings.max_views)
    if not choice.frames:
        bad = first_fault(sens.camera_to_world, settings.frame_step)
        fault = f" (the pose of frame {bad[0]}: {bad[1]})" if bad else ""
        raise InputError(
            f"{sens_path} gives no view: of {choice.candidates} frames (every "
            f"{settings.frame_step}), {choice.bad_poses} have no usable pose and "
            f"{choice.without_mask} no mask in {mask_path.name}{fault}. "
            "Download the scan again, or leave it out."
        )
    try:
        intrinsics = mask_intrinsics(
            sens.intrinsics, sens.color_size, mask_size, settings.image_size
        )
    except InputError as error:
        raise InputError(f"{mask_path}: {error}") from None
    poses = sens.camera_to_world[list(choice.frames)]
    return choice, room_cameras(poses, room_from_scan), intrinsics, mask_path


def _mask_path(folder: Path, kind: str) -> Path:
    path = folder / f"{folder.name}{MASK_FILES[kind]}"
    if path.is_file():
        return path
    others = [
        f" (or give --masks {other}, whose archive is here)"
        for other, ending in MASK_FILES.items()
        if other != kind and (folder / f"{folder.name}{ending}").is_file()
    ]
    raise InputError(
        f"{path} is missing: the instance masks. Download it into the scan's folder"
        f"{''.join(others)}."
    )
