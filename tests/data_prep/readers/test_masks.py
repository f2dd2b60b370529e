"""Masks and poses of every tool: what is read beside the room, guessed, joined and left out."""

import json
import warnings

import capture_files as tools
import numpy as np
import pytest
from capture_files import SEGMENTS, same_masks, same_objects
from colmap_files import write_colmap
from PIL import Image
from posed_files import SET, PosedRoom, furniture, prepared
from refusals import refused

from data_prep.readers.posed.coco import PanopticPngs
from data_prep.readers.posed.formats import MASKS, read_class_map, read_formats, read_label_set
from data_prep.readers.posed.masks import find_table
from data_prep.readers.posed.reader import Posed
from data_prep.readers.posed.transforms import POSES, read_recording
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.id_tables import read_class_table
from sceneprior.training.fit import warn_of_losses

TRACKED = {
    "sam2, without masks of what is hidden": lambda room: tools.write_sam2(room, hidden=False),
    "sam2 in masks": lambda room: tools.write_sam2(room, "masks"),
    "coco instance_id": lambda room: tools.write_coco_images(
        room, "instance_id", "annotations/instances_default.json"
    ),
}


@pytest.mark.parametrize("tool", TRACKED)
def test_tracked_masks_are_those_of_pngs(room, plain, tool):
    TRACKED[tool](room)
    made = prepared(room)
    same_masks(made.views, plain.views)
    name = tool.split()[0].strip(",")
    assert prepared(room, tools=["nerfstudio", name]).notes == made.notes == plain.notes


def test_ids_of_single_images_are_joined_without_being_asked(room):
    tools.write_coco_images(room)
    (said,) = (s for s in Posed(room.folder, classes=SET).assumptions() if "--tracks" in s)
    assert said.startswith("In 1 of 1 rooms ids belong to single images (")
    assert said.endswith("objects are found from poses, masks and classes, as with --tracks auto.")


WRITERS = {
    "png": tools.write_plain,
    "sam2": tools.write_sam2,
    "grounded-sam2": tools.write_grounded_sam2,
    "grounded-sam2, images": tools.write_grounded_sam2_images,
    "coco": lambda room: tools.write_coco_images(room, "track_id"),
    "coco, video": tools.write_coco_video,
    "panoptic": tools.write_panoptic,
}


@pytest.mark.parametrize("tool", WRITERS)
def test_masks_without_a_frame_and_names_of_windows(room, tool):
    WRITERS[tool](room)
    whole = prepared(room)
    data = room.data
    for path in [room.folder / "coco.json", *room.folder.glob("json_data/*.json")]:
        if path.is_file():  # names of pictures in masks, too
            path.write_text(path.read_text().replace("images/", r"C:\\rooms\\images\\"))
    for frame in data["frames"]:
        frame["file_path"] = "C:\\rooms\\" + frame["file_path"].replace("/", "\\")
    room.write_transforms(data | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]})
    made = prepared(room)
    np.testing.assert_array_equal(made.views.instance_ids, whole.views.instance_ids)
    assert made.notes == whole.notes
    room.write_transforms(data | {"frames": data["frames"][3:]})
    (note,) = (note for note in prepared(room).notes if "no frame" in note)
    assert note.startswith("3 of 10 masks have no frame ('frame_00000")
    assert note.endswith("); unused")


def test_ids_that_no_mask_shows_are_counted(room):
    table = {str(thing.id): thing.name for thing in room.things} | {"9": "bed", "12": "vase"}
    (room.folder / "classes.json").write_text(json.dumps(table))
    assert "2 of 5 ids show in no view (9, 12)" in prepared(room).notes


