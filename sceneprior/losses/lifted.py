"""The layout loss against lifted 3D boxes: what Eq. 7 asks of views, asked once of a room.

Not in the paper, which compares 2D boxes in every view at every step. `lifting` has found the 3D
box that a piece's masks imply, so the distance is taken there, and no frustum term is needed.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.losses.averages import mean_of_objects
from sceneprior.losses.completeness import completeness_targets
from sceneprior.losses.layout import class_loss, take
from sceneprior.losses.matching import Matches, assign, class_cost
from sceneprior.views import DecodedScenes, LiftedRooms

PER_METRE = 1 / 6
"""What a metre weighs: the share of an image's width that it spans 3 m before a camera that sees 90
degrees. So lambda_box and lambda_B mean about the same for lifted boxes as for 2D boxes."""


@torch.no_grad()
def match_lifted(scenes: DecodedScenes, rooms: LiftedRooms, box_weight: float = 5.0) -> Matches:
    """The cheapest one-to-one assignment of the first n predictions to a room's n objects.

        sigma = argmin sum_k -p_k(l_j) + lambda_B |b_k - b_j|_1

    with b a 3D box: centre and extents, a metre weighing `PER_METRE`. An object without a box
    costs nothing.
    """
    distance = torch.cdist(predicted_boxes(scenes), rooms.boxes_m, p=1)
    cost = class_cost(scenes, rooms.object_class) + box_weight * PER_METRE * distance
    cost = cost * rooms.is_lifted.unsqueeze(1)
    counts = rooms.is_object.sum(dim=-1).tolist()
    return Matches(assign(cost, counts, counts), rooms.is_lifted)


def needed_predictions(rooms: LiftedRooms, slots: int) -> Bool[Tensor, "rooms slots"]:
    """The first n + 1 of a room of n objects: the last of them says that there are no more, and no
    scene is decoded further. None of a room without objects, which stands for no room."""
    counts = rooms.is_object.sum(dim=-1, keepdim=True)
    return (torch.arange(slots, device=counts.device) <= counts) & (counts > 0)


def lifted_losses(
    scenes: DecodedScenes, rooms: LiftedRooms, matches: Matches, completeness_target: str
) -> dict[str, Float[Tensor, ""]]:
    """`class`, `box` and `completeness`, unweighted, as `layout_losses` has them of views, but for
    the completeness of predictions that are not needed (`needed_predictions`).

    L_box = mean over objects of |c_k - c_j|_1 + |s_k - s_j|_1, in metres
    """
    logits = scenes.completeness_logits
    goes_on = completeness_targets(
        rooms.is_object.sum(dim=-1), logits.shape[1], completeness_target
    )
    every = F.binary_cross_entropy_with_logits(logits, goes_on.to(logits.dtype), reduction="none")
    predicted = take(predicted_boxes(scenes), matches.prediction, dim=1)
    apart = (predicted - rooms.boxes_m).abs().sum(dim=-1)
    return {
        "class": class_loss(scenes, rooms, matches),
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
    """The squared distance of decoded and lifted shapes over the cells that the latter fill.

        L_S = mean over objects of |a_k - a_j|_2^2 / cells_j

    with a codes whose squared distances are numbers of cells. A lamp on a cord fills a hundredth
    of its box: without the division, it would not be worth learning.

    Args:
        scenes: With `shape_codes`.
        matches: As `match_lifted` gives them.
        codes, cells: Of the looks that the objects have (`OccupancyDecoder.targets`).
    """
    assert scenes.shape_codes is not None, "the prior decodes looks"
    apart = take(scenes.shape_codes, matches.prediction, dim=1) - codes
    return mean_of_objects(apart.square().sum(dim=-1) / cells, matches.valid)
