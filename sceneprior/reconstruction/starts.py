"""Where fitting begins: images in, the latents of the training rooms that look most alike out."""

import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.generation.sample import sample_latents
from sceneprior.reconstruction.fit import rows_of, view_loss
from sceneprior.training.method import TrainedPrior
from sceneprior.views import DecodedScenes, SceneViews

STARTS = ("nearest", "random")
BATCH = 256


def starting_latents(
    trained: TrainedPrior, views: SceneViews, count: int, kind: str = "nearest", seed: int = 0
) -> Float[Tensor, "images count width"]:
    """Several starts for each image.

    Args:
        trained: Of the run.
        views: One room an image.
        count: Starts an image.
        kind: `nearest`: the training rooms, as decoded, whose layout loss on the image is least.
            `random`: drawn around the training rooms, as new rooms are (the kernel distribution); the same
            for every image.
        seed: Of the random ones.

    Raises:
        InputError: an unknown kind, or more starts than training rooms.
    """
    if kind not in STARTS:
        raise InputError(f"No start is called '{kind}'; choose from {', '.join(STARTS)}.")
    images = len(views.is_object)
    if kind == "random":
        drawn = sample_latents(trained.prior.latent_space, trained.logits, count, seed, "kernel")
        return drawn.expand(images, -1, -1)
    if count > len(trained.logits):
        raise InputError(
            f"{count} nearest training rooms were asked for, but the run has "
            f"{len(trained.logits)}; ask for fewer restarts."
        )
    losses = layout_losses_of_rooms(trained, views)
    return trained.prior.latent_space(trained.logits)[
        losses.topk(count, dim=1, largest=False).indices
    ]


@torch.no_grad()
def layout_losses_of_rooms(
    trained: TrainedPrior, views: SceneViews
) -> Float[Tensor, "images rooms"]:
    """What each decoded training room would cost as the answer to each image, by 2D boxes alone."""
    most = views.is_object.shape[1]
    z = trained.prior.latent_space(trained.logits)
    every = torch.ones(len(z), most, dtype=torch.bool)
    rooms = [
        trained.prior.decode(z[at : at + BATCH], False, every[at : at + BATCH])
        for at in range(0, len(z), BATCH)
    ]
    return torch.stack(
        [
            _of_image(trained, rooms, rows_of(views, torch.tensor([row])))
            for row in range(len(views.is_object))
        ]
    )


def _of_image(trained: TrainedPrior, rooms: list[DecodedScenes], view: SceneViews) -> Tensor:
    scores = []
    for part in rooms:
        repeated = rows_of(view, torch.zeros(len(part.centers_m), dtype=torch.int64))
        scores.append(view_loss(trained, part, repeated, masks=False).score)
    return torch.cat(scores)
