"""Labels the views of one room of posed pictures, in the arrays that shards store."""

import math
from dataclasses import dataclass

import numpy as np

from data_prep.engine.source import PreparedRoom
from data_prep.frames import (
    choose_frames,
    is_pose,
    mask_intrinsics,
    room_cameras,
    sampled_lines,
)
from data_prep.posed.labels import read_classes
from data_prep.posed.transforms import PosedFrame, Recording, frame_intrinsics, room_name
from sceneprior.errors import InputError
from sceneprior.instances.observations import observe
from sceneprior.instances.pngs import mask_size, read_mask
from sceneprior.instances.tables import IdTable

UP_AXES = ("z", "y")
_GL_TO_CV = np.diag([1.0, -1, -1, 1])
_Y_UP = {
    "y": np.eye(4),
    # (x, y, z) with z up -> (x, z, -y); right-handed as before.
    "z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
_LARGEST_SPREAD_M = 100.0


@dataclass(frozen=True)
class PosedSettings:
    """How posed pictures become views."""

    up: str = "z"
    """Which axis of the poses' world points up; nerfstudio's is z."""
    floor_m: float | None = None
    """Height of the floor in rooms whose file does not say; None: estimated, see below."""
    camera_height_m: float = 1.2
    """What the estimate assumes: the lowest camera was this far above the floor. Masks alone
    cannot tell where the floor is."""
    metres_per_unit: float = 1.0
    """In rooms whose file does not say. Poses from pictures alone (COLMAP) have no unit."""
    max_side: int | None = None
    """Larger masks are sampled down until no side is longer."""
    max_views: int = 100
    """More frames than this are thinned evenly (paper: 100)."""

    def __post_init__(self) -> None:
        if self.up not in UP_AXES:
            raise InputError(f"up is '{self.up}'; choose {' or '.join(UP_AXES)}.")
        for name in ("max_side", "max_views"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}; it counts from 1.")
        for name in ("camera_height_m", "metres_per_unit"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} is {getattr(self, name)}; it must be above 0.")
        if self.floor_m is not None and not math.isfinite(self.floor_m):
            raise InputError(f"floor_m is {self.floor_m}; expected a height in metres.")


def usable_frames(recording: Recording) -> list[PosedFrame]:
    """Frames with a PNG of ids, in the file's order; poses may still be lost.

    Raises:
        InputError: there is none.
    """
    frames = [frame for frame in recording.frames if frame.instances.is_file()]
    if not frames:
        raise InputError(
            f"{recording.path}: none of its {len(recording.frames)} frames has a PNG of instance "
            f"ids; expected {recording.frames[0].instances}."
        )
    return frames


def stored_size(frame: PosedFrame, settings: PosedSettings) -> tuple[int, int]:
    """(height, width) at which a room is stored: that of its PNGs, or less by `max_side`."""
    height, width = mask_size(frame.instances)
    shrink = 1.0 if settings.max_side is None else min(1, settings.max_side / max(height, width))
    return max(1, round(height * shrink)), max(1, round(width * shrink))


def prepare_posed(
    recording: Recording, label_set_name: str, settings: PosedSettings
) -> PreparedRoom | None:
    """Label the views of one room, which has no ground truth in 3D; None if no view shows an
    object of the label set.

    Raises:
        InputError: a file is missing, damaged, or does not fit the others.
    """
    folder = recording.path.parent
    frames = usable_frames(recording)
    size, first = stored_size(frames[0], settings), mask_size(frames[0].instances)
    poses = np.stack([frame.camera_to_world for frame in recording.frames])
    with_mask = [i for i, frame in enumerate(recording.frames) if frame.instances.is_file()]
    choice = choose_frames(poses, with_mask, 1, settings.max_views)
    if not choice.frames:
        raise InputError(
            f"{recording.path} has no usable frame: {choice.bad_poses} of {choice.candidates} have "
            f"no usable pose (a rotation with a translation), {choice.without_mask} no PNG of ids."
        )
    chosen = [recording.frames[i] for i in choice.frames]
    notes = [
        f"{count} of {choice.candidates} frames have {what}; skipped"
        for count, what in ((choice.bad_poses, "no usable pose"), (choice.without_mask, "no PNG"))
        if count
    ]
    table = IdTable(read_classes(folder), label_set_name, str(folder))
    notes += table.notes
    images, intrinsics = [], []
    for frame in chosen:
        try:
            values = _read(frame, first)
            K, picture = frame_intrinsics(frame, first)
            # That function counts pixel centres in whole numbers, as ScanNet does.
            shifted = np.eye(4)
            shifted[:3, :3] = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
            intrinsics.append(mask_intrinsics(shifted, picture, first, size))
        except InputError as error:
            raise InputError(f"{recording.path}: {str(error).removesuffix('.')}.") from None
        rows, columns = sampled_lines(first[0], size[0]), sampled_lines(first[1], size[1])
        images.append(table.ids(values[np.ix_(rows, columns)]))
    seen = observe(np.stack(images), table.classes)
    if table.unlisted:
        listed = ", ".join(map(str, sorted(table.unlisted)[:20]))
        notes.append(f"masks show ids that the table of classes does not have ({listed}): void")
    if not len(seen.tracked):
        return None
    world_to_camera, said = cameras_in_room(recording, [*choice.frames], settings)
    views = seen.room_views(room_name(folder), world_to_camera, np.stack(intrinsics))
    return PreparedRoom(views, notes=(*notes, *said))


def cameras_in_room(
    recording: Recording, frames: list[int], settings: PosedSettings
) -> tuple[np.ndarray, tuple[str, ...]]:
    """World-to-camera transforms in the room frame, (views, 4, 4), and what had to be assumed.

    The room frame: y up; the floor from the file, the settings, or `camera_height_m` below the
    lowest camera; the origin below the middle of the cameras, where the file gives no
    `floor_center_m`.

    Raises:
        InputError: the cameras are spread too far for metres, or the lowest is below the floor.
    """
    scale = recording.metres_per_unit or settings.metres_per_unit
    raw = np.stack([recording.frames[i].camera_to_world for i in frames])
    poses = raw.copy()
    poses[:, :3, 3] *= scale
    room_from_world = _Y_UP[settings.up].copy()
    eyes = poses[:, :3, 3] @ room_from_world[:3, :3].T
    low, high = eyes.min(axis=0), eyes.max(axis=0)
    if (high - low).max() > _LARGEST_SPREAD_M:
        raise InputError(
            f"{recording.path}: its cameras are spread over {(high - low).max():.0f} m; is "
            "metres_per_unit wrong?"
        )
    notes = []
    floor = recording.floor_m if recording.floor_m is not None else settings.floor_m
    if floor is None:
        floor = low[1] - settings.camera_height_m
        notes.append(f"the floor is assumed {settings.camera_height_m:g} m below the lowest camera")
    if low[1] <= floor:
        raise InputError(
            f"{recording.path}: its lowest camera is at {low[1]:.2f} m, below the floor at "
            f"{floor:.2f} m; check floor_m, metres_per_unit and --up."
        )
    middle = (low[0] + high[0]) / 2, (low[2] + high[2]) / 2
    if recording.floor_center_m is not None:
        first, second = recording.floor_center_m
        middle = (first, -second) if settings.up == "z" else (first, second)
    room_from_world[:3, 3] = -middle[0], -floor, -middle[1]
    return room_cameras(poses @ _GL_TO_CV, room_from_world), tuple(notes)


def seems_up(recording: Recording) -> str | None:
    """Which axis the tops of the pictures point along, `y` or `z`; None where neither is clear."""
    poses = np.stack([frame.camera_to_world for frame in recording.frames])
    tops = poses[is_pose(poses), :3, 1]
    if not len(tops):
        return None
    mean = tops.mean(axis=0)
    best = "y" if mean[1] > mean[2] else "z"
    return best if max(mean[1], mean[2]) > 0.7 else None


def _read(frame: PosedFrame, size: tuple[int, int]) -> np.ndarray:
    """Ids of one frame, int32; -1 where nothing is known."""
    values = read_mask(frame.instances)
    if values.shape != size:
        raise InputError(
            f"{frame.instances} is {values.shape[1]} x {values.shape[0]} pixels, but the first "
            f"frame's {size[1]} x {size[0]}; a room has one size"
        )
    ids = values.astype(np.int32)
    if frame.known is not None:
        known = read_mask(frame.known)
        if known.shape != size:
            raise InputError(
                f"{frame.known} is {known.shape[1]} x {known.shape[0]} pixels, but the ids "
                f"{size[1]} x {size[0]}"
            )
        ids[known == 0] = -1
    return ids
