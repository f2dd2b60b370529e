"""The Triton kernels against `reference` in float64, in a process of their own.

Triton decides when it is first imported whether its interpreter runs the kernels, and Lightning
imports it early. So the checks below (`check_...`) are collected by a second pytest alone: on the
GPU where there is one, else under the interpreter. There they take minutes: `make test` runs each
kernel once, on a small image, and the slow tests run the others.
"""

import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import compiled  # noqa: F401 (the second pytest reads no conftest.py)
import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.proxies import icosphere
from sceneprior.render.silhouettes import reference
from sceneprior.render.silhouettes.render import render_scene

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("triton") is None,
        reason="Triton is not installed, so the backend `cuda` is not tested: pip install triton",
    ),
    # The interpreter is numpy: e^x overflows and 1 / 0 is infinite there as on a GPU, aloud.
    pytest.mark.filterwarnings("ignore:(overflow|divide by zero):RuntimeWarning"),
]
ROOT = Path(__file__).parents[3]
DEVICE = "cpu" if os.environ.get("TRITON_INTERPRET") == "1" else "cuda"
MODES = ("exact", "fast")
COMPOSITING = ("alone", "layered", "paper")
SIZE = (11, 15)


@pytest.mark.parametrize(
    ("where", "checks"),
    [
        ("interpreter", "check_each_kernel"),
        pytest.param("interpreter", "check and not each_kernel", marks=pytest.mark.slow),
        ("device", "check"),
    ],
)
def test_the_kernels_in_a_process_of_their_own(where, checks):
    if where == "device" and not torch.cuda.is_available():
        pytest.skip("no CUDA device: the kernels ran through Triton's interpreter alone")
    if where == "interpreter" and torch.cuda.is_available():
        pytest.skip("there is a CUDA device: the kernels ran on it, compiled")
    options = ["-q", "--noconftest", "-p", "no:cacheprovider", "-o", "python_functions=check_*"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", __file__, "-k", checks, *options],
        cwd=ROOT,
        env=os.environ | {"TRITON_INTERPRET": "1" if where == "interpreter" else "0"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert " passed" in run.stdout and "skipped" not in run.stdout, run.stdout


def test_cpu_tensors_are_refused_where_kernels_are_compiled(monkeypatch):
    from sceneprior.render.silhouettes.cuda import backend as cuda

    monkeypatch.setattr(cuda, "INTERPRETED", False)
    with pytest.raises(ValueError, match=r"`cuda` needs tensors on a CUDA device.*'cpu'"):
        cuda.draw(*soups(), settings("exact", "alone"))


def test_a_long_image_is_refused(monkeypatch):
    from sceneprior.render.silhouettes.cuda import backend as cuda

    monkeypatch.setattr(cuda, "INTERPRETED", True)
    with pytest.raises(ValueError, match="at most 32767 pixels"):
        cuda.draw(*soups(), settings("exact", "alone", size=(1, 40000)))


def test_without_triton_the_import_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "triton", None)
    monkeypatch.delitem(sys.modules, "sceneprior.render.silhouettes.cuda.kernels", raising=False)
    with pytest.raises(ImportError, match=r"backend `cuda` needs Triton.*pip install triton"):
        importlib.import_module("sceneprior.render.silhouettes.cuda.kernels")


def test_edges_are_read_again_only_where_faces_were_written_to():
    from sceneprior.render.silhouettes.cuda.kernels import edges_of

    faces = torch.tensor([[0, 1, 2], [2, 1, 3]])
    edges = edges_of(faces)
    assert edges.ends.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    assert edges.first_faces.tolist() == [0, 1, 2, 4, 5, 6]
    assert edges.faces[2:4].tolist() == [0, 1] and edges.ways[2:4].tolist() == [1, -1]
    assert edges_of(faces) is edges
    faces[1, 2] = 0
    assert edges_of(faces).ends.tolist() == [[0, 1], [0, 2], [1, 2]]
    with torch.inference_mode():
        faces = faces.clone()
        assert len(edges_of(faces).ends) == 3
        faces[1, 2] = 3
        assert len(edges_of(faces).ends) == 5


def settings(mode: str, compositing: str, size=SIZE):
    # Sigma and blur are the same in float32, to which compiled kernels round them.
    return reference.Settings(size, 0.5, 4.5, 0.05, mode, compositing)


def soups():
    """3 images of 3 triangle soups; of the last image, one object is drawn.

    Before, around and behind the camera in the first, beside, before and twice the same in the
    second; faces without an area and smaller than a pixel.
    """
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(3, 3, 9, 3, generator=generator, dtype=torch.float64) * 0.45
    points[..., 8, :] = points[..., 7, :] + 0.01 * points[..., 6, :]
    places = [
        [[-0.4, 0.2, 2.0], [0.5, -0.2, 0.6], [0, 0, -2]],
        [[9, 0, 2], [0.2, 0.1, 1.6], [0.2, 0.1, 1.6]],
        [[0, 0, 1.5], [0, 0, 2], [0, 0, 2]],
    ]
    points += torch.tensor(places, dtype=torch.float64).unsqueeze(2)
    points[1, 2] = points[1, 1]
    faces = [[0, 1, 2], [2, 1, 3], [3, 4, 5], [4, 5, 6], [6, 7, 8], [5, 5, 0], [1, 8, 6]]
    drawn = torch.tensor([[True, True, True], [True, True, True], [False, True, False]])
    return *projected_points(points), torch.tensor(faces), drawn


def projected_points(points):
    depth = points[..., 2]
    pixels = points[..., :2] / depth.clamp(min=1e-3).unsqueeze(-1) * 7 + torch.tensor([7.4, 5.7])
    return pixels, depth


def spheres(level: int, places: list, radius: float):
    sphere, faces = icosphere(level)
    points = sphere.double() * radius + torch.tensor(places, dtype=torch.float64).unsqueeze(1)
    return *projected_points(points[None]), faces, torch.ones(1, len(places), dtype=torch.bool)


def drawing(draw, scene, how, dtype=torch.float64, device="cpu"):
    """Masks, front, depth and the gradient of a random sum of the masks."""
    pixels, depths, faces, drawn = (tensor.to(device) for tensor in scene)
    pixels = pixels.to(dtype).clone().requires_grad_()
    masks, front, depth = draw(pixels, depths.to(dtype), faces, drawn, how)
    generator = torch.Generator().manual_seed(1)
    upstream = torch.randn(masks.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((masks * upstream.to(masks)).sum(), pixels)
    return [tensor.detach().cpu() for tensor in (masks, front, depth, gradient)]


def agree(scene, how, dtype=torch.float64, masks_within=1e-12, grad_within=1e-7):
    """The result of `cuda`, after it is compared with that of `reference` for the same numbers."""
    from sceneprior.render.silhouettes.cuda import backend as cuda

    got = drawing(cuda.draw, scene, how, dtype, DEVICE)
    rounded = (*(part.to(dtype).double() for part in scene[:2]), *scene[2:])
    wanted = drawing(reference.draw, rounded, how)
    assert got[0].dtype == got[2].dtype == got[3].dtype == dtype
    assert_close(got[0].double(), wanted[0], rtol=0, atol=masks_within)
    assert torch.equal(got[1], wanted[1])
    assert_close(got[2].double(), wanted[2], rtol=masks_within, atol=0)
    # Relative to the largest gradient. The kernels leave out pixels missed by less than 1.5e-8.
    scale = float(wanted[3].abs().max()) if wanted[3].numel() else 0.0
    assert_close(got[3].double(), wanted[3], rtol=0, atol=grad_within * scale)
    return got


@pytest.mark.parametrize("mode", MODES)
def check_each_kernel_on_a_small_image(mode):
    # A quadrangle before another.
    near = [[1.2, 0.9], [6.1, 1.3], [2.8, 4.9], [7.2, 4.4]]
    far = [[0.3, 3.8], [8.4, 0.2], [5.1, 4.7], [8.9, 4.1]]
    scene = (
        torch.tensor([[near, far]], dtype=torch.float64),
        torch.tensor([[[2.0, 2.5, 3, 2], [4, 3, 5, 4]]], dtype=torch.float64),
        torch.tensor([[0, 1, 2], [2, 1, 3]]),
        torch.ones(1, 2, dtype=torch.bool),
    )
    masks, front, _, gradient = agree(scene, settings(mode, "layered", (5, 8)))
    assert set(front.unique().tolist()) == {-1, 0, 1}
    assert (masks.amax((2, 3)) > 0.5).all() and gradient.abs().amax((2, 3)).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("compositing", COMPOSITING)
def check_soups_before_beside_behind_and_around_the_camera(mode, compositing):
    masks, front, depth, gradient = agree(soups(), settings(mode, compositing))
    shown = (masks > 0.5).sum((2, 3))
    assert shown[0, 0] > 5 and shown[1, 1] > 5 and shown[2, 1] > 5
    # Behind, beside, not drawn; of two that are the same, the first is in front.
    for nothing in ((0, 2), (1, 0), (2, 0), (2, 2)):
        assert not masks[nothing].any() and not gradient[nothing].any()
    assert (front[1] != 2).all() and (front[1] == 1).any()
    assert set(front[2].unique().tolist()) == {-1, 1}
    assert torch.equal(depth == torch.inf, front == -1)


@pytest.mark.parametrize("mode", MODES)
def check_float32_and_the_same_bits_again(mode):
    from sceneprior.render.silhouettes.cuda import backend as cuda

    # Seen 2e-6 in masks and 1e-6 of the largest gradient.
    scene, how = soups(), settings(mode, "layered")
    first = agree(scene, how, torch.float32, 2e-5, 2e-5)
    again = drawing(cuda.draw, scene, how, torch.float32, DEVICE)
    assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True))


