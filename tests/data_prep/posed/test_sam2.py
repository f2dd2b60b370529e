"""SAM 2's folders per object: overlaps, classes, and what cannot be used."""

import capture_files as tools
import numpy as np
from capture_files import refusal, same_masks
from PIL import Image
from posed_files import prepared


def test_masks_that_overlap_show_the_smaller_one(room, plain):
    """SAM 2's masks may overlap; those of a whole bed, say, with the chair that hides a part."""
    tools.write_sam2(room)
    hidden = plain.views.instance_ids == 2
    assert hidden.any()
    for view in range(len(room.poses)):
        path = room.folder / "003" / f"{room.stem(view)}.png"
        whole = np.isin(room.ids(view), (3, 300)).astype(np.uint8)
        Image.fromarray(whole).save(path)
    same_masks(prepared(room).views, plain.views)


def test_sam2_knows_no_classes(room):
    tools.write_sam2(room)
    (room.folder / "classes.json").unlink()
    said = refusal(room)
    assert "has no classes.json or classes.csv or panoptic.json" in said
    assert said.endswith("""so write one for each object's folder: {"3": "bed", ...}.""")


def test_object_folders_that_cannot_be_used(room):
    tools.write_sam2(room)
    path = room.folder / "007" / f"{room.stem(1)}.png"
    Image.fromarray(np.zeros((9, 8), dtype=np.uint8)).save(path)
    assert f"{path} is 8 x 9 pixels, but the masks of other objects 128 x 96; wr" in refusal(room)
    Image.fromarray(room.ids(1)).save(path)
    path.write_bytes(path.read_bytes()[:90])
    assert f"{path} is damaged (" in refusal(room)
    (room.folder / "007").rename(room.folder / "03")
    assert "003 and 03 are folders of one object; keep one of them." in refusal(room)
    (room.folder / "03").rename(room.folder / "000")
    assert "000: its object has the number 0, expected 1 to 65534; rename the fol" in refusal(room)


def test_masks_of_other_frames_are_named(room):
    tools.write_sam2(room)
    for folder in ("003", "007", "300"):
        for view in range(10):
            path = room.folder / folder / f"{room.stem(view)}.png"
            path.rename(path.with_name(f"{view:05d}.png"))
    said = refusal(room)
    assert "none of its 10 frames has a mask; expected " in said
    assert said.endswith(
        "003/frame_00000.png, but there is 00000, 00001, 00002, ...: give masks the names of their "
        "frames."
    )
    tools.write_plain(room)
    for folder in ("003", "007", "300"):
        for path in (room.folder / folder).iterdir():
            path.unlink()
    tools.write_grounded_sam2(room)
    (room.folder / "mask_data").rename(room.folder / "away")
    (room.folder / "mask_data").mkdir()
    (room.folder / "away" / "mask_frame_00003.npy").rename(room.folder / "mask_data/mask_3.npy")
    assert "mask_frame_00000.npy, but there is mask_3: give" in refusal(room)
