"""The fast mode on CUDA: each mesh's outline is extracted once, and only the outline is soft.

`cpu.outline` defines the result. Here, the candidate edges of all meshes are listed together and
cut into pieces, pieces with a face beyond them are discarded, and each tile iterates over the
pieces of its mesh. The host synchronises twice, for the numbers of edges and of pieces. Decisions
(areas, crossings, whether a pixel centre is inside) are computed in float64, at twice the cost of
float32 on an H200; distances near the image are in the precision of the input.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from sceneprior.render.silhouettes.cuda import outline_kernels as kernels
from sceneprior.render.silhouettes.cuda.faces import sum_by_vertex
from sceneprior.render.silhouettes.cuda.windows import Windows, launch, reach_of
from sceneprior.render.silhouettes.reference import ASIDE_PX, PIECE_PX, Settings, topology_of


class Edges(NamedTuple):
    """Edges of a mesh; the faces at edge e are faces[first_faces[e] : first_faces[e + 1]]."""

    ends: Tensor
    """(edges, 2) vertices, the lower first."""

    first_faces: Tensor
    faces: Tensor
    ways: Tensor
    """+1 if the face traverses the edge from its first to its second vertex, else -1."""


class _Pieces(NamedTuple):
    """Straight pieces of edges, sorted by mesh."""

    shapes: Tensor
    """(6, pieces): x and y of both ends in pixels, and 1 / depth at both."""

    spans: Tensor
    """(2, pieces): start and end on the edge, from 0 at its first vertex to 1 at its second."""

    vertices: Tensor
    """(pieces, 2): vertices of the edge, numbered across all meshes."""

    meshes: Tensor
    clear: Tensor
    """1 for pieces of the outline, which have no face beyond them, else 0."""


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def edges_of(faces: Tensor) -> Edges:
    """Edges of a mesh, on its device; cached until `faces` is modified."""
    if faces.is_inference():  # an inference tensor has no version counter
        return _read_edges(faces)
    version, edges = _known.get(faces, (None, None))
    if version != faces._version:
        version, edges = faces._version, _read_edges(faces)
        _known[faces] = version, edges
    return edges


def _read_edges(faces: Tensor) -> Edges:
    ends, edge_of, way = (torch.from_numpy(part) for part in topology_of(faces.cpu().numpy()))
    owners, places = edge_of.flatten().sort(stable=True)
    first = torch.searchsorted(owners, torch.arange(len(ends) + 1, dtype=owners.dtype))
    parts = (ends, first, places // 3, way.flatten()[places])
    return Edges(*(part.int().to(faces.device) for part in parts))


def cover(
    pixels: Tensor,
    depths: Tensor,
    faces: Tensor,
    windows: Windows,
    settings: Settings,
    edges: Edges,
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """1 - coverage and the order value at all pixels of the windows, and the inputs saved for
    `cover_backward`."""
    meshes, vertices, tiles = len(windows.places), pixels.shape[2], len(windows.tile_meshes)
    layers = torch.empty(meshes, len(edges.ends), dtype=torch.int32, device=pixels.device)
    programs = meshes * -(-len(edges.ends) // kernels.EDGES.value)
    launch(
        kernels.sum_layers, programs, pixels, depths, faces, windows.places,
        edges.first_faces, edges.faces, edges.ways, layers, vertices, len(edges.ends),
        settings.near_m, num_warps=4, enable_fp_fusion=False,
    )  # fmt: skip
    nearness = depths.double().reciprocal()
    pieces = _cut_edges(pixels, nearness, edges.ends, layers, settings)
    missed = pixels.new_empty(tiles * kernels.TILE.value**2)
    order = torch.empty_like(missed)
    nearest = torch.empty_like(missed, dtype=torch.int32)
    launch(
        kernels.trace_tiles, tiles, pixels, nearness, faces, *windows, pieces.shapes, pieces.clear,
        _firsts(pieces.meshes, meshes), missed, order, nearest, vertices,
        windows.block_bounds.shape[-1], len(pieces.meshes), settings.sigma_px2,
        settings.blur_px2, reach_of(settings), num_warps=1,
    )  # fmt: skip
    return missed, order, (nearest, *pieces)


def _cut_edges(
    pixels: Tensor, nearness: Tensor, ends: Tensor, layers: Tensor, settings: Settings
) -> _Pieces:
    """Pieces, near the image, of all edges across which the number of faces changes."""
    meshes, edges = layers.nonzero().unbind(dim=1)
    layers = layers[meshes, edges]
    vertices = ends.long()[edges] + (meshes * pixels.shape[2]).unsqueeze(1)
    start, end = pixels.reshape(-1, 2)[vertices].double().unbind(dim=1)
    line, spans = _cut_lines(start, end, settings)
    along, side = (end - start)[line], layers[line].sign()
    # Towards the side with fewer faces: the right side, (y, -x), for positive layers.
    aside = torch.stack([along[:, 1], -along[:, 0]], dim=1) * side.unsqueeze(1)
    aside *= ASIDE_PX / along.norm(dim=1, keepdim=True)
    beside = start[line] + spans.mean(dim=0).unsqueeze(1) * along + aside
    clear = torch.empty(len(line), dtype=torch.uint8, device=pixels.device)
    launch(
        kernels.certify_pieces, -(-len(line) // kernels.PIECES.value), beside.T.contiguous(),
        meshes[line].int(), torch.cat([start, end], dim=1).T.contiguous(), layers,
        _firsts(meshes, pixels.shape[0] * pixels.shape[1]), clear, len(line), len(start),
        num_warps=4,
    )  # fmt: skip
    near0, near1 = nearness.flatten()[vertices[line]].unbind(dim=1)
    shapes = [(start[line] + t.unsqueeze(1) * along).T for t in spans]
    shapes += [torch.stack([(1 - t) * near0 + t * near1 for t in spans])]
    shape, spans = torch.cat(shapes).to(pixels.dtype), spans.to(pixels.dtype).contiguous()
    return _Pieces(shape, spans, vertices[line], meshes[line].int(), clear)


def _cut_lines(start: Tensor, end: Tensor, settings: Settings) -> tuple[Tensor, Tensor]:
    """Line and span of each piece of at most PIECE_PX near the image."""
    along = end - start
    count = (along.norm(dim=1) / PIECE_PX).ceil()
    low, high, reach = torch.zeros_like(count), torch.ones_like(count), reach_of(settings)
    for axis, size in enumerate(reversed(settings.image_size)):
        # A line without extent along an axis divides by 0: infinities give the right result, and
        # NaN leaves the line out.
        t = torch.stack([-reach - start[:, axis], size + reach - start[:, axis]]) / along[:, axis]
        low, high = torch.maximum(low, t.amin(dim=0)), torch.minimum(high, t.amax(dim=0))
    near = low < high
    first = torch.where(near, (low * count).floor(), 0.0)
    number = (torch.where(near, (high * count).ceil(), 0.0) - first).long()
    last = number.cumsum(dim=0)
    every = torch.arange(len(number), device=number.device)
    line = every.repeat_interleave(number, output_size=int(last[-1]) if len(last) else 0)
    place = torch.arange(len(line), device=line.device) - (last - number)[line] + first[line]
    return line, torch.stack([place, place + 1]) / count[line]


def _firsts(meshes: Tensor, count: int) -> Tensor:
    """The first index of each mesh in a list sorted by mesh, and the length of the list."""
    every = torch.arange(count + 1, dtype=meshes.dtype, device=meshes.device)
    return torch.searchsorted(meshes.contiguous(), every).int()


def cover_backward(
    pixels: Tensor,
    seen: tuple[Tensor, Tensor],
    settings: Settings,
    missed: Tensor,
    order: Tensor,
    traced: list[Tensor],
    upstream: Tensor,
) -> Tensor:
    """dL/dpixels from -dL/dlog(missed); a pixel contributes to the ends of its nearest edge."""
    nearest, *rest = traced
    pieces = _Pieces(*rest)
    count = len(pieces.meshes)
    by_end = pixels.new_empty(count, 2, 2)
    launch(
        kernels.end_gradients, -(-count // kernels.PER_PROGRAM.value), pieces.shapes, pieces.spans,
        pieces.meshes, pieces.clear, *seen, missed, order, nearest, upstream, by_end, count,
        settings.sigma_px2, reach_of(settings), num_warps=1,
    )  # fmt: skip
    # All meshes are summed as one, since their vertices are numbered consecutively.
    everywhere = torch.ones(1, 4, dtype=torch.int32, device=pixels.device)
    return sum_by_vertex(by_end, pieces.vertices.flatten(), everywhere, pixels)
