"""The latent space Z: from the logits of rooms to points z of the hypersphere (section 3.1, Eq. 2).

A latent space turns the logits of rooms, which are learnt, into latents z, which are decoded.
Logits drawn from N(0, 1) are where training rooms start and what the `paper` distribution samples.
Beside that a space knows how near two latents are, what lies between them and what a small step
is. The hypersphere is the paper's; the cube is ablation c1.
"""

import math
from abc import ABC, abstractmethod
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.settings import Section


class SphereConfig(Section):
    """The hypersphere of the paper."""

    name: Literal["sphere"] = "sphere"
    anchors: int = Field(100, ge=2)
    """M fixed unit vectors that latents are mixed from; 100 in the authors' code."""

    def build(self, dimension: int, seed: int) -> "LatentSphere":
        return LatentSphere(self.anchors, dimension, seed)


class CubeConfig(Section):
    """A cube with one logit a coordinate: ablation c1. `distribution: paper` is uniform in it."""

    name: Literal["cube"] = "cube"

    def build(self, dimension: int, seed: int) -> "LatentCube":
        return LatentCube(dimension)


class _Space(nn.Module, ABC):
    @abstractmethod
    def onto(self, points: Tensor) -> Tensor:
        """The point of the latent space nearest to each point of the space around it."""

    def step(
        self, z: Float[Tensor, "rooms dimension"], length: float, seed: int
    ) -> Float[Tensor, "rooms dimension"]:
        """Move each point a random step of about `length`; the same seed, the same steps."""
        generator = torch.Generator().manual_seed(seed)
        steps = torch.randn(z.shape, generator=generator).to(z) * (length / z.shape[-1] ** 0.5)
        return self.onto(z + steps)


class LatentSphere(_Space):
    """Map weights w_i of M fixed unit vectors phi_i to a point z of the hypersphere (Eq. 2).

        z = sum_i w_i phi_i / |sum_i w_i phi_i|,    w = softmax(logits)

    A constant added to all logits of a room changes nothing: `shift_free`. `seed` draws the
    anchors phi_i, which are stored with the model.
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
        """Latents z of rooms; the weights are positive and sum to 1."""
        return F.normalize(logits.softmax(dim=-1) @ self.anchors, dim=-1)

    def onto(self, points: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        return F.normalize(points, dim=-1)

    def nearness(
        self, some: Float[Tensor, "some dimension"], others: Float[Tensor, "others dimension"]
    ) -> Float[Tensor, "some others"]:
        """Larger for nearer pairs: the cosine of the angle between them."""
        return some @ others.T

    def between(
        self,
        start: Float[Tensor, "pairs dimension"],
        end: Float[Tensor, "pairs dimension"],
        along: Float[Tensor, " pairs"],
    ) -> Float[Tensor, "pairs dimension"]:
        """One point a pair of unit vectors, `along` (0 to 1) of the geodesic between them (5.3).

        Raises:
            ValueError: two vectors are opposite, so that no geodesic is the shortest.
        """
        # Not acos of the dot product, which in float32 knows no angle between pi - 3e-4 and pi.
        apart, together = (start - end).norm(dim=-1), (start + end).norm(dim=-1)
        angle = 2 * torch.atan2(apart, together).unsqueeze(-1)
        if bool((angle > torch.pi - 1e-4).any()):
            raise ValueError("The two latents are opposite points; any great circle joins them.")
        t = along.unsqueeze(-1)
        # Where the two all but coincide, sin(angle) vanishes and the chord is the geodesic.
        straight = F.normalize(torch.lerp(start, end, t), dim=-1)
        turned = torch.sin((1 - t) * angle) * start + torch.sin(t * angle) * end
        return torch.where(angle < 1e-3, straight, turned / torch.sin(angle).clamp(min=1e-6))


class LatentCube(_Space):
    """Map one logit a coordinate to a point of a cube around the origin: ablation c1.

    z_i = a * (2 * Phi(logit_i) - 1), Phi the normal distribution function, so that logits from
    N(0, 1) are points spread uniformly over the cube. Its half edge a = sqrt(3 / D_z) makes the
    mean square length of such points 1: what follows sees numbers as large as the sphere's.

    The paper says 'uniform latent space parameterization' and no more; this is our reading.
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
        """Larger for nearer pairs: minus their distance."""
        return -torch.cdist(some, others)

    def between(
        self,
        start: Float[Tensor, "pairs dimension"],
        end: Float[Tensor, "pairs dimension"],
        along: Float[Tensor, " pairs"],
    ) -> Float[Tensor, "pairs dimension"]:
        """One point a pair, on the straight line."""
        return torch.lerp(start, end, along.unsqueeze(-1))


LatentSpace = LatentSphere | LatentCube
