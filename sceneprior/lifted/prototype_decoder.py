"""The look decoder: maps an object's feature to a prototype, made of parts, in one of its poses.

It replaces the paper's deformed template; such shapes may have legs, holes and thin tops.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn

from sceneprior.core.parts import (
    KIND_NAMES,
    MOST_CORNERS,
    MOST_PARTS,
    SQUARE,
    Parts,
    Stretch,
    filled_cells,
    stretched_parts,
    surface_of_parts,
    whole_box,
)
from sceneprior.core.scene import Mesh, Solid
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.prototypes import (
    POSES,
    Prototypes,
    embed_posed,
    pose_rotation,
    turn_of,
    turned_extents,
)
from sceneprior.lifted.shape_morphing import appearances_of, blend_parts, matched_parts
from sceneprior.paper.decoders import Places, ShapeModule, ShapeModuleConfig

KEPT = 512
"""Number of looks, and of matched pairs of looks, that are kept for later rooms: about 6 MB."""


class PrototypeConfig(ShapeModuleConfig):
    """Shapes in parts, chosen among prototypes lifted from the training rooms' masks."""

    prototypes: int = Field(1024, ge=1)
    """Maximum number of prototype shapes, which represent the shapes of all objects. Fewer are
    coarser, and more often repeated."""
    codes: int = Field(128, ge=1)
    """Dimension of the shape code; similar looks (`lifted/prototypes.py`) have nearby codes. A
    larger one can distinguish more looks."""
    width: int = Field(128, ge=8)
    """Hidden width of the MLP that predicts the code."""
    cells: int = Field(32, ge=8, le=64)
    """Cells along each axis of the grids on which visual hulls are carved and looks compared. More
    are finer; lifting's time and memory grow with their cube."""
    margin: float = Field(1.1, ge=1, le=2)
    """Extent of these grids, relative to the object's box; at 1, hulls are cut off at the box."""

    def build(self, features: int) -> "PrototypeDecoder":
        """The module for object features of width `features`, freshly initialised."""
        return PrototypeDecoder(features, self)


@dataclass(frozen=True)
class PosedScenes(DecodedScenes):
    """Decoded scenes whose shapes are prototypes in poses."""

    shape_codes: Float[Tensor, "rooms objects codes"] | None = None
    """Predicted shape codes; None if shapes are deformed meshes."""
    looks: Int[Tensor, "rooms objects"] | None = None
    """Look of each object, that is, its prototype and pose as one index: prototype * 8 + pose
    (`lifted/prototypes.py`). None before the shape decoder has run, and if it predicts meshes."""
    next_looks: Int[Tensor, "rooms objects"] | None = None
    """Look into which each object changes along a path; None if the room is not on a path."""
    shares: Float[Tensor, "rooms objects"] | None = None
    """Share of `next_looks` in each object's shape, at least 0 and less than 1."""

    @classmethod
    def of(cls, scenes: DecodedScenes, **shapes: Any) -> "PosedScenes":
        """Decoded scenes with these shapes."""
        return cls(**{each.name: getattr(scenes, each.name) for each in fields(scenes)} | shapes)


class Posed(NamedTuple):
    """The shape of a look, in the frame of its box, which spans [-0.5, 0.5] along each axis."""

    parts: Parts
    surface: Mesh
    stretch: Stretch
    """Stretches the prototype, in this pose, to other extents."""


