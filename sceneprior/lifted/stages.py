"""The stage that trains the paper's network and latents on lifted boxes and shapes, and its losses.

These losses are not in the paper, which compares 2D boxes in every view at every step. `lifting`
estimates each object's 3D box from its masks before training, so the layout loss (Eq. 7) compares
boxes in 3D, and no frustum loss is needed.
"""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.lifting.dataset import LiftedDataset, LiftedRooms
from sceneprior.lifted.prototype_decoder import PosedScenes, PrototypeDecoder
from sceneprior.paper.losses import class_loss, completeness_targets, mean_of_objects, take
from sceneprior.paper.matching import Matches, assign, class_cost
from sceneprior.paper.stages import LatentStage
from sceneprior.training.steps import batch_seed, check_finite, full_precision

if TYPE_CHECKING:
    from sceneprior.lifted.config import LiftedLossConfig

PER_METRE = 1 / 6
"""Weight of a metre: the share of the image's width that 1 m spans at a distance of 3 m and a field
of view of 90 degrees. So lambda_box and lambda_B have about the same effect as for 2D boxes."""
DIRECTIONS = 32
"""Number of projection directions per step. Each step draws new ones, so a stage uses thousands."""


class LiftedStage(LatentStage):
    """Trains with the layout loss against lifted 3D boxes, and the distance to lifted shapes."""

    loss: "LiftedLossConfig"
    rooms: LiftedDataset
    """The training rooms, which `LiftedConfig` sets."""

    @property
    def looks(self) -> PrototypeDecoder:
        """The shape decoder."""
        assert isinstance(self.prior.shape, PrototypeDecoder)
        return self.prior.shape

    def on_fit_start(self) -> None:
        # Done only now, since a resumed run has just loaded its checkpoint's prototypes.
        self.rooms.assign_prototypes(self.looks.prototypes)

    def training_step(self, rooms: LiftedRooms, batch_idx: int) -> Tensor:
        slots = min(rooms.is_object.shape[1] + 1, self.prior.max_objects)
        wanted = needed_predictions(rooms, slots)
        scenes = self.prior.decode(self.room_latents(rooms.room_index, batch_idx), False, wanted)
        with full_precision(self.device):
            matches = match_lifted(scenes, rooms, self.loss.match_box)
            losses = lifted_losses(scenes, rooms, matches, self.completeness_target)
            known = matches._replace(valid=matches.valid & (rooms.looks >= 0))
            targets = self.looks.targets(rooms.looks.clamp(min=0))
            losses["shape"] = shape_code_loss(scenes, known, *targets)
            if self.loss.latents:
                seed = batch_seed(self.seed, self.trainer, batch_idx) + 1  # not the noise's seed
                generator = torch.Generator().manual_seed(seed)
                space = self.prior.latent_space
                losses["latents"] = latent_loss(self.latents.weight, space.shift_free, generator)
            total = self.total(losses, len(rooms.room_index))
            check_finite(total, rooms.room_ids)
            return total


@torch.no_grad()
def match_lifted(scenes: DecodedScenes, rooms: LiftedRooms, box_weight: float = 5.0) -> Matches:
    """The cheapest one-to-one assignment of the first n predictions to a room's n objects.

        sigma = argmin sum_k -p_k(l_j) + lambda_B |b_k - b_j|_1

    as Eq. S2, but b is a 3D box (centre and extents), with weight `PER_METRE` per metre. An object
    without a lifted box has zero cost with every prediction.
    """
    distance = torch.cdist(predicted_boxes(scenes), rooms.boxes_m, p=1)
    cost = class_cost(scenes, rooms.object_class) + box_weight * PER_METRE * distance
    cost = cost * rooms.is_lifted.unsqueeze(1)
    counts = rooms.is_object.sum(dim=-1).tolist()
    return Matches(assign(cost, counts, counts), rooms.is_lifted)


def needed_predictions(rooms: LiftedRooms, slots: int) -> Bool[Tensor, "rooms slots"]:
    """Mask of the first n + 1 predictions in a room of n objects: the last of them marks the end,
    and no scene is decoded further. A room without objects is padding of the batch and needs
    none."""
    counts = rooms.is_object.sum(dim=-1, keepdim=True)
    return (torch.arange(slots, device=counts.device) <= counts) & (counts > 0)


