"""Files of Grounded-SAM-2: classes that change, and what cannot be used."""

import capture_files as tools
import numpy as np
import pytest
from capture_files import refusal, same_masks
from posed_files import prepared


def test_an_id_takes_its_most_frequent_class(room, plain):
    tools.write_grounded_sam2(room)
    path = room.folder / "json_data/mask_frame_00004.json"
    path.write_text(path.read_text().replace('"bed"', '"sofa"'))
    made = prepared(room)
    same_masks(made.views, plain.views)
    note = "ids with several classes take the most frequent one: 3 (bed 9, sofa 1)"
    assert note in made.notes


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros((96, 128)), "holds float64 of shape (96, 128); expected integer ids"),
        (np.zeros((2, 96, 128), dtype=bool), "holds bool of shape (2, 96, 128); expected integer"),
        (np.full((96, 128), -3), "has ids from -3 to -3; expected 0 to 65534, where 0 means no"),
        (np.full((96, 128), 65_535), "has ids from 65535 to 65535; expected 0 to 65534"),
        (np.array([{}]), "cannot be read as an .npy of numbers ("),
        (b"\x93NUMPY", "cannot be read as an .npy of numbers ("),
    ],
)
def test_arrays_that_are_no_ids(room, array, said):
    tools.write_grounded_sam2(room)
    path = room.folder / "mask_data/mask_frame_00000.npy"
    if isinstance(array, bytes):
        path.write_bytes(array)
    else:
        np.save(path, array, allow_pickle=True)
    assert f"{path} {said}" in refusal(room)


def test_grounded_sam2_files_that_cannot_be_used(room):
    tools.write_grounded_sam2(room)
    path = room.folder / "mask_data/mask_frame_00002.npy"
    path.write_bytes(path.read_bytes()[:-9])
    assert f"{path} cannot be read as an .npy of numbers (" in refusal(room)
    labels = room.folder / "json_data/mask_frame_00000.json"
    text = labels.read_text()
    labels.write_text(text.replace('"300": {', '"x": {'))
    assert f"{labels}: 'x' under `labels` is not an instance id; expected a num" in refusal(room)
    labels.write_text(text[:-9])
    assert f"{labels.name} is not JSON" in refusal(room)
    for path in (room.folder / "json_data").iterdir():
        path.unlink()
    assert "json_data names no class; expected mask_<frame>.json for each mask of" in refusal(room)


def test_results_of_single_images_that_cannot_be_used(room):
    tools.write_grounded_sam2_images(room)
    path = room.folder / "json_data/results_3.json"
    text = path.read_text()
    path.write_text(text.replace('"image_path"', '"path"'))
    said = refusal(room)
    assert f"{path} (there is no mask_data/mask_*.npy, so it is read as a single image's)" in said
    assert "image_path is" in said
    path.write_text(text.replace("frame_00003", "frame_00002"))
    assert f"{path}: two pictures are named 'frame_00002'; a room has one of each" in refusal(room)
