"""Sets of rooms that an evaluation compares."""

from dataclasses import replace

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import SceneObject
from sceneprior.evaluation.room_sets import seeded_rows, without_void


def test_void_is_left_out_and_subsets_are_seeded(shards):
    real = reference_scenes(shards, "test", limit=1)[0]
    void = SceneObject("void", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    scene = replace(real, objects=(void, *real.objects))
    assert without_void(scene) == real
    rows = seeded_rows(20, 5, 0)
    assert rows == seeded_rows(20, 5, 0) == sorted(set(rows)) and len(rows) == 5
    assert rows != seeded_rows(20, 5, 1) and set(rows) < set(range(20))
    assert seeded_rows(20, 50, 0) == list(range(20))
