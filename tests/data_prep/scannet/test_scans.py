"""A made scan read back: room frame, objects, cameras; and files that are missing or do not fit."""

import json

import numpy as np
import pytest
from scan_files import sens_bytes, write_zip

from data_prep.readers.scannet.scans import FULL_SIZE, ScanSettings, read_scan
from sceneprior.core.errors import InputError

EVERY = ScanSettings(frame_step=1)


def test_y_is_up_and_the_floors_centre_is_the_origin(scan, labels):
    read = read_scan(scan.write().folder, labels, EVERY)
    assert read.scan_id == "scene0000_00"
    floor, bed, chair, _ = read.instances
    # Bed and chair, which have a class, stand between x = 0..3.5 and y = 0..2.5 of the aligned
    # frame, from z = 0.05 on; x' = y, y' = z, z' = x. The mesh is float32, of some metres.
    close = dict(rtol=0, atol=2e-6)
    np.testing.assert_allclose(bed.lower_m, (-1.25, 0, -1.75), **close)
    np.testing.assert_allclose(bed.upper_m, (0.25, 0.6, 0.25), **close)
    np.testing.assert_allclose(chair.lower_m, (0.75, 0, 1.25), **close)
    np.testing.assert_allclose(chair.upper_m, (1.25, 0.9, 1.75), **close)
    np.testing.assert_allclose(floor.lower_m, (-1.75, -0.05, -2.25), **close)
    assert [item.label for item in read.instances] == ["void", "bed", "chair", "void"]
    assert [item.is_shell for item in read.instances] == [True, False, False, False]
    assert [item.object_id for item in read.instances] == [0, 1, 2, 3]
    np.testing.assert_allclose(
        read.floor_m, [(-1.25, -1.75), (1.25, -1.75), (1.25, 1.75), (-1.25, 1.75)], **close
    )
    assert read.height_m == pytest.approx(0.9, abs=2e-6)


def test_cameras_stand_where_they_stood(scan, labels):
    read = read_scan(scan.write().folder, labels, EVERY)
    assert read.frames == (0, 1, 3, 4, 5)  # 2 lost its pose
    assert "1 of 6 frames have no usable pose; skipped" in read.notes
    eyes = np.array([(-2.5, -2, 2.5), (5, -2.5, 1.8), (6, 4, 2.2), (0.5, 5.5, 2.0), (-2, 4, 1.6)])
    expected = eyes[:, [1, 2, 0]] - (1.25, 0.05, 1.75)
    turn, shift = read.world_to_camera[:, :3, :3], read.world_to_camera[:, :3, 3:]
    centres = -(turn.transpose(0, 2, 1) @ shift)[..., 0]
    np.testing.assert_allclose(centres, expected, atol=2e-6)  # poses are float32
    # Held level: the image's right is level, its down points down, depth grows ahead.
    np.testing.assert_allclose(turn[:, 0, 1], 0, atol=1e-6)
    assert (turn[:, 1, 1] < 0).all()
    target = np.array([1.2 - 1.25, 0.5 - 0.05, 1.9 - 1.75])
    assert ((turn @ target[:, None] + shift)[:, 2, 0] > 2).all()


def test_without_alignment_the_scans_own_axes_stay(scan, labels):
    scan.alignment = np.eye(4)
    scan.write()
    with_identity = read_scan(scan.folder, labels, EVERY)
    scan.path(".txt").write_text("colorHeight = 968\n")
    read = read_scan(scan.folder, labels, EVERY)
    np.testing.assert_array_equal(read.world_to_camera, with_identity.world_to_camera)
    np.testing.assert_allclose(read.instances[1].lower_m, (-1.25, 0, -1.75), atol=1e-6)


def test_the_lens_is_that_of_the_stored_image(scan, labels):
    scan.write()
    quarter = read_scan(scan.folder, labels).intrinsics
    # 647.75 + 0.5 in our count of pixel centres; the third of each four lines is half a pixel late.
    np.testing.assert_allclose(
        quarter,
        [(292.5, 0, (648.25 - 0.5) / 4), (0, 292.5, (484.25 - 0.5) / 4), (0, 0, 1)],
        atol=1e-12,
    )
    full = read_scan(scan.folder, labels, ScanSettings(image_size=FULL_SIZE)).intrinsics
    np.testing.assert_allclose(full, [(1170, 0, 648.25), (0, 1170, 484.25), (0, 0, 1)], atol=1e-12)
    assert read_scan(scan.folder, labels).frames == (0,)  # every 15th of six


