"""A map of the latent space: two directions of it, in which training rooms differ most."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.models.latents import LatentSpace, LatentSphere

MARGIN = 0.12
"""Room round the outermost training rooms, as a share of the map's side."""
RIM = 0.999
"""A point of the sphere's map is drawn in to this distance from the origin, where the sphere ends:
at the rim itself nothing would be left of a latent's other coordinates."""
SNAP = 0.02
"""A training room so near to a click, as a share of the map's side, is what was meant."""


@dataclass(frozen=True)
class LatentMap:
    """An orthographic picture of the latent space: a latent z lies at (a_1 . z, a_2 . z).

    The orthonormal axes a_1 and a_2 are the first two principal components of the training rooms'
    latents, so no other plane spreads these rooms wider. Every latent has a place on the map, a
    great circle is an arc of an ellipse on it, and moving over the map changes two coordinates and
    keeps the others in proportion: a click on a training room's dot gives that room itself.
    """

    space: LatentSpace
    axes: Float[Tensor, "2 dimension"]
    rooms: Float[Tensor, "rooms 2"]
    """Places of the training rooms."""
    share: float
    """How much of the variance of training rooms' latents the two axes hold, 0 to 1."""
    middle: tuple[float, float]
    side: float
    """Of the square that the map shows, with all training rooms in it."""

    def place(self, z: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms 2"]:
        """Where latents lie on the map."""
        return z @ self.axes.T

    def moved(
        self, z: Float[Tensor, " dimension"], point: tuple[float, float]
    ) -> Float[Tensor, " dimension"]:
        """The latent at a point of the map that is nearest to z in all other coordinates.

        On the sphere the others shrink or grow together, so that the length stays 1; beyond its
        rim, the point is drawn in.
        """
        here = torch.tensor(point, dtype=z.dtype)
        rest = z - self.axes.T @ (self.axes @ z)
        if isinstance(self.space, LatentSphere):
            here = here * (RIM / here.norm().clamp(min=RIM))
            rest = rest * ((1 - here.square().sum()).sqrt() / rest.norm().clamp(min=1e-6))
        return self.space.onto((rest + self.axes.T @ here).unsqueeze(0))[0]

    def room_at(self, point: tuple[float, float]) -> int | None:
        """The training room whose dot a click at a point means; None where there is none near."""
        apart = (self.rooms - torch.tensor(point, dtype=self.rooms.dtype)).norm(dim=1)
        row = int(apart.argmin())
        return row if float(apart[row]) <= SNAP * self.side else None


def make_map(space: LatentSpace, z: Float[Tensor, "rooms dimension"]) -> LatentMap:
    """The map of a latent space in which training rooms lie at z.

    Raises:
        InputError: there are fewer than three, which span no plane.

    Example: on the sphere in three dimensions, rooms differ most along x, then along y.

        >>> space = LatentSphere(4, 3)
        >>> z = [[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.3, 0.954], [0.0, -0.3, 0.954]]
        >>> latent_map = make_map(space, torch.tensor(z))
        >>> latent_map.rooms[0].abs().tolist()
        [0.6000000238418579, 0.0]
        >>> latent_map.moved(torch.tensor(z[0]), (0.0, 0.0)).tolist()
        [0.0, 0.0, 1.0]
    """
    if len(z) < 3:
        raise InputError(
            f"A map of the latent space needs at least 3 training rooms, and this prior knows "
            f"{len(z)}; sample rooms instead."
        )
    _, scale, directions = torch.linalg.svd(z - z.mean(dim=0), full_matrices=False)
    axes = _upright(directions[:2])
    rooms = z @ axes.T
    low, high = rooms.amin(dim=0), rooms.amax(dim=0)
    side = max(float((high - low).max()), 1e-3) * (1 + 2 * MARGIN)
    share = float(scale[:2].square().sum() / scale.square().sum().clamp(min=1e-12))
    x, y = ((low + high) / 2).tolist()
    return LatentMap(space, axes, rooms, share, (x, y), side)


def _upright(directions: Float[Tensor, "2 dimension"]) -> Float[Tensor, "2 dimension"]:
    """A singular vector has no sign of its own: its largest entry is positive, on any machine."""
    largest: Int[Tensor, "2 1"] = directions.abs().argmax(dim=1, keepdim=True)
    return directions * directions.gather(1, largest).sign()
