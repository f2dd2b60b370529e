"""Views of a made scan: the ground truth must project onto its masks, at any size of anything."""

import json
import tracemalloc

import numpy as np
import pytest
from scan_files import (
    BOX_FACES,
    Box,
    ScanFolder,
    alignment,
    frame_header,
    png,
    sens_header,
    write_ply,
    write_zip,
)

from data_prep.inspection.agreement import box_iou_2d
from data_prep.readers.scannet.scans import FULL_SIZE, QUARTER_SIZE, ScanSettings, read_scan
from data_prep.readers.scannet.views import instance_images, prepare_scan
from sceneprior.core.classes import STUFF, label_set
from sceneprior.render.zbuffer import rasterize

BITS = (np.arange(8)[:, None] >> np.arange(3)) & 1
NAMES = label_set("scannet")


def corners_m(truth):
    """(m, 8, 3) corners of the ground truth's boxes."""
    return truth.centers_m[:, None] + (BITS - 0.5) * truth.sizes_m[:, None].astype(float)


def projected_boxes(views, truth):
    """(T, n, 4) boxes around the corners of the ground truth, shares of the image."""
    count = views.visible.shape[1]
    made = np.empty((*views.visible.shape, 4))
    for view, (camera, lens) in enumerate(
        zip(views.world_to_camera, views.intrinsics, strict=True)
    ):
        points = corners_m(truth)[:count] @ camera[:3, :3].T + camera[:3, 3]
        assert (points[..., 2] > 0).all()
        pixels = (points @ lens.T)[..., :2] / points[..., 2:]
        made[view] = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
    return made / np.tile(views.image_size[::-1], 2)


def drawn(views, truth, view):
    """The ground truth's boxes, drawn with the stored camera: what the ids should be."""
    camera, lens = views.world_to_camera[view], views.intrinsics[view].tolist()
    faces = np.concatenate([BOX_FACES + 8 * k for k in range(len(truth.centers_m))])
    index, _ = rasterize(
        corners_m(truth).reshape(-1, 3), faces, camera,
        (lens[0][0], lens[1][1], lens[0][2], lens[1][2]), views.image_size,
    )  # fmt: skip
    return (index + len(BOX_FACES)) // len(BOX_FACES)


@pytest.fixture(scope="module")
def seen_around(tmp_path_factory):
    """A bed and two chairs far apart, seen whole by 24 cameras of 1296 x 968 all around."""
    scan = ScanFolder(
        tmp_path_factory.mktemp("scans") / "scene0001_01",
        [
            Box("bed", (-1, -0.8, 0.3), (1, 0.8, 0.9)),
            Box("chair", (-2.3, 1.2, 0.3), (-1.3, 2.3, 1.1), object_id=200),
            Box("chair", (1.4, -2.2, 0.3), (2.3, -1.2, 1.2), object_id=7),
        ],
        alignment(),
    )
    for k in range(24):
        angle = 2 * np.pi * k / 24
        eye = 2.5 * np.cos(angle), 2.5 * np.sin(angle), 8.5 + 0.02 * k
        scan.look(eye, (0.01 * k, 0.013 * k, 0.5))
    return scan.write()


@pytest.mark.parametrize("mask_size", [FULL_SIZE, (480, 640)])
@pytest.mark.parametrize("image_size", [QUARTER_SIZE, FULL_SIZE])
def test_ground_truth_projects_onto_the_masks(seen_around, labels, mask_size, image_size):
    """Masks may differ in size from colour frames (1296 x 968), what is stored from both."""
    if mask_size != FULL_SIZE:
        write_zip(
            seen_around.path("_2d-instance.zip"),
            {f"instance/{k}.png": png(seen_around.mask(k, mask_size)) for k in range(24)},
        )
    kind = "filt" if mask_size == FULL_SIZE else "raw"
    scan = read_scan(seen_around.folder, labels, ScanSettings(1, 100, kind, image_size))
    room = prepare_scan(scan)
    views, truth = room.views, room.truth
    assert [NAMES[k] for k in views.object_class] == ["bed", "chair", "chair"]
    assert views.visible.shape == (24, 3) and views.visible.all() and views.sides_clear.all()
    again = np.stack([drawn(views, truth, view) for view in range(24)])
    wrong = (again != views.instance_ids).sum(axis=(1, 2)) / (again > 0).sum(axis=(1, 2))
    assert box_iou_2d(projected_boxes(views, truth), views.boxes).min() > 0.95
    if mask_size == FULL_SIZE:
        # The very same rays, but for float32 in poses and mesh: no pixel differs as measured.
        # Half a full-size pixel in the lens would move 8e-3 of them, at either size.
        assert wrong.max() < 1e-4
    else:
        # 640 columns and 324 or 1296 do not go by whole steps: outlines are off by up to half a
        # mask pixel (8e-3 and 9e-3 as measured; with half a pixel more in the lens, 1.1e-2).
        assert wrong.mean() < 1e-2


def test_what_the_scan_saw_of_an_object_is_its_model(scan, labels):
    """In the aligned frame the bed fills its box; what has no surface is a unit cube in its box."""
    room = prepare_scan(read_scan(scan.write().folder, labels, ScanSettings(1)))
    truth = room.truth
    assert truth.model_ids == ("scene0000_00_001", "scene0000_00_002") == tuple(room.models)
    for row, name in enumerate(truth.model_ids):
        model = room.models[name]
        assert len(model.vertices_m) == 8 and len(model.faces) == len(BOX_FACES)
        # The very triangles of the scan, numbered anew.
        np.testing.assert_array_equal(model.faces, BOX_FACES)
        placed = np.c_[model.vertices_m, np.ones(8)] @ truth.model_to_room[row].T
        low, high = placed[:, :3].min(axis=0), placed[:, :3].max(axis=0)
        np.testing.assert_allclose((low + high) / 2, truth.centers_m[row], atol=1e-6)
        np.testing.assert_allclose(high - low, truth.sizes_m[row], atol=1e-6)


