"""A user's own image: the same observation as from shards, and sentences for bad files."""

import json

import numpy as np
import pytest
from PIL import Image
from refusals import refused

from sceneprior.apps.reconstruction.own_image import (
    CAMERA_DISTANCE_M,
    SAME_CLASS,
    level_camera,
    read_gravity,
    read_intrinsics,
    read_own_image,
    read_pose,
)
from sceneprior.core.cameras import camera_at
from sceneprior.core.classes import label_set
from sceneprior.core.id_tables import tidy
from sceneprior.core.observations import thinned_intrinsics
from sceneprior.core.views import images_of_split

LABELS = "front3d_bedroom"
INTRINSICS = "48,48,48,36"


@pytest.fixture(scope="module")
def seen(toy_shards):
    return images_of_split(toy_shards, "test", 0)[0][0]


@pytest.fixture
def own(seen, tmp_path):
    """The view as three files, its ids times 10; (mask, classes, pose)."""
    names = label_set(LABELS)
    paths = [tmp_path / name for name in ("mask.png", "classes.json", "pose.json")]
    Image.fromarray((seen.instance_ids * 10).astype(np.uint8)).save(paths[0])
    classes = {str(10 * (k + 1)): names[index] for k, index in enumerate(seen.object_class)}
    paths[1].write_text(json.dumps(classes))
    paths[2].write_text(json.dumps({"world_to_camera": seen.world_to_camera.tolist()}))
    return paths


def read(mask, classes, pose, intrinsics=INTRINSICS):
    return read_own_image(mask, classes, intrinsics, LABELS, pose, None, 1, None)


def test_it_is_what_the_shards_say_of_the_same_view(own, seen):
    mask, classes, pose = own
    (image,), notes = read(mask, classes, pose)
    assert notes == [] and image.name == "mask"
    np.testing.assert_array_equal(image.instance_ids, seen.instance_ids)
    np.testing.assert_array_equal(image.object_class, seen.object_class)
    np.testing.assert_allclose(image.boxes, seen.boxes, atol=1e-6)
    np.testing.assert_allclose(image.world_to_camera, seen.world_to_camera)
    np.testing.assert_allclose(image.intrinsics, seen.intrinsics)


def test_without_a_pose_the_camera_is_level_on_any_of_four_sides(own):
    mask, classes, _ = own
    read = read_own_image(mask, classes, INTRINSICS, LABELS, None, 1.5, 4, None)
    assert read.notes[0].startswith("without --pose the camera is level, 1.5 m above the floor")
    assert (
        "it displaced objects by 34 cm" in read.notes[1] and "give --gravity x,y,z" in read.notes[1]
    )
    d, eyes = CAMERA_DISTANCE_M, []
    for image in read.images:
        pose = image.world_to_camera
        eyes.append(tuple(np.round(image.eye_m, 9) + 0.0))
        middle = pose @ np.array([0, 1.5, 0, 1])  # straight ahead, at the camera's own height
        np.testing.assert_allclose(middle, [0, 0, d, 1], atol=1e-12)
        above = pose @ np.array([0, 2.5, 0, 1])
        np.testing.assert_allclose(above - middle, [0, -1, 0, 0], atol=1e-12)  # y down
    assert eyes == [(0, 1.5, d), (d, 1.5, 0), (0, 1.5, -d), (-d, 1.5, 0)]


def test_unknown_classes_and_values_are_void_and_told(own, seen):
    mask, classes, pose = own
    table = json.loads(classes.read_text())
    first, last = min(table, key=int), max(table, key=int)
    table[first] = "grand piano"
    del table[last]
    classes.write_text(json.dumps(table))
    (image,), notes = read(mask, classes, pose)
    assert notes == [
        "classes outside the label set are void: grand piano (1)",
        f"{mask} has values that {classes} does not list, taken for void: {last}",
    ]
    np.testing.assert_array_equal(image.object_class, seen.object_class[1:-1])


