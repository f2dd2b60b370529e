"""`prep-posed --from`: masks of every tool are those of PNGs; what is guessed is said."""

import capture_files as tools
import numpy as np
import pytest
from capture_files import refusal, same_masks
from colmap_files import write_colmap
from PIL import Image
from posed_files import SET, PosedRoom, furniture, prepared
from test_untracked import same_objects

from data_prep.readers.posed.formats import MASKS, read_formats
from data_prep.readers.posed.source import PosedSource
from data_prep.readers.posed.transforms import POSES, read_recording
from sceneprior.core.errors import InputError

TRACKED = {
    "sam2": tools.write_sam2,
    "sam2, without masks of what is hidden": lambda room: tools.write_sam2(room, hidden=False),
    "sam2 in masks": lambda room: tools.write_sam2(room, "masks"),
    "grounded-sam2": tools.write_grounded_sam2,
    "coco track_id": lambda room: tools.write_coco_images(room, "track_id"),
    "coco instance_id": lambda room: tools.write_coco_images(
        room, "instance_id", "annotations/instances_default.json"
    ),
    "coco attributes": lambda room: tools.write_coco_images(
        room, "attributes", "attic_annotations.coco.json", polygons=True
    ),
    "coco video": tools.write_coco_video,
}
UNTRACKED = {
    "coco": tools.write_coco_images,
    "grounded-sam2": tools.write_grounded_sam2_images,
}


@pytest.mark.parametrize("tool", TRACKED)
def test_tracked_masks_are_those_of_pngs(room, plain, tool):
    TRACKED[tool](room)
    made = prepared(room)
    same_masks(made.views, plain.views)
    assert "classes outside the label set are void: backpack (1)" in made.notes
    # And so they are if their ids are not trusted, which are right.
    same_objects(prepared(room, tracks="auto").views, plain.views)
    name = tool.split()[0].strip(",")
    assert prepared(room, tools=["nerfstudio", name]).notes == made.notes


@pytest.mark.parametrize("tool", UNTRACKED)
def test_ids_of_single_images_are_joined_without_being_asked(room, plain, tool, cli):
    UNTRACKED[tool](room)
    made = prepared(room)
    assert any("3 objects are found from" in note for note in made.notes)
    same_objects(made.views, plain.views)
    (said,) = (s for s in PosedSource(room.folder, SET).assumptions() if "--tracks" in s)
    assert said.startswith("In 1 of 1 rooms ids belong to single images (")
    assert said.endswith("objects are found from poses, masks and classes, as with --tracks auto.")


def test_what_was_found_is_said(room, cli):
    other = PosedRoom(room.folder.parent / "cellar", furniture(0.1)).write(floor_m=0.0)
    tools.write_sam2(room)
    source = PosedSource(room.folder.parent, SET)
    assert source.found() == [
        "1 room with poses of nerfstudio (transforms.json) and masks of SAM 2 (a folder per "
        "object), as with --from nerfstudio --from sam2.",
        "1 room with poses of nerfstudio (transforms.json) and masks of PNGs of ids (instances/), "
        "as with --from nerfstudio --from png.",
    ]
    both = read_formats(["png", "nerfstudio"])
    assert PosedSource(other.folder, SET, formats=both).found() == []
    words = ("prep-posed", room.folder.parent, "--label-set", SET, "--test-share", 0)
    result = cli(*words, "--out", room.folder.parent.parent / "a", "--workers", 1)
    assert result.exit_code == 0, result.output
    assert "Found 1 room with poses of nerfstudio (transforms.json) and masks of" in result.stderr
    # A room without the masks that were asked for is in the report, and the other is prepared.
    out = room.folder.parent.parent / "b"
    result = cli(*words, "--from", "sam2", "--out", out, "--workers", 1)
    assert result.exit_code == 3 and result.stderr.startswith("Found 1 room with"), result.output
    assert (
        "has no masks of SAM 2 (a folder per object); leave out --from sam2 to guess."
        in (out / "report.csv").read_text()
    )


def test_two_tools_in_a_folder_are_a_question(room, plain):
    pngs = {view: room.png(view).read_bytes() for view in range(10)}
    tools.write_record3d(room)
    room.write_transforms(room.data | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]})
    assert refusal(room).endswith(
        "attic has poses of nerfstudio (transforms.json) and of Record3D (metadata); choose with "
        "--from nerfstudio or --from record3d."
    )
    for view, data in pngs.items():
        room.png(view).write_bytes(data)
    chosen = prepared(room, tools=["nerfstudio"])
    np.testing.assert_array_equal(chosen.views.world_to_camera, plain.views.world_to_camera)
    (room.folder / "007").mkdir()
    Image.fromarray(room.ids(0)).save(room.folder / "007" / "0.png")
    assert refusal(room, ["nerfstudio"]).endswith(
        "attic has masks of PNGs of ids (instances/) and of SAM 2 (a folder per object); choose "
        "with --from png or --from sam2."
    )
    assert len(prepared(room, tools=["png", "nerfstudio"]).views.visible) == 10


def test_a_colmap_model_beside_transforms_is_taken_if_named(room, plain, tmp_path):
    write_colmap(room, "PINHOLE", binary=True)
    room.write_transforms(room.data | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]})
    np.testing.assert_array_equal(prepared(room).views.world_to_camera, plain.views.world_to_camera)
    assert read_recording(room.folder).up == "z"
    assert read_recording(room.folder, "colmap").up == "cameras"
    with pytest.raises(InputError, match=r"attic has no poses of Polycam .keyframes/.; leave out"):
        read_recording(room.folder, "polycam")
    (room.folder / "instances").rename(tmp_path / "instances")
    with pytest.raises(InputError, match=r"rooms holds no poses of Polycam .keyframes/., and none"):
        PosedSource(tmp_path / "rooms", SET, formats=read_formats(["polycam"])).found()


def test_names_of_tools():
    assert read_formats([]) == read_formats(())
    for name in (*POSES, *MASKS):
        assert name in vars(read_formats([name])).values()
    with pytest.raises(InputError, match=r"--from 'sam3' is not known; choose from nerfstudio,"):
        read_formats(["sam3"])
    with pytest.raises(InputError, match=r"--from sam2 and --from coco are both formats of mas"):
        read_formats(["sam2", "polycam", "coco"])
