"""Reads one scan folder: its objects in the room frame, and its cameras."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_prep.frames import FrameChoice, choose_frames, mask_intrinsics, room_cameras
from data_prep.scannet.annotations import (
    axis_alignment,
    object_parts,
    read_groups,
    read_mesh,
    read_properties,
    read_segments,
    surface_of,
)
from data_prep.scannet.labels import Labels
from data_prep.scannet.masks import MASK_FILES, MaskArchive
from data_prep.scannet.sens import read_recording
from sceneprior.errors import InputError
from sceneprior.scene import Mesh

FULL_SIZE = (968, 1296)
QUARTER_SIZE = (242, 324)
"""(height, width) of ScanNet's colour frames, and the quarter at which the paper renders."""

_Y_UP = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""(x, y, z) with z up -> (y, z, x) with y up; right-handed as before."""


@dataclass(frozen=True)
class ScanSettings:
    """How a recording becomes views."""

    frame_step: int = 15
    """Every so many frames is a candidate; ScanNet's common export takes every 15th."""
    max_views: int = 100
    """More candidates than this are thinned evenly (paper: 100)."""
    masks: str = "filt"
    """`filt`, which ScanNet cleaned along depth and colour edges, or `raw`, the projected mesh."""
    image_size: tuple[int, int] = QUARTER_SIZE
    """(height, width) of every stored image. One size for all rooms, also for the few that were
    recorded at 640 x 480: a batch holds many rooms. `FULL_SIZE` keeps every pixel."""

    def __post_init__(self) -> None:
        if self.masks not in MASK_FILES:
            raise InputError(f"masks is '{self.masks}'; choose {' or '.join(MASK_FILES)}.")
        for name in ("frame_step", "max_views"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it counts from 1.")
        if min(self.image_size) < 1:
            height, width = self.image_size
            raise InputError(f"image_size is {width} x {height} pixels; both must be at least 1.")


@dataclass(frozen=True)
class Instance:
    """One annotated object with the box of its vertices, in the room frame."""

    object_id: int
    """Masks say this + 1."""
    category: str
    """The annotators' word."""
    label: str
    """Class of the label set `scannet`; `void` outside the 19."""
    is_shell: bool
    """A part of the room (wall, floor, ...), not a thing in it."""
    lower_m: np.ndarray
    upper_m: np.ndarray
    """(3,) float64 corners of the axis-aligned box."""
    surface: Mesh | None
    """What the scan saw of it, in the room frame; None of what has no class."""


@dataclass(frozen=True)
class Scan:
    """A scan: its objects and cameras in memory, its masks still in their zip."""

    folder: Path
    scene_type: str
    """Such as "Bedroom / Hotel"; empty where the scan does not say."""
    instances: tuple[Instance, ...]
    """By object id; those without vertices are missing."""
    room_from_scan: np.ndarray
    """(4, 4) float64, rigid, from the scan's own frame (z up) to the room frame."""
    floor_m: np.ndarray
    """(4, 2) x, z of the rectangle round the objects."""
    height_m: float
    """From the floor to the highest vertex of the scan."""
    frames: tuple[int, ...]
    """Frame number of each view."""
    world_to_camera: np.ndarray
    """(views, 4, 4) float64, OpenCV axes, from the room frame."""
    intrinsics: np.ndarray
    """(3, 3) float64, pixels of an image of the settings' size."""
    masks: Path
    settings: ScanSettings
    notes: tuple[str, ...]
    """What was left out, and why."""

    @property
    def scan_id(self) -> str:
        """`scene0000_00`; a room that was scanned twice is two rooms."""
        return self.folder.name


def read_scan(folder: Path, labels: Labels, settings: ScanSettings | None = None) -> Scan:
    """Read everything of a scan but its pictures.

    The room frame: axisAlignment, then (x, y, z) -> (y, z, x), so that y is up. The floor, y = 0,
    is the lowest point of the boxes of objects that have a class, and its centre, the origin, the
    middle of the rectangle around these boxes in x and z: ScanNet has no floor plan, and its
    annotated floors are as ragged as what the camera happened to see. Where no object has a
    class, the whole mesh takes their place.

    Raises:
        InputError: a file is missing or damaged, files do not belong together, or no frame has
            both a pose and a mask. The message names the file and what to do.
    """
    folder, settings = Path(folder), settings or ScanSettings()
    name = folder.name
    properties_path = folder / f"{name}.txt"
    properties = read_properties(properties_path)
    aligned = _Y_UP @ axis_alignment(properties_path, properties)
    groups, notes = read_groups(folder / f"{name}.aggregation.json")
    if "axisAlignment" not in properties:
        notes.append(
            f"{properties_path.name} has no axisAlignment: walls may stand at an angle to the axes "
            "and boxes be larger than what is in them; ScanNet v2's file has one"
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
                f"object {group.object_id}: '{group.category}' is not in {labels.source}, so void"
            )
        if box is None:
            notes.append(f"object {group.object_id} ({group.category}) has no vertices; left out")
            continue
        kind, is_shell = labels.label(group.category), labels.is_shell(group.category)
        corners = box[0] - origin, box[1] - origin
        surface = None if kind == "void" else surface_of(mesh, part)
        item = Instance(group.object_id, group.category, kind, is_shell, *corners, surface)
        instances.append(item)
    half = (upper - lower)[[0, 2]] / 2
    choice, world_to_camera, intrinsics, masks = _read_cameras(folder, room_from_scan, settings)
    every = f"of {choice.candidates} frames (every {settings.frame_step})"
    for count, why in (
        (choice.bad_poses, "have no usable pose"),
        (choice.without_mask, "have no mask"),
    ):
        notes += [f"{count} {every} {why}; skipped"] * bool(count)
    return Scan(
        folder=folder,
        scene_type=properties.get("sceneType", ""),
        instances=tuple(instances),
        room_from_scan=room_from_scan,
        floor_m=np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half,
        height_m=float(whole[1][1] - origin[1]),
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
    """Which frames, their world_to_camera, the intrinsics of all, and the archive of masks."""
    mask_path = _mask_path(folder, settings.masks)
    sens_path = folder / f"{folder.name}.sens"
    sens = read_recording(sens_path)
    with MaskArchive(mask_path) as masks:
        frames, mask_size = masks.frames, masks.image_size
    choice = choose_frames(sens.camera_to_world, frames, settings.frame_step, settings.max_views)
    if not choice.frames:
        raise InputError(
            f"{sens_path} gives no view: of {choice.candidates} frames (every "
            f"{settings.frame_step}), {choice.bad_poses} have no usable pose and "
            f"{choice.without_mask} no mask in {mask_path.name}. Download the scan again, or "
            "leave it out."
        )
    try:
        intrinsics = mask_intrinsics(
            sens.intrinsic_color, sens.color_size, mask_size, settings.image_size
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
