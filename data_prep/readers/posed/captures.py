"""Reads the poses that COLMAP writes, and apps that record with an iPhone: Polycam and Record3D.

COLMAP's models, binary or text, have cameras and poses of images; their points are not read. Poses
of the apps are camera to world, in metres, with OpenGL axes: Polycam's in ARKit's world, whose y
points up; Record3D's relative to the first camera, so that no axis of their world points up.
nerfstudio's reader moves Record3D's principal point to the image centre; here it stays as written.

Source: COLMAP's documentation of its output format, and its `src/colmap/sensor/models.h`; the
README and `polyform/core/capture_folder.py` of PolyCam/polyform; the author's answers in the issues
of marek-simonik/record3d (27, 33, 36, 83, 93), and `scripts/record3d2nerf.py` in
NVlabs/instant-ngp.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model
from scipy.spatial.transform import Rotation

from data_prep.readers.frames import GL_TO_CV
from data_prep.readers.posed.cameras import Camera, Number
from data_prep.readers.posed.recording import PosedFrame
from data_prep.readers.reader import by_number
from sceneprior.core.cameras import rigid
from sceneprior.core.checked import checked, plain, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, list_folders, read_bytes, read_json, read_text

FOLDERS = ("sparse/*", "sparse", "colmap/sparse/*")
"""Folders in which COLMAP or nerfstudio put a model; `*` is a number, one for each model."""
_MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fl_x fl_y cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
"""Name and parameters of a camera model by COLMAP's number. Parameters have their names in
transforms.json; `f` stands for both focal lengths."""
_NUMBERS = frozenset("0123456789+-.eE \t")
"""Characters of the lines of points in a model's text."""
_BYTES_A_POINT = 24
_LONGEST_NAME = 4096
KEYFRAMES = ("keyframes/corrected_cameras", "keyframes/cameras")
"""Folders of optimized poses, for undistorted pictures, and of ARKit's poses, for originals."""
METADATA = ("metadata", "metadata.json", "EXR_RGBD/metadata", "EXR_RGBD/metadata.json")
"""Names of the JSON in an unpacked .r3d file, and in an export of EXRs and pictures."""
_OFF = 0.01
"""Largest deviation of a quaternion's length from 1."""
_ENTRIES = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
_SIZE = ("width", "height")
_FIELDS: dict[str, Any] = {
    **{key: (Number, ...) for key in ("fx", "fy", "cx", "cy", "width", "height")},
    **{key: (float, ...) for row in _ENTRIES for key in row},
}
_Keyframe = create_model("_Keyframe", __config__=ConfigDict(strict=True), **_FIELDS)


def model_files(folder: Path) -> list[Path]:
    """Find the files of cameras and of images of each model, preferably binary; empty without any.

    COLMAP makes several models of pictures that it cannot join.
    """
    for name in FOLDERS:
        place = folder / name.removesuffix("/*")
        models = [place]
        if name.endswith("*"):
            models = by_number([path for path in list_folders(place) if path.name.isdecimal()])
        found: list[Path] = []
        for model in models:
            for ending in ("bin", "txt"):
                paths = [model / f"{part}.{ending}" for part in ("cameras", "images")]
                if all(path.is_file() for path in paths):
                    found += paths
                    break
        if found:
            return found
    return []


def choose_model(files: Sequence[Path], number: int | None) -> tuple[list[Path], tuple[str, ...]]:
    """The files of one of several models, by default of the largest, and a note on the others."""
    models = {own[0].parent.name: [*own] for own in zip(files[::2], files[1::2], strict=True)}
    if number is not None and str(number) not in models:
        raise InputError(
            f"{files[0].parent.parent} has no model {number} (--model); it has {', '.join(models)}."
        )
    if len(models) == 1:
        return [*files], ()
    counts = {name: len(read_model(own)) for name, own in models.items()}
    chosen = max(counts, key=lambda name: counts[name]) if number is None else str(number)
    others = ", ".join(f"{name} with {count}" for name, count in counts.items() if name != chosen)
    return models[chosen], (
        f"of COLMAP's {len(models)} models, {chosen} with {counts[chosen]} frames is used, and not "
        f"{others} (--model chooses)",
    )


