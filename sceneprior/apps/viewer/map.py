"""The map of a prior's latent space: its plane, and its picture in the page's panel."""

import re
from dataclasses import dataclass
from importlib.resources import files

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.errors import InputError
from sceneprior.paper.prior import LatentSpace, LatentSphere

MARGIN = 0.12
"""Margin around the outermost training rooms, as a share of the map's side."""
RIM = 0.999
"""Largest distance from the origin on the map of a sphere. At the rim, distance 1, the latent's
other coordinates would all become 0."""
SNAP = 0.02
"""Distance within which a click selects a training room, as a share of the map's side."""
Point = tuple[float, float]
"""A point of the map."""
_EVENT = re.compile(r"([01](?:\.\d+)?) ([01](?:\.\d+)?) (click|drag|end) \d+")
# viser's plots and pictures send no pointer events. This picture writes them into the text field
# that follows it, in the way that React listens to, and the field sends its text to the server.
_PICTURE = files("sceneprior.apps.viewer").joinpath("map.svg").read_text()


@dataclass(frozen=True)
class LatentMap:
    """Orthographic projection of the latent space: latent z is at the point (a_1 . z, a_2 . z).

    The orthonormal axes a_1 and a_2 are the first two principal components of the training rooms'
    latents, so no other plane shows more of their variance. A great circle projects to an arc of an
    ellipse. Moving over the map changes two coordinates and keeps the others in proportion. A click
    on a training room's dot gives that room itself.
    """

    space: LatentSpace
    axes: Float[Tensor, "2 dimension"]
    rooms: Float[Tensor, "rooms 2"]
    """Map points of the training rooms."""
    share: float
    """Explained variance: the share of the latents' variance along the two axes, 0 to 1."""
    middle: tuple[float, float]
    side: float
    """Side of the square that the map shows, which contains all training rooms."""

    def place(self, z: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms 2"]:
        """Map points of latents."""
        return z @ self.axes.T

    def moved(
        self, z: Float[Tensor, " dimension"], point: tuple[float, float]
    ) -> Float[Tensor, " dimension"]:
        """Move latent z to a point of the map, keeping its other coordinates.

        On the sphere the other coordinates are scaled so that the length stays 1, and a point
        beyond the rim is moved to it.
        """
        here = torch.tensor(point, dtype=z.dtype)
        rest = z - self.axes.T @ (self.axes @ z)
        if isinstance(self.space, LatentSphere):
            here = here * (RIM / here.norm().clamp(min=RIM))
            rest = rest * ((1 - here.square().sum()).sqrt() / rest.norm().clamp(min=1e-6))
        return self.space.onto((rest + self.axes.T @ here).unsqueeze(0))[0]

    def room_at(self, point: tuple[float, float]) -> int | None:
        """The training room that a click at a point selects; None if no dot is near."""
        apart = (self.rooms - torch.tensor(point, dtype=self.rooms.dtype)).norm(dim=1)
        row = int(apart.argmin())
        return row if float(apart[row]) <= SNAP * self.side else None


def make_map(space: LatentSpace, z: Float[Tensor, "rooms dimension"]) -> LatentMap:
    """Make the map of a latent space from the training rooms' latents z.

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
    # The signs of singular vectors are arbitrary: the largest entry becomes positive.
    largest: Int[Tensor, "2 1"] = directions[:2].abs().argmax(dim=1, keepdim=True)
    axes = directions[:2] * directions.gather(1, largest).sign()
    rooms = z @ axes.T
    low, high = rooms.amin(dim=0), rooms.amax(dim=0)
    side = max(float((high - low).max()), 1e-3) * (1 + 2 * MARGIN)
    share = float(scale[:2].square().sum() / scale.square().sum().clamp(min=1e-12))
    x, y = ((low + high) / 2).tolist()
    return LatentMap(space, axes, rooms, share, (x, y), side)


def map_picture(latent_map: LatentMap, path: Float[Tensor, "steps dimension"] | None = None) -> str:
    """The picture of a map as SVG, with a dot for each training room and the line of a path."""
    places = _on_picture(latent_map, latent_map.rooms)
    drawn = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="0.9"/>' for x, y in places)
    if path is not None:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in _on_picture(latent_map, path))
        drawn = f'<polyline points="{points}"/>{drawn}'
    return _PICTURE.replace("<!-- rooms -->", drawn)


def mark_style(latent_map: LatentMap, z: Float[Tensor, " dimension"] | None) -> str:
    """The style that moves the picture's mark to a latent; None hides the mark."""
    if z is None:
        return "<style>.sp-here {display: none}</style>"
    ((x, y),) = _on_picture(latent_map, z.unsqueeze(0))
    return f"<style>.sp-here {{transform: translate({x:.2f}px, {y:.2f}px)}}</style>"


def read_event(latent_map: LatentMap, text: str) -> tuple[Point, str] | None:
    """The map point and the kind (`click`, `drag`, or `end` of a drag) of a pointer event that the
    picture sent; None for other text, since a client may send any."""
    found = _EVENT.fullmatch(text)
    if found is None:
        return None
    x, y = (
        middle + (float(share) - 0.5) * latent_map.side
        for middle, share in zip(latent_map.middle, found.groups()[:2], strict=True)
    )
    return (x, y), found[3]


def _on_picture(latent_map: LatentMap, z: Float[Tensor, "n any"]) -> list[list[float]]:
    """Points of the picture, for latents or for points of the map."""
    places = z if z.shape[1] == 2 else latent_map.place(z)
    flat = (places - torch.tensor(latent_map.middle, dtype=places.dtype)) / latent_map.side * 100
    return (flat * torch.tensor([1.0, -1.0]) + 50).tolist()
