"""Chooses the frames of a recording that become views, and computes their cameras."""

from collections.abc import Collection, Sequence

import numpy as np

from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError

_ROTATION_SLACK = 1e-2
"""Largest deviation of R^T R from the identity in a valid pose. The fused poses of ScanNet's
release, rounded to float32, deviate a thousand times less."""
_FARTHEST = 1e9
"""Upper bound on the absolute value of a pose's entries, in any unit; NaN also fails."""
_ASPECT_SLACK = 0.02
"""Largest relative difference between the aspect ratios of masks and colour frames; 1296 x 968
and 640 x 480 differ by 0.4% and show the same picture."""

Y_UP = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Maps (x, y, z) with z up to (y, z, x) with y up; stays right-handed."""
GL_TO_CV = np.diag([1.0, -1, -1, 1])
"""Maps OpenGL's camera axes (y up, z backward) to OpenCV's, and back."""


def choose_frames(
    where: str,
    camera_to_world: np.ndarray,
    with_mask: Collection[int],
    at_most: int,
    step: int = 1,
    mask: str = "image of ids",
    inside: str = "",
    names: Sequence[str] | None = None,
    hint: str = " Download it again.",
) -> tuple[list[int], tuple[str, ...]]:
    """Choose every `step`-th usable frame, at most `at_most` of them, as the views of a room.

    Frames with a bad pose or without a mask are dropped first, so that a recording that lost
    tracking keeps as many views as possible. The rest is thinned evenly; the first and the last
    frame stay. ScanNet's exports have a step of 15, and the paper has 100 views.

    Args:
        where: Beginning of the message if no frame is usable; `hint` is its end.
        mask: Name of a missing mask, and `inside` the place where masks should be.
        names: Names of the frames, if they have other names than their numbers.

    Returns:
        Indices of the frames, and sentences on the numbers of rejected ones.

    Example: 7 candidates, one lost, thinned to 3.

        >>> poses = np.repeat(np.eye(4)[None], 61, axis=0)
        >>> poses[10] = -np.inf
        >>> choose_frames("a.sens", poses, range(61), at_most=3, step=10)
        ([0, 40, 60], ('1 of 7 frames (every 10) have no usable pose; skipped',))
    """
    candidates = np.arange(0, len(camera_to_world), step)
    good = is_pose(camera_to_world[candidates])
    bad, posed = candidates[~good], candidates[good].tolist()
    masked = set(with_mask)
    frames = [frame for frame in posed if frame in masked]
    unmasked = len(posed) - len(frames)
    every = f" (every {step})" if step > 1 else ""
    if not frames:
        fault = ""
        if len(bad):
            frame = bad[0] if names is None else shown(names[bad[0]])
            fault = f"; frame {frame}: {pose_fault(camera_to_world[bad[0]])}"
        raise InputError(
            f"{where} has no usable frame: {len(bad)} of {len(candidates)}{every} have no usable "
            f"pose (a rotation with a translation), {unmasked} no {mask}{inside}{fault}.{hint}"
        )
    if len(frames) > at_most:
        # Rounding half up, not to even, keeps the steps as equal as possible.
        places = np.floor(np.linspace(0, len(frames) - 1, at_most) + 0.5).astype(int)
        frames = [frames[place] for place in places]
    rejected = ((len(bad), "usable pose"), (unmasked, mask))
    of = f"of {len(candidates)} frames{every}"
    return frames, tuple(f"{n} {of} have no {what}; skipped" for n, what in rejected if n)


def is_pose(camera_to_world: np.ndarray) -> np.ndarray:
    """Test which (4, 4) matrices are rigid transforms with finite, plausible entries: (frames,)."""
    with np.errstate(invalid="ignore"):  # some bit patterns of NaN
        poses = np.asarray(camera_to_world, dtype=np.float64)
    finite = np.asarray((np.abs(poses) < _FARTHEST).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], poses, 0.0)
    turn = safe[:, :3, :3]
    off = np.abs(turn.transpose(0, 2, 1) @ turn - np.eye(3)).max(axis=(1, 2))
    bottom = np.abs(safe[:, 3] - (0, 0, 0, 1)).max(axis=1)
    right_handed = np.linalg.det(turn) > 0
    return finite & (off < _ROTATION_SLACK) & (bottom < _ROTATION_SLACK) & right_handed


def pose_fault(camera_to_world: np.ndarray) -> str:
    """Describe the fault of a (4, 4) pose that `is_pose` rejects.

    >>> pose_fault(np.diag([1.0, 1, -1, 1])).split(",")[0]
    'it is left-handed'
    """
    pose = np.asarray(camera_to_world, dtype=np.float64)
    if not np.isfinite(pose).all():
        return "it holds NaN or infinity"
    if np.abs(pose).max() >= _FARTHEST:
        return f"it holds {np.abs(pose).max():.3g}"
    if not is_pose(pose[None])[0] and is_pose(pose.T[None])[0]:
        return "it is transposed: its translation is in the last row"
    if np.abs(pose[3] - (0, 0, 0, 1)).max() >= _ROTATION_SLACK:
        return "its last row is not 0, 0, 0, 1"
    determinant = float(np.linalg.det(pose[:3, :3]))
    scale = abs(determinant) ** (1 / 3)
    if scale and is_pose((pose * [*[1 / scale] * 3, 1])[None])[0]:
        return f"its axes have the length {scale:.3g}, expected 1"
    if determinant < 0:
        return (
            "it is left-handed, as of Unity or Unreal, or mirrored: negate one row of all matrices "
            "to make their world right-handed"
        )
    return "its axes are no rotation"


def room_cameras(camera_to_world: np.ndarray) -> np.ndarray:
    """World-to-camera transforms, float64, of good poses with OpenCV axes.

    The rotation is the nearest exact one, so that a camera's centre and its rays agree to rounding.
    """
    poses = camera_to_world.astype(np.float64)
    u, _, v = np.linalg.svd(poses[:, :3, :3])
    turn = (u @ v).transpose(0, 2, 1)
    inverse = np.tile(np.eye(4), (len(poses), 1, 1))
    inverse[:, :3, :3], inverse[:, :3, 3:] = turn, -turn @ poses[:, :3, 3:]
    return inverse


def shrunk(size: tuple[int, int], max_side: int | None) -> tuple[int, int]:
    """Shrink an image's (height, width) until no side is longer than `max_side`.

    >>> shrunk((768, 1024), 512)
    (384, 512)
    """
    scale = 1.0 if max_side is None else min(1, max_side / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def sampled_lines(source: int, target: int) -> np.ndarray:
    """Indices of the `source` rows (or columns) that downsampling to `target` keeps, (target,).

    Each is the row nearest to the centre of a downsampled pixel; of two equally near rows, the
    later.

        >>> sampled_lines(12, 3).tolist()
        [2, 6, 10]
    """
    return np.floor((np.arange(target) + 0.5) * source / target).astype(np.int64)


def mask_intrinsics(
    intrinsics: np.ndarray,
    color_size: tuple[int, int],
    mask_size: tuple[int, int],
    image_size: tuple[int, int],
) -> np.ndarray:
    """Intrinsics of a mask that was downsampled to `image_size` with `sampled_lines`.

    Colour frames, masks and stored images may all differ in size; only this function converts
    between them. Two steps, each exact:

    - Masks and colour frames show the same picture: u scales with the width, v with the height.
    - A downsampled pixel copies one mask pixel, whose centre may be off its own: keeping every
      fourth row from the third on shifts the image by 0.5 full-size pixels. The principal point
      moves by the mean offset, so that points project onto the pixels that show them.

    `intrinsics`, (3, 3), are in pixels of the colour frame; sizes are (height, width). Masks and
    colour frames must have the same aspect ratio.

    Example: half size; the second pixel of each pair stays, 0.25 small pixels right of the centre.

        >>> K = np.diag([8.0, 8, 1])
        >>> K[:2, 2] = 4
        >>> mask_intrinsics(K, (8, 8), (8, 8), (4, 4))[0].tolist()
        [4.0, 0.0, 1.75]
    """
    shapes = mask_size[1] / mask_size[0], color_size[1] / color_size[0]
    if abs(shapes[0] / shapes[1] - 1) > _ASPECT_SLACK:
        raise InputError(
            f"The masks are {mask_size[1]} x {mask_size[0]} pixels but the colour frames "
            f"{color_size[1]} x {color_size[0]}: with different aspect ratios they do not show the "
            f"same picture.{turned_hint(mask_size, color_size)} Use the masks that belong to this "
            "recording."
        )
    intrinsics = np.array(intrinsics, dtype=np.float64)
    # Axis 0 is u (width), axis 1 is v (height).
    for axis, line in enumerate((1, 0)):
        intrinsics[axis] *= mask_size[line] / color_size[line]
        step = mask_size[line] / image_size[line]
        lines = sampled_lines(mask_size[line], image_size[line])
        late = np.mean(lines + 0.5 - (np.arange(image_size[line]) + 0.5) * step)
        intrinsics[axis, 2] -= late
        intrinsics[axis] /= step
    return intrinsics


def turned_hint(size: tuple[int, ...], other: tuple[int, ...]) -> str:
    """Sentence on the likely cause of images, (height, width), that differ by a quarter turn."""
    if abs(size[0] / size[1] / (other[1] / other[0]) - 1) > _ASPECT_SLACK:
        return ""
    return (
        " They seem turned by 90 degrees: some programs turn pictures as their EXIF orientation "
        "says, others do not. Turn the masks as the pictures of the poses are."
    )


def sampled(
    size: tuple[int, int], max_side: int | None, intrinsics: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Index that shrinks an image of this (height, width), and the intrinsics of the result."""
    stored = shrunk(size, max_side)
    lines = np.ix_(*(sampled_lines(*sides) for sides in zip(size, stored, strict=True)))
    return lines, mask_intrinsics(intrinsics, size, size, stored)