def shuffle(room, unique):
    """Give each frame ids of its own, and write their classes as `unique` ids of the room, or in a
    JSON beside each PNG."""
    names = {thing.id: thing.name for thing in room.things}
    table, first = {}, 1
    for view in range(len(room.poses)):
        old = room.ids(view)
        new = np.zeros_like(old)
        own = {}
        for k in np.unique(old[old > 0])[:: 1 - 2 * (view % 2)].tolist():
            new[old == k] = first
            own[str(first)] = names[k]
            first += 1
        Image.fromarray(new).save(room.png(view))
        table |= own
        if not unique:
            first = 1
            room.png(view).with_suffix(".json").write_text(json.dumps(own))
    (room.folder / "classes.json").unlink()
    if unique:
        (room.folder / "classes.json").write_text(json.dumps(table))


@pytest.mark.parametrize("unique", [True, False])
def test_ids_of_single_frames_are_joined(room, plain, unique, tmp_path):
    shuffle(room, unique)
    same_objects(prepared(room, tracks="auto").views, plain.views)
    if unique:
        with refused("readers/ids of single frames", tmp=tmp_path):
            prepared(room)
        return
    room.png(3).with_suffix(".json").unlink()
    with refused("readers/frame without classes", tmp=tmp_path):
        prepared(room, tracks="auto")
    room.png(3).with_suffix(".json").write_text(json.dumps({"1": "bed"}))
    notes = prepared(room, tracks="auto").notes
    assert any("masks have no class in their frame's table: void" in note for note in notes)


def test_an_id_takes_its_most_frequent_class(room, plain):
    tools.write_grounded_sam2(room)
    path = room.folder / "json_data/mask_frame_00004.json"
    path.write_text(path.read_text().replace('"bed"', '"sofa"'))
    made = prepared(room)
    same_masks(made.views, plain.views)
    note = "ids with several classes take the most frequent one: 3 (bed 9, sofa 1)"
    assert note in made.notes


def test_a_segment_of_stuff_with_several_classes_is_background(room):
    def rename(data):
        data["categories"].append({"id": 190, "name": "floor-other-merged", "isthing": 0})
        for segment in data["annotations"][1]["segments_info"]:
            if segment["id"] == SEGMENTS[11]:
                segment["category_id"] = 190

    tools.write_panoptic(room, rename)
    assert prepared(room).views.stuff is None


def test_names_are_mapped_to_classes(room, tmp_path):
    """Names of the masks get the classes of --class-map; other names stay as they are."""
    table = tmp_path / "map.csv"
    table.write_text("\ufeffBack_Pack ,void\nbackpack,chair\n")
    pairs = read_class_map(table, SET)
    assert dict(pairs) == {"back pack": "void", "backpack": "chair"}
    plain = prepared(room)
    source = Posed(room.folder.parent, classes=SET, class_map=pairs)
    mapped = prepared(room, class_map=pairs)
    assert "class_map" in source.options() and len(mapped.views.object_class) == 1 + len(
        plain.views.object_class
    )
    assert any("backpack" in note for note in plain.notes)
    assert not any("backpack" in note for note in mapped.notes)
    for row in ("backpack,spaceship", "backpack", "bed,chair,desk"):
        table.write_text(row)
        with pytest.raises(InputError, match=r"map.csv, row 1 .*expected a name of the masks"):
            read_class_map(table, SET)


def bed_as_stuff(room):
    def change(data):
        data["categories"][0] |= {"name": "cabinet-merged", "isthing": 0}

    tools.write_panoptic(room, change)


def bed_of_two_names(room):
    def change(data):
        data["categories"].append({"id": 190, "name": "couch", "isthing": 1})
        for segment in data["annotations"][1]["segments_info"]:
            segment["category_id"] = {65: 190}.get(segment["category_id"], segment["category_id"])

    tools.write_panoptic(room, change)


def bed_of_three_names(room):
    tools.write_grounded_sam2(room)
    names = ("couch", "settee", "chair", "couch", "chair")
    for k, path in enumerate(sorted(room.folder.glob("json_data/*.json"))):
        path.write_text(path.read_text().replace('"bed"', f'"{names[k % 5]}"'))


