"""Labels the views of one posed room and returns the arrays stored in shards."""

import math
from dataclasses import dataclass, replace

import numpy as np

from data_prep.engine.source import PreparedRoom
from data_prep.readers.frames import choose_frames, first_fault, room_cameras, shrunk
from data_prep.readers.heading import find_turn, note_of_turn, turn_matrix
from data_prep.readers.posed.cameras import UP, cameras_in_room, upright_cameras
from data_prep.readers.posed.corrected import correct
from data_prep.readers.posed.floor import find_floor
from data_prep.readers.posed.mask_format import MaskFormat
from data_prep.readers.posed.masks import RoomMasks
from data_prep.readers.posed.recording import PosedFrame, Recording, room_name
from data_prep.readers.posed.untracked import UntrackedMasks, track
from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError
from sceneprior.core.observations import Observations, observe
from sceneprior.core.shards import thinned_stuff

TRACKS = ("given", "auto")
_MANY_IDS, _MANY_FRAMES, _ONCE = 12, 5, 0.8
"""A room with at least these numbers of ids and frames is refused if more than this share of the
ids occurs in a single frame only."""


@dataclass(frozen=True)
class PosedSettings:
    """Settings that turn posed pictures into views."""

    up: str = "auto"
    """Up direction of the poses' world: the axis `z` or `y`, or `cameras`, which estimates it from
    cameras held upright. `auto` is z, as in nerfstudio's files, or `cameras` for COLMAP's."""
    floor_m: float | None = None
    """Height of the floor in rooms whose file has none; None estimates it (`find_floor`)."""
    camera_height_m: float = 1.2
    """Height of the lowest camera above the floor, assumed if the floor cannot be estimated."""
    metres_per_unit: float = 1.0
    """Scale in rooms whose file has none. Poses from pictures alone (COLMAP) have no unit."""
    max_side: int | None = None
    """Maximum side in pixels; larger masks are downsampled."""
    tracks: str = "given"
    """One of `TRACKS`: ids are `given` for all frames, or `auto` finds objects from masks whose ids
    have no meaning across frames."""
    max_views: int = 100
    """Maximum number of views; more frames are thinned evenly (paper: 100)."""

    def __post_init__(self) -> None:
        if self.up not in UP:
            raise InputError(f"up is '{self.up}'; choose from {', '.join(UP)}.")
        if self.tracks not in TRACKS:
            raise InputError(f"tracks is '{self.tracks}'; choose from {', '.join(TRACKS)}.")
        for name in ("max_side", "max_views"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}; expected at least 1.")
        for name in ("camera_height_m", "metres_per_unit"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InputError(f"{name} is {getattr(self, name)}; it must be above 0.")
        if self.floor_m is not None and not math.isfinite(self.floor_m):
            raise InputError(f"floor_m is {self.floor_m}; expected a height in metres.")


def usable_frames(recording: Recording, masks: MaskFormat) -> list[PosedFrame]:
    """Frames with masks, in the file's order; their poses may be invalid."""
    frames = [frame for frame in recording.frames if masks.has(frame)]
    if not frames:
        raise InputError(
            f"{recording.path}: none of its {len(recording.frames)} frames has a mask; expected "
            f"{masks.wanted(recording.frames[0])}."
        )
    return frames


def stored_size(
    recording: Recording, masks: MaskFormat, settings: PosedSettings
) -> tuple[int, int]:
    """Size, (height, width), at which a room is stored: its masks', limited by `max_side`."""
    return shrunk(masks.size(usable_frames(recording, masks)[0]), settings.max_side)


def prepare_posed(
    recording: Recording, masks: MaskFormat, settings: PosedSettings
) -> PreparedRoom | None:
    """Label the views of one room; None if no view shows an object of the label set."""
    usable = usable_frames(recording, masks)
    size = masks.size(usable[0])
    poses = np.stack([frame.camera_to_world for frame in recording.frames])
    with_mask = [i for i, frame in enumerate(recording.frames) if masks.has(frame)]
    choice = choose_frames(poses, with_mask, 1, settings.max_views)
    if not choice.frames:
        bad = first_fault(poses)
        fault = f"; frame {shown(recording.frames[bad[0]].name)}: {bad[1]}" if bad else ""
        raise InputError(
            f"{recording.path} has no usable frame: {choice.bad_poses} of {choice.candidates} have "
            f"no usable pose (a rotation with a translation), {choice.without_mask} no mask"
            f"{fault}."
        )
    notes = choice.notes("mask")
    stored = stored_size(recording, masks, settings)
    frames = [recording.frames[i] for i in choice.frames]
    unit = settings.metres_per_unit
    upright, turn = upright_cameras(recording, [*choice.frames], settings.up, unit)
    cameras = room_cameras(upright, np.eye(4))
    try:
        if settings.tracks == "auto" or not masks.tracked:
            untracked = UntrackedMasks(masks, size, stored)
            given, ids, stuff, intrinsics = untracked.read(frames)
            images, classes, said = track(given, ids, cameras, intrinsics)
            notes += [*untracked.notes, said]
        else:
            tracked = RoomMasks(masks, size, stored)
            images, stuff, intrinsics = (
                np.stack(arrays)
                for arrays in zip(*(tracked.read(frame) for frame in frames), strict=True)
            )
            notes += tracked.notes
            classes = tracked.table.classes
            _check_tracked(images, len(classes))
    except InputError as error:
        raise InputError(f"{recording.path}: {str(error).removesuffix('.')}.") from None
    seen = observe(images, classes)
    if not len(seen.tracked):
        return None
    found = correct(seen, cameras, intrinsics)
    seen = found.seen
    notes += found.notes
    if found.world_to_camera is not None:
        cameras, upright = found.world_to_camera, np.linalg.inv(found.world_to_camera)
    views = seen.room_views(room_name(recording.folder), cameras, intrinsics, thinned_stuff(stuff))
    degrees = find_turn(views)
    notes += note_of_turn(degrees)
    if degrees:
        upright, turn = turn_matrix(degrees) @ upright, turn_matrix(degrees) @ turn
    floor = recording.floor_m if recording.floor_m is not None else settings.floor_m
    if floor is None:
        floor, said = _unsaid_floor(seen, upright, intrinsics, settings)
        notes.append(said)
    world_to_camera = cameras_in_room(recording, upright, turn, floor)
    room_from_world = np.linalg.inv(upright[0] @ world_to_camera[0]) @ turn
    views = replace(views, world_to_camera=world_to_camera.astype(np.float32))
    if degrees:
        views = replace(views, turned_deg=degrees, room_from_world=room_from_world)
    origin = {
        "file": recording.path.relative_to(recording.folder).as_posix(),
        "room_from_world": room_from_world.round(9).tolist(),
    }
    return PreparedRoom(views, notes=tuple(notes), cameras=origin)


def _check_tracked(images: np.ndarray, void: int) -> None:
    """Raise an `InputError` if most ids occur in one frame only, as if each frame had its own
    ids."""
    frames_of = np.zeros(void + 1, dtype=np.int64)
    for image in images:
        frames_of[np.unique(image)] += 1
    frames_of = frames_of[1:void]  # without the background and without masks of no class
    count, once = int((frames_of > 0).sum()), int((frames_of == 1).sum())
    if len(images) >= _MANY_FRAMES and count >= _MANY_IDS and once > _ONCE * count:
        raise InputError(
            f"{once} of its {count} ids are in one of {len(images)} frames only, expected the same "
            "id for an object in all frames; --tracks auto finds the objects of such masks."
        )


def _unsaid_floor(
    seen: Observations, upright: np.ndarray, intrinsics: np.ndarray, settings: PosedSettings
) -> tuple[float, str]:
    """Estimate or assume the height of an unknown floor; also return a note on its origin."""
    lowest = float(upright[:, 1, 3].min())
    found = find_floor(seen, room_cameras(upright, np.eye(4)), intrinsics)
    if found is not None and found[0] < lowest:
        level, pieces = found
        under = f"{lowest - level:.2f} m below the lowest camera"
        return level, f"the floor is found where {pieces} pieces end, {under}"
    height = settings.camera_height_m
    why = "too few pieces show where they end"
    return lowest - height, f"the floor is assumed {height:g} m below the lowest camera ({why})"
