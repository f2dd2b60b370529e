"""Which rooms the sets of an evaluation hold."""

from dataclasses import replace

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import SceneObject
from sceneprior.evaluation.room_sets import choose_rooms, seeded_rows, without_void


def test_void_is_left_out_and_subsets_are_seeded(shards):
    real = reference_scenes(shards, "test", limit=1)[0]
    void = SceneObject("void", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    scene = replace(real, objects=(void, *real.objects))
    assert without_void(scene) == real
    rows = seeded_rows(20, 5, 0)
    assert rows == seeded_rows(20, 5, 0) == sorted(set(rows)) and len(rows) == 5
    assert rows != seeded_rows(20, 5, 1) and set(rows) < set(range(20))
    assert seeded_rows(20, 50, 0) == list(range(20))


def test_real_and_made_up_rooms_are_as_many_as_generated_ones(shards):
    train = reference_scenes(shards, "train", meshes=False)
    rooms = choose_rooms(train[:3], shards, "test", 4, train[:6])
    sizes = {name: len(scenes) for name, scenes in rooms.groups.items()}
    three = ("generated", "train", "independent", "shuffled", "decoded_rooms")
    assert sizes == {"test": 5, **dict.fromkeys(three, 3)}
    names = [scene.name for scene in rooms.groups["train"]]
    assert names == [train[row].name for row in rooms.train_rows]
    assert set(choose_rooms(train, shards, "test", 4, []).groups) == {*three[:4], "test"}
