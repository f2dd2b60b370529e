"""Reads the files of a scan: ScanNet's recording (`.sens`), alignment (`.txt`) and masks (zip); and
the annotated mesh that ScanNet and ScanNet++ have."""

import contextlib
import io
import re
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, BinaryIO, NamedTuple, TypeVar

import numpy as np
from PIL import Image
from pydantic import BaseModel, Field

from data_prep.readers.annotations import download
from sceneprior.core.cameras import to_camera
from sceneprior.core.checked import checked, plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import check_file, read_bytes, read_json, reading
from sceneprior.core.id_tables import png_kind
from sceneprior.core.scene import Mesh

_LARGEST_MEMBER_BYTES = 64 << 20
"""Size limit of a mask; a mask of 1296 x 968 pixels has some 10 KB, or 1.2 MB uncompressed."""
_COMPRESSIONS = {-1, 0, 1, 2}
_LONGEST_SIDE_PX = 1 << 16
"""Image size from which a file counts as damaged; the data set has no such images."""
_FRAME = struct.Struct("<16f4Q")
"""Header of a frame: camera_to_world; timestamps and byte counts of colour and depth."""
_AFTER_CALIBRATION = struct.Struct("<2i4IfQ")
"""Rest of the header: compressions; widths and heights of colour and depth; depth shift; number of
frames."""
_DAMAGE = (OSError, ValueError, SyntaxError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""Errors of damaged zips and PNGs; RuntimeError means a password, or a method that is unknown."""
_M = TypeVar("_M", bound=BaseModel)
_Index = Annotated[int, Field(strict=True, ge=0, lt=2**31)]


class SensRecording(NamedTuple):
    """Cameras of a `.sens` recording.

    Depth and colour of the release are already aligned, so the header's extrinsics are not used.
    """

    intrinsics: np.ndarray
    """(3, 3) float64, of the colour camera in pixels of a frame of `color_size`."""
    color_size: tuple[int, int]
    """(height, width) of the colour frames."""
    camera_to_world: np.ndarray
    """(frames, 4, 4) float32, OpenCV axes, metres, as written: untracked frames hold infinities."""


def read_sens(path: Path) -> SensRecording:
    """Read the header and the pose of every frame; errors name the file, the frame and the byte.

    Only the 96 bytes before each frame's pictures are read, so that a recording of several GB needs
    about a hundred bytes of memory per frame.

    Source: ScanNet's SensReader (sensorData.h), version 4.
    """
    size = check_file(path, sys.maxsize, "a scan folder holds it as <scene>.sens").st_size
    # The file is unbuffered, because a buffer would read 100 KB around every header.
    with reading(path), path.open("rb", buffering=0) as file:
        return _read(_Part(path, file, size))


@dataclass
class _Part:
    """The part of a recording that is read: its place in the file, and its name for messages."""

    path: Path
    file: BinaryIO
    size: int
    at: int = 0
    name: str = "header"

    def take(self, count: int, what: str) -> bytes:
        """Read the next bytes."""
        self.skip(count, what)
        self.file.seek(self.at - count)
        return self.file.read(count)

    def skip(self, count: int, what: str) -> None:
        """Go on behind the next bytes, which must lie inside the file."""
        if count > self.size - self.at:
            # A negative size, read as unsigned, is very large and also ends here.
            raise InputError(
                f"{self.where()}: {what} should take {count} bytes, but {self.size - self.at} are "
                "left; the file is truncated or damaged. Download it again."
            )
        self.at += count

    def where(self) -> str:
        return f"{self.path}, {self.name}, byte {self.at}"


def _read(part: _Part) -> SensRecording:
    version = int.from_bytes(part.take(4, "the version"), "little")
    if version != 4:
        raise InputError(
            f"{part.path}, header, byte 0: version {version}, expected 4; "
            "this is not a .sens file of ScanNet's release, or it is damaged."
        )
    part.skip(int.from_bytes(part.take(8, "the sensor's name"), "little"), "the sensor's name")
    where = part.where()
    intrinsics = np.eye(3)
    matrices = np.frombuffer(part.take(4 * 64, "the calibration"), dtype="<f4")
    intrinsics[:2] = matrices[:16].reshape(4, 4)[:2, :3]
    focal = intrinsics[(0, 1), (0, 1)]
    if not np.isfinite(intrinsics[:2]).all() or not (focal > 0).all():
        raise InputError(
            f"{where}: the colour camera's focal lengths are {focal[0]:g} and {focal[1]:g} pixels; "
            "the file is damaged. Download it again."
        )
    # ScanNet puts pixel centres at integers: its tools unproject pixel x, y by K^-1 (x, y, 1).
    intrinsics[:2, 2] += 0.5
    where = part.where()
    rest = part.take(_AFTER_CALIBRATION.size, "the sizes")
    color_kind, depth_kind, width, height, *depth, _, frames = _AFTER_CALIBRATION.unpack(rest)
    if not {color_kind, depth_kind} <= _COMPRESSIONS:
        raise InputError(
            f"{where}: compressions {color_kind} (colour) and {depth_kind} (depth), expected 0, 1 "
            "or 2; the file is damaged. Download it again."
        )
    if min(width, height) < 1 or max(width, height, *depth) >= _LONGEST_SIDE_PX:
        raise InputError(
            f"{where}: colour pictures of {width} x {height} and depth of {depth[0]} x {depth[1]} "
            "are implausible; the file is damaged. Download it again."
        )
    if not frames:
        raise InputError(f"{where}: the recording has no frames. Download it again.")
    poses = bytearray()  # grows as frames are read: a damaged count must not allocate memory
    for frame in range(frames):
        part.name = f"frame {frame}"
        head = part.take(_FRAME.size, "its pose and sizes")
        poses += head[:64]
        *_, color_bytes, depth_bytes = _FRAME.unpack(head)
        part.skip(color_bytes, "the colour picture")
        part.skip(depth_bytes, "the depth picture")
    # The count of IMU records comes next. A file may end here without loss to us, but a truncated
    # number means a broken download.
    part.name = "IMU records"
    if part.at != part.size:
        part.skip(8, "their count")
    camera_to_world = np.frombuffer(poses, "<f4").reshape(-1, 4, 4).astype(np.float32)
    return SensRecording(intrinsics, (height, width), camera_to_world)


@contextlib.contextmanager
def open_masks(path: Path) -> Iterator["MaskArchive"]:
    """Open a zip of masks."""
    check_file(path, sys.maxsize, "download it again")
    with reading(path, " cannot be opened as a zip", "; download it again."):
        archive = zipfile.ZipFile(path)
    with archive:
        yield MaskArchive(path, archive)


class MaskArchive:
    """An open archive of masks: 8-bit grey PNGs, value = objectId + 1, 0 = no object.

    The stem of a member is its frame number (`instance-filt/123.png`), in any folder. `frames` are
    the numbers of the frames with a mask, ascending, and `image_size` is every mask's.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile):
        self.path, self._zip = path, archive
        self._members = members = dict[int, zipfile.ZipInfo]()
        for item in archive.infolist():
            parts = item.filename.replace("\\", "/").split("/")
            if parts[0] == "" or ".." in parts or re.match(r"[A-Za-z]:", parts[0]):
                raise InputError(
                    f"{self.path} holds {shown(item.filename)}, a path outside of the archive, "
                    "which ScanNet's files never have. Do not use it: download the archive again."
                )
            found = re.fullmatch(r"([0-9]{1,9})\.png", parts[-1], re.IGNORECASE)
            if not found:
                continue  # folders, and files that macOS adds
            frame = int(found[1])
            if frame in members:
                raise InputError(
                    f"{self.path} holds frame {frame} twice: {shown(members[frame].filename)} and "
                    f"{shown(item.filename)}; keep one of them."
                )
            members[frame] = item
        if not members:
            raise InputError(
                f"{self.path} holds no masks; expected members such as instance-filt/0.png."
            )
        self.frames = tuple(sorted(members))
        width, height = self._open(self.frames[0]).size
        self.image_size = height, width

    def read(self, frame: int) -> np.ndarray:
        """Read the mask of one frame, (height, width) uint8: objectId + 1, or 0 for no object."""
        picture = self._open(frame)
        width, height = picture.size
        if (height, width) != self.image_size:
            raise InputError(
                f"{self._where(frame)} is {width} x {height} pixels, but the masks before it "
                f"{self.image_size[1]} x {self.image_size[0]}; an archive has one size."
            )
        try:
            # Pillow rejects truncated pictures; cv2 would pad them.
            return np.array(picture)
        except _DAMAGE as error:
            raise self._damaged(frame, error) from None

    def _open(self, frame: int) -> Image.Image:
        item = self._members[frame]
        if item.file_size > _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{item.file_size} bytes unpacked")
        try:
            data = self._zip.read(item)
        except _DAMAGE as error:
            raise self._damaged(frame, error) from None
        kind = png_kind(data)
        if kind is None:
            raise self._damaged(frame, "it is not a PNG")
        if kind != (8, "grey"):
            hint = "; 16-bit ones are the label archives (_2d-label)" if kind[0] == 16 else ""
            raise InputError(
                f"{self._where(frame)} has {kind[0]} bits, {kind[1]}; an instance mask has 8 bits, "
                f"grey{hint}."
            )
        try:
            picture = Image.open(io.BytesIO(data), formats=("PNG",))
        except (*_DAMAGE, Image.DecompressionBombError):
            raise self._damaged(frame, "its header is damaged") from None
        if not 0 < picture.width * picture.height <= _LARGEST_MEMBER_BYTES:
            raise self._damaged(frame, f"{picture.width} x {picture.height} pixels")
        return picture

    def _damaged(self, frame: int, why: object) -> InputError:
        return InputError(
            f"{self._where(frame)} cannot be read ({plain(str(why), 200)}); download the archive "
            "again."
        )

    def _where(self, frame: int) -> str:
        return f"{self.path}, {plain(self._members[frame].filename)}"


class _Object(BaseModel):
    objectId: _Index  # noqa: N815
    label: str
    segments: frozenset[_Index]


class _Aggregation(BaseModel):
    segGroups: list[_Object]  # noqa: N815


class _Segmentation(BaseModel):
    segIndices: list[_Index]  # noqa: N815


class ScanObject(NamedTuple):
    """One annotated object: the entries of the aggregation's `segGroups` with its number."""

    object_id: int
    category: str
    part: np.ndarray
    """Indices of its vertices; empty if the mesh has none of its segments."""
    others: tuple[int, ...] = ()
    """Further numbers of the same object."""


class AnnotatedMesh(NamedTuple):
    """The mesh of a scan and its annotated objects."""

    mesh: Mesh
    objects: list[ScanObject]
    """Sorted by id."""
    notes: list[str]


def read_annotated_mesh(
    mesh_path: Path, segments_path: Path, groups_path: Path, world_from_mesh: np.ndarray
) -> AnnotatedMesh:
    """Read the mesh, the segment of each vertex, and the objects, which are sets of segments."""
    mesh = read_mesh(mesh_path)
    why = "a scan without annotations (ScanNet's test scans) cannot be prepared"
    categories: dict[int, str] = {}
    segments_of: dict[int, frozenset[int]] = {}
    notes = []
    for entry in _read_json(_Aggregation, groups_path, why).segGroups:
        number = entry.objectId
        if number in categories:
            notes.append(f"object {number} is listed twice; its parts were joined")
        categories.setdefault(number, entry.label)
        segments_of[number] = segments_of.get(number, frozenset()) | entry.segments
    # Some scans, such as scene0217_00, list every object twice, and masks may show either number.
    numbers: dict[object, list[int]] = {}
    for number in sorted(categories):
        numbers.setdefault(segments_of[number] or number, []).append(number)
    for first, *others in numbers.values():
        told = "is listed again with the same segments, as"
        notes += [f"object {first} {told} {', '.join(map(str, others))}; one object"] * bool(others)
    why = "it assigns the parts of the mesh to objects"
    listed = _read_json(_Segmentation, segments_path, why).segIndices
    if len(listed) != len(mesh.vertices_m):
        raise InputError(
            f"{segments_path} has {len(listed)} segIndices, but {mesh_path.name} "
            f"{len(mesh.vertices_m)} vertices; they are not of one release, or the mesh is "
            "truncated. Download both again."
        )
    segments = np.array(listed, dtype=np.int64)
    objects = [
        ScanObject(
            number,
            categories[number],
            np.flatnonzero(np.isin(segments, [*segments_of[number]])),
            tuple(others),
        )
        for number, *others in numbers.values()
    ]
    vertices_m = to_camera(mesh.vertices_m, world_from_mesh)
    return AnnotatedMesh(Mesh(vertices_m, mesh.faces), objects, notes)


def read_mesh(path: Path) -> Mesh:
    """Read a PLY: vertices float64, metres."""
    from trimesh.exchange.ply import load_ply

    content = io.BytesIO(read_bytes(path, hint=download(path)))
    then = "; it is truncated or damaged. Download the scan again."
    with reading(path, " is not a mesh that can be read", then):
        # Load raw arrays, not a Trimesh, which may merge or drop vertices: segments index them.
        loaded = load_ply(content, fix_texture=False, skip_materials=True)
        vertices = np.array(loaded["vertices"], dtype=np.float64).reshape(-1, 3)
        faces = np.array(loaded.get("faces", ()), dtype=np.int64).reshape(-1, 3)
    if not len(vertices) or not np.isfinite(vertices).all():
        raise InputError(f"{path} holds no vertices, or broken ones. Download the scan again.")
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise InputError(f"{path} has triangles of vertices it lacks. Download the scan again.")
    return Mesh(vertices, faces)


def _read_json(model: type[_M], path: Path, why: str) -> _M:
    if not path.is_file():
        raise InputError(f"{path} is missing; {why}; {download(path)}.")
    try:
        return checked(model, read_json(path), str(path))
    except InputError as error:
        raise InputError(f"{error} Download the scan again.") from None