SAME = {"fx": 40, "fy": 41, "cx": 48, "cy": 36}
MATRIX = [[40, 0, 48], [0, 41, 36], [0, 0, 1]]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (SAME, MATRIX),
        ({"K": MATRIX}, MATRIX),
        (MATRIX, MATRIX),
        ({**SAME, "width": 96}, MATRIX),
        ("40, 41,48,36", MATRIX),
        ("fov=90", [[48, 0, 48], [0, 48, 36], [0, 0, 1]]),  # half the width at 45 degrees
        # Film of 36 x 24 mm at 43.27 mm sees its diagonal at 53 degrees.
        ("35mm=43.26661", [[120, 0, 48], [0, 120, 36], [0, 0, 1]]),
    ],
    ids=str,
)
def test_intrinsics(tmp_path, given, expected):
    text = given
    if not isinstance(given, str):
        text = str(tmp_path / "camera.json")
        (tmp_path / "camera.json").write_text(json.dumps(given))
    np.testing.assert_allclose(read_intrinsics(text, (72, 96)), expected, rtol=1e-6, atol=1e-9)


def test_poses(own, seen, tmp_path):
    *_, pose = own
    pose.write_text(json.dumps({"camera_to_world": np.linalg.inv(seen.world_to_camera).tolist()}))
    np.testing.assert_allclose(read_pose(pose), seen.world_to_camera, atol=1e-5)
    down = camera_at(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0, 2.5, 0]))
    pose.write_text(json.dumps({"world_to_camera": down.tolist()}))  # straight down
    np.testing.assert_array_equal(read_pose(pose), down)


def test_large_pictures_are_thinned(own, tmp_path):
    """Every second pixel of one of 960."""
    mask, classes, pose = own
    large = Image.open(mask).resize((960, 720), Image.Resampling.NEAREST)
    large.save(tmp_path / "large.png")
    (image,), _ = read(tmp_path / "large.png", classes, pose, "480,480,480,360")
    (small,), _ = read(mask, classes, pose)
    assert image.instance_ids.shape == (360, 480)
    lens = np.diag([10, 10, 1]) @ small.intrinsics
    np.testing.assert_allclose(image.intrinsics, thinned_intrinsics(lens, 2))
    np.testing.assert_array_equal(image.instance_ids[2::5, 2::5], small.instance_ids)


def test_gravity_tilts_the_camera_where_it_stands(own):
    mask, classes, _ = own
    read = read_own_image(mask, classes, INTRINSICS, LABELS, None, 1.5, 1, "0.2,3,0.8")
    assert read.notes[0].startswith("without --pose the camera is tilted as given, 1.5 m above")
    assert not any("guess" in note for note in read.notes)
    (image,) = read.images
    np.testing.assert_allclose(image.eye_m, [0, 1.5, CAMERA_DISTANCE_M], atol=1e-12)
    down = np.array([0.2, 3, 0.8]) / np.linalg.norm([0.2, 3, 0.8])
    np.testing.assert_allclose(image.world_to_camera[:3, :3] @ [0, -1, 0], down, atol=1e-12)


def test_a_coco_file_lists_its_classes(own, seen, tmp_path):
    mask, classes, pose = own
    (height, width), names = seen.instance_ids.shape, label_set(LABELS)
    box = [10, 10, 40, 10, 40, 30, 10, 30]  # a rectangle as a polygon
    data = {
        "images": [{"id": 3, "height": height, "width": width}],
        "categories": [{"id": 4, "name": names[4]}],
        "annotations": [{"image_id": 3, "category_id": 4, "segmentation": [box]}],
    }
    coco = tmp_path / "coco.json"
    coco.write_text(json.dumps(data))
    (image,), _ = read(coco, None, pose)
    assert image.object_class.tolist() == [4] and (image.instance_ids == 1).sum() == 30 * 20
    with refused("apps/own_classes_twice", tmp=tmp_path):
        read(coco, classes, pose)
    with refused("apps/own_no_classes", tmp=tmp_path):
        read(mask, None, pose)


