"""Found boxes in, the same boxes moved onto their masks out: poses alone, no latent."""

from dataclasses import replace

import torch
from torch import Tensor

from sceneprior.geometry.boxes import place
from sceneprior.reconstruction.fit import Fit, ViewLoss, view_loss
from sceneprior.training.method import TrainedPrior
from sceneprior.views import DecodedScenes, SceneViews

STEPS = 100
RATE = 0.01
"""Of Adam: about a centimetre, or a hundredth of a size, a step."""
HOLD = 0.5
"""Weight of staying with the latent's decode. Larger trusts the prior more than the image, which
says little of depth: moving an object by `HOLD_M`, or changing a size by a tenth, costs this."""
HOLD_M = 0.3


def refine(trained: TrainedPrior, views: SceneViews, fit: Fit, steps: int = STEPS) -> Fit:
    """Move and stretch the found boxes, each with its mesh, to agree better with their image.

    What is moved: centre and (logarithm of the) size of every box; its lower side stays on or
    above the floor. What pulls: the fit's own losses with its own matching, and a spring to where
    the latent put the box. An image whose score does not fall keeps what it had.

    Args:
        trained: Of the run.
        views: The images.
        fit: What `fit_latents` found for them.
        steps: Of Adam.
    """
    start = fit.scenes
    canonical = _canonical(start)
    moved = torch.zeros_like(start.centers_m).requires_grad_()
    stretched = torch.zeros_like(start.sizes_m).requires_grad_()
    optimizer = torch.optim.Adam([moved, stretched], lr=RATE)
    real = views.is_object[:, : start.centers_m.shape[1]].unsqueeze(-1)
    for _ in range(steps):
        scenes = _move(start, canonical, moved, stretched)
        loss = view_loss(trained, scenes, views, matches=fit.loss.matches)
        hold = (moved / HOLD_M) ** 2 + (stretched / 0.1) ** 2
        spring = (hold * real).sum(dim=(1, 2)) / real.sum(dim=(1, 2)).clamp(min=1)
        optimizer.zero_grad()
        (loss.total + HOLD * spring).sum().backward()
        optimizer.step()
    with torch.no_grad():
        scenes = _move(start, canonical, moved, stretched)
        loss = view_loss(trained, scenes, views, matches=fit.loss.matches)
    better = loss.score < fit.loss.score
    kept = {
        name: torch.where(better, getattr(loss, name), getattr(fit.loss, name))
        for name in ("total", "score", "mask_iou")
    }
    return replace(
        fit, scenes=_where(better, scenes, start), loss=ViewLoss(**kept, matches=fit.loss.matches)
    )


def _canonical(scenes: DecodedScenes) -> Tensor | None:
    if scenes.vertices_m is None:
        return None
    half = (scenes.sizes_m / 2).unsqueeze(-2).clamp(min=1e-6)
    return (scenes.vertices_m - scenes.centers_m.unsqueeze(-2)) / half


def _move(
    start: DecodedScenes, canonical: Tensor | None, moved: Tensor, stretched: Tensor
) -> DecodedScenes:
    sizes = start.sizes_m * stretched.exp()
    floor = start.centers_m[..., 1] - start.sizes_m[..., 1] / 2 + moved[..., 1]
    y = floor.clamp(min=0) + sizes[..., 1] / 2
    x, _, z = (start.centers_m + moved).unbind(dim=-1)
    centers = torch.stack([x, y, z], dim=-1)
    vertices = None if canonical is None else place(canonical, centers, sizes)
    return replace(start, centers_m=centers, sizes_m=sizes, vertices_m=vertices)


def _where(better: Tensor, moved: DecodedScenes, start: DecodedScenes) -> DecodedScenes:
    def choose(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(better.reshape(-1, *[1] * (one.dim() - 1)), one, other)

    vertices = None
    if moved.vertices_m is not None and start.vertices_m is not None:
        vertices = choose(moved.vertices_m, start.vertices_m)
    return replace(
        start,
        centers_m=choose(moved.centers_m, start.centers_m),
        sizes_m=choose(moved.sizes_m, start.sizes_m),
        vertices_m=vertices,
    )
