"""The reference implementation of the renderer: visible soft masks of projected meshes, in torch.

It is slow, differentiable by autograd, and runs in any precision on any device. The fast backends
are tested against it.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F


class Topology(NamedTuple):
    """Edges of a mesh.

    `edges`: (edges, 2) vertices, the lower first; `edge_of`: (faces, 3) the edge from each corner
    to the next; `way`: (faces, 3) +1 if the face traverses the edge in this order, else -1.
    """

    edges: np.ndarray
    edge_of: np.ndarray
    way: np.ndarray


def topology_of(faces: np.ndarray) -> Topology:
    """Edges of (faces, 3) triangles; any number of faces may share an edge."""
    return _topology(np.ascontiguousarray(faces, dtype=np.int64).tobytes())


@lru_cache(maxsize=16)
def _topology(data: bytes) -> Topology:
    faces = np.frombuffer(data, dtype=np.int64).reshape(-1, 3)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, edge_of = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    way = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    return Topology(
        edges.astype(np.int32).reshape(-1, 2),
        edge_of.astype(np.int32).reshape(-1, 3),
        way.astype(np.int8).reshape(-1, 3),
    )


MIN_AREA_PX2 = 1e-12
"""Twice the area in px**2 up to which a projected face counts as degenerate and is not drawn."""

PIECE_PX = 4.0
"""Maximum length in pixels of the equal pieces into which an edge is cut. A piece is either wholly
on the outline or not on it."""

ASIDE_PX = 1e-3
"""Distance in pixels between the middle of a piece and a test point beside it. The piece is part of
the outline if no face covers this point."""

SLACK = 1e-6
"""Tolerance on barycentric weights for ids and depths, so that rounding leaves no gap at a pixel
centre on the edge between two faces."""


class Settings(NamedTuple):
    """Drawing settings; see `render_scene`."""

    image_size: tuple[int, int]
    sigma_px2: float
    blur_px2: float
    near_m: float
    mode: str
    compositing: str


class Drawing(NamedTuple):
    """The result of a backend; see `RenderedScene`."""

    masks: Float[Tensor, "images objects height width"]
    front: Int[Tensor, "images height width"]
    depth_m: Float[Tensor, "images height width"]


class Alone(NamedTuple):
    """One mesh, drawn without occlusion by others."""

    coverage: Float[Tensor, "*image"]
    order_m: Float[Tensor, "*image"]
    """Depth for ordering the masks, at pixels that the mesh or its blur touches; else infinite."""
    depth_m: Float[Tensor, "*image"]
    """Depth at pixels whose centre lies in a face; else infinite."""


def draw(
    pixels: Float[Tensor, "images objects vertices 2"],
    depths: Float[Tensor, "images objects vertices"],
    faces: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, "images objects"],
    settings: Settings,
) -> Drawing:
    """Draw every object in its image: masks, front-most object and its depth."""
    images, objects = pixels.shape[:2]
    flat = zip(pixels.flatten(0, 1), depths.flatten(0, 1), drawn.flatten(), strict=True)
    alone = [draw_alone(*mesh[:2], faces, mesh[2], settings) for mesh in flat]
    shape = (images, objects, *settings.image_size)
    if not alone:
        coverage = order = depth = pixels.new_zeros(shape) + pixels.sum()
    else:
        coverage, order, depth = (torch.stack(x).reshape(shape) for x in zip(*alone, strict=True))
    masks = composite(coverage, order, settings.compositing)
    if objects == 0:
        depth = pixels.new_full((images, 1, *settings.image_size), float("inf"))
    nearest, front = depth.detach().min(dim=1)
    return Drawing(masks, torch.where(nearest < float("inf"), front, -1).int(), nearest)


def draw_alone(
    pixels: Float[Tensor, "vertices 2"],
    depths: Float[Tensor, " vertices"],
    faces: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, ""],
    settings: Settings,
) -> Alone:
    """Draw one mesh in one view, without occlusion."""
    height, width = settings.image_size
    rows = torch.arange(height, dtype=pixels.dtype, device=pixels.device) + 0.5
    columns = torch.arange(width, dtype=pixels.dtype, device=pixels.device) + 0.5
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).reshape(-1, 1, 2)
    corners, z = pixels[faces], depths[faces]
    keep = (z > settings.near_m).all(-1) & (_twice_area(corners).abs() > MIN_AREA_PX2) & drawn
    if not keep.any():
        # Adding an empty sum keeps the result in the graph, with a gradient of 0 instead of none.
        empty = torch.zeros_like(grid[:, 0, 0]) + corners[:0].sum()
        nowhere = torch.full_like(empty, float("inf"))
        alone: tuple[Tensor, ...] = (empty, nowhere, nowhere)
    elif settings.mode == "exact":
        alone = _faces(grid, corners[keep], z[keep], settings)
    else:
        alone = _outline(grid, pixels, depths, faces, keep, settings)
    return Alone(*(x.reshape(height, width) for x in alone))


def _faces(grid: Tensor, corners: Tensor, z: Tensor, settings: Settings) -> tuple[Tensor, ...]:
    """The exact mode: coverage by all faces (see `render_scene`), order depth, and depth."""
    a, b, c = corners.unbind(dim=1)
    squared = torch.stack(
        [_segment_distance2(grid, *edge)[0] for edge in ((a, b), (b, c), (c, a))]
    ).amin(dim=0)
    weights = _weights(grid, corners)
    inside = (weights > 0).all(dim=-1)
    touched = inside | (squared < settings.blur_px2)
    x = torch.where(inside, squared, -squared) / settings.sigma_px2
    log_missed = torch.where(touched, -F.softplus(x), 0.0).sum(dim=-1)
    clipped = weights.detach().clamp(min=0)
    face_depth = clipped.sum(dim=-1) / (clipped / z.detach()).sum(dim=-1)
    contained = (weights > -SLACK).all(dim=-1)
    depth = torch.where(contained, face_depth, float("inf")).amin(dim=-1)
    soft_depth = torch.where(touched, face_depth, float("inf")).amin(dim=-1)
    return -torch.expm1(log_missed), torch.where(depth < float("inf"), depth, soft_depth), depth


def _outline(
    grid: Tensor, pixels: Tensor, depths: Tensor, faces: Tensor, keep: Tensor, settings: Settings
) -> tuple[Tensor, ...]:
    """The fast mode: coverage by the mesh's outline, order depth, and depth."""
    corners, z = pixels[faces[keep]], depths[faces[keep]].detach()
    weights = _weights(grid, corners.detach())
    contained = (weights > -SLACK).all(dim=-1)
    clipped = weights.clamp(min=0)
    face_depth = clipped.sum(dim=-1) / (clipped / z).sum(dim=-1)
    depth = torch.where(contained, face_depth, float("inf")).amin(dim=-1)
    inside = contained.any(dim=-1)
    ends, spans = _outline_pieces(pixels.detach(), faces, keep, settings)
    if len(ends) == 0:
        covered = inside.to(pixels.dtype) + corners[:0].sum()
        return covered, depth, depth
    start, end = pixels[ends[:, 0]], pixels[ends[:, 1]]
    squared, share = _segment_distance2(grid, start, end, spans)
    squared, nearest = squared.min(dim=-1)
    share = share.gather(-1, nearest.unsqueeze(-1)).squeeze(-1).detach()
    on_outline = squared < settings.blur_px2
    x = torch.where(inside, squared, -squared) / settings.sigma_px2
    coverage = torch.where(on_outline, torch.sigmoid(x), inside.to(x.dtype))
    z0, z1 = depths.detach()[ends[nearest]].unbind(dim=-1)
    soft_depth = 1 / ((1 - share) / z0 + share / z1)
    soft_depth = torch.where(on_outline, soft_depth, float("inf"))
    return coverage, torch.where(inside, depth, soft_depth), depth