def check_a_sphere_whose_halves_lie_1024_faces_apart():
    # A word of bits holds 32 blocks of 32 faces: the second half comes in the next word.
    pixels, depths, faces, drawn = spheres(0, [[0.3, 0.1, 2.5]], 0.9)
    nothing = (torch.arange(1024) % 12).unsqueeze(1).expand(-1, 3)
    faces = torch.cat([faces[:10], nothing, faces[10:]])
    masks = agree((pixels, depths, faces, drawn), settings("exact", "alone"))[0]
    assert (masks > 0.9).sum() > 5


def check_edges_that_other_faces_cover_in_part_and_corners_far_outside():
    # One object: a triangle crosses a second one; the third reaches 900 px out of the image.
    corners = [[0.7, 1.3], [14.1, 2.9], [1.2, 9.8], [6.2, -3.1], [9.4, 12.2], [3.1, 10.9]]
    far = [[7.7, 8.8], [-900.3, 300.2], [140.6, 701.9]]
    depths = torch.tensor([[[2.0, 3, 2.5, 4, 3, 2, 1, 9, 5]]], dtype=torch.float64)
    scene = (
        torch.tensor([[corners + far]], dtype=torch.float64),
        depths,
        torch.arange(9).reshape(3, 3),
        torch.ones(1, 1, dtype=torch.bool),
    )
    agree(scene, settings("fast", "alone"))
    masks, *_, gradient = agree(scene, settings("fast", "alone"), torch.float32, 2e-6, 1e-5)
    # An edge does not show where another face lies beyond it.
    how, (pixels, depths, faces, drawn) = settings("fast", "alone"), scene
    apart = [reference.draw(pixels, depths, face[None], drawn, how)[0] for face in faces]
    assert (masks > torch.stack(apart).amax(0) + 0.2).any() and gradient[0, 0, 6:].any()


