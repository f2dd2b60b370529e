"""Box lists of other methods become scenes of ours: conventions, padding, turns, refusals."""

import json

import numpy as np
import pytest

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.interchange.box_lists import read_box_lists, turned_box
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
    (scene,) = read_box_lists(save(tmp_path), BEDROOM)
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
    foot = np.array([2.0 * s / 2, 0, 2.0 * c / 2]) + bed.center_m
    distances = np.linalg.norm(bed.mesh.vertices_m - foot, axis=1)
    np.testing.assert_allclose(np.sort(distances)[:4], np.hypot(0.9, 0.3), atol=1e-6)
    (whole,) = read_box_lists(save(tmp_path), BEDROOM, sizes="full")
    np.testing.assert_allclose(whole.objects[0].size_m, (0.3, 0.4, 0.6), atol=1e-6)
    square = turned_box("table", np.array([0.0, 0.4, 0.0]), np.array([2.0, 0.8, 2.0]), 0.3)
    covered = (topdown(Scene("a", BEDROOM, (square,))) != 255).any(-1).sum() * 0.0125**2
    assert covered == pytest.approx(4.0, rel=0.01)


def test_start_end_and_padding_are_no_furniture(tmp_path):
    row = {"translations": np.ones((5, 3)), "sizes": np.ones((5, 3)), "angles": np.zeros((5, 1))}
    path = save(tmp_path, class_labels=one_hot(21, DESK, BED, 22, DESK), **row)
    assert labels_of(read_box_lists(path, BEDROOM)[0]) == ["desk", "double_bed"]
    several = {key: np.stack([value, value]) for key, value in row.items()}
    labels = np.stack([one_hot(DESK, 22, 22, 22, 22), one_hot(BED, DESK, DESK, 22, 22)])
    rooms = read_box_lists(save(tmp_path, "a.npz", class_labels=labels, **several), BEDROOM)
    assert [scene.name for scene in rooms] == ["a_0000", "a_0001"]
    assert [labels_of(scene) for scene in rooms] == [["desk"], ["double_bed", "desk", "desk"]]
    # After the `end` of each room, rows may be empty; scores may all be negative.
    padded = labels * (np.arange(5) <= [[1], [3]])[..., None]
    for name, values in (("padded", padded), ("scores", labels - 2.0)):
        path = save(tmp_path, f"{name}.npz", class_labels=values, **several)
        assert [*map(labels_of, read_box_lists(path, BEDROOM))] == [*map(labels_of, rooms)]
    path = save(tmp_path, class_labels=np.array([2, 1, 0, 1, 2]), **row)
    (scene,) = read_box_lists(path, BEDROOM, "double_bed, empty, desk")
    assert labels_of(scene) == ["desk", "double_bed", "desk"]
    assert labels_of(read_box_lists(path, BEDROOM)[0])[:2] == ["cabinet", "bookshelf"]


def test_json_by_name_and_floor_plans_are_read(tmp_path):
    record = {key: value.tolist() for key, value in atiss().items()}
    record |= {"class_labels": ["desk", "kids_bed"]}
    empty = {"class_labels": [], "translations": [], "sizes": [], "angles": []}
    (tmp_path / "rooms.json").write_text(json.dumps([record, empty]))
    floor = {
        "floor_plan_vertices": np.array([[1.0, 5, 1], [5, 5, 1], [5, 5, 3], [1, 5, 3]]),
        "floor_plan_faces": np.array([[0, 1, 2], [0, 3, 2]]),
        "floor_plan_centroid": np.array([3.0, 5.0, 2.0]),
    }
    save(tmp_path, "uid/boxes.npz", **floor)
    first, second, scene = read_box_lists(tmp_path, BEDROOM)
    assert [labels_of(first), labels_of(second)] == [["desk", "kids_bed"], []]
    assert [first.name, second.name, scene.name] == ["rooms_0000", "rooms_0001", "uid"]
    assert {tuple(corner) for corner in scene.floor_m} >= {(-2, -1), (2, -1), (2, 1), (-2, 1)}
    assert np.abs(scene.floor_m).max(0).tolist() == [2, 1]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"sizes": np.ones((3, 3))}, "do not describe the same objects"),
        ({"angles": np.zeros((2, 0))}, r"angles \(2, 0\) do not describe the same objects"),
        ({"angles": np.full((2, 1), np.nan)}, "not finite"),
        ({"sizes": np.zeros((2, 3))}, "sizes above 0"),
        ({"sizes": np.full((2, 3), 90)}, r"a desk .* Are these centimetres\? Give metres"),
        ({"class_labels": np.zeros((2, 0))}, "neither names, indices nor one-hot rows"),
        ({"class_labels": np.zeros((2, 21))}, "a row of class_labels has no class"),
        ({"class_labels": np.full((2, 21), np.nan)}, "a row of class_labels has no class"),
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
        read_box_lists(save(tmp_path, **changes), BEDROOM)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.npz", "x", r"it holds no arrays, or Python objects\); expected a box list"),
        ("a.json", "{", r"a\.json is not JSON .*; expected a box list"),
        ("a.json", "[1]", r"a\.json is not a box list"),
        ("a.json", '{"class_labels": [[1], [1, 2]], "translations": [], "sizes": [], "angles": []}',
         "class_labels, translations, sizes and angles must be"),
        ("a.json", '{"sizes": []}', "has no class_labels and no translations and no angles"),
        ("absent/a.txt", "", r"holds no \.npz and no \.json"),
    ],
)  # fmt: skip
def test_files_that_are_none_are_named(tmp_path, name, content, sentence):
    (tmp_path / "absent").mkdir()
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=sentence):
        read_box_lists(tmp_path, BEDROOM)
    with pytest.raises(InputError, match="No sizes 'third'"):
        read_box_lists(tmp_path, BEDROOM, sizes="third")
