"""A user's own image: the same observation as from shards, and sentences for bad files."""

import json

import numpy as np
import pytest
from PIL import Image

from sceneprior.apps.reconstruction.own_image import (
    CAMERA_DISTANCE_M,
    SAME_CLASS,
    level_camera,
    read_gravity,
    read_intrinsics,
    read_own_image,
    read_pose,
    tilted,
)
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import tidy
from sceneprior.core.observed_image import images_of_split

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


def test_it_is_what_the_shards_say_of_the_same_view(own, seen):
    mask, classes, pose = own
    read = read_own_image(mask, classes, INTRINSICS, LABELS, pose)
    (image,) = read.images
    assert read.notes == [] and image.name == "mask"
    np.testing.assert_array_equal(image.instance_ids, seen.instance_ids)
    np.testing.assert_array_equal(image.object_class, seen.object_class)
    np.testing.assert_allclose(image.boxes, seen.boxes, atol=1e-6)
    np.testing.assert_allclose(image.world_to_camera, seen.world_to_camera)
    np.testing.assert_allclose(image.intrinsics, seen.intrinsics)


def test_without_a_pose_the_camera_is_level_on_any_of_four_sides(own):
    mask, classes, _ = own
    read = read_own_image(mask, classes, INTRINSICS, LABELS, camera_height_m=1.5)
    assert read.notes[0].startswith("without --pose the camera is level, 1.5 m above the floor")
    assert (
        "it displaced objects by 34 cm" in read.notes[1] and "give --gravity x,y,z" in read.notes[1]
    )
    eyes = []
    for quarter, image in enumerate(read.images):
        pose = image.world_to_camera
        np.testing.assert_array_equal(pose, level_camera(1.5, quarter))
        eyes.append(tuple(np.round(-pose[:3, :3].T @ pose[:3, 3], 9) + 0.0))
        middle = pose @ np.array([0, 1.5, 0, 1])  # straight ahead, at the camera's own height
        np.testing.assert_allclose(middle, [0, 0, CAMERA_DISTANCE_M, 1], atol=1e-12)
        above = pose @ np.array([0, 2.5, 0, 1])
        np.testing.assert_allclose(above - middle, [0, -1, 0, 0], atol=1e-12)  # y down
    d = CAMERA_DISTANCE_M
    assert eyes == [(0, 1.5, d), (d, 1.5, 0), (0, 1.5, -d), (-d, 1.5, 0)]


def test_unknown_classes_and_values_are_void_and_told(own, seen):
    mask, classes, pose = own
    table = json.loads(classes.read_text())
    first, last = min(table, key=int), max(table, key=int)
    table[first] = "grand piano"
    del table[last]
    classes.write_text(json.dumps(table))
    read = read_own_image(mask, classes, INTRINSICS, LABELS, pose)
    assert read.notes == [
        "classes outside the label set are void: grand piano (1)",
        f"{mask} has values that {classes} does not list, taken for void: {last}",
    ]
    np.testing.assert_array_equal(read.images[0].object_class, seen.object_class[1:-1])


def test_masks_of_nothing_known(own):
    mask, classes, _ = own
    size = Image.open(mask).size
    Image.new("L", size).save(mask)
    with pytest.raises(InputError, match=r"mask\.png shows no object: .*Its values are 0; "):
        read_own_image(mask, classes, INTRINSICS, LABELS)
    classes.write_text('{"10": "grand piano"}')
    with pytest.raises(InputError, match=r"none of its classes \(grand piano\) is in the label s"):
        read_own_image(mask, classes, INTRINSICS, LABELS)


