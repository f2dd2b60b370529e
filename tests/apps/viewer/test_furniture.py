"""The choice of furniture: decoded, or models."""

import pytest

from sceneprior.apps.viewer.explorer import Folder
from sceneprior.core.scene import Scene, SceneObject

pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.page import Page
from sceneprior.apps.viewer.panel import DECODED, MODELS
from sceneprior.apps.viewer.server import serving


def test_models_come_and_go():
    bed = SceneObject("double_bed", (0.0, 0.5, 0.0), (2.0, 1.0, 2.2))
    with serving("127.0.0.1", 0) as server:
        page = Page(server, Folder([Scene("room", "front3d_bedroom", (bed,))]), "rooms")
        assert page.scene.objects == (bed,)
        page.panel.furniture.value = MODELS
        page.show(page.shown)
        (found,) = page.scene.extra["retrieval"]
        assert found["model_id"].startswith("double_bed_")
        assert page.scene.objects[0].mesh is not None
        page.panel.furniture.value = DECODED
        page.show(page.shown)
        assert page.scene.objects == (bed,)
