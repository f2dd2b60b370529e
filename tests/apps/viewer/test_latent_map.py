"""The map of the latent space: its axes, what moving over it keeps, and which dot a click means."""

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from sceneprior.apps.viewer.latent_map import SNAP, make_map
from sceneprior.core.errors import InputError
from sceneprior.paper.latents import LatentCube, LatentSphere


@pytest.fixture
def space():
    return LatentSphere(20, 8)


@pytest.fixture
def z(space, torch_rng):
    return space(torch.randn(30, 20, generator=torch_rng) * 2)


def test_axes_are_the_principal_components(space, z):
    latent_map = make_map(space, z)
    points = z.double().numpy()
    values, vectors = np.linalg.eigh(np.cov(points.T))
    ours = latent_map.axes.double().numpy()
    np.testing.assert_allclose(np.abs(ours @ vectors[:, :-3:-1]), np.eye(2), atol=1e-4)
    assert latent_map.share == pytest.approx(values[-2:].sum() / values.sum(), rel=1e-4)
    # Whatever sign a singular vector comes with, the map is the same way up.
    again = make_map(space, z.flip(0))
    torch.testing.assert_close(again.axes, latent_map.axes, rtol=0, atol=1e-4)


def test_moving_goes_where_the_pointer_is_and_keeps_the_rest(space, z):
    latent_map = make_map(space, z)
    moved = latent_map.moved(z[3], (0.3, -0.4))
    assert moved.norm().item() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(latent_map.place(moved[None])[0], [0.3, -0.4], atol=1e-6)

    def rest(point):
        return point - latent_map.axes.T @ (latent_map.axes @ point)

    cosine = F.cosine_similarity(rest(moved), rest(z[3]), dim=0)
    assert cosine.item() == pytest.approx(1, abs=1e-5)
    # No other point of the sphere at this place is nearer to where it began.
    other = latent_map.moved(z[4], (0.3, -0.4))
    assert moved @ z[3] > other @ z[3]
    back = latent_map.moved(moved, tuple(latent_map.rooms[3].tolist()))
    torch.testing.assert_close(back, z[3], rtol=0, atol=1e-5)


def test_in_a_cube_the_rest_stays_to_the_bit_and_walls_hold(torch_rng):
    cube = LatentCube(6)
    z = cube(torch.randn(20, 6, generator=torch_rng))
    latent_map = make_map(cube, z)
    inside = latent_map.moved(z[1] * 0.2, (0.1, 0.05))
    np.testing.assert_allclose(latent_map.place(inside[None])[0], [0.1, 0.05], atol=1e-6)
    assert latent_map.moved(z[1], (9.0, 9.0)).abs().max() <= cube.half_edge + 1e-6


def test_a_click_means_a_dot_that_is_near(space, z):
    latent_map = make_map(space, z)
    x, y = latent_map.rooms[7].tolist()
    assert latent_map.room_at((x, y)) == 7
    far = 1.01 * SNAP * latent_map.side
    corner = (latent_map.rooms.amax(dim=0) + far).tolist()
    assert latent_map.room_at(tuple(corner)) is None


def test_two_rooms_span_no_plane(space, z):
    with pytest.raises(InputError, match="at least 3 training rooms, and this prior knows 2"):
        make_map(space, z[:2])
