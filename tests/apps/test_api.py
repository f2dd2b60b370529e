"""The Python API: the same rooms as the functions below it, gradients, and sentences."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import sceneprior
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.topdown import html_of, show

BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))


@pytest.fixture(scope="module")
def prior(toy_run):
    return sceneprior.load(toy_run)


def test_names_are_found_when_asked_for():
    assert set(sceneprior.__all__) <= set(dir(sceneprior))
    with pytest.raises(AttributeError, match="no attribute 'weights'"):
        _ = sceneprior.weights


def test_a_way_leads_from_room_to_room(prior):
    start, end = prior.sample(2, seed=1)
    way = prior.interpolate(start, end, 3)
    np.testing.assert_allclose(way[0].latent, start.latent, atol=1e-6)
    np.testing.assert_allclose(way[-1].centers_m, end.centers_m, atol=1e-4)
    assert way[0].extra["from"] == start.name
    middle = prior.interpolate(way[1].latent, "seed:1", 2)
    np.testing.assert_allclose(middle[0].centers_m, way[1].centers_m, atol=1e-4)
    with pytest.raises(InputError, match="Room drawn has no latent"):
        prior.interpolate(Scene("drawn", "front3d_bedroom"), end)
    with pytest.raises(InputError, match=r"The vector has a latent of shape \(3,\)"):
        prior.latent(torch.ones(3))


def test_a_notebook_shows_the_picture(monkeypatch):
    room = Scene("my <room>", "front3d_bedroom", (BED, BED))
    shown = []
    page = html_of(room)
    assert "data:image/png;base64," in page and "my &lt;room&gt;: double_bed ×2" in page
    with pytest.raises(InputError, match="draws in a notebook, and this is none"):
        show(room)
    notebook = SimpleNamespace(
        get_ipython=object, display=SimpleNamespace(display=shown.append, HTML=str)
    )
    monkeypatch.setitem(__import__("sys").modules, "IPython", notebook)
    show(room)
    assert shown == [page]