def test_classes_under_another_name_are_taken_for_the_label_sets(own):
    mask, classes, pose = own
    table = json.loads(classes.read_text())
    table = dict(zip(table, ["couch", "Bed", "hat", *list(table.values())[3:]], strict=False))
    classes.write_text(json.dumps(table))
    (image,), notes = read(mask, classes, pose)
    assert notes[:2] == [
        "the label set has no class Bed: taken for double bed (1)",
        "the label set has no class couch: taken for sofa (1)",
    ]
    names = label_set(LABELS)
    assert [names[index] for index in image.object_class][:2] == ["sofa", "double_bed"]
    known = {tidy(name) for each in (LABELS, "scannet") for name in label_set(each)}
    assert set(SAME_CLASS.values()) <= known


# -- Refusals --------------------------------------------------------------------------------------


def test_masks_of_nothing_known(own, tmp_path):
    mask, classes, _ = own
    Image.new("L", Image.open(mask).size).save(mask)
    with refused("apps/own_empty_mask", tmp=tmp_path):
        read(mask, classes, None)
    classes.write_text('{"10": "grand piano"}')
    with refused("apps/own_unknown_classes", tmp=tmp_path):
        read(mask, classes, None)


BAD_INTRINSICS = {
    "three": "40,40,48",
    "word": "fov=wide",
    "radians": "fov=1.08",
    "narrow": "fov=3.5",
    "no_film": "35mm=0",
    "shares": "0.7,0.7,48,36",
    "nan": "40,nan,48,36",
    "of_other_size": "240,240,240,180",
    "text_in_file": '{"fx": "40", "fy": 40, "cx": 48, "cy": 36}',
    "infinite": '{"K": [[1e400, 0, 48], [0, 40, 36], [0, 0, 1]]}',
    "huge": f"[[1{'0' * 400}, 0, 48], [0, 40, 36], [0, 0, 1]]",
    "one_key": '{"fx": 40}',
    "skew": "[[40, 1, 48], [0, 40, 36], [0, 0, 1]]",
    "no_json": "{",
    "size_in_file": '{"fx": 40, "fy": 40, "cx": 48, "cy": 36, "width": 640, "height": 480}',
}


@pytest.mark.parametrize("name", BAD_INTRINSICS)
def test_wrong_intrinsics_are_a_sentence(tmp_path, name):
    text = BAD_INTRINSICS[name]
    if text[0] in "{[":
        (tmp_path / "camera.json").write_text(text)
        text = str(tmp_path / "camera.json")
    with refused(f"apps/intrinsics_{name}", tmp=tmp_path):
        read_intrinsics(text, (72, 96))


@pytest.mark.parametrize("text", ["down", "0,1", "0,0,0", "0,nan,1", "0,1,0,0", "0,-1,0"])
def test_gravity_that_is_no_direction(text):
    with refused(f"apps/gravity_{text}"):
        read_gravity(text)


def test_wrong_poses_are_a_sentence(own, seen, tmp_path):
    *_, pose = own
    sunk = camera_at(level_camera(1.6)[:3, :3], np.array([0, -0.3, 1.5]))
    for name, matrix in {
        "short": [[1]],
        "mirrored": np.diag([1, 1, -1, 1]).tolist(),
        "text": [["1", "0", "0", "0"]] * 4,
        "huge": np.diag([1, 1, 1, 10**400]).tolist(),
        "nan": np.full((4, 4), np.nan).tolist(),
        "upside_down": (np.diag([1, -1, -1, 1]) @ seen.world_to_camera).tolist(),  # OpenGL's axes
        "below_the_floor": sunk.tolist(),
    }.items():
        pose.write_text(json.dumps({"world_to_camera": matrix}))
        with refused(f"apps/pose_{name}", tmp=tmp_path):
            read_pose(pose)
    for content in ("3", "[]", "{}"):
        pose.write_text(content)
        with refused("apps/pose_short", tmp=tmp_path):
            read_pose(pose)
    with refused("apps/pose_missing", tmp=tmp_path):
        read_pose(tmp_path / "nowhere.json")