@pytest.mark.parametrize("write", [bed_as_stuff, bed_of_two_names, bed_of_three_names])
def test_names_are_mapped_before_they_are_compared(room, plain, write):
    """With what is stuff, with the names in other frames, and by votes: couch 4, settee 2 of 10."""
    write(room)
    pairs = tuple((name, "bed") for name in ("cabinet merged", "couch", "settee"))
    same_masks(prepared(room, class_map=pairs).views, plain.views)


def test_panoptic_frames_of_one_name_in_two_folders_have_their_own_classes(tmp_path):
    frames = [
        {"file_name": f"{folder}/0000.png", "segments_info": [{"id": 5, "category_id": k}]}
        for k, folder in enumerate(("left", "right"))
    ]
    categories = [{"id": 0, "name": "bed"}, {"id": 1, "name": "chair"}]
    table = {"annotations": frames, "categories": categories}
    (tmp_path / "panoptic.json").write_text(json.dumps(table))
    masks = PanopticPngs(tmp_path, SET)
    pngs = [tmp_path / "instances" / frame["file_name"] for frame in frames]
    assert [masks.of_png(path).classes() for path in pngs] == [{1: "bed"}, {1: "chair"}]
    with refused("readers/panoptic classes that differ between folders", tmp=tmp_path):
        masks.classes()


def test_crowds_and_ids_without_a_segment_are_void(room):
    def crowd(data):
        for frame in data["annotations"]:
            for segment in frame["segments_info"]:
                segment["iscrowd"] = int(segment["id"] == 5)
            frame["segments_info"] = [s for s in frame["segments_info"] if s["id"] != 256]

    tools.write_panoptic(room, crowd)
    made = prepared(room)
    assert made.views.object_class.tolist() == [1]
    assert "classes outside the label set are void: backpack (1), crowd (1)" in made.notes
    assert any("masks show ids that the table of classes does not have" in n for n in made.notes)


def test_names_that_are_no_class_are_counted_to_the_end(room, cli, tmp_path):
    """Near matches are suggested; the summary, `--verify` and `fit` name what has no class."""
    table = json.loads((room.folder / "classes.json").read_text())
    key = next(key for key, name in table.items() if name in SET.split(","))
    table[key] = f"##{table[key]}."
    (room.folder / "classes.json").write_text(json.dumps(table))
    made = prepared(room)
    assert made.unknown_categories[table[key]] == 1
    assert any(f"(1: {table[key].strip('#.')}?)" in note for note in made.notes)
    out = tmp_path / "shards"
    done = cli("prep-posed", room.folder, "--out", out, "--label-set", f"{SET},piano",
               "--workers", 1)  # fmt: skip
    for text in (done.output, cli("inspect", out, "--verify").output):
        assert "objects whose name is no class" in " ".join(text.split())
        assert "all is well" not in text
    assert "no object is" in done.output and "piano" in done.output
    with pytest.warns(InputWarning) as told:
        warn_of_losses(out, 0)
    assert "0 of the 1 rooms" in str(told[0].message)


@pytest.mark.parametrize(
    ("unknown", "known", "status", "warns"),
    [(2, 4, "prepared", True), (1, 4, "prepared", False), (9, 4, "filtered", False)],
)
def test_fit_warns_if_a_third_of_the_objects_has_no_class(tmp_path, unknown, known, status, warns):
    """Names in rooms that are not prepared do not count: their objects with a class do not."""
    rooms = [
        {"status": "prepared", "classes": {"bed": known}, "unknown_categories": {}},
        {"status": status, "classes": {}, "unknown_categories": {"bed.": unknown}},
    ]
    report = {
        "counts": {"train": {"rooms": 1}},
        "rooms": rooms,
        "classes": {"bed": known},
        "unknown_categories": {"bed.": unknown},
    }
    (tmp_path / "report.json").write_text(json.dumps(report))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warn_of_losses(tmp_path, 1)
    assert [str(one.message).startswith(f"{unknown} objects") for one in told] == [True] * warns