def test_intrinsics(tmp_path):
    path = tmp_path / "camera.json"
    expected = np.array([[40, 0, 48], [0, 41, 36], [0, 0, 1]])
    same = {"fx": 40, "fy": 41, "cx": 48, "cy": 36}
    for data in (same, {"K": expected.tolist()}, expected.tolist(), {**same, "width": 96}):
        path.write_text(json.dumps(data))
        np.testing.assert_array_equal(read_intrinsics(str(path), (72, 96)), expected)
    np.testing.assert_array_equal(read_intrinsics("40, 41,48,36", (72, 96)), expected)
    path.write_text(json.dumps({**same, "width": 640, "height": 480}))
    with pytest.raises(
        InputError, match="is for an image of 640 x 480 pixels, but the mask has 96"
    ):
        read_intrinsics(str(path), (72, 96))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("40,40,48", "--intrinsics 40,40,48 gives no intrinsics; expected fx,fy,cx,cy in pixels"),
        ("fov=wide", "--intrinsics fov=wide gives no intrinsics"),
        (
            "fov=1.08",
            "fov=1.08: no camera has so small a field of view. If 1.08 is in radians, give "
            "degrees: fov=61.9.",
        ),
        (
            "fov=3.5",
            "sees 3.5 degrees, expected 5 to 160; give that of this image, not of a larger",
        ),
        ("0.7,0.7,48,36", "give pixels, not a share of the width or millimetres."),
        ('{"fx": "40", "fy": 40, "cx": 48, "cy": 36}', "holds no intrinsics"),
        ('{"K": [[1e400, 0, 48], [0, 40, 36], [0, 0, 1]]}', "is not a pinhole camera"),
        (f"[[1{'0' * 400}, 0, 48], [0, 40, 36], [0, 0, 1]]", "holds no intrinsics"),
        ("[" * 3000 + "]" * 3000, "camera.json is not JSON"),
        ("40,nan,48,36", "is not a pinhole camera"),
        ('{"fx": 40}', "holds no intrinsics"),
        ("[[40, 1, 48], [0, 40, 36], [0, 0, 1]]", "no skew"),
        ("{", "camera.json is not JSON"),
    ],
)
def test_intrinsics_that_are_none(tmp_path, text, said):
    if text[0] in "{[":
        (tmp_path / "camera.json").write_text(text)
        text = str(tmp_path / "camera.json")
    with pytest.raises(InputError) as error:
        read_intrinsics(text, (72, 96))
    assert said in str(error.value)


def test_intrinsics_as_photographers_say_them():
    """Half the width at 45 degrees; film of 36 x 24 mm at 43.27 mm sees its diagonal at 53."""
    wide = read_intrinsics("fov=90", (72, 96))
    np.testing.assert_allclose(wide, [[48, 0, 48], [0, 48, 36], [0, 0, 1]], atol=1e-9)
    normal = read_intrinsics("35mm=43.2666", (72, 96))
    np.testing.assert_allclose(normal, [[120, 0, 48], [0, 120, 36], [0, 0, 1]], rtol=1e-5)
    phone = read_intrinsics("35mm=26", (240, 360))  # of film's own shape
    assert phone[0, 0] / 360 == pytest.approx(26 / 36)
    with pytest.raises(InputError, match="--intrinsics 35mm=0 is not a pinhole camera"):
        read_intrinsics("35mm=0", (72, 96))


def test_poses(own, seen, tmp_path):
    *_, pose = own
    pose.write_text(json.dumps({"camera_to_world": np.linalg.inv(seen.world_to_camera).tolist()}))
    np.testing.assert_allclose(read_pose(pose), seen.world_to_camera, atol=1e-5)
    mirrored = np.diag([1, 1, -1, 1]).tolist()
    texts = [[str(value) for value in row] for row in np.eye(4)]
    huge = np.diag([1, 1, 1, 10**400]).tolist()
    lost = np.full((4, 4), np.nan).tolist()
    for data in (
        3, [], {}, {"world_to_camera": [[1]]}, {"world_to_camera": mirrored},
        {"world_to_camera": texts}, {"world_to_camera": huge}, {"world_to_camera": lost},
    ):  # fmt: skip
        pose.write_text(json.dumps(data))
        with pytest.raises(InputError, match=r"pose\.json holds no pose; expected"):
            read_pose(pose)
    with pytest.raises(InputError, match=r"nowhere\.json cannot be read"):
        read_pose(tmp_path / "nowhere.json")