def read_model(files: Sequence[Path]) -> list[PosedFrame]:
    """Read the images of a model, sorted by name."""
    cameras, images = files
    try:
        known, rows = (_read_binary if cameras.suffix == ".bin" else _read_text)(cameras, images)
        made = []
        for name, pose, camera in rows:
            # World to camera with OpenCV axes: a quaternion w, x, y, z, then the translation.
            matrix = np.eye(4)
            w, x, y, z = pose[:4]
            matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
            matrix[:3, 3] = -matrix[:3, :3] @ pose[4:]
            lens = checked(Camera, known[camera], f"{images}, image {shown(name)}")
            made.append(PosedFrame(name, matrix @ GL_TO_CV, lens))
    except KeyError as error:
        raise InputError(f"{images} names camera {error}, which {cameras.name} lacks.") from None
    except (OSError, ValueError, IndexError, struct.error, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{cameras.parent} holds no COLMAP model that can be read ({plain(str(error), 120)})."
        ) from None
    if not made:
        raise InputError(f"{images} has no image with a pose.")
    return sorted(made, key=lambda image: image.name)


_Image = tuple[str, list[float], int]
"""Name, pose and number of the camera of an image."""
_Model = tuple[dict[int, dict[str, Any]], list[_Image]]
"""Keys of `Camera` by a camera's number; and the images."""


def _camera(path: Path, model: str, size: tuple[int, int], values: list[float]) -> dict[str, Any]:
    names = next((text.split() for name, text in _MODELS.values() if name == model), None)
    if names is None:
        raise InputError(
            f"{path}: its camera model {plain(model)} is not supported; use `colmap "
            "image_undistorter` to make pinhole pictures and a model of them (and make masks of "
            "those pictures), or reconstruct again with OPENCV or OPENCV_FISHEYE."
        )
    if len(values) != len(names):
        raise ValueError(f"{plain(model)} has {len(names)} parameters, not {len(values)}")
    keys = dict(zip(names, values, strict=True))
    if "f" in keys:
        keys["fl_x"] = keys["fl_y"] = keys.pop("f")
    return {"camera_model": model, "w": size[0], "h": size[1], **keys}


def _read_text(cameras: Path, images: Path) -> _Model:
    known = {}
    for _, line in _lines(cameras):
        number, model, *rest = line.split()
        values = [float(word) for word in rest[2:]]
        known[int(number)] = _camera(cameras, model, (int(rest[0]), int(rest[1])), values)
    return known, _image_rows(images)


def _image_rows(path: Path) -> list[_Image]:
    """Images of a text, whose second line has an image's points: x, y and a number of each.

    Texts that are written by hand often lack that line, which may also be empty, so it is told by
    its words: a multiple of three numbers. An image has ten words, or more if its name has spaces.
    """
    rows: list[_Image] = []
    for number, line in _lines(path):
        if rows and len(line.split()) % 3 == 0 and _NUMBERS.issuperset(line):
            continue
        try:
            image, w, x, y, z, *position, camera, name = line.split(maxsplit=9)
            _, (a, b, c) = int(image), position
            rows.append((name, [*map(float, (w, x, y, z, a, b, c))], int(camera)))
        except ValueError:
            raise InputError(
                f"{path}, line {number}: {shown(line)} is neither an image (its number, quaternion "
                "w x y z, translation x y z, camera and name) nor the points of one (three numbers "
                "each)."
            ) from None
    return rows


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number and text of each line that is neither empty nor a comment."""
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        if (line := line.strip()) and not line.startswith("#"):
            yield number, line


def _read_binary(cameras: Path, images: Path) -> _Model:
    known, rows = {}, []
    with cameras.open("rb") as file:
        for _ in range(_take(file, "Q")[0]):
            number, model, *size = _take(file, "iiQQ")
            name, keys = _MODELS.get(model, (f"number {model}", ""))
            values = [*_take(file, f"{len(keys.split())}d")]
            known[number] = _camera(cameras, name, (size[0], size[1]), values)
    with images.open("rb") as file:
        for _ in range(_take(file, "Q")[0]):
            _, *pose, camera = _take(file, "i7di")
            text = bytearray()
            while (letter := file.read(1)) not in (b"\0", b"") and len(text) < _LONGEST_NAME:
                text += letter
            (points,) = _take(file, "Q")
            file.seek(points * _BYTES_A_POINT, 1)
            rows.append((text.decode(), pose, camera))
    return known, rows


def _take(file: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(f"<{form}", file.read(struct.calcsize(f"<{form}")))


def polycam_files(folder: Path) -> list[Path]:
    """The JSONs of a raw export's keyframes, preferably the optimized ones; empty without any."""
    for name in KEYFRAMES:
        if paths := list_files(folder / name, "*.json"):
            return paths
    return []


