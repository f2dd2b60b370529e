"""The sampler's network: a room's contents, and the next object given the set of the previous
ones."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import LogisticMixture, draw_index
from sceneprior.core.settings import AttentionSection
from sceneprior.lifted.lifting import HANGS_M
from sceneprior.lifted.prototypes import POSES, PosedRooms, turn_posed
from sceneprior.lifted.sampler.contents import MANY, Contents, PairwisePotentials, reached
from sceneprior.lifted.sampler.frames import SYMMETRIES, gaps_m, rectangle_sides
from sceneprior.lifted.sampler.placement import SHOWN, Placement, Places
from sceneprior.paper.decoders import mlp
from sceneprior.training.method import TrainConfig

CLASS_WIDTH = 32
"""Dimension of the class embedding."""
RECTANGLES = 12
"""Components of the Gaussian mixture of the rectangle around a room's furniture."""
EXTENTS = 4
"""Components of the logistic mixture of an object's extents."""
MATCH_WIDTH = 64
"""Dimension of the query and the keys by which looks are compared."""
SIZES = 32
"""Maximum number of sizes of a prototype; the most frequent ones are kept."""
OCTAVES = 6
"""Frequencies in the encoding of a length."""
LONGEST_M = 16.0
"""Longest period of that encoding, which has a sine and a cosine for each of `OCTAVES` periods;
each is half the previous one."""
LENGTHS = 1 + 2 * OCTAVES
"""Number of values that encode a length."""
RARELY = 0.05
"""Share of a class's training objects above the floor below which the class stands; in the shipped
priors it is at most 0.006 for furniture, and 1 for lamps on the ceiling."""
OWN_POSE = turn_posed(
    torch.arange(POSES).expand(SYMMETRIES, -1),
    torch.arange(SYMMETRIES) % QUARTERS,
    torch.arange(SYMMETRIES) >= QUARTERS,
).argsort(dim=1)
"""Maps (room symmetry, observed pose) to the pose in the untransformed room."""


class SamplerConfig(TrainConfig, AttentionSection):
    """Training and size of the sampler: the section `sampler` of a run's YAML."""

    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    """Peak of the cosine schedule; contents and tables of pairs learn 5 and 10 times as fast."""
    weight_decay: float = Field(0.01, ge=0)
    """Decay of AdamW; that of tables of pairs is 10 times as large. More helps with few rooms."""
    clip_gradient: float = Field(1.0, ge=0)
    width: int = Field(128, ge=8)
    """Width of the transformer encoder; its feed-forward layers are twice as wide. A wider or
    deeper encoder needs more rooms."""
    layers: int = Field(2, ge=1, le=100)
    """Layers of the transformer encoder."""
    heads: int = Field(4, ge=1)
    """Attention heads; must divide the width."""
    dropout: float = Field(0.1, ge=0, lt=1)
    """Share of activations dropped in training; more of it delays overfitting to few rooms."""
    val_every: int = Field(10, ge=1)
    """Epochs between evaluations on the val rooms. The network that gives them the highest
    likelihood is kept, or the newest network if there are no val rooms."""


class EncoderState(NamedTuple):
    """Encoder outputs for partly furnished rooms."""

    before: PosedRooms
    rectangle_m: Float[Tensor, "rooms 4"]
    """Rectangle that the furniture may fill: centre x, z and extents x, z."""
    symmetry: Int[Tensor, " rooms"]
    """Index of the symmetry, out of `SYMMETRIES`, in which each room is presented; 0 is
    untransformed."""
    coming: Float[Tensor, "rooms classes"]
    """Number of objects of each class that are still to be placed."""
    context: Float[Tensor, "rooms width"]
    """Output of the query: the context for the next object."""

    def rows(self, rows: Int[Tensor, " some"]) -> "EncoderState":
        """These outputs, reduced to the rooms with these indices."""
        before, *others = self
        return EncoderState(before.changed(lambda part: part[rows]), *(o[rows] for o in others))


