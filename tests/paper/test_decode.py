"""From decoded batches to scenes: where a scene ends, what is furniture, what is unfolded."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import tiny_config

from sceneprior.core.scene import Scene
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.decode import to_rooms
from sceneprior.paper.prior import ScenePrior


@pytest.fixture
def decoded(torch_rng) -> DecodedScenes:
    """Two rooms of four objects of classes 9, 13, 0 (void), 21."""
    logits = torch.zeros(2, 4, 22)
    for item, label in enumerate((9, 13, 0, 21)):
        logits[:, item, label] = 3
    return DecodedScenes(
        class_logits=logits,
        centers_m=torch.rand(2, 4, 3, generator=torch_rng),
        sizes_m=torch.rand(2, 4, 3, generator=torch_rng) + 0.1,
        completeness_logits=torch.tensor([[2.0, 0.1, 5.0, 0.3], [1.0, -0.01, 5.0, 5.0]]),
        vertices_m=torch.rand(2, 4, 6, 3, generator=torch_rng),
    )


@pytest.fixture
def prior(tmp_path) -> ScenePrior:
    """A prior whose meshes have two triangles."""
    prior = tiny_config(tmp_path).build_prior()
    prior.shape.faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    return prior


def scenes_of(*arguments) -> list[Scene]:
    return [room.scene for room in to_rooms(*arguments)]


def labels(scene) -> list[str]:
    return [item.label for item in scene.objects]


def test_a_scene_ends_at_the_first_object_whose_completeness_falls(decoded, prior):
    rooms = to_rooms(decoded, prior, "front3d_bedroom", ["a", "b"])
    assert [room.predictions for room in rooms] == [[0, 1, 3], [0]]
    assert torch.equal(rooms[0].class_logits, decoded.class_logits[0, [0, 1, 3]])
    first, second = scenes_of(decoded, prior, "front3d_bedroom", ["a", "b"])
    assert (first.name, second.name) == ("a", "b")
    # void is decoded like any class, but is no furniture; what follows it stays.
    assert labels(first) == ["double_bed", "nightstand", "wardrobe"]
    # The second ends before its second object, though later ones score high again.
    assert labels(second) == ["double_bed"]
    for item, source in zip(first.objects, (0, 1, 3), strict=True):
        np.testing.assert_array_equal(item.center_m, decoded.centers_m[0, source])
        np.testing.assert_array_equal(item.size_m, decoded.sizes_m[0, source])
        np.testing.assert_array_equal(item.mesh.vertices_m, decoded.vertices_m[0, source])
        np.testing.assert_array_equal(item.mesh.faces, prior.faces)


def test_a_stop_flag_ends_a_scene_after_the_object_that_has_it(decoded, prior):
    stops = replace(
        decoded, completeness_logits=torch.tensor([[-2.0, 0.1, -5, 3], [-1, -1, -1, -1]])
    )
    first, second = scenes_of(stops, prior, "front3d_bedroom", ["a", "b"], "stop")
    assert labels(first) == ["double_bed", "nightstand"]
    assert labels(second) == ["double_bed", "nightstand", "wardrobe"]
