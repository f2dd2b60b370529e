"""The latent space Z: from learnt logits to points z of the hypersphere (section 3.1, Eq. 2).

A latent space maps the learnt logits of rooms to latents z, which are decoded. The logits of
training rooms are initialised from N(0, 1), and the distribution `paper` samples the logits of new
rooms from N(0, 1), too. A space also measures how near two latents are, interpolates between them
and takes small random steps. The hypersphere is the paper's; the cube is ablation c1.
"""

import math
from abc import ABC, abstractmethod
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.settings import Section


class SphereConfig(Section):
    """The paper's hypersphere."""

    name: Literal["sphere"] = "sphere"
    anchors: int = Field(100, ge=2)
    """M, the number of fixed unit vectors of which latents are mixtures; 100 in the authors'
    code."""

    def build(self, dimension: int, seed: int) -> "LatentSphere":
        return LatentSphere(self.anchors, dimension, seed)


class CubeConfig(Section):
    """A cube with one logit per coordinate: ablation c1. `distribution: paper` is uniform in it."""

    name: Literal["cube"] = "cube"

    def build(self, dimension: int, seed: int) -> "LatentCube":
        return LatentCube(dimension)


class _Space(nn.Module, ABC):
    @abstractmethod
    def onto(self, points: Tensor) -> Tensor:
        """The nearest point of the latent space to each given point of the surrounding R^D_z."""

    def step(
        self, z: Float[Tensor, "rooms dimension"], length: float, seed: int
    ) -> Float[Tensor, "rooms dimension"]:
        """Move each point by a random step of about `length`; the same seed gives the same
        steps."""
        generator = torch.Generator().manual_seed(seed)
        steps = torch.randn(z.shape, generator=generator).to(z) * (length / z.shape[-1] ** 0.5)
        return self.onto(z + steps)


class LatentSphere(_Space):
    """Map weights w_i of M fixed unit vectors phi_i to a point z of the hypersphere (Eq. 2).

        z = sum_i w_i phi_i / |sum_i w_i phi_i|,    w = softmax(logits)

    Adding a constant to all logits of a room does not change z, hence `shift_free`. `seed`
    determines the anchors phi_i, which are drawn at random and stored with the model.
    """

    shift_free = True

    def __init__(self, anchors: int, dimension: int, seed: int = 0):
        super().__init__()
        self.anchors: Tensor
        generator = torch.Generator().manual_seed(seed)
        # Normalised Gaussians are uniform on the sphere.
        vectors = torch.randn(anchors, dimension, generator=generator)
        self.register_buffer("anchors", F.normalize(vectors, dim=-1))

    def forward(self, logits: Float[Tensor, "rooms anchors"]) -> Float[Tensor, "rooms dimension"]:
        """Latents z of rooms (Eq. 2); the weights w_i are positive and sum to 1."""
        return F.normalize(logits.softmax(dim=-1) @ self.anchors, dim=-1)

    def onto(self, points: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        return F.normalize(points, dim=-1)

    def nearness(
        self, some: Float[Tensor, "some dimension"], others: Float[Tensor, "others dimension"]
    ) -> Float[Tensor, "some others"]:
        """Cosine of the angle between each pair: larger for nearer pairs."""
        return some @ others.T

    def between(
        self,
        start: Float[Tensor, "pairs dimension"],
        end: Float[Tensor, "pairs dimension"],
        along: Float[Tensor, " pairs"],
    ) -> Float[Tensor, "pairs dimension"]:
        """The point at `along` (0 to 1) of the geodesic between each pair of unit vectors (section
        5.3).

        Raises:
            ValueError: two vectors are opposite, so that no geodesic is the shortest.
        """
        # Not acos of the dot product: in float32 it cannot resolve angles between pi - 3e-4 and pi.
        apart, together = (start - end).norm(dim=-1), (start + end).norm(dim=-1)
        angle = 2 * torch.atan2(apart, together).unsqueeze(-1)
        if bool((angle > torch.pi - 1e-4).any()):
            raise ValueError("The two latents are opposite points; any great circle joins them.")
        t = along.unsqueeze(-1)
        # If the two nearly coincide, sin(angle) vanishes, and the chord replaces the geodesic.
        straight = F.normalize(torch.lerp(start, end, t), dim=-1)
        turned = torch.sin((1 - t) * angle) * start + torch.sin(t * angle) * end
        return torch.where(angle < 1e-3, straight, turned / torch.sin(angle).clamp(min=1e-6))


class LatentCube(_Space):
    """Map one logit per coordinate to a point of a cube around the origin: ablation c1.

        z_i = a * (2 * Phi(logit_i) - 1),    a = sqrt(3 / D_z)

    Phi is the cumulative distribution function of N(0, 1), so logits from N(0, 1) give points that
    are uniform in the cube. The half edge a makes their mean square length 1, the scale of latents
    on the sphere.

    The paper says only 'uniform latent space parameterization'; this is our reading of it.
    """

    shift_free = False

    def __init__(self, dimension: int):
        super().__init__()
        self.half_edge = math.sqrt(3 / dimension)

    def forward(self, logits: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        """Points z of the cube; 2 Phi(x) - 1 = erf(x / sqrt(2))."""
        return self.half_edge * torch.erf(logits / math.sqrt(2))

    def onto(self, points: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        return points.clamp(-self.half_edge, self.half_edge)

    def nearness(
        self, some: Float[Tensor, "some dimension"], others: Float[Tensor, "others dimension"]
    ) -> Float[Tensor, "some others"]:
        """Minus the distance of each pair: larger for nearer pairs."""
        return -torch.cdist(some, others)

    def between(
        self,
        start: Float[Tensor, "pairs dimension"],
        end: Float[Tensor, "pairs dimension"],
        along: Float[Tensor, " pairs"],
    ) -> Float[Tensor, "pairs dimension"]:
        """For each pair, the point at `along` (0 to 1) of the straight line between them."""
        return torch.lerp(start, end, along.unsqueeze(-1))


LatentSpace = LatentSphere | LatentCube
