"""Compositing in both backends against loops, and its gradient."""

import numpy as np
import pytest
import torch
from references.silhouettes import composite_loop
from silhouette_scenes import COMPOSITING, MODES, one_triangle_over_another, triangles
from torch.testing import assert_close

from sceneprior.render.silhouettes import reference
from sceneprior.render.silhouettes.cpu import compositing
from sceneprior.render.silhouettes.cpu.windows import Windows
from sceneprior.render.silhouettes.render import render_scene, render_silhouettes

IMAGES, OBJECTS, HEIGHT, WIDTH = 2, 4, 3, 11
STRIPS = 2


def random_layers(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coverage, depth and whether a face contains the pixel; a third of the pixels untouched,
    and some depths equal."""
    rng = np.random.default_rng(seed)
    shape = (IMAGES, OBJECTS, HEIGHT, WIDTH)
    z = np.where(rng.random(shape) < 0.3, 2.0, rng.uniform(1, 4, shape))
    z[rng.random(shape) < 0.3] = np.inf
    inside = (rng.random(shape) < 0.5) & np.isfinite(z)
    coverage = np.where(np.isfinite(z), rng.uniform(0.05, 0.95, shape), 0.0)
    return coverage, z, inside


def pack(dense: np.ndarray, fill: float) -> np.ndarray:
    """Images as windows that are the whole image: strips of eight columns, row by row."""
    wide = np.full((*dense.shape[:-1], STRIPS * 8), fill)
    wide[..., :WIDTH] = dense
    return wide.reshape(-1, HEIGHT, STRIPS, 8).transpose(0, 2, 1, 3).ravel()


def whole_windows() -> Windows:
    meshes = IMAGES * OBJECTS
    bounds = np.tile(np.array([0, HEIGHT, 0, STRIPS], dtype=np.int32), (meshes, 1))
    return Windows(bounds, np.arange(meshes + 1) * (HEIGHT * STRIPS * 8))


@pytest.mark.parametrize("way", COMPOSITING)
def test_compositing_and_its_gradient_are_the_definitions(way):
    coverage, z, inside = random_layers(0)
    odds = pack(1 / (1 - coverage), 1.0)
    # Larger is nearer: 1 / z inside, -z in the halo, -inf untouched.
    order = pack(np.where(inside, 1 / z, -z), -np.inf)
    drawn = compositing.compose(odds, order, whole_windows(), way, coverage.shape)
    visible, front, front_depth = drawn
    assert front.dtype == np.int32

    wanted = composite_loop(coverage, z, way)
    np.testing.assert_allclose(visible, wanted, rtol=0, atol=1e-14)
    alpha = torch.from_numpy(coverage).requires_grad_()
    masks = reference.composite(alpha, torch.from_numpy(z), way)
    np.testing.assert_allclose(masks.detach().numpy(), wanted, rtol=0, atol=1e-14)
    contained = np.where(inside, z, np.inf)
    nearest = contained.min(axis=1)
    np.testing.assert_allclose(front_depth, nearest, rtol=1e-15)
    ids = np.where(np.isfinite(nearest), contained.argmin(axis=1), -1)
    first, second = np.sort(contained, axis=1)[:, :2].swapaxes(0, 1)
    assert ((first == second) & np.isfinite(first)).any()  # some are equal
    np.testing.assert_array_equal(front, ids)  # of equals, the first

    upstream = np.random.default_rng(1).normal(size=coverage.shape)
    masks.backward(torch.from_numpy(upstream))
    packed = compositing.compose_backward(odds, order, whole_windows(), way, upstream)
    # `packed` has the chance to miss in it: d coverage / d x = missed * sigmoid(x).
    wanted = pack(np.where(np.isfinite(z), alpha.grad.numpy() * (1 - coverage), 0), 0.0)
    touched = order > -np.inf
    np.testing.assert_allclose(packed[touched], wanted[touched], rtol=0, atol=1e-14)


@pytest.mark.parametrize("way", COMPOSITING)
def test_the_references_compositing_passes_gradcheck(way):
    coverage, z, _ = random_layers(2)
    alpha = torch.from_numpy(coverage[:1, :, :2, :5]).clamp(min=1e-3).requires_grad_()
    depth = torch.from_numpy(z[:1, :, :2, :5])
    assert torch.autograd.gradcheck(lambda a: reference.composite(a, depth, way), (alpha,))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_face_that_contains_the_pixel_centre_decides_the_depth_before_a_nearer_halo(
    mode, backend
):
    # Object 0 is one large wall at 3 m; object 1 a wall at 2 m whose right edge runs along
    # u = 16. One pixel to its right, 0 contains the centre and 1 only reaches it: 1 counts
    # as the nearer, for it is, but what a camera would see there is 0.
    wall = [[-20, -20, 3], [20, -20, 3], [0, 40, 3]]
    half = [[0, -20, 2], [-20, 0, 2], [0, 20, 2]]
    options = {"sigma_px2": 1.0, "mode": mode, "backend": backend}
    masks, front, depth_m = (x[0, 0] for x in render_scene(**triangles(wall, half), **options))
    assert front[12, 14:18].tolist() == [1, 1, 0, 0]
    assert_close(depth_m[12, 14:18], torch.tensor([2.0, 2, 3, 3]).double(), rtol=1e-9, atol=0)
    edge = [1 / (1 + np.exp(-s * d * d)) for s, d in ((1, 1.5), (1, 0.5), (-1, 0.5), (-1, 1.5))]
    assert_close(masks[1, 12, 14:18], torch.tensor(edge).double(), rtol=1e-6, atol=0)
    assert_close(masks[0, 12], 1 - masks[1, 12], rtol=0, atol=1e-12)

    # The same object: a far face that contains the centre, a near one whose halo reaches it.
    # A third between them in depth, which contains it too, is now in front of the whole object.
    both = triangles([*wall, *half], [*[[x, y, 2.5] for x, y, _ in wall], *[[0, 0, -1]] * 3])
    both["faces"] = torch.tensor([[0, 1, 2], [3, 4, 5]])
    masks, front, depth_m = (x[0, 0] for x in render_scene(**both, **options))
    assert front[12, 14:18].tolist() == [0, 0, 1, 1]
    assert_close(depth_m[12, 14:18], torch.tensor([2, 2, 2.5, 2.5]).double(), rtol=1e-9, atol=0)
    assert (masks[1, 12, 16:] > 1 - 1e-9).all() and (masks[0, 12, 16:] < 1e-9).all()


def gradients_of(way: str, item: int, **options) -> torch.Tensor:
    """What it takes for more to be seen of an object."""
    scene = one_triangle_over_another()
    vertices = scene["vertices_m"].clone().requires_grad_()
    scene["vertices_m"] = vertices
    masks = render_silhouettes(**scene, compositing=way, sigma_px2=0.2, **options)
    masks[0, 0, item].sum().backward()
    return vertices.grad[0]


@pytest.mark.parametrize("mode", MODES)
def test_only_layered_lets_a_boundary_between_two_objects_push_the_front_one(mode):
    gradients = {way: gradients_of(way, 0, mode=mode) for way in COMPOSITING}
    assert gradients["alone"][0].abs().max() > 1
    # Nothing is nearer than the front object: seen as if alone, and the one behind has no say.
    assert_close(gradients["layered"][0], gradients["alone"][0], rtol=1e-12, atol=1e-12)
    assert gradients["layered"][1].abs().max() < 1e-12
    assert gradients["paper"].abs().max() < 1e-12


@pytest.mark.parametrize("mode", MODES)
def test_layered_reveals_the_object_behind_as_the_front_one_shrinks(mode):
    front, back = (gradients_of("layered", item, mode=mode)[0] for item in (0, 1))
    # The back one fills the image: what the front one gains there, it loses.
    assert_close(back, -front, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_layered_masks_add_up_to_the_paper_s_whole_scene(mode, backend):
    options = {"sigma_px2": 0.8, "mode": mode, "backend": backend}
    scene = one_triangle_over_another()
    layered = render_silhouettes(**scene, compositing="layered", **options).sum(dim=2)
    paper = render_silhouettes(**scene, compositing="paper", **options)
    assert_close(layered, paper.sum(dim=2), rtol=0, atol=1e-12)
    assert ((paper > 0).sum(dim=2) <= 1).all()  # each pixel belongs to one object
