"""Latents of training rooms in, latents of new rooms out: the law that sampling follows."""

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.errors import InputError

LAWS = ("gaussian", "paper")


def sample_logits(
    trained: Float[Tensor, "rooms anchors"], count: int, seed: int, law: str = "gaussian"
) -> Float[Tensor, "count anchors"]:
    """Draw logits of latent weights.

    Args:
        trained: The training rooms' logits.
        count: How many to draw.
        seed: Same seed, same rooms.
        law: `paper`: N(0, 1), which is where training rooms' logits started, not where they
            ended. `gaussian`: the mean and covariance of the training rooms' logits.

    Raises:
        InputError: an unknown law, or too few rooms to fit one to.
    """
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, trained.shape[1], generator=generator, dtype=torch.float64)
    if law == "paper":
        return noise.to(trained.dtype)
    if law != "gaussian":
        raise InputError(f"No sampling law '{law}'; choose from {', '.join(LAWS)}.")
    if len(trained) < 2:
        raise InputError("The gaussian law needs at least 2 training rooms; use --law paper.")
    # A softmax does not see what is added to all its logits: take that freedom out first.
    logits = trained.double() - trained.double().mean(dim=1, keepdim=True)
    mean = logits.mean(dim=0)
    centred = (logits - mean) / (len(logits) - 1) ** 0.5
    # centred^T centred is the covariance; its square root needs no positive definiteness.
    _, scale, axes = torch.linalg.svd(centred, full_matrices=False)
    return (mean + (noise[:, : len(scale)] * scale) @ axes).to(trained.dtype)
