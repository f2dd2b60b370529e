"""Answers object by object: outlines, places, and what is chosen, each on cases made by hand."""

import numpy as np
import pytest
import torch
from refusals import refused
from torch.testing import assert_close

from sceneprior.apps.reconstruction.own_image import level_camera
from sceneprior.core.views import ObservedImage
from sceneprior.lifted.reconstruction import objects as candidates
from sceneprior.lifted.reconstruction.objects import answer_images
from sceneprior.lifted.reconstruction.placing import (
    Outlines,
    outlines_of,
    place_objects,
    projected_extents,
)

CUBE = torch.tensor([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CAMERA = np.array([[48.0, 0, 48], [0, 48, 36], [0, 0, 1]])


def painted(*rectangles, clear=True) -> ObservedImage:
    """Rectangles x1, y1, x2, y2 of 96 x 72 pixels, the later ones in front."""
    ids = np.zeros((72, 96), dtype=np.uint8)
    for k, (x1, y1, x2, y2) in enumerate(rectangles, start=1):
        ids[y1:y2, x1:x2] = k
    boxes = np.array(rectangles, dtype=np.float32) / (96, 72, 96, 72)
    sides = np.full((len(rectangles), 4), clear)
    classes = np.ones(len(rectangles), dtype=np.int64)
    pose = level_camera(1.6).astype(np.float32)
    return ObservedImage("painted", "front3d_bedroom", classes, ids, boxes.astype(np.float32),
                         sides, pose, CAMERA)  # fmt: skip


def cameras(count: int) -> Outlines:
    one = outlines_of(painted((40, 30, 60, 50)))
    return Outlines(*(part.expand(count, *part.shape[1:]) for part in one))


def seen(points_m) -> Outlines:
    """The cameras of `cameras`, with masks that end where these objects do."""
    given = cameras(len(points_m))
    extents = projected_extents(points_m, given)[0]
    border = extents.new_tensor([0, 0, 1, 1, 0, 1, 2, 1])
    return given._replace(extents=extents.minimum(border), clear=torch.ones_like(given.clear))


def test_slopes_of_extents_are_those_of_finite_differences():
    torch.manual_seed(0)
    points = (CUBE * torch.tensor([1.0, 0.8, 0.6]) + torch.tensor([0.3, 0.5, -1.0])).double()
    given = Outlines(*(p.double() if p.is_floating_point() else p for p in cameras(1)))
    _, slope, behind = projected_extents(points[None], given)
    assert behind.item() == 0
    for axis, column in ((0, 0), (2, 1)):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        ends = [projected_extents((points + s * step)[None], given)[0] for s in (1, -1)]
        assert_close(slope[..., column], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("place", [(0.0, -1.5), (1.2, -2.5), (-1.5, -0.5), (2.6, -1.0)])
def test_an_object_of_the_right_size_goes_where_it_stands(place):
    """The last one is cut by the image's side."""
    size, center = torch.tensor([[1.0, 0.8, 0.6]]), torch.tensor([[place[0], 0.4, place[1]]])
    masks = seen(CUBE * size[:, None] + center[:, None])
    placed = place_objects(CUBE[None], size, torch.zeros(1), masks)
    assert_close(placed.centers_m, center, atol=0.01, rtol=0)
    assert placed.energy.item() < 0.2
    wrong = place_objects(CUBE[None], size * 1.4, torch.zeros(1), masks)
    assert wrong.energy.item() > placed.energy.item() + 0.5


def test_a_run_whose_rooms_are_all_empty_says_so(trained, images, monkeypatch):
    monkeypatch.setattr(
        candidates, "kept_objects", lambda logits, _: torch.zeros_like(logits, dtype=torch.bool)
    )
    with refused("lifted/all rooms empty"):
        answer_images(trained, images)
