"""Rooms of every public data set, from its files to shards: classes, masks, cameras, boxes."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from pages import ROOT, commands_of, first_block
from public_files import (
    cam_from_uv,
    classes_of,
    expected_corners,
    furnished,
    write_blenderproc,
    write_hypersim,
    write_scannetpp,
    write_structured3d,
)

from data_prep.engine.workers import pool
from data_prep.inspection.agreement import boxes_around, hull_of
from data_prep.readers.frames import GL_TO_CV, Y_UP
from data_prep.readers.heading import turn_matrix
from data_prep.readers.rooms import FramedRoom, prepare_room
from data_prep.readers.source import PublicSource, open_reader
from data_prep.readers.upright import own_sides
from sceneprior.core.boxes import quarter_rotation
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.ground_truth import reference_scenes

NAMES = label_set("scannet")


def prepared(name, folder, **settings):
    """Rooms of a folder by id, prepared without the engine."""
    source = PublicSource(open_reader(name, folder), **settings)
    with pool(1) as run:
        tasks = source.survey(run).rooms
    return {task.room_id: source.prepare(task, None) for task in tasks}


@pytest.fixture
def room(tmp_path):
    return furnished(tmp_path / "unused")


def check(made, room, axes, origin, slack_px=0.0):
    """Boxes of bed and chair, projected, bound their masks; the ground truth has these boxes.

    A side of a mask that nothing hides is at most a pixel from that of the projection, since masks
    are sampled at pixel centres; no mask reaches beyond the projection.
    """
    views, corners = made.views, expected_corners(room, axes, np.array(origin))
    height, width = views.image_size
    masks_px = views.boxes * np.array([width, height, width, height])
    clear = own_sides(views, views.image_size)
    assert clear.sum() >= 8
    for k, points in enumerate(corners):
        boxes_px = boxes_around(hull_of(points), views.world_to_camera, views.intrinsics)
        within = (boxes_px - masks_px[:, k]) * (1, 1, -1, -1)
        assert within[views.visible[:, k]].max() < 0.51 + slack_px
        assert within[clear[:, k]].min() > -1.01 - slack_px
    if made.truth is not None:
        centers = [points.mean(axis=0) for points in corners]
        sizes = [np.ptp(points, axis=0) for points in corners]
        np.testing.assert_allclose(made.truth.centers_m[:2], centers, atol=1e-5)
        np.testing.assert_allclose(made.truth.sizes_m[:2], sizes, atol=1e-5)


def check_stuff(made, seen):
    """Pixels of the floor and the wall are known in each view, and nothing is where furniture is.

    `seen` are the true ids of the views.
    """
    assert made.views.image_size == seen.shape[1:] and max(seen.shape) < 240, "none is thinned"
    expected = np.select([seen == 11, seen == 12], [STUFF.index("floor"), STUFF.index("wall")])
    np.testing.assert_array_equal(made.views.stuff, expected)


def test_blenderproc_is_mirrored_back_to_3d_front(room, tmp_path):
    write_blenderproc(tmp_path / "renders", "house", room)
    (made,) = prepared("blenderproc", tmp_path / "renders", max_side=None).values()
    views = made.views
    assert views.room_id == "house_MasterBedroom-1" and len(views.visible) == 4
    assert classes_of(views, label_set("front3d_bedroom")) == ["double_bed", "chair"]
    eyes = np.stack([pose[:3, 3] for pose in room.poses[:4]])
    low, high = eyes.min(axis=0), eyes.max(axis=0)
    middle = (low + high) / 2
    # Blender's (x, y, z) is 3D-FRONT's (x, z, y): the images are mirror images.
    check(made, room, (0, 2, 1), (middle[0], 0, middle[1]))
    assert made.truth is None
    mirrored = views.instance_ids[0][:, ::-1]
    assert (mirrored == 1)[room.ids(0) == 3].all() and (mirrored == 3)[room.ids(0) == 7].all()
    assert (mirrored == 0)[np.isin(room.ids(0), (11, 12))].all()


def test_blenderproc_knows_classes_by_its_own_table_and_hides_other_rooms(room, tmp_path):
    folder = tmp_path / "renders"
    write_blenderproc(folder, "house", room)
    (folder / "model_info.json").unlink()
    table = "id,name\n0,Double Bed\n1,Floor Lamp\n2,void\n41,floor\n"
    (folder / "blender_label_mapping.csv").write_text(table)
    path = folder / "house" / "0.hdf5"
    with h5py.File(path, "r+") as file:
        parts = json.loads(bytes(file["instance_attribute_maps"][()]))
        parts[2]["room_id"] = "Balcony-3"  # the chair
        del file["instance_attribute_maps"]
        file["instance_attribute_maps"] = np.bytes_(json.dumps(parts))
    (made,) = prepared("blenderproc", folder, max_side=None).values()
    names = label_set("front3d_bedroom")
    assert classes_of(made.views, names)[0] == "double_bed"
    void = len(made.views.object_class) + 1
    chair = room.ids(0)[:, ::-1] == 300
    assert (made.views.instance_ids[0][chair] == void).all()


@pytest.mark.parametrize("shifts", [(0.0, 0.0), (0.25, 0.0), (-0.2, 0.3)])
def test_hypersim_has_asset_units_and_tilted_image_planes(room, tmp_path, shifts):
    room.focal_px = 75.0
    write_hypersim(tmp_path / "scenes", "ai_001_002", room, cam_from_uv(room, *shifts))
    (made,) = prepared("hypersim", tmp_path / "scenes", max_side=None).values()
    assert made.views.room_id == "ai_001_002" and len(made.views.visible) == 4
    assert classes_of(made.views, NAMES) == ["bed", "chair"]
    assert made.notes == (
        "1 of 5 frames have no image of ids; skipped",
        "classes outside the label set are void: pillow (1)",
    )
    # (x, y, z) -> (y, z, x); the origin is below the middle of bed and chair.
    # With both shifts the grid is skewed; straightening moves pixels by up to half of one.
    check(made, room, (1, 2, 0), (0.05, 0, 0.2), slack_px=0.5 * all(shifts))
    if not any(shifts):
        kept = made.views.instance_ids == 0
        assert set(np.unique(made.views.stuff[kept])) == {STUFF.index("floor"), STUFF.index("wall")}
    assert not made.views.stuff[made.views.instance_ids > 0].any()
    assert made.truth.height_m == pytest.approx(2.5)


def test_structured3d_has_millimetres_a_floor_and_the_authors_split(room, tmp_path):
    for k, scene in enumerate(("scene_00007", "scene_03249", "scene_03499")):
        write_structured3d(tmp_path / "s3d", scene, f"48{k}", room)
    made = prepared("structured3d", tmp_path / "s3d", max_side=None)
    assert list(made) == ["scene_00007_480", "scene_03249_481", "scene_03499_482"]
    one = made["scene_00007_480"]
    assert classes_of(one.views, NAMES) == ["bed", "chair"]
    check(one, room, (1, 2, 0), (-0.1, 0, 0.05))
    check_stuff(one, np.stack([room.ids(k) for k in range(len(room.poses))]))
    outline = [(y + 0.1, x - 0.05) for x, y in [(-3, -3.2), (3.1, -3.2), (3.1, 3), (-3, 3)]]
    np.testing.assert_allclose(one.truth.floor_m, outline, atol=1e-5)
    assert one.truth.height_m == pytest.approx(2.6)
    source = PublicSource(open_reader("structured3d", tmp_path / "s3d"))
    with pool(1) as run:
        splits = [task.split for task in source.survey(run).rooms]
    assert splits == ["train", "val", "test"]


@pytest.mark.parametrize("poses", ["colmap", "nerfstudio", "iphone"])
def test_scannetpp_is_drawn_from_its_annotated_mesh(room, tmp_path, poses):
    write_scannetpp(tmp_path / "data", "0a5c013435", room, poses)
    iphone = poses == "iphone"
    side = 640 if iphone else None
    (made,) = prepared("scannetpp", tmp_path / "data", max_side=side).values()
    assert made.views.image_size == ((480, 640) if iphone else (96, 128))
    assert classes_of(made.views, NAMES) == ["bed", "chair"]
    check(made, room, (1, 2, 0), (0.05, 0, 0.2))
    if not iphone:
        ids = room.ids(1)
        for number, thing in ((1, 3), (2, 300), (3, 7), (0, 11), (0, 12), (3, 0)):
            assert (made.views.instance_ids[1][ids == thing] == number).all()
        check_stuff(made, np.stack([room.ids(k) for k in range(len(room.poses))]))


def test_masks_are_shrunk_with_their_cameras(room, tmp_path):
    room.size, room.focal_px = (240, 320), 200.0
    write_structured3d(tmp_path / "s3d", "scene_00007", "480", room)
    (made,) = prepared("structured3d", tmp_path / "s3d", max_side=107, max_views=3).values()
    assert made.views.image_size == (80, 107) and len(made.views.visible) == 3
    check(made, room, (1, 2, 0), (-0.1, 0, 0.05))


def test_the_commands_of_public_data_md_write_shards_that_verify(room, tmp_path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for k in range(3):
        write_blenderproc(Path("renderings"), f"house_{k}", room)
        write_hypersim(Path("evermotion_dataset/scenes"), f"ai_001_00{k}", room, cam_from_uv(room))
        write_structured3d(Path("Structured3D"), f"scene_0{k}100", "480", room)
        write_scannetpp(Path("scannetpp/data"), f"{k}a5c01", room)
    commands = commands_of(first_block(ROOT / "docs" / "public_data.md", "bash"))
    for _, *words in commands:
        done = cli(*words, "--workers", 1)
        assert done.exit_code == 0, done.output
        if words[0] == "prep-dataset":
            said = " ".join(done.stdout.split())
            assert "train 2 rooms" in said or words[1] == "structured3d", said
            checked = cli("inspect", words[-1], "--verify")
            assert checked.exit_code == 0, (words, checked.output)
            again = " ".join(cli(*words, "--workers", 1).stdout.split())
            assert "0 shards made" in again
    for name in ("hypersim", "structured3d", "scannetpp"):
        for scene in reference_scenes(Path("out") / name / "shards", "train"):
            assert [item.label for item in scene.objects] == ["bed", "chair"]


@pytest.mark.parametrize("degrees", [30.0, -75.0])
def test_rooms_at_an_angle_are_turned_with_their_boxes_and_floors(room, degrees):
    """The world of a room is turned about y: ground truth and cameras are those of the plain room,
    up to quarter turns."""
    room.size, room.focal_px = (192, 256), 160.0
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7)]:
        room.look(eye, (0.1, 0.1, 0.3))
    plain = FramedRoom(
        np.stack([room.ids(k) for k in range(9)]).astype(np.int32),
        {3: "bed", 300: "chair", 7: "pillow", 11: "floor", 12: "wall"},
        Y_UP @ np.stack(room.poses) @ GL_TO_CV,
        np.array([[160.0, 0, 128], [0, 160, 96], [0, 0, 1]]),
        {thing.id: thing.corners @ Y_UP[:3, :3].T for thing in room.things[:3]},
        floor_m=np.array([(-3.0, -3), (3, -3), (3, 3.1), (-3, 3.1)]),
    )
    turn = turn_matrix(degrees)
    turned = replace(
        plain,
        camera_to_world=turn @ plain.camera_to_world,
        boxes={k: points @ turn[:3, :3].T for k, points in plain.boxes.items()},
        floor_m=plain.floor_m @ turn[::2, ::2][:2, :2].T,
    )
    one, other = (prepare_room("a", framed, "scannet") for framed in (plain, turned))
    assert one.views.turned_deg == 0 and one.views.room_from_world is None
    views, truth = other.views, other.truth
    assert abs((views.turned_deg + degrees + 45) % 90 - 45) < 0.5
    assert f"turned by {views.turned_deg:.2f} degrees, along its walls" in other.notes[-1]
    quarter = quarter_rotation(round((views.turned_deg + degrees) / 90))
    slack = 0.05  # 0.5 degrees at 4 m
    np.testing.assert_allclose(truth.centers_m, one.truth.centers_m @ quarter.T, atol=slack)
    np.testing.assert_allclose(truth.sizes_m, one.truth.sizes_m @ abs(quarter).T, atol=slack)
    level = quarter[::2, ::2]
    np.testing.assert_allclose(truth.floor_m, one.truth.floor_m @ level.T, atol=slack)
    mapped = views.room_from_world @ turned.camera_to_world
    np.testing.assert_allclose(
        mapped, np.linalg.inv(views.world_to_camera.astype(float)), atol=1e-5
    )