def read_keyframes(paths: Sequence[Path]) -> Iterator[PosedFrame]:
    """Read Polycam's keyframes."""
    for path in paths:
        data = read_json(path)
        if isinstance(data, dict) and not data.keys() >= set(_SIZE):
            original = path.parent.with_name("cameras") / path.name
            other = read_json(original, hint=f"{path} has no size, which is read there")
            data |= {key: other.get(key) for key in _SIZE} if isinstance(other, dict) else {}
        read: Any = checked(_Keyframe, data, str(path))
        rows = [[getattr(read, key) for key in row] for row in _ENTRIES]
        pictures = path.parent.name.replace("cameras", "images")
        yield PosedFrame(
            f"keyframes/{pictures}/{path.stem}.jpg",
            np.array([*rows, [0, 0, 0, 1.0]]),
            Camera(fl_x=read.fx, fl_y=read.fy, cx=read.cx, cy=read.cy, w=read.width, h=read.height),
        )


class _Metadata(BaseModel):
    poses: list[Annotated[list[float], Field(min_length=7, max_length=7)]]
    """Rotation as a quaternion x, y, z, w, then the position."""
    K: Annotated[list[Number], Field(min_length=9, max_length=9)]
    """Intrinsics (3, 3) of the first frame, column by column."""
    perFrameIntrinsicCoeffs: list[Annotated[list[Number], Field(min_length=4)]] | None = None  # noqa: N815
    """fx, fy, cx, cy of each frame."""
    w: Number
    h: Number


def record3d_files(folder: Path) -> list[Path]:
    """The JSON of a recording; empty if there is none. A file without poses is ignored."""
    for name in METADATA:
        path = folder / name
        if path.is_file() and b'"poses"' in read_bytes(path):
            return [path]
    return []


def read_metadata(files: Sequence[Path]) -> Iterator[PosedFrame]:
    """Read Record3D's frames."""
    (path,) = files
    read = checked(_Metadata, read_json(path), str(path))
    poses = np.array(read.poses).reshape(-1, 7)
    if not len(poses):
        raise InputError(f"{path} has no poses; expected one for each picture.")
    if len(poses) > 1 and np.allclose(poses, [0, 0, 0, 1, 0, 0, 0]):
        raise InputError(
            f"{path}: all its poses are the identity, as those of the selfie camera, which have "
            "none; record with the LiDAR camera."
        )
    K = read.K
    lenses = read.perFrameIntrinsicCoeffs or [[K[0], K[4], K[6], K[7]]] * len(poses)
    if len(lenses) != len(poses):
        raise InputError(
            f"{path}: perFrameIntrinsicCoeffs has {len(lenses)} rows, but poses has {len(poses)}; "
            "expected one for each picture: export the recording again."
        )
    for number, (pose, lens) in enumerate(zip(poses, lenses, strict=True)):
        # A quaternion far from length 1 is invalid; scipy would reject zeros and NaN.
        known = abs(np.linalg.norm(pose[:4]) - 1) < _OFF and np.isfinite(pose).all()
        turn = Rotation.from_quat(pose[:4]).as_matrix() if known else np.full((3, 3), np.nan)
        fx, fy, cx, cy = lens[:4]
        camera = Camera(fl_x=fx, fl_y=fy, cx=cx, cy=cy, w=read.w, h=read.h)
        yield PosedFrame(f"{number}.jpg", rigid(turn, pose[4:]), camera)


class Tool(NamedTuple):
    """A tool that writes poses."""

    title: str
    """Name of the tool, and its files or folders, for messages."""
    up: str
    """See `Recording.up`."""
    in_metres: bool
    find: Callable[[Path], list[Path]]
    """Files of the poses in a room's folder; empty if there are none."""
    read: Callable[[Sequence[Path]], Iterable[PosedFrame]]


TOOLS = {
    "colmap": Tool("COLMAP (sparse/)", "cameras", False, model_files, read_model),
    "polycam": Tool("Polycam (keyframes/)", "y", True, polycam_files, read_keyframes),
    "record3d": Tool("Record3D (metadata)", "cameras", True, record3d_files, read_metadata),
}
"""Tools by the value of `--from`."""