def test_optimized_keyframes_of_polycam_are_preferred(room):
    tools.write_polycam(room, "corrected_cameras")
    room.focal_px = 70.0
    tools.write_polycam(room, "cameras")
    recording = read_recording(room.folder)
    assert {frame.camera.fl_x for frame in recording.frames} == {80.0}
    assert recording.metres_per_unit == 1.0 and recording.up == "y"
    assert recording.frames[0].name == f"keyframes/corrected_images/{tools.timestamp(0)}.jpg"
    # Newer versions leave the size to the original cameras.
    paths = sorted(room.folder.glob("keyframes/corrected_cameras/*.json"))
    for path in paths:
        data = json.loads(path.read_text())
        path.write_text(json.dumps({k: data[k] for k in data if k not in ("width", "height")}))
    again = read_recording(room.folder)
    assert [frame.camera for frame in again.frames] == [frame.camera for frame in recording.frames]
    (room.folder / "keyframes/cameras" / paths[2].name).unlink()
    with refused("readers/polycam without a size", tmp=room.folder):
        read_recording(room.folder)


@pytest.mark.parametrize("name", ["metadata.json", "EXR_RGBD/metadata"])
def test_each_frame_of_record3d_has_its_principal_point_and_may_be_lost(room, name):
    tools.write_record3d(room, name, per_frame=True)
    made = prepared(room, up="y").views
    np.testing.assert_array_equal(made.intrinsics[:, 0, 2], 64.0 + np.arange(10))
    data = json.loads((room.folder / name).read_text())
    data["poses"][2] = [0.0] * 7
    data["poses"][3][4] = float("nan")
    (room.folder / name).write_text(json.dumps(data))
    assert prepared(room, up="y").notes[0] == "2 of 10 frames have no usable pose; skipped"


def test_a_colmap_model_beside_transforms_is_taken_if_named(room, plain):
    write_colmap(room, "PINHOLE", binary=True, folder="colmap/sparse/0")
    assert len(read_recording(room.folder).frames) == 10
    room.write_transforms(room.data | {"floor_m": 0.0, "floor_center_m": [0.1, -0.2]})
    np.testing.assert_array_equal(prepared(room).views.world_to_camera, plain.views.world_to_camera)
    assert read_recording(room.folder).up == "z"
    assert read_recording(room.folder, "colmap").up == "cameras"


BLANK = "\n\n"
TEXTS = {
    "a line each": lambda lines: [line for line in lines if ".jpg" in line],
    "points of each": lambda lines: [line or "1 2 -1 3 4 5 6 7 8" for line in lines],
    "blank lines": lambda lines: ["# by hand", "", "", *lines, "", ""],
    "blank lines between": lambda lines: [f"{line}{BLANK}" for line in lines],
    "mark and carriage returns": lambda lines: ["\ufeff# a list", *(f"{line}\r" for line in lines)],
    "indents and tabs": lambda lines: [" " + line.replace(" ", "\t") for line in lines],
}


@pytest.mark.parametrize("text", TEXTS)
def test_images_of_texts_of_colmap_in_any_layout(room, text):
    write_colmap(room, "PINHOLE", binary=False)
    before = read_recording(room.folder).frames
    path = room.folder / "sparse/0/images.txt"
    lines = TEXTS[text](path.read_text().split("\n"))
    path.write_text("\n".join(lines), newline="")
    after = read_recording(room.folder).frames
    assert [frame.name for frame in after] == [frame.name for frame in before] and len(after) == 10
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)
    for k, line in enumerate(
        ("1.5 2.5 -1 3.5", "1 1 0 0 0 0 0 0 7", "1.5 2.5 -1 3.5 4.5 7 8 9 10 11")
    ):
        path.write_text(f"# images\n\n{line}\n")
        with refused(f"readers/line {k} of images.txt", tmp=room.folder):
            read_recording(room.folder)