def test_a_camera_that_is_upside_down_or_underground(own, seen):
    """OpenGL's axes, the usual mistake: y up and z backwards."""
    *_, pose = own

    def said(world_to_camera) -> str:
        pose.write_text(json.dumps({"world_to_camera": np.asarray(world_to_camera).tolist()}))
        with pytest.raises(InputError) as error:
            read_pose(pose)
        return str(error.value)

    assert "pose.json is upside down" in said(np.diag([1, -1, -1, 1]) @ seen.world_to_camera)
    sunk = level_camera(1.6)
    sunk[:3, 3] = -sunk[:3, :3] @ np.array([0, -0.3, 1.5])
    assert "pose.json is 0.3 m below the floor" in said(sunk)
    down = np.eye(4)
    down[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # from above, straight down
    down[:3, 3] = -down[:3, :3] @ np.array([0, 2.5, 0])
    pose.write_text(json.dumps({"world_to_camera": down.tolist()}))
    np.testing.assert_array_equal(read_pose(pose), down)


def test_a_mask_of_another_size_than_the_cameras(own):
    mask, classes, pose = own
    with pytest.raises(InputError, match=r"cx = 240 and cy = 180, is outside the mask of 96 x 72"):
        read_own_image(mask, classes, "240,240,240,180", LABELS, pose)


def test_large_pictures_are_thinned(own, seen, tmp_path):
    """Every second pixel of one of 960."""
    mask, classes, pose = own
    large = Image.open(mask).resize((960, 720), Image.Resampling.NEAREST)
    large.save(tmp_path / "large.png")
    (image,) = read_own_image(
        tmp_path / "large.png", classes, "480,480,480,360", LABELS, pose
    ).images
    (small,) = read_own_image(mask, classes, INTRINSICS, LABELS, pose).images
    assert image.instance_ids.shape == (360, 480)
    np.testing.assert_allclose(image.intrinsics, np.diag([5, 5, 1]) @ small.intrinsics)
    np.testing.assert_array_equal(image.instance_ids[2::5, 2::5], small.instance_ids)


def test_gravity_tilts_the_camera_where_it_stands(own):
    mask, classes, _ = own
    read = read_own_image(
        mask, classes, INTRINSICS, LABELS, camera_height_m=1.5, sides=1, gravity="0.2,3,0.8"
    )
    assert read.notes[0].startswith("without --pose the camera is tilted as given, 1.5 m above")
    assert not any("guess" in note for note in read.notes)
    (image,) = read.images
    np.testing.assert_allclose(image.eye_m, [0, 1.5, CAMERA_DISTANCE_M], atol=1e-12)
    down = np.array([0.2, 3, 0.8]) / np.linalg.norm([0.2, 3, 0.8])
    np.testing.assert_allclose(image.world_to_camera[:3, :3] @ [0, -1, 0], down, atol=1e-12)
    turn = image.world_to_camera[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_array_equal(tilted(np.array([0.0, 1.0, 0.0])), np.eye(4))


@pytest.mark.parametrize("text", ["down", "0,1", "0,0,0", "0,nan,1", "0,1,0,0"])
def test_gravity_that_is_no_direction(text):
    with pytest.raises(InputError, match="is not a direction; expected x,y,z in camera axes"):
        read_gravity(text)
    with pytest.raises(InputError, match="points up in the image: the camera is upside down"):
        read_gravity("0,-1,0")


def test_coco_says_the_same_as_a_png_and_its_table(own, seen, tmp_path):
    mask, classes, pose = own
    names = label_set(LABELS)
    rows = []
    for k, index in enumerate(seen.object_class.tolist()):
        counts, before = [0], False
        for pixel in (seen.instance_ids == k + 1).T.ravel().tolist():
            if pixel != before:
                counts.append(0)
                before = pixel
            counts[-1] += 1
        segmentation = {"size": list(seen.instance_ids.shape), "counts": counts}
        rows.append({"image_id": 3, "category_id": index, "segmentation": segmentation})
    height, width = seen.instance_ids.shape
    data = {
        "images": [{"id": 3, "height": height, "width": width}],
        "categories": [{"id": index, "name": name} for index, name in enumerate(names)],
        "annotations": rows,
    }
    coco = tmp_path / "coco.json"
    coco.write_text(json.dumps(data))
    (image,) = read_own_image(coco, None, INTRINSICS, LABELS, pose).images
    np.testing.assert_array_equal(image.instance_ids, seen.instance_ids)
    np.testing.assert_array_equal(image.object_class, seen.object_class)
    with pytest.raises(InputError, match="already lists its classes; leave out --classes"):
        read_own_image(coco, classes, INTRINSICS, LABELS, pose)
    with pytest.raises(InputError, match=r"mask\.png needs --classes: a table of the class"):
        read_own_image(mask, None, INTRINSICS, LABELS, pose)


def test_classes_under_another_name_are_taken_for_the_label_sets(own):
    mask, classes, pose = own
    table = json.loads(classes.read_text())
    table = dict(zip(table, ["couch", "Bed", "hat", *list(table.values())[3:]], strict=False))
    classes.write_text(json.dumps(table))
    read = read_own_image(mask, classes, INTRINSICS, LABELS, pose)
    assert read.notes[:2] == [
        "the label set has no class Bed: taken for double bed (1)",
        "the label set has no class couch: taken for sofa (1)",
    ]
    assert read.notes[2:] == ["classes outside the label set are void: hat (1)"] * (len(table) > 2)
    names = label_set(LABELS)
    found = [names[index] for index in read.images[0].object_class]
    assert found[:2] == ["sofa", "double_bed"]
    known = {tidy(name) for each in (LABELS, "scannet") for name in label_set(each)}
    assert set(SAME_CLASS.values()) <= known
