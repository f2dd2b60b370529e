"""Projected triangles in, soft coverage out, in plain torch: the readable definition.

Slow and differentiable by autograd, in any precision and on any device. The fast backends are
tested against it.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F


def soft_coverage(
    pixels: Float[Tensor, "meshes vertices 2"],
    depths: Float[Tensor, "meshes vertices"],
    faces: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, " meshes"],
    image_size: tuple[int, int],
    sigma_px2: float,
    blur_px2: float,
    near_m: float,
) -> tuple[Float[Tensor, "meshes height width"], Float[Tensor, "meshes height width"]]:
    """Coverage and depth of each mesh, alone: see `sceneprior.silhouettes.render`."""
    height, width = image_size
    rows = torch.arange(height, dtype=pixels.dtype, device=pixels.device) + 0.5
    columns = torch.arange(width, dtype=pixels.dtype, device=pixels.device) + 0.5
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).reshape(-1, 1, 2)
    coverage, depth = [], []
    for mesh in range(len(pixels)):
        corners, z = pixels[mesh][faces], depths[mesh][faces]
        keep = (z > near_m).all(dim=-1) & (_twice_area(corners).abs() > 1e-12) & drawn[mesh]
        soft, nearest = _one_mesh(grid, corners[keep], z[keep], sigma_px2, blur_px2)
        coverage.append(soft.reshape(height, width))
        depth.append(nearest.reshape(height, width))
    return torch.stack(coverage), torch.stack(depth)


def _one_mesh(
    grid: Tensor, corners: Tensor, z: Tensor, sigma: float, blur: float
) -> tuple[Tensor, Tensor]:
    if len(corners) == 0:
        # The sum over no corners is 0, and carries a gradient of 0 instead of none.
        empty = torch.zeros_like(grid[:, 0, 0]) + corners.sum()
        return empty, torch.full_like(empty, float("inf"))
    a, b, c = corners.unbind(dim=1)
    squared = torch.stack(
        [_segment_distance2(grid, *edge) for edge in ((a, b), (b, c), (c, a))]
    ).amin(dim=0)
    weights = torch.stack([_cross(grid, b, c), _cross(grid, c, a), _cross(grid, a, b)], dim=-1)
    weights = weights / _twice_area(corners).unsqueeze(-1)
    inside = (weights > 0).all(dim=-1)
    touched = inside | (squared < blur)
    x = torch.where(inside, squared, -squared) / sigma
    log_missed = torch.where(touched, -F.softplus(x), 0.0).sum(dim=-1)
    clipped = weights.clamp(min=0)
    clipped = clipped / clipped.sum(dim=-1, keepdim=True)
    face_depth = 1 / (clipped / z).sum(dim=-1)
    nearest = torch.where(touched, face_depth, float("inf")).amin(dim=-1)
    return -torch.expm1(log_missed), nearest.detach()


def _segment_distance2(point: Tensor, start: Tensor, end: Tensor) -> Tensor:
    along = end - start
    t = ((point - start) * along).sum(-1) / (along * along).sum(-1).clamp(min=1e-12)
    nearest = start + t.clamp(0, 1).unsqueeze(-1) * along
    return ((point - nearest) ** 2).sum(-1)


def _cross(point: Tensor, start: Tensor, end: Tensor) -> Tensor:
    along, across = end - start, point - start
    return along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]


def _twice_area(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(dim=-2)
    return _cross(c, a, b)


def composite(
    coverage: Float[Tensor, "images objects height width"],
    depth: Float[Tensor, "images objects height width"],
    compositing: str,
) -> Float[Tensor, "images objects height width"]:
    """Visible soft masks from coverages and depths: see `sceneprior.silhouettes.compositing`."""
    order = depth.argsort(dim=1, stable=True)
    alpha = coverage.gather(1, order)
    missed = 1 - alpha
    if compositing == "layered":
        ones = torch.ones_like(missed[:, :1])
        visible = alpha * torch.cat([ones, missed.cumprod(dim=1)[:, :-1]], dim=1)
    else:
        whole = 1 - missed.prod(dim=1, keepdim=True)
        front = torch.zeros_like(alpha)
        front[:, 0] = depth.amin(dim=1) < float("inf")
        visible = whole * front
    return torch.zeros_like(visible).scatter(1, order, visible)
