"""Homes on disk: models as they were built, floors and walls facing the right way."""

import numpy as np
import pytest
import trimesh
from homes_on_disk import TYPES
from shapely.geometry import LineString, Point

from sceneprior.furniture.catalog import make_catalog


def test_models_on_disk_load_as_they_were_built(homes):
    folder = homes["bedroom"] / "3D-FUTURE-model"
    for models in make_catalog(0, "front3d_bedroom").values():
        loaded = trimesh.load_mesh(folder / models[0].jid / "raw_model.obj", process=False)
        np.testing.assert_allclose(loaded.bounds, models[0].mesh.bounds, atol=6e-5)
        assert len(loaded.faces) == len(models[0].mesh.faces)


@pytest.mark.parametrize("room_type", TYPES)
def test_floor_looks_up_walls_look_in_and_outer_walls_out(rooms, room_type):
    for room in rooms[room_type][:60]:
        kinds = {"Floor", "Ceiling", "WallInner", "WallOuter", "Door"}
        assert {m["type"] for m in room["meshes"]} == kinds
        for mesh in room["meshes"]:
            points = np.reshape(mesh["xyz"], (-1, 3))[np.reshape(mesh["faces"], (-1, 3))]
            normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            np.testing.assert_allclose(normal, np.reshape(mesh["normal"], (-1, 3))[::3], atol=1e-4)
            if mesh["type"] in ("Floor", "Ceiling"):
                assert np.all(normal[:, 1] == (1 if mesh["type"] == "Floor" else -1))
                continue
            step = points.mean(axis=(0, 1)) + 0.05 * normal[0]
            inside = room["floor"].contains(Point(step[[0, 2]]))
            assert inside == (mesh["type"] in ("WallInner", "Door"))


@pytest.mark.parametrize("room_type", TYPES)
def test_a_door_is_in_a_wall_and_no_furniture_stands_before_it(rooms, room_type):
    for room in rooms[room_type]:
        (door,) = (mesh for mesh in room["meshes"] if mesh["type"] == "Door")
        points = np.reshape(door["xyz"], (-1, 3))
        base = LineString(np.unique(points[points[:, 1] == 0][:, [0, 2]], axis=0))
        assert base.length == pytest.approx(0.9) and points[:, 1].max() == 2.0
        assert max(room["floor"].exterior.distance(Point(xy)) for xy in base.coords) < 0.006
        before = base.buffer(0.3, cap_style="flat")
        standing = [p["footprint"] for p in room["pieces"] if p["levels"][0] < 0.5]
        assert not any(before.intersection(piece).area > 1e-6 for piece in standing)
