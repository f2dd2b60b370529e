"""Captures as people have them: distorted lenses, COLMAP's models, split files, panoptic masks."""

import json
import struct

import cv2
import numpy as np
import pytest
from capture_files import SEGMENTS, write_panoptic
from colmap_files import SCALE, TURN, write_colmap
from PIL import Image
from posed_files import SET, PosedRoom, Thing, in_room, overlaps, prepared
from scipy.spatial.transform import Rotation

from data_prep.readers.posed.source import PosedSource
from data_prep.readers.posed.transforms import read_recording
from sceneprior.core.classes import STUFF
from sceneprior.core.errors import InputError
from sceneprior.core.shards import stuff_step, thinned

LENSES = {
    "OPENCV": {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002},
    "OPENCV_FISHEYE": {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": 0.0},
}


@pytest.fixture
def room(tmp_path):
    return PosedRoom(tmp_path / "room", size=(240, 320), focal_px=180.0)


def distorted_ids(room, view, model, keys):
    """The picture through a lens: OpenCV finds the ray of each pixel, and a wide pinhole picture
    gives the value on that ray."""
    wide = PosedRoom(room.folder, room.things, (1200, 1600), 400.0, list(room.poses))
    height, width = room.size
    v, u = np.indices(room.size) + 0.5
    points = np.stack([u - width / 2, v - height / 2], axis=-1).reshape(-1, 1, 2) / room.focal_px
    if model == "OPENCV":
        bent = np.array([keys["k1"], keys["k2"], keys["p1"], keys["p2"]])
        rays = cv2.undistortPoints(points, np.eye(3), bent)
    else:
        bent = np.array([keys[f"k{i}"] for i in range(1, 5)])
        rays = cv2.fisheye.undistortPoints(points, np.eye(3), bent)
    places = np.floor(rays.reshape(-1, 2) * 400 + [800, 600]).astype(int)
    assert (places >= 0).all() and (places < [1600, 1200]).all()
    return wide.ids(view)[places[:, 1], places[:, 0]].reshape(room.size)


def write_distorted(room, model):
    room.write(camera_model=model, **LENSES[model], floor_m=0.0, floor_center_m=[0.1, -0.2])
    for view in range(len(room.poses)):
        Image.fromarray(distorted_ids(room, view, model, LENSES[model])).save(room.png(view))


@pytest.mark.parametrize("model", LENSES)
def test_things_are_where_they_are_through_a_distorted_lens(room, model):
    write_distorted(room, model)
    made = prepared(room)
    # Half a pixel a side of the source, stretched to one at the rim: of things from 40 px on.
    assert len(found := overlaps(made.views, in_room(room))) >= 2 and found.min() > 0.94
    assert any(
        note.startswith(f"the lens {model} ") and "of its pictures is cut away" in note
        for note in made.notes
    )
    data = room.data | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]}
    room.write_transforms(data)  # as if the lens were straight
    assert overlaps(prepared(room).views, in_room(room)).mean() < found.mean() - 0.03
    small = prepared(room, max_side=160)
    assert small.views.image_size == (120, 160)


def test_a_lens_that_folds_the_picture_over_names_the_frame(room):
    room.write(floor_m=0.0, k1=-0.9)
    with pytest.raises(InputError, match=r"frame 'images/frame_00000.jpg': its lens .* distorts"):
        prepared(room)


# -- COLMAP ----------------------------------------------------------------------------------------


