"""The objects of a prior's rooms: what the masks of an image may be of."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.classes import VOID
from sceneprior.geometry.meshes import beveled_cube, icosphere
from sceneprior.losses.completeness import kept_objects
from sceneprior.models.occupancy import OccupancyDecoder
from sceneprior.models.prior import ScenePrior
from sceneprior.training.method import TrainedPrior
from sceneprior.views import DecodedScenes

ROOMS = 64
"""Decoded at once."""
POINTS_LEVEL = 1
"""Shapes are compared by their furthest points in the 42 directions of such a sphere."""

UNIT_BOX = np.array([0.0, 0, 0, 1, 1, 1])


class Candidates(NamedTuple):
    """Objects as the prior decodes them, one a row."""

    room: Int[Tensor, " objects"]
    """The training room; which of its predictions:"""
    slot: Int[Tensor, " objects"]
    object_class: Int[Tensor, " objects"]
    bottom_m: Float[Tensor, " objects"]
    sizes_m: Float[Tensor, "objects 3"]
    points: Float[Tensor, "objects points 3"]
    """Of the surface; the box is [-0.5, 0.5]^3."""

    def take(self, rows: Int[Tensor, " rows"]) -> "Candidates":
        """Some of them."""
        return Candidates(*(part[rows] for part in self))


@torch.no_grad()
def candidates_of(trained: TrainedPrior) -> Candidates:
    """All objects of the training rooms as decoded; beveled boxes stand for their shapes."""
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
    return Candidates(*(torch.cat(part) for part in zip(*parts, strict=True)))


@torch.no_grad()
def with_shapes(trained: TrainedPrior, candidates: Candidates) -> Candidates:
    """The same with points of their decoded shapes; before the shape stage, as they are."""
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
    """Training rooms with the shapes of some of their objects, after the shape stage."""
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
        assert decoded.looks is not None and isinstance(prior.shape, OccupancyDecoder)
        meshes = [prior.shape.mesh(look, UNIT_BOX) for look in decoded.looks[row, slot].tolist()]
        surfaces = [torch.from_numpy(mesh.vertices_m).to(directions) for mesh in meshes]
    return torch.stack([each[(each @ directions.T).argmax(dim=0)] for each in surfaces])