class PrototypeDecoder(ShapeModule):
    """An MLP on MLP1's output predicts a code; the object gets the look whose code is nearest.

    Looks are defined in `lifted/prototypes.py`: a prototype shape in one of its poses. Squared
    distances between the codes of looks approximate the number of cells in which their grids
    differ. The code is trained with a squared error, so a similar look costs little, and the
    decoded shape is always a sharp prototype rather than a mean of several.

    Prototypes and the codes of their looks are buffers, not parameters: they are computed from the
    training data before the first step (`set_prototypes`) and saved in checkpoints.
    """

    faces = None
    unknown: ClassVar[int] = -1
    """Class of unused prototypes, and kind of unused parts."""

    def __init__(self, features: int, config: PrototypeConfig):
        super().__init__()
        width, most = config.width, config.prototypes
        self.cells, self.margin = config.cells, config.margin
        self.mlp = nn.Sequential(
            nn.ReLU(),
            nn.Linear(features, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, config.codes),
        )  # fmt: skip
        self.part_kind: Tensor
        self.part_mirrored: Tensor
        self.part_ends: Tensor
        self.outlines: Tensor
        self.filled: Tensor
        self.sizes_m: Tensor
        self.object_class: Tensor
        self.common: Tensor
        self.look_codes: Tensor
        self.spread: Tensor
        slots = (most, MOST_PARTS)
        self.register_buffer("part_kind", torch.full(slots, self.unknown, dtype=torch.int8))
        self.register_buffer("part_mirrored", torch.zeros(slots, dtype=torch.int8))
        self.register_buffer("part_ends", torch.zeros(*slots, 3, 2))
        self.register_buffer("outlines", torch.zeros(most, MOST_CORNERS, 2))
        self.register_buffer("filled", torch.ones(most))
        self.register_buffer("sizes_m", torch.ones(most, 3))
        self.register_buffer("object_class", torch.full((most,), self.unknown))
        self.register_buffer("common", torch.zeros(most, dtype=torch.bool))
        self.register_buffer("look_codes", torch.zeros(most * POSES, config.codes))
        self.register_buffer("spread", torch.ones(()))
        self._shapes: dict[int, Posed] = {}
        self._matched: dict[tuple[int, int], tuple[Parts, Parts]] = {}

    def set_prototypes(self, prototypes: Prototypes) -> None:
        """Set the prototypes whose looks are decoded."""
        count = len(prototypes.parts)
        for row, parts in enumerate(prototypes.parts):
            used = slice(len(parts.kind))
            self.part_kind[row, used] = torch.from_numpy(parts.kind)
            self.part_mirrored[row, used] = torch.from_numpy(parts.mirrored)
            self.part_ends[row, used] = torch.from_numpy(parts.ends).float()
            self.outlines[row] = _padded(parts.outline)
        filled = prototypes.grids.sum(axis=(1, 2, 3)).clip(min=1)
        self.filled[:count] = torch.from_numpy(filled.astype(np.float32))
        self.sizes_m[:count] = torch.from_numpy(prototypes.sizes_m)
        self.object_class[:count] = torch.from_numpy(prototypes.object_class)
        self.common[:count] = torch.from_numpy(prototypes.common)
        codes = embed_posed(prototypes.grids, self.look_codes.shape[1])
        self.look_codes[: count * POSES] = torch.from_numpy(codes)
        self.spread.fill_(float(np.sqrt((codes**2).mean())) or 1.0)

    @property
    def prototypes(self) -> Prototypes:
        """The prototypes set by `set_prototypes`."""
        sizes_m, labels, common = (
            part[self.known].cpu().numpy()
            for part in (self.sizes_m, self.object_class, self.common)
        )
        parts = tuple(map(self.parts, self.known))
        grids = np.zeros((len(parts), *(self.cells,) * 3), bool)
        for row, each in enumerate(parts):
            grids[row] = filled_cells(each, self.cells, self.margin)
        return Prototypes(parts, grids, sizes_m.astype(np.float64), labels, common)

    def parts(self, prototype: int) -> Parts:
        """The parts of a prototype; a single box for an unused prototype."""
        used = self.part_kind[prototype] != self.unknown
        if not used.any():
            return whole_box()
        kind, mirrored, ends = (
            part[prototype, used].cpu().numpy()
            for part in (self.part_kind, self.part_mirrored, self.part_ends)
        )
        corners = self.outlines[prototype].double().cpu().numpy()
        new = (corners != np.roll(corners, 1, axis=0)).any(axis=1)  # the last corner is repeated
        return Parts(
            kind.astype(np.int64), mirrored.astype(np.int64), ends.astype(np.float64), corners[new]
        )

    def forward(
        self, features: Float[Tensor, "*objects features"]
    ) -> Float[Tensor, "*objects codes"]:
        """Predicted shape codes of objects."""
        codes: Tensor = self.mlp(features) * self.spread
        return codes

    def add_shapes(
        self,
        scenes: DecodedScenes,
        features: Float[Tensor, "rooms objects features"],
        with_shape: bool | Places,
        wanted: Bool[Tensor, "rooms wanted"] | None,
    ) -> DecodedScenes:
        """The scenes with shape codes of all objects and, with `with_shape`, the looks nearest to
        them."""
        codes = self(features).to(scenes.centers_m.dtype)
        looks = None if with_shape is False else self.looks(codes)
        return PosedScenes.of(scenes, shape_codes=codes, looks=looks)

    def along_path(
        self,
        rooms: DecodedScenes,
        places: Float[Tensor, " rooms"],
        path: DecodedScenes,
        kept: Bool[Tensor, "steps objects"],
    ) -> DecodedScenes:
        if not (isinstance(rooms, PosedScenes) and isinstance(path, PosedScenes)):
            return rooms
        if rooms.looks is None or path.looks is None:
            return rooms
        looks, next_looks = rooms.looks.clone(), rooms.looks.clone()
        shares = torch.zeros_like(looks, dtype=torch.float64)
        for item in range(looks.shape[1]):
            shown = appearances_of(path.looks[:, item].cpu().numpy(), kept[:, item].cpu().numpy())
            for room, place in enumerate(places.tolist() if shown else []):
                nearest = min(shown, key=lambda each: each.apart(place))
                looks[room, item], next_looks[room, item], shares[room, item] = nearest.at(place)
        return replace(rooms, looks=looks, next_looks=next_looks, shares=shares)

    def mesh_of(self, decoded: DecodedScenes, room: int, item: int) -> Mesh | None:
        shape = self._shape_of(decoded, room, item)
        return None if shape is None else self.mesh(shape, _box_m(decoded, room, item))

    def solids_of(self, decoded: DecodedScenes, room: int, item: int) -> tuple[Solid, ...]:
        shape = self._shape_of(decoded, room, item)
        return () if shape is None else self.solids(shape, _box_m(decoded, room, item))

    def _shape_of(self, decoded: DecodedScenes, room: int, item: int) -> int | Parts | None:
        """The look of a prediction or, between two looks of a path, the blended parts in the frame
        of its box; None if no looks are decoded."""
        if not isinstance(decoded, PosedScenes) or decoded.looks is None:
            return None
        look = int(decoded.looks[room, item])
        if decoded.shares is None or not (share := float(decoded.shares[room, item])):
            return look
        assert decoded.next_looks is not None
        size_m = _box_m(decoded, room, item)[3:]
        pair = look, int(decoded.next_looks[room, item])
        own = [self._posed(each) for each in pair]
        if (matched := self._matched.get(pair)) is None:
            matched = matched_parts(*(each.parts for each in own))
            _keep(self._matched, pair, matched)
        here, there = (
            stretched_parts(parts, each.stretch, size_m)
            for parts, each in zip(matched, own, strict=True)
        )
        return blend_parts(here, there, share)

    def mesh(self, shape: int | Parts, box_m: Float[np.ndarray, "6"]) -> Mesh:
        """The mesh of a look, stretched into a box (centre, full extents), or of parts in the frame
        of that box."""
        if isinstance(shape, Parts):
            vertices, faces = surface_of_parts(shape)
        else:
            own = self._posed(shape)
            vertices = own.stretch.moved(own.surface.vertices_m, box_m[3:])
            faces = own.surface.faces
        return Mesh(vertices * box_m[3:] + box_m[:3], faces)

    def solids(self, shape: int | Parts, box_m: Float[np.ndarray, "6"]) -> tuple[Solid, ...]:
        """The solids of a look or of parts in a box (centre, full extents), as `mesh` places its
        surface."""
        if not isinstance(shape, Parts):
            own = self._posed(shape)
            shape = stretched_parts(own.parts, own.stretch, box_m[3:])
        placed_m = shape.ends.swapaxes(1, 2) * box_m[3:] + box_m[:3]
        # A part in the middle is its own mirror image, up to rounding.
        _, first = np.unique(placed_m.round(5), axis=0, return_index=True)
        low_m, high_m = placed_m.swapaxes(0, 1).tolist()
        return tuple(
            Solid(KIND_NAMES[shape.kind[row]], tuple(low_m[row]), tuple(high_m[row]))
            for row in sorted(first)
        )

    def _posed(self, look: int) -> Posed:
        """The shape of a look, which is kept (`KEPT`)."""
        if (shape := self._shapes.get(look)) is None:
            prototype, pose = divmod(look, POSES)
            parts = self.parts(prototype)
            surface = self._posed(look - pose).surface if pose else Mesh(*surface_of_parts(parts))
            vertices = surface.vertices_m @ pose_rotation(pose).T
            # Mirroring inverts the faces: reverse their corners.
            faces = surface.faces[:, ::-1].copy() if turn_of(pose)[1] else surface.faces
            size_m = self.sizes_m[prototype].double().cpu().numpy()
            posed = _posed_parts(parts, pose)
            stretch = Stretch.of(posed, turned_extents(size_m[None], pose)[0])
            shape = Posed(posed, Mesh(vertices, faces), stretch)
            _keep(self._shapes, look, shape)
        return shape

    def looks(self, codes: Float[Tensor, "*objects codes"]) -> Int[Tensor, "*objects"]:
        """The look whose code is nearest, in a tie the first; 0 before prototypes are set."""
        known = (self.object_class != self.unknown).repeat_interleave(POSES).nonzero()[:, 0]
        if not len(known):
            return torch.zeros(codes.shape[:-1], dtype=torch.int64, device=codes.device)
        # Only looks in use are compared: most slots are unused, and comparing with all takes as
        # long as decoding.
        apart = torch.cdist(codes.flatten(0, -2), self.look_codes[known].to(codes))
        return known[apart.argmin(dim=-1)].unflatten(0, codes.shape[:-1])

    def targets(
        self, looks: Int[Tensor, "*objects"]
    ) -> tuple[Float[Tensor, "*objects codes"], Float[Tensor, "*objects"]]:
        """Codes of looks, and the number of cells that each fills."""
        return self.look_codes[looks], self.filled[looks // POSES]

    @property
    def known(self) -> list[int]:
        """Indices of the prototypes in use."""
        return (self.object_class != self.unknown).nonzero()[:, 0].tolist()


def _keep(kept: dict[Any, Any], key: Any, value: Any) -> None:
    if len(kept) >= KEPT:
        kept.clear()
    kept[key] = value


def _box_m(decoded: DecodedScenes, room: int, item: int) -> Float[np.ndarray, "6"]:
    box_m = torch.cat((decoded.centers_m[room, item], decoded.sizes_m[room, item]))
    return np.asarray(box_m.double().cpu().numpy())


def _padded(outline: Float[np.ndarray, "corners 2"]) -> Float[Tensor, "most 2"]:
    """An outline of `MOST_CORNERS` corners, its last one repeated."""
    missing = MOST_CORNERS - len(outline)
    return torch.from_numpy(np.pad(outline, ((0, missing), (0, 0)), mode="edge")).float()


def _posed_parts(parts: Parts, pose: int) -> Parts:
    """The parts of a prototype in a pose, with mirror images as separate parts."""
    across = pose_rotation(pose)
    kind, ends = zip(*parts.solids(), strict=True)
    outline = parts.outline
    if not np.array_equal(outline, SQUARE):
        outline = outline @ across[::2, ::2].T
        outline = outline[::-1] if turn_of(pose)[1] else outline  # stays counter-clockwise
    return Parts(
        np.array(kind), np.zeros(len(kind), np.int64), np.sort(across @ np.stack(ends)), outline
    )
