"""Ground truth of the shards as scenes, and the sets of rooms drawn from them."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from toy_rooms import write_shard

from sceneprior.core.errors import ShardError
from sceneprior.core.ground_truth import read_model, reference_scenes
from sceneprior.render.topdown import topdown


def test_a_room_holds_its_named_objects_seen_or_not_and_no_void(shards):
    scenes = reference_scenes(shards, "test")
    assert [scene.name for scene in scenes] == [f"house/test_{index}" for index in range(5)]
    assert [item.label for item in scenes[0].objects] == ["desk", "double_bed", "wardrobe"]
    assert scenes[0].floor_m.shape == (4, 2)
    seen = reference_scenes(shards, "test", limit=1, tracked_only=True)
    assert [item.label for item in seen[0].objects] == ["desk", "double_bed"]
    assert len(reference_scenes(shards, "train", limit=3)) == 3


def test_meshes_stand_where_the_boxes_are(shards):
    for scene in reference_scenes(shards, "test"):
        for item in scene.objects:
            low, high = item.mesh.vertices_m.min(0), item.mesh.vertices_m.max(0)
            # float32 in the shard and in the PLY: a micrometre.
            np.testing.assert_allclose((low + high) / 2, item.center_m, atol=1e-6)
            np.testing.assert_allclose(high - low, item.size_m, atol=1e-6)


def test_a_mirrored_model_still_faces_outwards(shards, tmp_path, toy_room):
    views, truth = toy_room("house/mirror", np.random.default_rng(5))
    mirrored = truth.model_to_room.copy()
    mirrored[:, 0, 0] *= -1
    rooms = [(views, truth), (replace(views, room_id="m"), replace(truth, model_to_room=mirrored))]
    write_shard(tmp_path / "test" / "a.h5", "front3d_bedroom", rooms)
    shutil.copytree(shards / "models", tmp_path / "models")
    plain, mirror = reference_scenes(tmp_path, "test")
    for scene in (plain, mirror):
        a, b, c = np.swapaxes(scene.objects[0].mesh.vertices_m[scene.objects[0].mesh.faces], 0, 1)
        volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6
        assert volume == pytest.approx(1.2 * 0.75 * 0.6, abs=1e-5)
    np.testing.assert_array_equal(topdown(plain), topdown(mirror))


def test_a_model_that_changed_is_read_again(tmp_path):
    path = tmp_path / "bed.ply"
    for second, size in enumerate([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]):
        trimesh.creation.box(size).export(path)
        os.utime(path, (second, second))
        assert np.ptp(read_model(path).vertices_m, axis=0).tolist() == list(size)
        assert read_model(path) is read_model(path)


def test_missing_and_damaged_models_are_named(tmp_path, toy_room):
    views, truth = toy_room("house/a", np.random.default_rng(0))
    write_shard(tmp_path / "test" / "a.h5", "front3d_bedroom", [(views, truth)])
    with pytest.raises(ShardError, match=r"desk_v0\.ply is missing"):
        reference_scenes(tmp_path, "test")
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "desk_v0.ply").write_text("not a mesh\n")
    with pytest.raises(ShardError, match="is not a triangle mesh"):
        reference_scenes(tmp_path, "test")


def test_shards_without_ground_truth_say_so(tmp_path, toy_room):
    views, _ = toy_room("house/a", np.random.default_rng(0))
    write_shard(tmp_path / "test" / "a.h5", "front3d_bedroom", [(views, None)])
    with pytest.raises(ShardError, match="carries no 3D ground truth"):
        reference_scenes(tmp_path, "test")