@pytest.mark.parametrize("mode", MODES)
def check_nothing_to_draw(mode):
    how = settings(mode, "layered", (1, 9))
    behind = spheres(0, [[0, 0, -2.5]], 0.6)
    masks, front, depth, gradient = agree(behind, how)
    assert not masks.any() and (front == -1).all() and depth.isinf().all() and not gradient.any()
    pixels, depths, faces, drawn = spheres(0, [[0, 0, 2.5]], 0.6)
    agree((pixels, depths, faces[:0], drawn), how)
    agree((pixels[:0], depths[:0], faces, drawn[:0]), how)
    agree((pixels[:, :0], depths[:, :0], faces, drawn[:, :0]), how)


@pytest.mark.parametrize("mode", MODES)
def check_a_scene_from_vertices_to_their_gradient(mode):
    sphere, faces = icosphere(0)
    points = sphere.double() * 0.5 + torch.tensor([[0.2, 0.1, 2.2], [-0.3, 0.07, 3.1]])[:, None]
    lens = torch.tensor([[8.0, 0, 7.4], [0, 8, 5.7], [0, 0, 1]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.35
    results = []
    for backend, device in (("cuda", DEVICE), ("reference", "cpu")):
        vertices = points.to(device)[None].requires_grad_()
        seen = (faces, poses[None], lens.expand(1, 2, 3, 3))
        scene = render_scene(
            vertices, *(part.to(device) for part in seen), SIZE, sigma_px2=0.5, mode=mode,
            drawn=torch.ones(1, 2, dtype=torch.bool, device=device), backend=backend,
        )  # fmt: skip
        (scene.masks**2).sum().backward()
        results.append([part.detach().cpu() for part in (*scene, vertices.grad)])
    for one, other in zip(*results, strict=True):
        assert_close(one, other, rtol=0, atol=1e-7)
    assert len(results[0][1].unique()) == 3 and results[0][3].abs().max() > 0.1