def test_of_several_models_of_colmap_the_largest_is_taken_and_said(room, tmp_path, cli):
    for number, most in ((0, 2), (1, 8), (10, 4)):
        write_colmap(room, "PINHOLE", binary=number < 10, folder=f"sparse/{number}", most=most)
    source = Posed(room.folder, classes=SET)
    (said,) = (sentence for sentence in source.assumptions() if "COLMAP's 3 models" in sentence)
    note = (
        "of COLMAP's 3 models, 1 with 9 frames is used, and not 0 with 3, 10 with 5 (--model "
        "chooses)"
    )
    assert said == f"In 1 of 1 rooms a part of the poses is unused: in attic, {note}."
    made = prepared(room)
    assert made.notes[:2] == (note, "1 of 10 masks have no frame ('frame_00009.png'); unused")
    words = ("prep-posed", room.folder, "--label-set", SET, "--out", tmp_path / "a", "--workers", 1)
    result = cli(*words, "--model", 0)
    assert result.exit_code == 0 and "train 1 rooms, 3 views" in result.stdout, result.output
    with refused("readers/model that is none", tmp=room.folder):
        read_recording(room.folder, model=7)


def test_what_was_found_is_said(room, cli, tmp_path):
    other = PosedRoom(room.folder.parent / "cellar", furniture(0.1)).write(floor_m=0.0)
    tools.write_sam2(room)
    assert Posed(room.folder.parent, classes=SET).found() == [
        "1 room with poses of nerfstudio (transforms.json) and masks of SAM 2 (a folder per "
        "object), as with --from nerfstudio --from sam2.",
        "1 room with poses of nerfstudio (transforms.json) and masks of PNGs of ids (instances/), "
        "as with --from nerfstudio --from png.",
    ]
    both = read_formats(["png", "nerfstudio"])
    assert Posed(other.folder, classes=SET, **both).found() == []
    # A room without the masks that were asked for is in the report, and the other is prepared.
    result = cli("prep-posed", room.folder.parent, "--label-set", SET, "--test-share", 0,
                 "--from", "sam2", "--out", tmp_path / "b", "--workers", 1)  # fmt: skip
    assert result.exit_code == 3 and result.stderr.startswith("Found 1 room with"), result.output
    assert "leave out --from sam2 to guess." in (tmp_path / "b" / "report.csv").read_text()


@pytest.mark.parametrize("tool", WRITERS)
def test_a_room_with_masks_and_no_poses_is_in_the_report(room, tool):
    PosedRoom(room.folder.parent / "cellar", furniture(0.1)).write(floor_m=0.0)
    WRITERS[tool](room)
    (room.folder / "transforms.json").unlink()
    survey = Posed(room.folder.parent, classes=SET).survey()
    assert [task.room_id for task in survey.rooms] == ["cellar"]
    (line,) = survey.left_out
    assert (line.room_id, line.status) == ("attic", "failed") and "transforms.json" in line.reason


def test_names_of_tools():
    assert read_formats([]) == {}
    for name in (*POSES, *MASKS):
        assert name in read_formats([name]).values()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("classes.json", '{"1": "bed", " 300 ": "night stand"}'),
        ("classes.csv", "id,class\n1,bed\n\n300,night stand\n"),
        ("classes.csv", "\ufeff1,bed,note\n 300 ,night stand"),
    ],
)
def test_tables_and_label_sets(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert read_class_table(find_table(tmp_path)) == {1: "bed", 300: "night stand"}
    assert read_label_set("scannet") == "scannet"
    assert read_label_set("void, bed,night stand") == "void,bed,night stand"
    path = tmp_path / "set.txt"
    path.write_text("# mine\nvoid\nbed\n\n night stand \n")
    assert read_label_set(str(path)) == "void,bed,night stand"
    (tmp_path / "set.json").write_text('["bed", "chair"]')
    assert read_label_set(str(tmp_path / "set.json")) == SET


def test_a_list_of_classes_may_be_longer_than_the_name_of_a_file():
    classes = ",".join(["void", *(f"class number {k}" for k in range(50))])
    assert len(classes) > 255 and read_label_set(classes) == classes