def test_an_object_without_triangles_has_no_model(scan, labels):
    """The unit cube stands for it; triangles that reach out of an object are no part of it."""
    scan.write()
    vertices, faces, _ = scan.mesh
    bed, chair = faces[12:24], faces[24:36]
    write_ply(scan.path("_vh_clean_2.ply"), vertices, np.vstack([bed, [(8, 9, 16)]]))
    room = prepare_scan(read_scan(scan.folder, labels, ScanSettings(1)))
    assert room.truth.model_ids == ("scene0000_00_001", "")
    assert len(room.models["scene0000_00_001"].faces) == len(bed) and len(chair) == 12
    cube = np.c_[BITS - 0.5, np.ones(8)]
    corners = cube @ room.truth.model_to_room[1].T
    half = room.truth.sizes_m[1] / 2
    np.testing.assert_allclose(
        corners[:, :3].min(axis=0), room.truth.centers_m[1] - half, atol=1e-6
    )
    np.testing.assert_allclose(
        corners[:, :3].max(axis=0), room.truth.centers_m[1] + half, atol=1e-6
    )


def painted(scan, labels, pictures):
    """The made scan with masks painted by hand, stored pixel for pixel."""
    scan.write()
    write_zip(
        scan.path("_2d-instance-filt.zip"),
        {f"{k}.png": png(picture) for k, picture in pictures.items()},
    )
    height, width = pictures[0].shape
    return read_scan(scan.folder, labels, ScanSettings(1, image_size=(height, width)))


def picture(*rectangles):
    image = np.zeros((60, 80), dtype=np.uint8)
    for value, x1, y1, x2, y2 in rectangles:
        image[y1:y2, x1:x2] = value
    return image


def test_the_shell_touches_everything_and_hides_nothing(scan, labels):
    """The floor (1) lies around bed (2) and chair (3); the backpack (4) stands at the chair."""
    image = picture((1, 0, 0, 80, 60), (2, 5, 10, 30, 40), (3, 50, 10, 60, 40), (4, 60, 20, 70, 30))
    room = prepare_scan(painted(scan, labels, {0: image}))
    assert room.views.sides_clear.tolist() == [[[True] * 4, [True, True, False, True]]]
    assert room.views.mask_pixels.tolist() == [[750, 300]]
    np.testing.assert_array_equal(room.views.instance_ids[0] == 3, image == 4)
    np.testing.assert_array_equal(room.views.instance_ids[0] == 0, image <= 1)
    np.testing.assert_array_equal(room.views.stuff[0], (image == 1) * STUFF.index("floor"))


def test_ids_without_an_object_hide_and_are_told(scan, labels):
    image = picture((2, 5, 10, 30, 40), (90, 30, 20, 40, 30), (255, 70, 0, 80, 10))
    made = painted(scan, labels, {0: image})
    (ids,), _, unlisted = instance_images(made)
    assert unlisted == [89, 254]
    assert ids[20, 35] == 5 and ids[20, 10] == 2  # four instances
    room = prepare_scan(made)
    assert room.views.sides_clear.tolist() == [[[True, True, False, True]]]
    assert "masks show objects that the aggregation does not have (89, 254): void" in room.notes
    np.testing.assert_array_equal(room.views.instance_ids[0] == 2, image >= 90)


def test_objects_no_view_shows_are_truth_alone(scan, labels):
    room = prepare_scan(painted(scan, labels, {0: picture((3, 5, 5, 30, 30))}))
    assert [NAMES[k] for k in room.views.object_class] == ["chair"]
    assert [NAMES[k] for k in room.truth.object_class] == ["chair", "bed"]
    assert room.truth.centers_m.shape == room.truth.sizes_m.shape == (2, 3)


def test_objects_past_what_a_mask_can_say(scan, labels):
    scan.write()
    data = json.loads(scan.path(".aggregation.json").read_text())
    data["segGroups"][1]["objectId"] = 255
    painted(scan, labels, {0: picture((3, 5, 5, 30, 30))})
    scan.path(".aggregation.json").write_text(json.dumps(data))
    room = prepare_scan(read_scan(scan.folder, labels, ScanSettings(1, image_size=(60, 80))))
    assert [NAMES[k] for k in room.truth.object_class] == ["chair", "bed"]


def test_a_long_recording_takes_little_memory(scan, labels):
    """1,000 frames with payloads of half a megabyte (holes in the file), 67 of them views."""
    scan.write()
    pose, mask = scan.poses[0], png(scan.mask(0))
    with scan.path(".sens").open("wb") as file:
        file.write(sens_header(1000))
        for frame in range(1000):
            file.write(frame_header(pose, frame, 400_000, 100_000))
            file.seek(500_000, 1)
        file.write(bytes(8))
    write_zip(
        scan.path("_2d-instance-filt.zip"), {f"instance-filt/{k}.png": mask for k in range(1000)}
    )
    tracemalloc.start()
    room = prepare_scan(read_scan(scan.folder, labels))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(room.views.visible) == 67
    # Three times the stored images (ids before and after numbering, and stuff, 67 x 242 x 324 bytes
    # each), a full-size mask or two (1.25 MB) and the archive's names.
    assert peak < 3 * 67 * 242 * 324 + 8e6
