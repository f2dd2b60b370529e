"""The shape decoder: a template mesh deformed by a point-wise MLP (section 3.3, Eq. 6)."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from sceneprior.geometry.meshes import icosphere, to_cube
from sceneprior.settings import Section


class ShapeDecoderConfig(Section):
    """Template and size of the shape decoder."""

    name: Literal["mesh"] = "mesh"
    width: int = Field(256, ge=8)
    """Hidden width; the paper's network has 256."""
    level: int = Field(4, ge=0, le=6)
    """Icosphere subdivisions of the template: 20 * 4**level faces."""
    template: Literal["sphere", "box"] = "sphere"
    """What shapes are deformed from: the `sphere` (paper), or its vertices pushed out to the `box`
    that the layout stage fitted."""
    fit_box: bool = False
    """Scale each mesh to fill its box exactly, so that boxes stay the meshes' own. The paper leaves
    the two free to drift apart."""

    def build(self, features: int) -> "ShapeDecoder":
        """The module for object features of such a width, freshly initialised."""
        return ShapeDecoder(features, self)


class ShapeDecoder(nn.Module):
    """Offset every vertex v of a template by a point-wise MLP3 (Eq. 6).

        dv_k = MLP3([r(MLP1(x_k)), v]),    S_k = {v + dv_k}

    r are two layers more on MLP1's output, which has so many `features`, as in the released code.
    """

    nothing: ClassVar[float] = 0.0
    """The canonical vertices of an object that was not decoded: the centre of its box."""

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
        # The first layer on [feature, vertex] is the sum of two: the large one runs once an
        # object instead of once a vertex.
        self.from_feature = nn.Linear(width, width)
        self.from_vertex = nn.Linear(3, width, bias=False)
        self.offsets = nn.Sequential(
            nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 3),
        )  # fmt: skip
        with torch.no_grad():
            last: nn.Linear = self.offsets[-1]  # type: ignore[assignment]
            last.weight *= 0.01  # deformation starts from the plain template
            last.bias.zero_()

    def forward(
        self, features: Float[Tensor, "rooms objects features"]
    ) -> Float[Tensor, "rooms objects vertices 3"]:
        """Canonical vertices S_k = v + dv_k; the box spans [-1, 1]^3."""
        code = self.from_feature(self.reduce(features)).unsqueeze(-2)
        vertices = self.template + self.offsets(code + self.from_vertex(self.template))
        return fill_unit_box(vertices) if self.fit_box else vertices


def fill_unit_box(
    vertices: Float[Tensor, "*batch vertices 3"],
) -> Float[Tensor, "*batch vertices 3"]:
    """Scale and move each mesh so that its bounds are [-1, 1]^3."""
    low, high = vertices.amin(dim=-2, keepdim=True), vertices.amax(dim=-2, keepdim=True)
    return (2 * vertices - low - high) / (high - low).clamp(min=1e-6)
