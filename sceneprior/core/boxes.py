"""Boxes in rooms: corners, rotations about +y (+z towards +x, docs/conventions.md), and overlaps.

Preparing data uses this without torch.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from sceneprior.core.cameras import Array
from sceneprior.core.errors import InputError
from sceneprior.core.repeatable import Tensor
from sceneprior.core.scene import Scene

CUBE_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
"""(8, 3) corners of the cube [-1, 1]^3; x changes slowest, z fastest."""
BOX_EDGES = tuple((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit)
"""The 12 edges as pairs of indices into `CUBE_CORNERS`."""
BOX_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip
"""12 outward-facing triangles as indices into `CUBE_CORNERS`."""


def box_corners(centers_m: Array, sizes_m: Array) -> Array:
    """Corners of boxes, (..., 8, 3), in the order of `CUBE_CORNERS`.

    Centres and full extents are (..., 3).
    """
    half = sizes_m[..., None, :] / 2
    signs = CUBE_CORNERS if isinstance(half, np.ndarray) else half.new_tensor(CUBE_CORNERS)
    return centers_m[..., None, :] + signs * half


QUARTERS = 4
"""Number of orientations of a room by quarter turns: 0, 90, 180 and 270 degrees."""
_COLUMNS = ((0, 1, 2), (2, 1, 0), (0, 1, 2), (2, 1, 0))
_SIGNS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, 1.0, 1.0))


def yaw_rotation(yaw_rad: float | Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices about +y for column vectors; float64."""
    cosine, sine, zero = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)
    rows = [[cosine, zero, sine], [zero, zero + 1, zero], [-sine, zero, cosine]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quarter_rotation(quarters: int) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix by a number of quarter turns (`yaw_rotation`), with exact entries 0 and +-1.

    Example: a quarter turn maps +z to +x.

        >>> (quarter_rotation(1) @ [0, 0, 1]).tolist()
        [1.0, 0.0, 0.0]
    """
    sine, cosine = ((0, 1), (1, 0), (0, -1), (-1, 0))[quarters % QUARTERS]
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], dtype=np.float64)


def turn_vectors(
    vectors: Float[Tensor, "rooms *batch 3"], quarters: Int[Tensor, " rooms"]
) -> Float[Tensor, "rooms *batch 3"]:
    """Rotate the vectors of each room by its own number of quarter turns, 0 to 3.

    Rows of `world_to_camera[..., :3]` may be rotated, too: a camera that rotates with its room sees
    the same image. Components are permuted, because matrix products on a GPU may round.
    """
    import torch

    many = (len(quarters), *[1] * (vectors.ndim - 2), 3)
    columns = torch.tensor(_COLUMNS, device=vectors.device)[quarters].reshape(many)
    signs = torch.tensor(_SIGNS, device=vectors.device)[quarters].reshape(many)
    return vectors.gather(-1, columns.expand_as(vectors)) * signs


def turn_boxes(
    boxes_m: Float[Tensor, "rooms objects 6"],
    quarters: Int[Tensor, " rooms"],
    mirrored: Bool[Tensor, " rooms"] | None = None,
) -> Float[Tensor, "rooms objects 6"]:
    """Mirror (optionally, x reversed) and then rotate the boxes of rooms by quarter turns.

    Boxes are centres and full extents; the rotation is about +y.
    """
    import torch

    centers_m, sizes_m = boxes_m.split(3, dim=-1)
    if mirrored is not None:
        sign = 1 - 2 * mirrored.to(boxes_m)
        x, others = centers_m.split([1, 2], dim=-1)
        centers_m = torch.cat([x * sign[:, None, None], others], dim=-1)
    return torch.cat([turn_vectors(centers_m, quarters), turn_vectors(sizes_m, quarters).abs()], -1)


def turn_grids(
    grids: Shaped[np.ndarray, "objects x y z"], quarters: int, mirrored: bool = False
) -> Shaped[np.ndarray, "objects x y z"]:
    """Mirror (optionally, x reversed) and then rotate grids of objects by quarter turns about +y.

    x and z must have equally many cells.

    Example: the content of the last cell along z moves to the last cell along x.

        >>> grids = np.zeros((1, 2, 1, 2), dtype=bool)
        >>> grids[0, 0, 0, 1] = True
        >>> np.argwhere(turn_grids(grids, 1)[0]).tolist()
        [[1, 0, 1]]
    """
    return np.rot90(grids[:, ::-1] if mirrored else grids, quarters, axes=(3, 1))


CENTER_WEIGHT = 0.01
"""Matching cost per metre between centres. It decides between boxes that do not overlap, and is
negligible against differences in IoU."""


def box_iou_3d(
    centers_a: Float[np.ndarray, "n 3"],
    sizes_a: Float[np.ndarray, "n 3"],
    centers_b: Float[np.ndarray, "m 3"],
    sizes_b: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "n m"]:
    """Intersection over union of every axis-aligned box a with every box b, in metres.

    Two boxes without volume have IoU 0.

    Example: two unit cubes that share one half.

        >>> unit = np.ones((1, 3))
        >>> iou = box_iou_3d(np.zeros((1, 3)), unit, np.array([[0.5, 0.0, 0.0]]), unit)
        >>> round(float(iou[0, 0]), 6)
        0.333333
    """
    low = np.maximum((centers_a - sizes_a / 2)[:, None], (centers_b - sizes_b / 2)[None])
    high = np.minimum((centers_a + sizes_a / 2)[:, None], (centers_b + sizes_b / 2)[None])
    shared = np.asarray(np.clip(high - low, 0, None).prod(2))
    union = sizes_a.prod(1)[:, None] + sizes_b.prod(1)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


@dataclass(frozen=True)
class SceneMatch:
    """Matches between decoded and true objects, determined by their boxes alone."""

    decoded: Int[np.ndarray, " pairs"]
    """Indices of objects in the decoded scene."""
    truth: Int[np.ndarray, " pairs"]
    """Indices of objects in the true scene."""
    iou: Float[np.ndarray, " pairs"]
    correct: Bool[np.ndarray, " pairs"]
    """True if the classes agree."""
    decoded_count: int
    truth_count: int
    """Number of true objects; like `decoded_count`, it includes unmatched objects."""


def match_scenes(decoded: Scene, truth: Scene) -> SceneMatch:
    """Match the objects of two scenes one to one, with the least total cost.

        cost = 1 - IoU + 0.01 * (distance of the centres in metres)

    Classes are ignored, so that class accuracy is not measured on pairs chosen by class.
    """
    from scipy.optimize import linear_sum_assignment

    if decoded.label_set != truth.label_set:
        raise InputError(
            f"Objects are paired between scenes of one label set, but {decoded.name} has "
            f"'{decoded.label_set}' and {truth.name} '{truth.label_set}'; bring both into one."
        )
    iou = box_iou_3d(decoded.centers_m, decoded.sizes_m, truth.centers_m, truth.sizes_m)
    apart = np.linalg.norm(decoded.centers_m[:, None] - truth.centers_m[None], axis=2)
    rows, columns = linear_sum_assignment(1 - iou + CENTER_WEIGHT * apart)
    return SceneMatch(
        decoded=rows,
        truth=columns,
        iou=iou[rows, columns],
        correct=decoded.class_indices[rows] == truth.class_indices[columns],
        decoded_count=len(decoded.objects),
        truth_count=len(truth.objects),
    )
