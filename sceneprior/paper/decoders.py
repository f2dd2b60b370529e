"""The decoders of an object's feature (section 3.3): class, box and completeness (Eq. 5), bevels,
and shape, a template mesh deformed by a point-wise MLP (Eq. 6)."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.classes import VOID
from sceneprior.core.proxies import icosphere, place, to_cube
from sceneprior.core.scene import Mesh, Solid
from sceneprior.core.settings import Section
from sceneprior.core.views import DecodedScenes

Places = tuple[Int[Tensor, " places"], Int[Tensor, " places"]]
"""Rooms and numbers of predictions, as indices."""
INITIAL_SIZE_M = 0.7
"""Edge of every box before training."""


def mlp(*layers: nn.Module, slope: float = 0.0) -> nn.Sequential:
    """The layers in sequence, with a ReLU between them, or a leaky ReLU if `slope` is not 0."""
    between = nn.LeakyReLU(slope) if slope else nn.ReLU()
    return nn.Sequential(*[part for layer in layers for part in (layer, between)][:-1])


class JointHead(nn.Sequential):
    """MLP2 of Eq. 5: one MLP for class logits, x, y, z, width, height, depth and completeness."""

    def __init__(self, hidden: int, classes: int):
        super().__init__(
            nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, classes + 7)
        )

    def forward(  # type: ignore[override]
        self,
        shared: Float[Tensor, "rooms objects hidden"],
        features: Float[Tensor, "rooms objects width"],
    ) -> Float[Tensor, "rooms objects outputs"]:
        """All outputs, from MLP1's output `shared`; x_k, `features`, is not read."""
        return super().forward(shared)

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output of the last layer, in the order of the outputs."""
        last: nn.Linear = self[-1]  # type: ignore[assignment]
        return list(zip(last.weight, last.bias, strict=True))


class SeparateHeads(nn.Module):
    """The released code's replacement of MLP2: a linear layer for the classes and an MLP for each
    coordinate on MLP1's output without a ReLU, and an MLP for completeness on x_k.

    `hidden` is the size of MLP1's output and of each coordinate's hidden layer; `width` is D_z.
    """

    def __init__(self, width: int, hidden: int, classes: int):
        super().__init__()
        self.classes = nn.Linear(hidden, classes)
        self.coordinates = nn.ModuleList(
            mlp(nn.Linear(hidden, hidden), nn.Linear(hidden, 1))
            for _ in ("x", "y", "z", "width", "height", "depth")
        )
        self.completeness = mlp(nn.Linear(width, width // 4), nn.Linear(width // 4, 1))

    def forward(
        self,
        shared: Float[Tensor, "rooms objects hidden"],
        features: Float[Tensor, "rooms objects width"],
    ) -> Float[Tensor, "rooms objects outputs"]:
        """Class logits, x, y, z, width, height, depth and completeness, in the order of
        `JointHead`, from MLP1's output `shared` and x_k, `features`."""
        parts = [self.classes(shared), *(head(shared) for head in self.coordinates)]
        return torch.cat([*parts, self.completeness(features)], dim=-1)

    def rows(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and bias of each output of the last layers, in the order of the outputs."""
        mlps = (*self.coordinates, self.completeness)
        last = (self.classes, *(head[-1] for head in mlps))  # type: ignore[index]
        return [row for layer in last for row in zip(layer.weight, layer.bias, strict=True)]


class LayoutDecoder(nn.Module):
    """MLP1 (shared with the shape decoder), then MLP2 (Eq. 5).

        {l_k, c_k, s_k, p_k} = MLP2(MLP1(x_k))

    `heads` is `joint` (paper) or `separate` (`SeparateHeads`). If `void` is true, predictions may
    have the class `void`, which leaves them out of the scene, as low completeness does.
    `floor_gradient` is explained in `ModelConfig`.
    """

    def __init__(
        self,
        width: int,
        classes: int,
        heads: str = "joint",
        void: bool = True,
        floor_gradient: bool = False,
    ):
        super().__init__()
        hidden = 2 * width
        self.floor_gradient = floor_gradient
        self.classes, self.void = classes, void
        self.mlp1 = mlp(nn.Linear(width, width), nn.Linear(width, hidden))
        self.mlp2 = (
            SeparateHeads(width, hidden, classes)
            if heads == "separate"
            else JointHead(hidden, classes)
        )
        # Section 3.4: every object starts at the floor centre. The weights are small rather than
        # zero, so that objects can separate; y starts slightly above 0, where ReLU has a gradient.
        size = float(torch.log(torch.expm1(torch.tensor(INITIAL_SIZE_M, device="cpu"))))
        starts = (0.0, 0.1, 0.0, size, size, size, 0.0)
        with torch.no_grad():
            for (weight, bias), start in zip(self.mlp2.rows()[-7:], starts, strict=True):
                weight *= 0.1
                bias.fill_(start)

    def forward(
        self, features: Float[Tensor, "rooms objects width"]
    ) -> tuple[DecodedScenes, Float[Tensor, "rooms objects hidden"]]:
        """Class l_k, centre c_k, size s_k and completeness p_k of each object, and MLP1's output,
        which the shape decoder takes as input.

            c'_y = ReLU(y) + s_y / 2                                (Eq. S1)

        y is MLP2's output, so ReLU(y) is the height of the box's lower side, and no object reaches
        below the floor (supplement A). Sizes s_k are SoftPlus of MLP2's output.
        """
        shared = self.mlp1(features)
        out = self.mlp2(shared, features)
        logits, center, size, complete = out.split([self.classes, 3, 3, 1], dim=-1)
        if not self.void:
            is_void = torch.arange(self.classes, device=logits.device) == VOID
            logits = logits.masked_fill(is_void, -torch.inf)
        sizes = F.softplus(size)
        x, y, z = center.unbind(-1)
        bottom = above_floor(y) if self.floor_gradient else F.relu(y)
        y = bottom + sizes[..., 1] / 2
        centers = torch.stack([x, y, z], dim=-1)
        return DecodedScenes(logits, centers, sizes, complete[..., 0]), shared


class _AboveFloor(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, y: Tensor) -> Tensor:
        ctx.save_for_backward(y)
        return y.relu()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        # Descent moves against the gradient: where it is negative, y rises.
        return upstream[0].where((y > 0) | (upstream[0] < 0), 0.0)


def above_floor(y: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """ReLU(y) whose gradient at y <= 0 is kept where a descent step would raise y, and 0 elsewhere.

    With a plain ReLU, an object that has reached the floor cannot leave it. Early in training, the
    network cannot yet distinguish lamps from other furniture, most of which stands on the floor, so
    it moves lamps down as well.
    """
    lifted: Tensor = _AboveFloor.apply(y)
    return lifted


class ClassBevels(nn.Module):
    """Fraction, in [0, 1], by which the box edges of each class are cut off; see `beveled_cube`.

    Furniture fills its box less than a cuboid and more than an ellipsoid does, so the 2D box of
    either solid would bias the predicted size. Chairs and round tables leave the edges of their box
    empty, wardrobes do not; the bevels of a class are learnt from all views of its objects.
    """

    def __init__(self, classes: int):
        super().__init__()
        # Initially nearly a box: 0.12 of half a side is cut off.
        self.logits = nn.Parameter(torch.full((classes, 2), -2.0))

    def forward(
        self, class_logits: Float[Tensor, "rooms objects classes"]
    ) -> Float[Tensor, "rooms objects 2"]:
        """Bevels of vertical and horizontal edges: the mean of the classes' bevels, weighted by the
        class probabilities, which get no gradient here."""
        return class_logits.detach().softmax(dim=-1) @ self.logits.sigmoid()


class ShapeModule(nn.Module, ABC):
    """A shape decoder: maps an object's feature to its shape, and the shape to a mesh."""

    faces: Tensor | None
    """(faces, 3) triangles, if all meshes of the decoder share them; else None."""

    @abstractmethod
    def add_shapes(
        self,
        scenes: DecodedScenes,
        features: Float[Tensor, "rooms objects features"],
        with_shape: bool | Places,
        wanted: Bool[Tensor, "rooms wanted"] | None,
    ) -> DecodedScenes:
        """The decoded layouts with shapes added; the arguments are those of `ScenePrior.decode`."""

    def along_path(
        self,
        rooms: DecodedScenes,
        places: Float[Tensor, " rooms"],
        path: DecodedScenes,
        kept: Bool[Tensor, "steps objects"],
    ) -> DecodedScenes:
        """Rooms at places (0 to 1) of a path, with shapes that change gradually along it.

        `path` has the rooms at equal steps from 0 to 1, and `kept` selects the predictions that are
        objects. Deformed meshes change gradually anyway, so by default `rooms` stays unchanged.
        """
        return rooms

    @abstractmethod
    def mesh_of(self, decoded: DecodedScenes, room: int, item: int) -> Mesh | None:
        """The mesh of prediction `item`; None if shapes were not decoded."""

    def solids_of(self, decoded: DecodedScenes, room: int, item: int) -> tuple[Solid, ...]:
        """The convex solids of prediction `item`; none for shapes that are not made of solids."""
        return ()


class ShapeModuleConfig(Section, ABC):
    """A config section that builds a shape decoder."""

    @abstractmethod
    def build(self, features: int) -> ShapeModule:
        """The module for object features of width `features`, freshly initialised."""


class ShapeDecoderConfig(ShapeModuleConfig):
    """Template and size of the shape decoder."""

    width: int = Field(256, ge=8)
    """Hidden width; 256 in the released code. Wider ones deform in more detail, slower."""
    level: int = Field(4, ge=0, le=6)
    """Icosphere subdivisions of the template: 20 * 4**level faces. Each level has finer shapes, and
    four times the faces to render."""
    template: Literal["sphere", "box"] = "sphere"
    """Mesh that is deformed: the `sphere` (paper), or the same mesh with its vertices moved out to
    the surface of the object's `box`."""
    fit_box: bool = False
    """If true, each mesh is scaled to fill its box exactly, so that the box stays the bounding box
    of the mesh. In the paper (false) the two may drift apart."""

    def build(self, features: int) -> "ShapeDecoder":
        return ShapeDecoder(features, self)


class ShapeDecoder(ShapeModule):
    """Offset every vertex v of a template by a point-wise MLP3 (Eq. 6).

        dv_k = MLP3([r(MLP1(x_k)), v]),    S_k = {v + dv_k}

    r is two further layers on MLP1's output, as in the released code; `features` is the size of
    that output.
    """

    def __init__(self, features: int, config: ShapeDecoderConfig):
        super().__init__()
        vertices, faces = icosphere(config.level)
        width = config.width
        self.fit_box = config.fit_box
        self.template: Tensor
        self.faces: Tensor
        template = to_cube(vertices) if config.template == "box" else vertices
        self.register_buffer("template", template)
        self.register_buffer("faces", faces)
        self.reduce = nn.Sequential(
            nn.ReLU(), nn.Linear(features, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )
        # A linear layer on [feature, vertex] is the sum of two; the large one then runs once per
        # object instead of once per vertex.
        self.from_feature = nn.Linear(width, width)
        self.from_vertex = nn.Linear(3, width, bias=False)
        self.offsets = nn.Sequential(
            nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 3),
        )  # fmt: skip
        with torch.no_grad():
            last: nn.Linear = self.offsets[-1]  # type: ignore[assignment]
            last.weight *= 0.01  # so that training starts near the undeformed template
            last.bias.zero_()

    def forward(
        self, features: Float[Tensor, "rooms objects features"]
    ) -> Float[Tensor, "rooms objects vertices 3"]:
        """Canonical vertices S_k = {v + dv_k} (Eq. 6); the box spans [-1, 1]^3."""
        code = self.from_feature(self.reduce(features)).unsqueeze(-2)
        vertices = self.template + self.offsets(code + self.from_vertex(self.template))
        return fill_unit_box(vertices) if self.fit_box else vertices

    def add_shapes(
        self,
        scenes: DecodedScenes,
        features: Float[Tensor, "rooms objects features"],
        with_shape: bool | Places,
        wanted: Bool[Tensor, "rooms wanted"] | None,
    ) -> DecodedScenes:
        """Add the objects' meshes, placed in their boxes; vertices of objects without a mesh lie at
        the centre of the box."""
        if with_shape is False:
            return scenes
        dtype = scenes.centers_m.dtype
        shaped = wanted if with_shape is True else with_shape
        if shaped is None:
            shapes = self(features).to(dtype)
        else:
            assert not isinstance(shaped, bool)
            at = shaped if isinstance(shaped, tuple) else shaped.nonzero(as_tuple=True)
            some = self(features[at].unsqueeze(0))[0].to(dtype)
            shapes = some.new_zeros(*features.shape[:2], *some.shape[1:]).index_put(at, some)
        return replace(scenes, vertices_m=place(shapes, scenes.centers_m, scenes.sizes_m))

    def mesh_of(self, decoded: DecodedScenes, room: int, item: int) -> Mesh | None:
        if decoded.vertices_m is None:
            return None
        return Mesh(decoded.vertices_m[room, item].cpu().numpy(), self.faces.cpu().numpy())


def fill_unit_box(
    vertices: Float[Tensor, "*batch vertices 3"],
) -> Float[Tensor, "*batch vertices 3"]:
    """Scale and move each mesh so that its bounds are [-1, 1]^3."""
    low, high = vertices.amin(dim=-2, keepdim=True), vertices.amax(dim=-2, keepdim=True)
    return (2 * vertices - low - high) / (high - low).clamp(min=1e-6)