class RoomSampler(nn.Module):
    """Autoregressive model of rooms: the contents (`Contents`), then one object after the other,
    each given the unordered set of the previous ones and the classes still to come.

    A transformer encoder without positional encoding reads the rectangle around the room's
    furniture, the objects placed so far, and a learnt query. The query's output predicts the next
    object, whose class is already known: first its look, then its size relative to that look, then
    its place (`Placement`), relative to the rectangle, to the floor's middle and to the other
    objects. Drawn rooms take a size and a height that training objects with that look have
    (`draw_size`); the head of sizes only takes part in the likelihood.

    Training rooms are presented in all their `SYMMETRIES`. The frequency of each look in each pose
    depends on the orientation of the data; it is learnt for untransformed rooms, and transformed
    together with the room.

    Args:
        settings: Size of the network.
        classes: Size of the label set, void included.
        prototypes: Maximum number of prototypes, as in the prior's shape decoder.
        max_objects: Maximum number of objects in a room.
    """

    look_class: Tensor
    look_shown: Tensor
    rectangle_logits: Tensor
    rectangle_means: Tensor
    rectangle_factors: Tensor
    may_meet: Tensor
    exclusive: Tensor
    """Pairs of prototypes that no room has together, such as two dining tables; see `exclusive`."""
    footprints_m2: Tensor
    backs: Tensor
    fronts: Tensor
    front_confidence: Tensor
    sizes_m: Tensor
    bottoms_m: Tensor
    size_counts: Tensor

    def __init__(self, settings: SamplerConfig, classes: int, prototypes: int, max_objects: int):
        super().__init__()
        width, dropout = settings.width, settings.dropout
        self.max_objects = max_objects
        # Computed from the training rooms before the first step, and saved in checkpoints.
        looks = prototypes * POSES
        self.register_buffer("look_class", torch.full((looks,), -1))
        self.register_buffer("look_shown", torch.zeros(looks, SHOWN))
        self.register_buffer("rectangle_logits", torch.zeros(RECTANGLES))
        self.register_buffer("rectangle_means", torch.zeros(RECTANGLES, 4))
        self.register_buffer("rectangle_factors", torch.zeros(RECTANGLES, 4, 4))
        self.register_buffer("may_meet", torch.zeros(classes, classes, dtype=torch.bool))
        self.register_buffer("exclusive", torch.zeros(prototypes, prototypes, dtype=torch.bool))
        self.register_buffer("footprints_m2", torch.ones(classes))
        self.register_buffer("backs", torch.zeros(prototypes, dtype=torch.int64))
        self.register_buffer("fronts", torch.zeros(prototypes, dtype=torch.int64))
        self.register_buffer("front_confidence", torch.zeros(prototypes))
        self.register_buffer("sizes_m", torch.ones(prototypes, SIZES, 3))
        self.register_buffer("bottoms_m", torch.zeros(prototypes, SIZES))
        self.register_buffer("size_counts", torch.zeros(prototypes, SIZES))
        self.contents = Contents(classes, width, dropout)
        self.class_embedding = nn.Embedding(classes, CLASS_WIDTH)
        self.look_embedding = nn.Linear(SHOWN, width)
        self.object_embedding = nn.Linear(CLASS_WIDTH + 10 * LENGTHS, width)
        self.rectangle_embedding = nn.Linear(4 * LENGTHS, width)
        self.query = nn.Parameter(torch.randn(width))
        self.summary_embedding = nn.Linear((2 + MANY) * classes + 4 * LENGTHS, width)
        self.dropout = nn.Dropout(dropout)
        self.encoder = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, settings.heads, 2 * width, dropout, "gelu", batch_first=True, norm_first=True
            )
            for _ in range(settings.layers)
        )
        self.norm = nn.LayerNorm(width)
        known = width + CLASS_WIDTH
        self.wanted_look = _head(known, width, MATCH_WIDTH)
        self.offered_look = _head(SHOWN, width, MATCH_WIDTH)
        self.frequency = nn.Parameter(torch.zeros(prototypes, POSES))
        self.look_scores = PairwisePotentials(classes)
        self.extents_head = _head(known + width, width, EXTENTS * 7)
        # Places overfit first: they get twice the dropout, at most 0.5.
        self.placement = Placement(classes, min(2 * dropout, 0.5))

    @property
    def drawn_classes(self) -> list[int]:
        """Indices of the classes that can be sampled: those with looks, not the whole label set."""
        return [int(row) for row in self.look_class[self.look_class >= 0].unique()]

    @property
    def looks(self) -> int:
        """Number of looks: 8 for each prototype found, often far fewer than the maximum."""
        return 1 + int((self.look_class >= 0).nonzero().max())

    def rectangles(
        self, choice: Float[Tensor, "*batch"], noise: Float[Tensor, "*batch 4"]
    ) -> Float[Tensor, "*batch 4"]:
        """Sample rectangles (centre x, z, extents x, z) from a uniform number `choice` and standard
        normal numbers `noise`."""
        which = draw_index(self.rectangle_logits.expand(*choice.shape, -1), choice)
        moved = (self.rectangle_factors[which] @ noise.unsqueeze(-1))[..., 0]
        found = self.rectangle_means[which] + moved
        return torch.cat([found[..., :2], found[..., 2:].exp()], dim=-1)

    def tokens(
        self, rooms: PosedRooms, rectangle_m: Float[Tensor, "rooms 4"]
    ) -> Float[Tensor, "rooms objects width"]:
        """Encoder inputs, one per object: class, look, size, height, and place in the rectangle
        (centre x, z, extents x, z)."""
        assert rooms.looks is not None
        centre, size = rooms.boxes_m.split(3, dim=-1)
        middle, extents = rectangle_m.unsqueeze(1).split(2, dim=-1)
        place, footprint = centre[..., ::2] - middle, size[..., ::2]
        bottom = centre[..., 1:2] - size[..., 1:2] / 2
        low, high = (extents - footprint) / 2 + place, (extents - footprint) / 2 - place
        shown = fourier_features(torch.cat([place, bottom, size, low, high], dim=-1))
        known = torch.cat([self.class_embedding(rooms.object_class), shown], dim=-1)
        return self.object_embedding(known) + self.look_embedding(self.look_shown[rooms.looks])

    def read(
        self,
        before: PosedRooms,
        coming: Float[Tensor, "rooms classes"],
        rectangle_m: Float[Tensor, "rooms 4"],
        symmetry: Int[Tensor, " rooms"],
        tokens: Float[Tensor, "rooms objects width"],
    ) -> EncoderState:
        """Encode the objects placed so far, in any order, from their `tokens`, and the counts of
        each class still to come."""
        # Features that attention could only obtain by counting: the number of objects of each
        # class, placed and still to come, and the gaps between the furniture and each side of the
        # rectangle, which are small in a finished room.
        low, high = rectangle_sides(rectangle_m)
        furnished = before.is_object.any(dim=1, keepdim=True)
        gaps = gaps_m(before, rectangle_m).where(furnished, torch.cat([high - low] * 2, dim=-1))
        placed = self.counts(before)
        in_all = reached(placed + coming).flatten(-2)
        summary = torch.cat([placed, coming, fourier_features(gaps), in_all], dim=-1)
        query = self.query + self.summary_embedding(summary)
        shown = self.rectangle_embedding(fourier_features(rectangle_m))
        features = torch.cat([query.unsqueeze(1), shown.unsqueeze(1), tokens], dim=1)
        features = self.dropout(features)
        nothing = torch.cat([before.is_object.new_zeros(len(tokens), 2), ~before.is_object], dim=1)
        for layer in self.encoder:
            features = layer(features, src_key_padding_mask=nothing)
        features = self.norm(features)
        return EncoderState(before, rectangle_m, symmetry, coming, features[:, 0])

    def offers(self) -> Float[Tensor, "looks match"]:
        """Keys of all looks, which the steps of a room share."""
        offered: Tensor = self.offered_look(self.look_shown[: self.looks])
        return offered

    def look_logits(
        self,
        state: EncoderState,
        label: Int[Tensor, " rooms"],
        offers: Float[Tensor, "looks match"],
    ) -> Float[Tensor, "rooms looks"]:
        """Logits of the next object's look, given its class; looks of other classes are ruled
        out."""
        known = torch.cat([state.context, self.class_embedding(label)], dim=-1)
        shown = self.look_shown[: self.looks]
        logits = self.wanted_look(known) @ offers.T / math.sqrt(MATCH_WIDTH)
        own_pose = OWN_POSE.to(self.frequency.device)
        frequency = self.frequency[:, own_pose].transpose(0, 1).flatten(1)[:, : self.looks]
        logits = logits + frequency[state.symmetry]
        placed = self.counts(state.before)
        counts = torch.cat([placed + state.coming, placed], dim=-1)
        logits = logits + self.look_scores(label, state.before, counts, shown, self.backs)
        others = self.look_class[: self.looks] != label.unsqueeze(-1)
        return logits.masked_fill(others, -torch.inf)

    def is_known(self, rooms: PosedRooms) -> Bool[Tensor, "rooms objects"]:
        """True for objects with a look of their class; given ones of a class that no prototype
        shows have none."""
        assert rooms.looks is not None
        return rooms.is_object & (self.look_class[rooms.looks] == rooms.object_class)

    def excluded_looks(self, before: PosedRooms) -> Bool[Tensor, "rooms looks"]:
        """Looks of prototypes that no room has together with one that is there."""
        assert before.looks is not None
        barred = self.exclusive[before.looks // POSES] & self.is_known(before).unsqueeze(-1)
        return barred.any(dim=1).repeat_interleave(POSES, dim=1)[:, : self.looks]

    def draw_size(
        self, look: Int[Tensor, " rooms"], before: PosedRooms, uniform: Float[Tensor, " rooms"]
    ) -> tuple[Float[Tensor, "rooms 3"], Float[Tensor, " rooms"]]:
        """Sample the extents of objects with these looks and the heights of their bottoms, in
        proportion to the numbers of training objects with them (`find_sizes`).

        An object of the prototype of an object that is there (`before`) is its twin, as large and
        as high; lifted twins differ by errors alone.

        An object above the floor, of a class that stands (`RARELY`), is the visible part of a
        higher one, such as a chair behind a table, and is extended to the floor.
        """
        prototype, labels = look // POSES, self.look_class[::POSES].clamp(min=0)
        which = draw_index(self.size_counts[prototype].log(), uniform)
        size_m, bottom_m = self.sizes_m[prototype, which], self.bottoms_m[prototype, which]
        floating = self.size_counts * (self.bottoms_m > HANGS_M)
        numbers = torch.stack([floating, self.size_counts]).sum(dim=-1)
        above, every = numbers.new_zeros(2, len(self.footprints_m2)).index_add(1, labels, numbers)
        hidden = (bottom_m > HANGS_M) & (above < RARELY * every)[labels[prototype]]
        size_m[:, 1] += bottom_m * hidden
        size_m, bottom_m = _swapped(look, size_m), bottom_m * ~hidden
        assert before.looks is not None
        twins = self.is_known(before) & (before.looks // POSES == prototype.unsqueeze(1))
        for row in twins.any(dim=1).nonzero()[:, 0].tolist():
            twin = int(twins[row].int().argmax())
            centre_m, extents_m = before.boxes_m[row, twin].split(3)
            turns = before.looks[row, [twin]], look[[row]]
            size_m[row] = _swapped(turns[1], _swapped(turns[0], extents_m[None]))[0]
            bottom_m[row] = centre_m[1] - extents_m[1] / 2
        return size_m, bottom_m

    def place(
        self,
        state: EncoderState,
        label: Int[Tensor, " rooms"],
        look: Int[Tensor, " rooms"],
        size_m: Float[Tensor, "rooms 3"],
        bottom_m: Float[Tensor, " rooms"],
    ) -> Places:
        """Distribution of the x and z of the object's centre."""
        counts = torch.cat([self.counts(state.before), state.coming], dim=-1)
        return self.placement(
            label, look, size_m, bottom_m, state.rectangle_m, state.before, counts,
            self.look_shown, self.backs,
        )  # fmt: skip

    def counts(self, rooms: PosedRooms) -> Float[Tensor, "rooms classes"]:
        """Number of objects of each class."""
        return self.contents.before(rooms.object_class, rooms.is_object)[:, -1]

    def log_prob(
        self, state: EncoderState, coming: PosedRooms, offers: Float[Tensor, "looks match"]
    ) -> dict[str, Float[Tensor, " rooms"]]:
        """Log-probabilities of the look, size and place of each room's next object, given its
        class. Every room of `coming` has one object."""
        assert coming.looks is not None
        label, look = coming.object_class[:, 0], coming.looks[:, 0]
        centre_m, size_m = coming.boxes_m[:, 0].split(3, dim=-1)
        bottom_m = centre_m[:, 1] - size_m[:, 1] / 2
        looks = self.look_logits(state, label, offers).log_softmax(dim=-1)
        # The distribution of the log extents, relative to those of the look.
        known = [state.context, self.class_embedding(label)]
        known.append(self.look_embedding(self.look_shown[look]))
        extents = LogisticMixture.of(self.extents_head(torch.cat(known, dim=-1)), 3)
        place = self.place(state, label, look, size_m, bottom_m)
        return {
            "look": looks.gather(-1, look.unsqueeze(-1))[:, 0],
            "size": extents.log_prob(size_m.log() - self.look_shown[look, -3:]),
            "place": place.log_prob(centre_m[:, ::2]),
        }


def _swapped(
    look: Int[Tensor, " rooms"], size_m: Float[Tensor, "rooms 3"]
) -> Float[Tensor, "rooms 3"]:
    """Extents in the pose of a look from those in pose 0, or the reverse: odd poses are turned by a
    quarter or three."""
    return size_m.flip(-1).where(look.unsqueeze(-1) % 2 == 1, size_m)


def _head(inputs: int, width: int, outputs: int) -> nn.Sequential:
    return mlp(nn.Linear(inputs, width), nn.Linear(width, outputs))


def fourier_features(lengths_m: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch shown"]:
    """Encode lengths: the lengths themselves (in units of 4 m), then their Fourier features, a sine
    and a cosine for each of `OCTAVES` periods."""
    octaves = torch.arange(OCTAVES, device=lengths_m.device, dtype=lengths_m.dtype)
    phase = (lengths_m.unsqueeze(-1) * (2 * math.pi / LONGEST_M * 2**octaves)).flatten(-2)
    return torch.cat([lengths_m / 4, phase.sin(), phase.cos()], dim=-1)