def _outline_pieces(
    pixels: Tensor, faces: Tensor, keep: Tensor, settings: Settings
) -> tuple[Int[Tensor, "pieces 2"], Float[Tensor, "2 pieces"]]:
    """The pieces of the outline near the image: the vertices of their edges, and the span [t0, t1]
    of each piece on its edge."""
    mesh = topology_of(faces.cpu().numpy())
    corners = pixels[faces]
    side = torch.sign(_twice_area(corners)).long() * keep
    # The number of faces to the left of each edge in the image, minus those to its right.
    layers = torch.zeros(len(mesh.edges), dtype=torch.long, device=pixels.device)
    way = torch.from_numpy(mesh.way).to(side)
    edge_of = torch.from_numpy(mesh.edge_of).long().to(side.device)
    layers = layers.index_add(0, edge_of.flatten(), (side[:, None] * way).flatten())
    ends, spans = [torch.empty(0, 2).to(faces)], [torch.empty(0, 2).to(pixels)]
    size = torch.tensor(settings.image_size[::-1]).to(pixels)
    reach = settings.blur_px2**0.5 + PIECE_PX
    for e in layers.nonzero().flatten().tolist():
        a, b = mesh.edges[e].tolist()
        along = pixels[b] - pixels[a]
        length = float(along.norm())
        away = torch.stack([along[1], -along[0]]) / length * (1 if layers[e] > 0 else -1)
        count = max(int(-(-length // PIECE_PX)), 1)
        t0, t1 = (torch.arange(count).to(pixels) + k for k in (0, 1))
        middle = pixels[a] + ((t0 + t1) / (2 * count)).unsqueeze(-1) * along
        near = ((middle > -reach) & (middle < size + reach)).all(dim=-1)
        beside = (middle + ASIDE_PX * away)[near].unsqueeze(1)
        free = ~(_weights(beside, corners[keep]) > 0).all(dim=-1).any(dim=-1)
        spans.append(torch.stack([t0, t1], dim=-1)[near][free] / count)
        ends.append(torch.tensor([[a, b]]).to(faces).expand(len(spans[-1]), -1))
    return torch.cat(ends), torch.cat(spans).T


def _segment_distance2(
    point: Tensor, start: Tensor, end: Tensor, span: Tensor | tuple[int, int] = (0, 1)
) -> tuple[Tensor, Tensor]:
    """Squared distance to the part `span` of a segment, and the parameter of the nearest point."""
    along = end - start
    t = ((point - start) * along).sum(-1) / (along * along).sum(-1).clamp(min=MIN_AREA_PX2)
    t = torch.minimum(
        torch.maximum(t, torch.as_tensor(span[0]).to(t)), torch.as_tensor(span[1]).to(t)
    )
    nearest = start + t.unsqueeze(-1) * along
    return ((point - nearest) ** 2).sum(-1), t


def _weights(point: Tensor, corners: Tensor) -> Tensor:
    """Barycentric weights of points in triangles of either winding."""
    a, b, c = corners.unbind(dim=-2)
    sides = [_cross(point, b, c), _cross(point, c, a), _cross(point, a, b)]
    return torch.stack(sides, dim=-1) / _twice_area(corners).unsqueeze(-1)


def _cross(point: Tensor, start: Tensor, end: Tensor) -> Tensor:
    along, across = end - start, point - start
    return along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]


def _twice_area(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(dim=-2)
    return _cross(c, a, b)


def composite(
    coverage: Float[Tensor, "images objects height width"],
    order_m: Float[Tensor, "images objects height width"],
    compositing: str,
) -> Float[Tensor, "images objects height width"]:
    """Visible soft masks from coverages and depths; see `cpu.backend`."""
    if compositing == "alone" or coverage.shape[1] == 0:
        return coverage
    sequence = order_m.argsort(dim=1, stable=True)
    alpha = coverage.gather(1, sequence)
    missed = 1 - alpha
    if compositing == "layered":
        ones = torch.ones_like(missed[:, :1])
        visible = alpha * torch.cat([ones, missed.cumprod(dim=1)[:, :-1]], dim=1)
    else:
        whole = 1 - missed.prod(dim=1, keepdim=True)
        front = torch.zeros_like(alpha)
        front[:, 0] = order_m.amin(dim=1) < float("inf")
        visible = whole * front
    return torch.zeros_like(visible).scatter(1, sequence, visible)