def lifted_losses(
    scenes: DecodedScenes, rooms: LiftedRooms, matches: Matches, completeness_target: str
) -> dict[str, Float[Tensor, ""]]:
    """The losses `class`, `box` and `completeness`, unweighted, as in `layout_losses`.

    Completeness covers only the predictions that are needed (`needed_predictions`).

        L_box = mean over objects of `PER_METRE` * (|c_k - c_j|_1 + |s_k - s_j|_1)
    """
    logits = scenes.completeness_logits
    goes_on = completeness_targets(
        rooms.is_object.sum(dim=-1), logits.shape[1], completeness_target
    )
    every = F.binary_cross_entropy_with_logits(logits, goes_on.to(logits.dtype), reduction="none")
    predicted = take(predicted_boxes(scenes), matches.prediction, dim=1)
    apart = (predicted - rooms.boxes_m).abs().sum(dim=-1)
    return {
        "class": class_loss(scenes, rooms.object_class, matches),
        "box": mean_of_objects(PER_METRE * apart, matches.valid),
        "completeness": mean_of_objects(every, needed_predictions(rooms, logits.shape[1])),
    }


def predicted_boxes(scenes: DecodedScenes) -> Float[Tensor, "rooms objects 6"]:
    """Centre and full extents of every prediction."""
    return torch.cat([scenes.centers_m, scenes.sizes_m], dim=-1)


def shape_code_loss(
    scenes: DecodedScenes,
    matches: Matches,
    codes: Float[Tensor, "rooms objects codes"],
    cells: Float[Tensor, "rooms objects"],
) -> Float[Tensor, ""]:
    """Squared distance between decoded and lifted shape codes, relative to the size of the lifted
    shape.

        L_S = mean over objects of |a_k - a_j|_2^2 / cells_j

    a_k is the code that the network predicts for an object, and a_j that of its lifted shape. The
    squared distance of two codes is about the number of grid cells in which their shapes differ,
    and cells_j is the number of cells that the lifted shape fills. Without the division, a lamp on
    a cord, which fills a hundredth of its box, would hardly be learnt. `codes` holds a_j and
    `cells` cells_j, from the objects' looks (`PrototypeDecoder.targets`).
    """
    assert isinstance(scenes, PosedScenes) and scenes.shape_codes is not None
    apart = take(scenes.shape_codes, matches.prediction, dim=1) - codes
    return mean_of_objects(apart.square().sum(dim=-1) / cells, matches.valid)


def latent_loss(
    logits: Float[Tensor, "rooms logits"], shift_free: bool, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Sliced Wasserstein penalty that matches the training latents to the sampling distribution.

    The paper samples new rooms from the whole sphere, while the latents of training rooms may end
    up where hardly any sample falls. This is the sliced Wasserstein distance (Bonneel et al. 2015),
    applied to latents as in Kolouri et al. 2018 (sliced Wasserstein autoencoders), between the
    logits of all training rooms and as many from N(0, 1).

    If `shift_free`, adding a constant to a room's logits changes nothing, as on the sphere, and the
    distance ignores such a constant, too. `generator` is on the CPU.
    """
    normal = torch.randn(logits.shape, generator=generator).to(logits)
    directions = torch.randn(logits.shape[1], DIRECTIONS, generator=generator).to(logits)
    if shift_free:
        logits = logits - logits.mean(dim=1, keepdim=True)
        normal = normal - normal.mean(dim=1, keepdim=True)
    return sliced_wasserstein(logits, normal, F.normalize(directions, dim=0))


def sliced_wasserstein(
    some: Float[Tensor, "points dimension"],
    others: Float[Tensor, "points dimension"],
    directions: Float[Tensor, "dimension directions"],
) -> Float[Tensor, ""]:
    """The mean over directions of the squared 2-Wasserstein distance of the projected points.

    In one dimension, the optimal transport between two sets of n points keeps their order.
    """
    moved = (some @ directions).sort(dim=0).values - (others @ directions).sort(dim=0).values
    return moved.square().mean()
