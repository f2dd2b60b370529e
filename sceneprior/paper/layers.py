"""Building blocks that several modules share: MLPs, dropout, and base classes of the decoders."""

import math
from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.scene import Mesh, Solid
from sceneprior.core.settings import Section
from sceneprior.core.views import DecodedScenes


def mlp(*layers: nn.Module, slope: float = 0.0) -> nn.Sequential:
    """The layers in sequence, with a ReLU between them, or a leaky ReLU if `slope` is not 0."""
    between = nn.LeakyReLU(slope) if slope else nn.ReLU()
    return nn.Sequential(*[part for layer in layers for part in (layer, between)][:-1])


def dropout(x: Float[Tensor, "*shape"], p: float) -> Float[Tensor, "*shape"]:
    """Set each number to 0 with probability `p` and divide the others by 1 - p, as `F.dropout` in
    training.

    On a CPU, this function samples the positions of the zeros instead of deciding for every number,
    which takes a quarter of the time. For n numbers, Poisson(-n ln(1 - p)) positions are drawn
    uniformly with replacement. Each number is then drawn Poisson(-ln(1 - p)) times, independently
    of the others, so the probability that it is never drawn is 1 - p.
    """
    if p == 0 or x.device.type != "cpu":
        return F.dropout(x, p)
    hits = torch.poisson(torch.tensor(-x.numel() * math.log1p(-p), dtype=torch.float64))
    scale = x.new_full((x.numel(),), 1 / (1 - p))
    scale.scatter_(0, torch.randint(max(x.numel(), 1), (int(hits),)), 0)
    return x * scale.view(x.shape)


class ShapeModule(nn.Module, ABC):
    """A shape decoder: maps an object's feature to its shape, and the shape to a mesh."""

    faces: Tensor | None
    """(faces, 3) triangles, if all meshes of the decoder share them; else None."""

    @abstractmethod
    def add_shapes(
        self,
        scenes: DecodedScenes,
        features: Float[Tensor, "rooms objects features"],
        with_shape: bool | Bool[Tensor, "rooms shaped"],
        wanted: Bool[Tensor, "rooms wanted"] | None,
    ) -> DecodedScenes:
        """The decoded layouts with shapes added; the arguments are those of `ScenePrior.decode`."""

    def along_path(
        self,
        rooms: DecodedScenes,
        places: Float[Tensor, " rooms"],
        path: DecodedScenes,
        kept: Bool[Tensor, "steps objects"],
    ) -> DecodedScenes:
        """Rooms at places (0 to 1) of a path, with shapes that change gradually along it.

        `path` has the rooms at equal steps from 0 to 1, and `kept` selects the predictions that are
        objects. Deformed meshes change gradually anyway, so by default `rooms` stays unchanged.
        """
        return rooms

    @abstractmethod
    def mesh_of(self, decoded: DecodedScenes, room: int, item: int) -> Mesh | None:
        """The mesh of prediction `item`; None if shapes were not decoded."""

    def solids_of(self, decoded: DecodedScenes, room: int, item: int) -> tuple[Solid, ...]:
        """The convex solids of prediction `item`; none for shapes that are not made of solids."""
        return ()


class ShapeModuleConfig(Section, ABC):
    """A config section that builds a shape decoder."""

    @abstractmethod
    def build(self, features: int) -> ShapeModule:
        """The module for object features of width `features`, freshly initialised."""


class DecoderConfig(Section, ABC):
    """A config section that builds the decoder from a latent z to object features x_k.

    The module maps (z of shape (rooms, D_z), N) to features of shape (rooms, N, D_z). It also
    accepts the number of features that each room needs; features beyond that number are
    meaningless.
    """

    name: str

    @abstractmethod
    def build(self, width: int, max_objects: int) -> nn.Module:
        """The module for features of D_z = `width`, freshly initialised."""
