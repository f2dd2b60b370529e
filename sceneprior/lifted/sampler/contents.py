"""A room's contents: its list of classes, sampled before any object is placed."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.mixtures import draw_index

END = 0
"""Class that ends a room's list: void, which no listed object has."""
MANY = 3
"""Number of bits ("at least 1", "at least 2" and so on) that encode the count of a class, besides
the count itself: the first object of a class is more informative than the next ones."""


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

    known: Tensor
    """True for the classes that may be sampled: those of the training rooms, and `END`."""

    def __init__(self, classes: int, width: int, dropout: float):
        super().__init__()
        self.register_buffer("known", torch.zeros(classes, dtype=torch.bool))
        self.layers = nn.Sequential(
            nn.Linear((1 + MANY) * classes + 3, width), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(width, width), nn.ReLU(), nn.Dropout(dropout),
            nn.Linear(width, classes),
        )  # fmt: skip

    def forward(
        self, counts: Float[Tensor, "*batch classes"], extents_m: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch classes"]:
        """Logits of the next class, or of `END`."""
        many = torch.arange(1, MANY + 1).to(counts)
        reached = (counts.unsqueeze(-1) >= many).to(counts).flatten(-2)
        told = [counts, reached, counts.sum(dim=-1, keepdim=True), extents_m]
        logits: Tensor = self.layers(torch.cat(told, dim=-1))
        return logits.masked_fill(~self.known, -torch.inf)

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
        each = F.one_hot(object_class, len(self.known)) * is_object.unsqueeze(-1)
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
        `END`. Classes of which there are `most` already are left out.

        The network was trained to continue any subset of a room's classes.
        """
        going, drawn = torch.ones_like(free, dtype=torch.bool), torch.zeros_like(uniform).long()
        for slot, chance in enumerate(uniform.unbind(dim=1)):
            logits = self(counts, extents_m)
            if most is not None:
                logits = logits.masked_fill(counts >= most, -torch.inf)
            label = draw_index(logits, chance)
            going = going & (label != END) & (slot < free)
            drawn[:, slot] = label * going
            counts = counts.scatter_add(1, label[:, None], going[:, None].to(counts))
        return drawn