def steps(views):
    """Each camera in the first one's frame: the same whatever the world."""
    poses = views.world_to_camera.astype(float)
    return poses @ np.linalg.inv(poses[0])


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE"])
def test_a_colmap_model_is_the_room_it_was_made_of(room, model, binary):
    room.things.append(Thing(8, "chair", (-1.3, 0.5, 0.0), (-0.9, 0.9, 0.8)))
    room.write(floor_m=0.0)
    plain = prepared(room).views
    write_colmap(room, model, binary)
    made = prepared(room, metres_per_unit=1 / SCALE)
    np.testing.assert_allclose(steps(made.views), steps(plain), atol=2e-6)  # float32 poses
    np.testing.assert_array_equal(made.views.instance_ids, plain.instance_ids)
    np.testing.assert_allclose(made.views.intrinsics, plain.intrinsics, atol=1e-4)
    # Up is found from the cameras, which have no roll, the floor from the pieces.
    inverse, flat = (np.linalg.inv(v.world_to_camera.astype(float)) for v in (made.views, plain))
    np.testing.assert_allclose(inverse[:, 1, :3], flat[:, 1, :3], atol=1e-5)
    assert np.abs(inverse[:, 1, 3] - flat[:, 1, 3]).max() < 0.03
    assert any("the floor is found where 3 pieces end" in note for note in made.notes)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_colmap_capture_with_a_distorted_lens(room, model):
    write_colmap(room, model, binary=True)
    for view in range(len(room.poses)):
        Image.fromarray(distorted_ids(room, view, model, LENSES[model])).save(room.png(view))
    # What a transforms.json without frames says is of the room.
    said = {"metres_per_unit": 1 / SCALE, "floor_m": 0.0}
    (room.folder / "transforms.json").write_text(json.dumps(said))
    views = prepared(room).views
    centre = np.linalg.inv(views.world_to_camera.astype(float))[:, :3, 3]
    np.testing.assert_allclose(centre[:, 1], [pose[2, 3] for pose in room.poses], atol=1e-4)
    # The true boxes, in the room frame that the cameras give: of the rigid motion between both.
    true = np.array([pose[:3, 3] for pose in room.poses])
    turn, _ = Rotation.align_vectors(centre - centre.mean(axis=0), true - true.mean(axis=0))
    corners = [
        turn.apply(thing.corners - true.mean(axis=0)) + centre.mean(axis=0)
        for thing in room.things[:2]
    ]
    found = overlaps(views, corners)
    assert len(found) >= 2 and min(found) > 0.94


def test_where_a_colmap_model_may_lie(room):
    write_colmap(room, "PINHOLE", True, "colmap/sparse/0")
    assert len(read_recording(room.folder).frames) == 5
    source = PosedSource(room.folder.parent, SET)
    before = source.settings(None)["rooms"]
    path = room.folder / "colmap/sparse/0/images.bin"
    path.write_bytes(path.read_bytes() + b" ")
    assert source.settings(None)["rooms"] != before
    assert source.assumptions()[0].startswith(
        "1 of 1 rooms give no floor_m: the floor is estimated"
    )
    (said,) = (said for said in source.assumptions() if "--up" in said)
    assert said.startswith(
        "1 of 1 rooms do not state the up direction: it is estimated from the cameras, as if"
    )
    assert "If they roll by 5 degrees, the median error is 1.3 degrees" in said


def test_colmap_models_that_cannot_be_read(room):
    write_colmap(room, "PINHOLE", binary=True)
    place = room.folder / "sparse/0"
    whole = (place / "images.bin").read_bytes()
    for cut in (0, 4, 20, len(whole) - 200):
        (place / "images.bin").write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"sparse/0 holds no COLMAP model that can be read"):
            read_recording(room.folder)
    (place / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(InputError, match=r"images\.bin has no image with a pose"):
        read_recording(room.folder)
    (place / "images.bin").write_bytes(whole)
    (place / "cameras.bin").write_bytes(struct.pack("<QiiQQ3d", 1, 9, 0, 3, 3, 1, 1, 1))
    with pytest.raises(InputError, match=r"images\.bin names camera 7, which cameras\.bin lacks"):
        read_recording(room.folder)


@pytest.mark.parametrize("binary", [True, False])
def test_a_colmap_camera_that_is_not_read(tmp_path, binary):
    room = PosedRoom(tmp_path / "room")
    write_colmap(room, "FULL_OPENCV", binary)
    with pytest.raises(
        InputError, match=r"its camera model .* is not supported; use `colmap image_undist"
    ):
        read_recording(room.folder)


def test_cameras_that_all_look_one_way_do_not_tell_up(room):
    room.poses = room.poses[:1]
    room.look(room.poses[0][:3, 3] + [0.0, 0.0, 0.1], [0.1, 0.1, 0.4])
    room.write(floor_m=0.0)
    with pytest.raises(InputError, match=r"all look in about the same direction"):
        prepared(room, up="cameras")


def test_a_middle_along_level_axes_needs_some(room):
    tilt = np.eye(4)
    tilt[:3, :3] = TURN
    room.write(floor_m=0.0, floor_center_m=[0.0, 0.0])
    data = room.data | {"floor_m": 0.0, "floor_center_m": [0.0, 0.0]}
    for frame, pose in zip(data["frames"], room.poses, strict=True):
        frame["transform_matrix"] = (tilt @ pose).tolist()
    room.write_transforms(data)
    with pytest.raises(InputError, match=r"floor_center_m is along two level axes, but none of"):
        prepared(room, up="cameras")


# -- Frames in several files, masks of other tools -------------------------------------------------


def test_split_files_are_one_room(room):
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    whole = prepared(room).views
    data = room.data
    (room.folder / "transforms.json").unlink()
    for split, part in (("train", slice(0, 2)), ("val", slice(2, 3)), ("test", slice(3, 5))):
        own = {**data, "frames": data["frames"][part]}
        if split != "train":  # each file has a camera of its own, and the room's keys once
            own |= {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]}
        (room.folder / f"transforms_{split}.json").write_text(json.dumps(own))
    parts = prepared(room).views
    assert len(parts.visible) == 5
    order = [3, 4, 0, 1, 2]  # by the files' names: test, train, val
    np.testing.assert_array_equal(parts.world_to_camera, whole.world_to_camera[order])
    own = json.loads((room.folder / "transforms_val.json").read_text()) | {"floor_m": 0.3}
    (room.folder / "transforms_val.json").write_text(json.dumps(own))
    with pytest.raises(
        InputError,
        match=r"floor_m is 0\.0 in transforms_test\.json, but 0\.3 in transforms_val\.json; a room",
    ):
        read_recording(room.folder)