def test_notes_tell_what_was_left_out(scan, labels):
    scan.boxes[3].category = "never heard of"
    scan.write()
    data = json.loads(scan.path(".aggregation.json").read_text())
    data["segGroups"].append({"objectId": 40, "label": "bed", "segments": [999]})
    scan.path(".aggregation.json").write_text(json.dumps(data))
    masks = {f"{frame}.png": scan_mask(scan, frame) for frame in (0, 2, 3, 5)}
    write_zip(scan.path("_2d-instance-filt.zip"), masks)
    read = read_scan(scan.folder, labels, EVERY)
    assert read.notes == (
        "object 3: 'never heard of' is not in scannetv2-labels.combined.tsv, so void",
        "object 40 (bed) has no vertices; left out",
        "1 of 6 frames have no usable pose; skipped",
        "2 of 6 frames have no mask; skipped",
    )
    assert [item.object_id for item in read.instances] == [0, 1, 2, 3]


def scan_mask(scan, frame):
    from scan_files import png

    return png(scan.mask(frame, (242, 324)))


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        (".sens", r"\.sens cannot be opened"),
        (".txt", r"\.txt cannot be read .No such file"),
        (".aggregation.json", "a scan without annotations"),
        ("_vh_clean_2.0.010000.segs.json", r"segs\.json cannot be read .* to objects"),
        ("_vh_clean_2.ply", r"_vh_clean_2\.ply cannot be read"),
        ("_2d-instance-filt.zip", r"_2d-instance-filt\.zip is missing: .* folder\.$"),
    ],
)
def test_every_missing_file_is_named(scan, labels, ending, words):
    scan.write().path(ending).unlink()
    with pytest.raises(InputError, match="scene0000_00.*" + words):
        read_scan(scan.folder, labels)


def test_raw_masks_are_an_option(scan, labels):
    scan.write()
    scan.path("_2d-instance-filt.zip").rename(scan.path("_2d-instance.zip"))
    with pytest.raises(
        InputError, match=r"filt\.zip is missing.*or give --masks raw, whose archive"
    ):
        read_scan(scan.folder, labels)
    read = read_scan(scan.folder, labels, ScanSettings(masks="raw"))
    assert read.masks == scan.path("_2d-instance.zip")


def test_segments_that_do_not_fit_the_mesh(scan, labels):
    scan.write().path("_vh_clean_2.0.010000.segs.json").write_text('{"segIndices": [1, 2, 3]}')
    with pytest.raises(InputError, match=r"has 3 segIndices, but scene0000_00_vh.*ply 32 vertices"):
        read_scan(scan.folder, labels)


def test_a_recording_without_a_usable_frame(scan, labels):
    scan.poses = [np.full((4, 4), np.inf), *[np.eye(4)] * 2]
    scan.write()
    write_zip(scan.path("_2d-instance-filt.zip"), {"77.png": scan_mask(scan, 1)})
    with pytest.raises(
        InputError, match=r"\.sens gives no view: of 3 frames .every 1., 1 have no us.* 2 no"
    ):
        read_scan(scan.folder, labels, EVERY)


def test_masks_of_another_shape_than_the_colour_frames(scan, labels):
    scan.write()
    scan.path(".sens").write_bytes(sens_bytes(scan.poses, [b""] * 6, (500, 500)))
    with pytest.raises(InputError, match=r"filt\.zip: The masks are 1296 x 968 .* 500 x 500"):
        read_scan(scan.folder, labels)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"masks": "best"}, "masks is 'best'; choose filt or raw"),
        ({"frame_step": 0}, "frame_step is 0; expected at least 1"),
    ],
)
def test_settings_that_mean_nothing(change, words):
    with pytest.raises(InputError, match=words):
        ScanSettings(**change)


def test_a_scan_without_an_alignment_says_so(scan, labels):
    scan.write()
    assert not any("axisAlignment" in note for note in read_scan(scan.folder, labels).notes)
    scan.path(".txt").write_text("sceneType = Bedroom / Hotel\n")
    (note,) = (n for n in read_scan(scan.folder, labels).notes if "axisAlignment" in n)
    assert note.startswith("scene0000_00.txt has no axisAlignment, which ScanNet v2's")
