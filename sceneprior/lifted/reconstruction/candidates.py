"""Candidates for the objects behind an image's masks: the objects of a prior's training rooms."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.geometry.meshes import beveled_cube, icosphere
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.looks import LookDecoder
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import ScenePrior, TrainedPrior

ROOMS = 64
"""Rooms decoded at a time."""
POINTS_LEVEL = 1
"""Icosphere level of the 42 directions in which a shape's extreme points are compared."""

UNIT_BOX = np.array([0.0, 0, 0, 1, 1, 1])
"""Centre and extents of a cube at the origin, with sides of 1 m."""


class Candidates(NamedTuple):
    """Objects as the prior decodes them, one per row."""

    room: Int[Tensor, " objects"]
    """Index of the training room."""
    slot: Int[Tensor, " objects"]
    """Index of the object among the room's predictions."""
    object_class: Int[Tensor, " objects"]
    bottom_m: Float[Tensor, " objects"]
    sizes_m: Float[Tensor, "objects 3"]
    points: Float[Tensor, "objects points 3"]
    """Points on the surface, in the frame in which the object's box is [-0.5, 0.5]^3."""

    def take(self, rows: Int[Tensor, " rows"]) -> "Candidates":
        """The candidates of these rows."""
        return Candidates(*(part[rows] for part in self))


@torch.no_grad()
def candidates_of(trained: TrainedPrior) -> Candidates:
    """All objects of the decoded training rooms, with beveled boxes as their shapes.

    Raises:
        InputError: all training rooms decode into empty rooms.
    """
    parts = []
    for rows in torch.arange(len(trained.logits)).split(ROOMS):
        decoded = trained.prior(trained.logits[rows], with_shape=False)
        object_class = decoded.class_logits.argmax(dim=-1)
        kept = kept_objects(decoded.completeness_logits, trained.config.model.completeness_target)
        room, slot = (kept & (object_class != VOID)).nonzero(as_tuple=True)
        sizes_m, centers_m = decoded.sizes_m[room, slot], decoded.centers_m[room, slot]
        assert decoded.bevels is not None, "decode() gives every object bevels"
        parts.append(
            Candidates(
                rows[room],
                slot,
                object_class[room, slot],
                centers_m[:, 1] - sizes_m[:, 1] / 2,
                sizes_m,
                beveled_cube(decoded.bevels[room, slot]) / 2,
            )
        )
    found = Candidates(*(torch.cat(part) for part in zip(*parts, strict=True)))
    if not len(found.room):
        raise InputError(
            f"The run decodes all its {len(trained.logits)} training rooms as empty rooms, so "
            "there are no objects to place where the masks are; train it longer, or fit a latent "
            "instead (--fit paper)."
        )
    return found


@torch.no_grad()
def with_shapes(trained: TrainedPrior, candidates: Candidates) -> Candidates:
    """The candidates with points of their decoded shapes; unchanged before the shape stage."""
    if trained.stage == "layout" or not len(candidates.room):
        return candidates
    directions = icosphere(POINTS_LEVEL)[0].to(candidates.points)
    points = candidates.points.new_empty(len(candidates.room), len(directions), 3)
    for rooms in candidates.room.unique().split(ROOMS):
        mine = torch.isin(candidates.room, rooms).nonzero()[:, 0]
        row, slot = torch.searchsorted(rooms, candidates.room[mine]), candidates.slot[mine]
        decoded = decode_some(trained, rooms, row, slot)
        points[mine] = _furthest(decoded, row, slot, directions, trained.prior)
    return candidates._replace(points=points)


def decode_some(
    trained: TrainedPrior,
    rooms: Int[Tensor, " rooms"],
    row: Int[Tensor, " objects"],
    slot: Int[Tensor, " objects"],
) -> DecodedScenes:
    """Training rooms decoded with the shapes of some of their objects, once the shape stage has
    begun."""
    wanted = torch.zeros(len(rooms), int(slot.max()) + 1, dtype=torch.bool)
    wanted[row, slot] = True
    z = trained.prior.latent_space(trained.logits[rooms])
    return trained.prior.decode(z, trained.stage != "layout", wanted)


def _furthest(
    decoded: DecodedScenes,
    row: Int[Tensor, " objects"],
    slot: Int[Tensor, " objects"],
    directions: Float[Tensor, "directions 3"],
    prior: ScenePrior,
) -> Float[Tensor, "objects directions 3"]:
    if decoded.vertices_m is not None:
        sizes_m = decoded.sizes_m[row, slot].clamp(min=1e-6)
        away = decoded.vertices_m[row, slot] - decoded.centers_m[row, slot].unsqueeze(1)
        surfaces = list(away / sizes_m.unsqueeze(1))
    else:
        assert decoded.looks is not None and isinstance(prior.shape, LookDecoder)
        meshes = [prior.shape.mesh(look, UNIT_BOX) for look in decoded.looks[row, slot].tolist()]
        surfaces = [torch.from_numpy(mesh.vertices_m).to(directions) for mesh in meshes]
    return torch.stack([each[(each @ directions.T).argmax(dim=0)] for each in surfaces])