def test_frames_of_one_name_have_ids_where_the_frames_lie(room):
    room.write()
    data = room.data
    for k, frame in enumerate(data["frames"]):
        frame["file_path"] = f"./{'train' if k < 3 else 'test'}/r_{k % 3}"
    room.write_transforms(data)
    with pytest.raises(
        InputError, match=r"store the ids in the same folders as the frames: instances/train/r_0\."
    ):
        read_recording(room.folder)
    for k, frame in enumerate(data["frames"]):
        path = room.folder / "instances" / f"{frame['file_path']}.png"
        path.parent.mkdir(exist_ok=True)
        room.png(k).rename(path)
    assert len(prepared(room).views.visible) == 5


def test_panoptic_masks_are_tracks_with_classes(room):
    room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])
    plain = prepared(room).views
    write_panoptic(room)
    made = prepared(room)
    # Numbered by their ids, so the chair (5) comes before the bed (70,001).
    assert made.views.object_class.tolist() == [2, 1] and plain.object_class.tolist() == [1, 2]
    swapped = np.array([0, 2, 1, 3])[made.views.instance_ids]
    void = swapped == 3  # the backpack
    assert void.any()
    np.testing.assert_array_equal(swapped[~void], plain.instance_ids[~void])
    assert "classes outside the label set are void: backpack (1)" in made.notes
    # Things stand against a wall, which is stuff and hides nothing.
    np.testing.assert_array_equal(made.views.sides_clear[:, ::-1], plain.sides_clear)
    assert plain.stuff is None
    ids = np.stack([room.ids(view) for view in range(len(room.poses))])
    is_wall = (ids == 11)[:, *thinned(stuff_step((240, 320)))]
    assert is_wall.any()
    np.testing.assert_array_equal(made.views.stuff, STUFF.index("wall") * is_wall)


def test_a_stuff_segment_of_several_classes_is_background(room):
    def rename(data):
        data["categories"].append({"id": 190, "name": "floor-other-merged", "isthing": 0})
        for segment in data["annotations"][1]["segments_info"]:
            if segment["id"] == SEGMENTS[11]:
                segment["category_id"] = 190

    write_panoptic(room, rename)
    assert prepared(room).views.stuff is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda data: data["annotations"][1]["segments_info"][0].update(category_id=27),
            r"segment 70001 is bed in 'frame_00000', but backpack in 'frame_00001'\. Ids",
        ),
        (
            lambda data: data["annotations"][0]["segments_info"][0].update(category_id=1),
            r"category 1 of segment 70001 is not among its categories",
        ),
        (lambda data: data.pop("categories"), r"panoptic\.json: categories is"),
        (lambda data: data.update(annotations=[]), r"has 0 segments; expected 1 to"),
        (
            lambda data: data["annotations"][0]["segments_info"][0].update(id="x"),
            r"annotations\.0\.segments_info\.0\.id is 'x'",
        ),
    ],
)
def test_panoptic_files_that_cannot_be_used(room, change, said):
    write_panoptic(room, change)
    with pytest.raises(InputError, match=said):
        prepared(room)


def test_crowds_and_ids_without_a_segment_are_void(room):
    def crowd(data):
        for frame in data["annotations"]:
            for segment in frame["segments_info"]:
                segment["iscrowd"] = int(segment["id"] == 5)
            frame["segments_info"] = [s for s in frame["segments_info"] if s["id"] != 256]

    write_panoptic(room, crowd)
    made = prepared(room)
    assert made.views.object_class.tolist() == [1]
    assert "classes outside the label set are void: backpack (1), crowd (1)" in made.notes
    assert any("masks show ids that the table of classes does not have" in n for n in made.notes)
    Image.fromarray(room.ids(0)).save(room.png(0))
    with pytest.raises(InputError, match=r"is 16-bit grey; expected 8-bit RGB, whose colours are"):
        prepared(room)
