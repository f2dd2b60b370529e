"""The shape decoder: a template mesh deformed by a point-wise MLP (section 3.3, Eq. 6)."""

from dataclasses import replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.proxies import icosphere, place, to_cube
from sceneprior.core.scene import Mesh
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.layers import ShapeModule, ShapeModuleConfig


class ShapeDecoderConfig(ShapeModuleConfig):
    """Template and size of the shape decoder."""

    width: int = Field(256, ge=8)
    """Hidden width; the paper's network has 256."""
    level: int = Field(4, ge=0, le=6)
    """Icosphere subdivisions of the template: 20 * 4**level faces."""
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

    nothing: ClassVar[float] = 0.0
    """Canonical coordinate of every vertex of an object that was not decoded: the centre of its
    box."""

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
        with_shape: bool | Bool[Tensor, "rooms shaped"],
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
            assert isinstance(shaped, Tensor)
            shaped = F.pad(shaped, (0, features.shape[1] - shaped.shape[1]))
            some = self(features[shaped].unsqueeze(0))[0].to(dtype)
            shapes = some.new_full((*shaped.shape, *some.shape[1:]), self.nothing)
            shapes = shapes.index_put((shaped,), some)
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
