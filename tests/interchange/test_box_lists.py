"""Box lists of other methods become scenes of ours: conventions, padding, turns, refusals."""

import json

import numpy as np
import pytest

from sceneprior.apps.rooms import write_scenes
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.interchange.box_lists import read_box_lists, read_boxes, turned_box
from sceneprior.render.scene_files import load_scene_folder
from sceneprior.render.topdown import topdown

BEDROOM = "front3d_bedroom"
DESK, BED = 7, 8
"""Columns of ATISS's one-hot rows: the paper's classes without void, start and end after them."""


def one_hot(*columns: int) -> np.ndarray:
    return np.eye(23, dtype=np.float32)[list(columns)]


def atiss(**changes) -> dict[str, np.ndarray]:
    """A desk at a right angle, and a bed turned by 30 degrees."""
    return {
        "class_labels": one_hot(DESK, BED),
        "translations": np.array([[1.0, 0.4, -1.0], [0.0, 0.3, 0.5]], np.float32),
        "sizes": np.array([[0.6, 0.4, 0.3], [0.9, 0.3, 1.0]], np.float32),
        "angles": np.array([[np.pi / 2], [np.pi / 6]], np.float32),
    } | changes


def save(folder, name="boxes.npz", **changes):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **atiss(**changes))
    return path


def labels_of(scene: Scene) -> list[str]:
    return [item.label for item in scene.objects]


def test_half_extents_turn_into_boxes_around_the_turned_piece(tmp_path):
    (scene,) = read_boxes(save(tmp_path), "room", BEDROOM)
    assert labels_of(scene) == ["desk", "double_bed"] and scene.floor_m is None
    desk, bed = scene.objects
    # A quarter turn: width and depth change places, and a box it stays.
    np.testing.assert_allclose(desk.size_m, (0.6, 0.8, 1.2), atol=1e-6)
    assert desk.mesh is None and desk.center_m == pytest.approx((1.0, 0.4, -1.0))
    c, s = np.cos(np.pi / 6), 0.5
    np.testing.assert_allclose(bed.size_m, (1.8 * c + 2 * s, 0.6, 1.8 * s + 2 * c), atol=1e-6)
    # The mesh is the turned box: it fills its own bounds, and its foot end went towards +x.
    low, high = bed.mesh.vertices_m.min(0), bed.mesh.vertices_m.max(0)
    np.testing.assert_allclose(high - low, bed.size_m, atol=1e-6)
    np.testing.assert_allclose((high + low) / 2, bed.center_m, atol=1e-6)
    foot = np.array([2.0 * s / 2, 0, 2.0 * c / 2]) + bed.center_m
    distances = np.linalg.norm(bed.mesh.vertices_m - foot, axis=1)
    np.testing.assert_allclose(np.sort(distances)[:4], np.hypot(0.9, 0.3), atol=1e-6)
    (whole,) = read_boxes(save(tmp_path), "room", BEDROOM, size_factor=1.0)
    np.testing.assert_allclose(whole.objects[0].size_m, (0.3, 0.4, 0.6), atol=1e-6)


def test_a_turned_square_covers_its_own_area_in_the_picture():
    item = turned_box("table", np.array([0.0, 0.4, 0.0]), np.array([2.0, 0.8, 2.0]), 0.3)
    image = topdown(Scene("a", BEDROOM, (item,)))
    covered = (image != 255).any(-1).sum() * 0.0125**2
    assert covered == pytest.approx(4.0, rel=0.01)
    for quarter in range(-4, 5):
        still = turned_box("table", np.zeros(3), np.array([1.0, 1, 2]), quarter * np.pi / 2)
        assert still.mesh is None
        assert still.size_m == pytest.approx((2, 1, 1) if quarter % 2 else (1, 1, 2))


def test_start_end_and_padding_are_no_furniture(tmp_path):
    row = {"translations": np.ones((5, 3)), "sizes": np.ones((5, 3)), "angles": np.zeros((5, 1))}
    path = save(tmp_path, class_labels=one_hot(21, DESK, BED, 22, DESK), **row)
    assert labels_of(read_boxes(path, "a", BEDROOM)[0]) == ["desk", "double_bed"]
    several = {key: np.stack([value, value]) for key, value in row.items()}
    labels = np.stack([one_hot(DESK, 22, 22, 22, 22), one_hot(BED, DESK, DESK, 22, 22)])
    rooms = read_boxes(save(tmp_path, class_labels=labels, **several), "a", BEDROOM)
    assert [scene.name for scene in rooms] == ["a_0000", "a_0001"]
    assert [labels_of(scene) for scene in rooms] == [["desk"], ["double_bed", "desk", "desk"]]
    columns = ["double_bed", "empty", "desk"]
    path = save(tmp_path, class_labels=np.array([2, 1, 0, 1, 2]), **row)
    assert labels_of(read_boxes(path, "a", BEDROOM, columns)[0]) == ["desk", "double_bed", "desk"]
    assert labels_of(read_boxes(path, "a", BEDROOM)[0])[:2] == ["cabinet", "bookshelf"]


