"""Rooms under gravity in MuJoCo: those of the shipped priors stand still."""

import numpy as np
import pytest
from rooms_of_solids import solid_box

from sceneprior.apps.api import load
from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.scene import Scene, SceneObject, Solid
from sceneprior.evaluation.metrics.stability import settle, stable_count

pytest.importorskip("mujoco", reason="no mujoco here: pip install -e '.[sim]'")


def test_floating_and_leaning_objects_are_not_stable():
    standing = solid_box("nightstand", (0, 0.3, 0), (0.5, 0.6, 0.5))
    floating = solid_box("nightstand", (1, 0.35, 0), (0.5, 0.6, 0.5))
    lamp = solid_box("pendant_lamp", (0, 2.2, 0), (0.4, 0.4, 0.4))
    board = Solid("box", (1.75, 0.5, -0.25), (2.25, 0.6, 0.25))
    leg = Solid("box", (1.75, 0.0, -0.25), (1.8, 0.5, 0.25))
    leaning = SceneObject("table", (2.0, 0.3, 0.0), (0.5, 0.6, 0.5), solids=(board, leg))
    found = settle(Scene("room", "front3d_bedroom", (standing, floating, lamp, leaning)))
    assert found.stable.tolist() == [True, False, True, False]
    assert found.moved_m[1] == pytest.approx(0.05, abs=2e-3)  # it falls to the floor
    assert found.turned_rad[3] > 0.5
    assert found.penetration_m < 1e-6


def test_overlaps_at_the_start_are_measured():
    """Two boxes 10 cm into each other."""
    pair = (solid_box("table", (0, 0.5, 0), (1, 1, 1)), solid_box("desk", (0.9, 0.5, 0), (1, 1, 1)))
    assert settle(Scene("room", "front3d_bedroom", pair), 0.01).penetration_m == pytest.approx(0.1)
    assert stable_count(Scene("room", "front3d_bedroom", pair))["stable_share"] < (2, 2)
    assert stable_count(Scene("room", "front3d_bedroom"))["stable_share"] == (0, 0)


@pytest.mark.parametrize("name", ["procthor-bedroom", "procthor-living", "demo-bedroom"])
def test_rooms_of_shipped_priors_stand_still(name):
    """8 rooms of each prior: at least 97% of objects stay, and nothing overlaps at the start."""
    rooms = [make_stable(room)[0] for room in load(name).sample(8, seed=1)]
    found = [settle(room) for room in rooms]
    assert max(one.penetration_m for one in found) <= 1e-3
    stable = np.concatenate([one.stable for one in found])
    assert stable.mean() >= 0.97
