"""Offsets between pairs of furniture in training rooms, and their use to refine new rooms.

This is a reduced form of Sync2Gen's synchronisation: positions stay near the decoded ones, within
the decoder's mean squared error, and offsets follow their distribution in training rooms.
docs/baselines_3d.md lists the omissions.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneprior.core.views import RoomBoxes

COMPONENTS = 64
"""Number of offsets kept per pair of classes; each is the mean of one Gaussian of the pair's
mixture."""
BANDWIDTH_M = 0.15
ANYWHERE = 0.05
"""Weight of a uniform density over `AREA_M2` in each mixture, which bounds the pull of a pair."""
AREA_M2 = 64.0
STEP_M = 0.02
BATCH = 64
"""Rooms per batch in refinement."""


class PairPrior(nn.Module):
    """Gaussian mixtures of the offset between two centres in x and z, one per pair of classes."""

    offsets_m: Tensor
    known: Tensor
    error_m2: Tensor
    """Mean squared error of decoded centres per class, in square metres."""

    def __init__(self, classes: int):
        super().__init__()
        self.register_buffer("offsets_m", torch.zeros(classes, classes, COMPONENTS, 2))
        self.register_buffer("known", torch.zeros(classes, classes, dtype=torch.bool))
        self.register_buffer("error_m2", torch.full((classes,), 0.04))

    def fit(self, rooms: RoomBoxes, seed: int) -> None:
        """Keep `COMPONENTS` offsets per pair of classes from training rooms: a random choice for
        frequent pairs, with repetitions for rare ones."""
        generator = torch.Generator().manual_seed(seed)
        offsets_m, together = _offsets(rooms)
        room, one, other = together.nonzero(as_tuple=True)
        first, second = rooms.object_class[room, one], rooms.object_class[room, other]
        found_m = offsets_m[room, one, other]
        classes = len(self.known)
        pair = first * classes + second
        for index in pair.unique().tolist():
            mine = found_m[pair == index]
            pick = torch.randperm(len(mine), generator=generator)
            pick = pick.repeat(-(-COMPONENTS // len(mine)))[:COMPONENTS]
            self.offsets_m[index // classes, index % classes] = mine[pick]
            self.known[index // classes, index % classes] = True

    def energy(
        self, rooms: RoomBoxes, start_m: Float[Tensor, "rooms objects 2"]
    ) -> Float[Tensor, " rooms"]:
        """Minus the log-posterior of positions, up to a constant:

            sum_i |p_i - start_i|^2 / (2 error_i) - mean_(j != i) log p(p_j - p_i | classes)

        Pairs of classes that occur in no training room are left out.
        """
        error_m2 = self.error_m2[rooms.object_class]
        stray = ((rooms.boxes_m[..., [0, 2]] - start_m) ** 2).sum(dim=-1) / (2 * error_m2)
        offsets_m, together = _offsets(rooms)
        first, second = rooms.object_class.unsqueeze(2), rooms.object_class.unsqueeze(1)
        centres_m = self.offsets_m[first, second]
        squared = ((offsets_m.unsqueeze(-2) - centres_m) ** 2).sum(dim=-1)
        peak = 1 / (2 * torch.pi * BANDWIDTH_M**2)
        density = peak * torch.exp(-squared / (2 * BANDWIDTH_M**2)).mean(dim=-1)
        log_prob = torch.log((1 - ANYWHERE) * density + ANYWHERE / AREA_M2)
        counted = together & self.known[first, second]
        of_pairs = (log_prob * counted).sum(dim=-1) / counted.sum(dim=-1).clamp(min=1)
        return ((stray - of_pairs) * rooms.is_object).sum(dim=-1)

    @torch.enable_grad()
    def refine(self, rooms: RoomBoxes, steps: int) -> RoomBoxes:
        """Reduce the energy by `steps` steps of Adam on the floor positions."""
        moved = []
        for part in rooms.split(BATCH):
            start_m = part.boxes_m[..., [0, 2]]
            part = replace(part, boxes_m=part.boxes_m.clone().requires_grad_())
            # Adam updates each number from its own gradient, so rooms in a batch do not affect each
            # other, and heights and sizes, which have no gradient, do not change.
            optimizer = torch.optim.Adam([part.boxes_m], lr=STEP_M)
            for _ in range(steps):
                optimizer.zero_grad()
                self.energy(part, start_m).sum().backward()
                optimizer.step()
            moved.append(part.boxes_m.detach())
        return replace(rooms, boxes_m=torch.cat(moved))


def _offsets(
    rooms: RoomBoxes,
) -> tuple[Float[Tensor, "rooms objects objects 2"], Bool[Tensor, "rooms objects objects"]]:
    """Offsets from object i to object j in x and z, and True for two objects of a room."""
    floor_m = rooms.boxes_m[..., [0, 2]]
    objects = floor_m.shape[1]
    other = ~torch.eye(objects, dtype=torch.bool, device=floor_m.device)
    together = rooms.is_object.unsqueeze(2) & rooms.is_object.unsqueeze(1) & other
    return floor_m.unsqueeze(1) - floor_m.unsqueeze(2), together