def test_json_by_name_and_floor_plans_are_read(tmp_path):
    record = {key: value.tolist() for key, value in atiss().items()}
    record |= {"class_labels": ["desk", "kids_bed"]}
    empty = {"class_labels": [], "translations": [], "sizes": [], "angles": []}
    path = tmp_path / "rooms.json"
    path.write_text(json.dumps([record, empty]))
    rooms = read_boxes(path, "r", BEDROOM)
    assert [labels_of(scene) for scene in rooms] == [["desk", "kids_bed"], []]
    floor = {
        "floor_plan_vertices": np.array([[1.0, 5, 1], [5, 5, 1], [5, 5, 3], [1, 5, 3]]),
        "floor_plan_faces": np.array([[0, 1, 2], [0, 3, 2]]),
        "floor_plan_centroid": np.array([3.0, 5.0, 2.0]),
    }
    (scene,) = read_boxes(save(tmp_path, **floor), "r", BEDROOM)
    assert {tuple(corner) for corner in scene.floor_m} >= {(-2, -1), (2, -1), (2, 1), (-2, 1)}
    assert np.abs(scene.floor_m).max(0).tolist() == [2, 1]


def test_a_folder_becomes_scenes_that_are_read_back(tmp_path):
    for name in ("uid_a", "uid_b"):
        save(tmp_path / "theirs", f"{name}/boxes.npz")
    found = read_box_lists(tmp_path / "theirs", BEDROOM)
    write_scenes(found, tmp_path / "ours")
    scenes = load_scene_folder(tmp_path / "ours")
    assert len(found) == 2 and [scene.name for scene in scenes] == ["uid_a", "uid_b"]
    (direct,) = read_boxes(tmp_path / "theirs" / "uid_a" / "boxes.npz", "uid_a", BEDROOM)
    np.testing.assert_allclose(scenes[0].sizes_m, direct.sizes_m, atol=1e-5)
    np.testing.assert_array_equal(topdown(scenes[0]), topdown(direct))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"sizes": np.ones((3, 3))}, "do not describe the same objects"),
        ({"angles": np.zeros((2, 0))}, r"angles \(2, 0\) do not describe the same objects"),
        ({"angles": np.full((2, 1), np.nan)}, "not finite"),
        ({"sizes": np.zeros((2, 3))}, "sizes above 0"),
        ({"sizes": np.full((2, 3), 90)}, r"a desk .* Are these centimetres\? Give metres"),
        ({"class_labels": np.zeros((2, 0))}, "neither names, indices nor one-hot rows"),
        ({"angles": np.zeros((2, 1), complex)}, "must be arrays, the last three of numbers"),
        ({key: np.ones((1001, 3)) for key in ("translations", "sizes")}
         | {"angles": np.zeros(1001), "class_labels": np.ones(1001, int)}, "1001 objects"),
        ({"class_labels": np.eye(30)[:2]}, "have 30 columns, but there are 21 names"),
        ({"class_labels": np.array(["desk", "lamp"])}, "'lamp' is not in label set"),
        ({"floor_plan_vertices": np.ones(3), "floor_plan_faces": np.ones(3),
          "floor_plan_centroid": np.ones(3)}, "its floor plan cannot be read"),
        ({"floor_plan_vertices": np.eye(3) * 900, "floor_plan_faces": np.array([[0, 1, 2]]),
          "floor_plan_centroid": np.zeros(3)}, "the floor reaches 900 m .* centimetres"),
    ],
)  # fmt: skip
def test_what_is_no_box_list_is_a_sentence(tmp_path, changes, sentence):
    with pytest.raises(InputError, match=sentence):
        read_boxes(save(tmp_path, **changes), "a", BEDROOM)


def test_files_that_are_none_are_named(tmp_path):
    for name, content in (("a.npz", "x"), ("a.json", "{"), ("b.json", "[1]")):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match=f"{name} is not a box list"):
            read_boxes(tmp_path / name, "a", BEDROOM)
    (tmp_path / "c.json").write_text('{"sizes": []}')
    (tmp_path / "d.json").write_text('{"class_labels": [[1], [1, 2]], "translations": [], "sizes": '
                                     '[], "angles": []}')  # fmt: skip
    with pytest.raises(InputError, match="class_labels, translations, sizes and angles must be"):
        read_boxes(tmp_path / "d.json", "a", BEDROOM)
    with pytest.raises(InputError, match="has no class_labels and no translations and no angles"):
        read_boxes(tmp_path / "c.json", "a", BEDROOM)
    with pytest.raises(InputError, match=r"holds no \.npz and no \.json"):
        read_box_lists(tmp_path / "absent", BEDROOM)
    with pytest.raises(InputError, match="No sizes 'third'"):
        read_box_lists(tmp_path, BEDROOM, sizes="third")
