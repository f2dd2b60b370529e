"""Weights in, points on the latent hypersphere out (section 3.1, equation 2)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


class LatentSphere(nn.Module):
    """Map weights of M fixed unit vectors to a point on the unit hypersphere.

    Args:
        anchors: M, the number of fixed vectors phi_i.
        dimension: D_z.
        seed: Draws the anchors; they are stored with the model.
    """

    def __init__(self, anchors: int, dimension: int, seed: int = 0):
        super().__init__()
        self.anchors: Tensor
        generator = torch.Generator().manual_seed(seed)
        # Normalised Gaussians are uniform on the sphere.
        vectors = torch.randn(anchors, dimension, generator=generator)
        self.register_buffer("anchors", F.normalize(vectors, dim=-1))

    def forward(self, logits: Float[Tensor, "rooms anchors"]) -> Float[Tensor, "rooms dimension"]:
        """z = normalise(sum_i w_i phi_i), w = softmax(logits): positive weights that sum to 1."""
        return F.normalize(logits.softmax(dim=-1) @ self.anchors, dim=-1)


def jitter(
    z: Float[Tensor, "rooms dimension"], length: float, seed: int
) -> Float[Tensor, "rooms dimension"]:
    """Move points a random step of about `length` on the sphere; the same seed, the same steps."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.randn(z.shape, generator=generator).to(z) * (length / z.shape[-1] ** 0.5)
    return F.normalize(z + step, dim=-1)


def slerp(
    start: Float[Tensor, " dimension"], end: Float[Tensor, " dimension"], steps: int
) -> Float[Tensor, "steps dimension"]:
    """Points at equal angles along the geodesic between two unit vectors (section 5.3).

    Raises:
        ValueError: the two are opposite, so that no geodesic is the shortest.
    """
    along = torch.linspace(0, 1, steps, dtype=start.dtype, device=start.device)
    return slerp_pairs(start.expand(steps, -1), end.expand(steps, -1), along)


def slerp_pairs(
    start: Float[Tensor, "pairs dimension"],
    end: Float[Tensor, "pairs dimension"],
    along: Float[Tensor, " pairs"],
) -> Float[Tensor, "pairs dimension"]:
    """One point a pair of unit vectors, `along` (0 to 1) of the geodesic between them.

    Raises:
        ValueError: two vectors are opposite, so that no geodesic is the shortest.
    """
    angle = torch.acos((start * end).sum(dim=-1).clamp(-1, 1)).unsqueeze(-1)
    if bool((angle > torch.pi - 1e-4).any()):
        raise ValueError("The two latents are opposite points; any great circle joins them.")
    t = along.unsqueeze(-1)
    # Where the two all but coincide, sin(angle) vanishes and the chord is the geodesic.
    straight = F.normalize(torch.lerp(start, end, t), dim=-1)
    turned = torch.sin((1 - t) * angle) * start + torch.sin(t * angle) * end
    return torch.where(angle < 1e-3, straight, turned / torch.sin(angle).clamp(min=1e-6))
