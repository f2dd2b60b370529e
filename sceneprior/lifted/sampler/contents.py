"""Models of a room's contents with few weights: `Contents` samples the list of classes before any
object is placed, and `PairwisePotentials` scores the looks that suit the other furniture."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.prototypes import POSES, PosedRooms
from sceneprior.lifted.sampler.frames import side_of

END = 0
"""Class that ends a room's list: void, which no listed object has."""
FEW = 5
"""Number of training rooms in which two independent classes, or looks, must be expected together,
for none to mean that rooms have one or the other."""
MANY = 8
"""Number of bits ("at least 1", "at least 2" and so on) that encode the count of a class, besides
the count itself: tables have two, four or six chairs, and a desk makes it an odd number."""
RELATIONS = 4
"""Number of features of the relation of a direction to an object already placed: its back points
in the same direction, in the opposite one, or sideways; and the logarithm of the ratio of its
extents, along the direction to across it."""
MOST_LOG = 1.0
"""Bound of this logarithm."""
MEASURES = 3
"""Number of measures of a look's footprint: the logarithm of its area, the absolute value of the
logarithm of the ratio of its extents, and the square of the first."""


class Contents(nn.Module):
    """Autoregressive model of a room's list of classes: it predicts the next class, or the end.

    The only inputs are the counts of the classes so far, and the size of the rectangle around the
    furniture. Contents are sampled without seeing placements, so that placement errors do not
    accumulate.

    Args:
        classes: Size of the label set, void included.
        width: Width of the hidden layers.
        dropout: Dropout rate between them.
    """

    most: Tensor
    """Largest number of each class in a training room."""
    excluded: Tensor
    """True for pairs of classes of which rooms have one or the other, such as two kinds of beds."""

    def __init__(self, classes: int, width: int, dropout: float):
        super().__init__()
        self.register_buffer("most", torch.zeros(classes))
        self.register_buffer("excluded", torch.zeros(classes, classes, dtype=torch.bool))
        self.layers = nn.Sequential(
            nn.Linear((1 + MANY) * classes + 3, width), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(width, width), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(width, classes),
        )  # fmt: skip

    def teach(self, counts: Float[Tensor, "rooms classes"]) -> None:
        """Set the buffers from the numbers of each class in the training rooms."""
        self.most.copy_(counts.amax(dim=0))
        self.most[END] = 1
        self.excluded.copy_(exclusive(counts))

    def forward(
        self, counts: Float[Tensor, "*batch classes"], extents_m: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch classes"]:
        """Logits of the next class, or of `END`."""
        told = [counts, reached(counts).flatten(-2), counts.sum(dim=-1, keepdim=True), extents_m]
        logits: Tensor = self.layers(torch.cat(told, dim=-1))
        return logits.masked_fill(self.most == 0, -torch.inf)

    def negative_log_likelihood(
        self,
        object_class: Int[Tensor, "rooms objects"],
        is_object: Bool[Tensor, "rooms objects"],
        extents_m: Float[Tensor, "rooms 2"],
    ) -> Float[Tensor, " rooms"]:
        """Negative log-likelihood of each room's list of classes, in the given order and including
        its end."""
        label = F.pad(object_class * is_object, (0, 1), value=END)
        before = self.before(object_class, is_object)
        logits = self(before, extents_m.unsqueeze(1).expand(-1, label.shape[1], -1))
        losses = F.cross_entropy(logits.flatten(0, 1), label.flatten(), reduction="none")
        asked = F.pad(is_object, (1, 0), value=True)
        return (losses.view(label.shape) * asked).sum(dim=1)

    def before(
        self, object_class: Int[Tensor, "rooms objects"], is_object: Bool[Tensor, "rooms objects"]
    ) -> Float[Tensor, "rooms steps classes"]:
        """Counts of each class before each step; the last step counts all objects."""
        each = F.one_hot(object_class, len(self.most)) * is_object.unsqueeze(-1)
        return F.pad(each.cumsum(dim=1), (0, 0, 1, 0)).to(next(self.parameters()))

    def draw(
        self,
        counts: Float[Tensor, "rooms classes"],
        free: Int[Tensor, " rooms"],
        extents_m: Float[Tensor, "rooms 2"],
        uniform: Float[Tensor, "rooms slots"],
        most: Float[Tensor, " classes"] | None = None,
    ) -> Int[Tensor, "rooms slots"]:
        """Sample the classes to add to the given `counts`, at most `free` of them, followed by
        `END`. Classes of which there are `most` already are left out, and so are those of which no
        training room has as many, or of which none has both it and a class that is there.

        The network was trained to continue any subset of a room's classes.
        """
        most = self.most if most is None else torch.minimum(most, self.most)
        going, drawn = torch.ones_like(free, dtype=torch.bool), torch.zeros_like(uniform).long()
        for slot, chance in enumerate(uniform.unbind(dim=1)):
            barred = (counts >= most) | ((counts > 0).to(counts) @ self.excluded.to(counts) > 0)
            logits = self(counts, extents_m).masked_fill(barred, -torch.inf)
            label = draw_index(logits, chance)
            going = going & (label != END) & (slot < free)
            drawn[:, slot] = label * going
            counts = counts.scatter_add(1, label[:, None], going[:, None].to(counts))
        return drawn


def reached(counts: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch many"]:
    """The `MANY` bits of counts."""
    return (counts.unsqueeze(-1) >= torch.arange(1, MANY + 1).to(counts)).to(counts)


def exclusive(counts: Float[Tensor, "rooms kinds"]) -> Bool[Tensor, "kinds kinds"]:
    """Pairs of kinds of objects that no room has together, and would have if they were independent;
    a pair of a kind with itself is two objects of it. `counts` are the objects of each kind."""
    here = (counts > 0).to(counts)
    each, together = here.sum(dim=0), here.T @ here
    together.fill_diagonal_(0).diagonal().add_((counts > 1).sum(dim=0))
    return (together == 0) & (each * each[:, None] > FEW * len(counts))


class PairwisePotentials(nn.Module):
    """Scores of looks, added to the network's logits: functions with a few coefficients for each
    class or pair of classes, which a few hundred rooms suffice to learn.

    Chairs at a table point in the same direction or in opposite ones, towards its long sides; they
    have the same shape; and a table with four chairs is large, the next table is not. The encoder
    does not learn this: it sees a look as a coarse grid of its shape, in which it recognises
    neither the back nor that two objects have the same prototype.

    Args:
        classes: Size of the label set.
    """

    def __init__(self, classes: int):
        super().__init__()
        self.direction_table = nn.Parameter(torch.zeros(classes, classes, RELATIONS))
        self.facing_table = nn.Parameter(torch.zeros(classes, 3, MANY, MANY))
        self.repeat_table = nn.Parameter(torch.zeros(classes))
        self.size_table = nn.Parameter(torch.zeros(classes, 2 * classes, MANY, MEASURES))

    def forward(
        self,
        label: Int[Tensor, " rooms"],
        before: PosedRooms,
        counts: Float[Tensor, "rooms twice_classes"],
        look_shown: Float[Tensor, "looks shown"],
        backs: Int[Tensor, " prototypes"],
    ) -> Float[Tensor, "rooms looks"]:
        """The scores of all looks for an object of class `label`.

        Args:
            before: The objects already placed.
            counts: Number of objects of each class, placed or still to come, then of those placed.
            look_shown: Encoding of every look; it ends with the logarithms of the extents.
            backs: Side of every prototype's back; see `side_of`.
        """
        assert before.looks is not None
        here, looks = before.is_object, len(look_shown)
        # Directions: the back may point to low z, low x, high z or high x.
        sides = torch.arange(QUARTERS, device=label.device)
        turned = (side_of(before.looks, backs).unsqueeze(-1) - sides) % QUARTERS
        extents = before.boxes_m[..., [3, 5]].where(here.unsqueeze(-1), 1.0)
        along_x = (extents[..., :1].log() - extents[..., 1:].log()).clamp(-MOST_LOG, MOST_LOG)
        along = torch.where(sides % 2 == 1, along_x, -along_x)
        features = torch.stack([turned == 0, turned == 2, turned % 2 == 1, along], -1)
        table = self.direction_table[label.unsqueeze(1), before.object_class]
        table = table * here.unsqueeze(-1)
        directions = torch.einsum("rosf,rof->rs", features.to(table), table)
        # How many objects of the class point in the same direction, in the opposite one, and
        # sideways, given how many it has in all: four chairs stand two by two, the fifth at an end.
        same = here & (before.object_class == label.unsqueeze(1))
        facing = torch.einsum("rosf,ro->rsf", features[..., :3].to(table), same.to(table))
        in_all = reached(counts.gather(1, label.unsqueeze(1))[:, 0])
        directions = directions + torch.einsum(
            "rsfk,rm,rfkm->rs", reached(facing), in_all, self.facing_table[label]
        )
        # Repeats: looks whose prototype another object of the class has.
        prototypes = F.one_hot(before.looks // POSES, looks // POSES) * same.unsqueeze(-1)
        repeated = prototypes.sum(dim=1).clamp(max=1).repeat_interleave(POSES, dim=1)
        # Sizes: the looks' footprints, given how many objects of each class the room has.
        wanted = torch.einsum("rcm,rcmf->rf", reached(counts), self.size_table[label])
        x, z = look_shown[:, -3], look_shown[:, -1]
        return (
            directions[:, side_of(torch.arange(looks, device=label.device), backs)]
            + self.repeat_table[label].unsqueeze(1) * repeated
            + wanted @ torch.stack([x + z, (x - z).abs(), (x + z).square()])
        )
