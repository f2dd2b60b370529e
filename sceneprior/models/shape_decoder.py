"""MLP1's features and template vertices in, deformed canonical meshes out (equation 6)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.geometry.meshes import icosphere, to_cube


class ShapeDecoder(nn.Module):
    """Offset every vertex of a template by a point-wise MLP3 of [feature, vertex].

    Args:
        features: Size of MLP1's output.
        width: Hidden width; the paper's network has 256.
        level: Subdivisions of the icosphere: 4 gives 5,120 faces, the authors' choice.
        template: `sphere` (paper) or `box`, the same vertices pushed out to the cube.
        fit_box: Scale each deformed mesh to fill its box exactly, so that the predicted box
            always is the mesh's own. The paper leaves the two free to drift apart.
    """

    def __init__(self, features: int, width: int, level: int, template: str, fit_box: bool):
        super().__init__()
        vertices, faces = icosphere(level)
        self.fit_box = fit_box
        self.template: Tensor
        self.faces: Tensor
        self.register_buffer("template", to_cube(vertices) if template == "box" else vertices)
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
        """Canonical vertices v + dv; the box spans [-1, 1]^3."""
        code = self.from_feature(self.reduce(features)).unsqueeze(-2)
        vertices = self.template + self.offsets(code + self.from_vertex(self.template))
        return fill_unit_box(vertices) if self.fit_box else vertices


def fill_unit_box(
    vertices: Float[Tensor, "*batch vertices 3"],
) -> Float[Tensor, "*batch vertices 3"]:
    """Scale and move each mesh so that its bounds are [-1, 1]^3."""
    low, high = vertices.amin(dim=-2, keepdim=True), vertices.amax(dim=-2, keepdim=True)
    return (2 * vertices - low - high) / (high - low).clamp(min=1e-6)
