"""The command `inspect`, and a folder held against itself: what is wrong is found and named."""

import shutil

import h5py
import numpy as np
import pytest
from front_jobs import change_room, six_bedrooms_shards
from golden_values import hold
from PIL import Image
from posed_files import SET, PosedRoom
from refusals import refused
from rich.console import Console

from data_prep.engine.build import Job, build_shards
from data_prep.inspection.agreement import Tally
from data_prep.inspection.pictures import draw_sheet, legend
from data_prep.inspection.tables import check_tables, count_tables, room_table
from data_prep.inspection.verify import FolderCheck, RoomCheck, verify
from data_prep.readers.posed.reader import Posed
from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.errors import sentence_of
from sceneprior.core.parallel import on_workers

RULES = ("views.per_m2=1.5", "views.image_size=[120, 160]")


@pytest.fixture
def shards(made_once, tmp_path):
    made = made_once("verified", lambda folder: six_bedrooms_shards(folder, *RULES))
    return shutil.copytree(made, tmp_path / "shards")


def problems(name, shards):
    hold("verify", {name: list(verify(shards).problems)}, slack=0.02, shards=shards)


def test_a_right_folder_and_one_room_of_it(shards):
    found = verify(shards)
    assert found.problems == ()
    with on_workers(2):
        assert verify(shards) == found
    one = verify(shards, "house1_MasterBedroom-1")
    assert [room.room_id for room in one.every] == ["house1_MasterBedroom-1"]
    for split in ("train", "val", "test"):
        shutil.rmtree(shards / split)
    with refused("inspect/folder without rooms", shards=shards):
        verify(shards)


def test_changed_numbers_are_found_under_a_wrong_and_under_a_right_checksum(shards):
    path = next((shards / "train").glob("*.h5"))
    turned = np.ones(3, "f4")
    change_room(path, lambda group: group["ground_truth/yaw_rad"].write_direct(turned), seal=False)

    def shift(group):
        boxes = group["boxes"][()]
        boxes[group["visible"][()], 0] *= 0.5
        group["boxes"][...] = boxes

    change_room(path, shift, number=1)

    def cut(group):
        sides = group["sides_clear"][()]
        del group["sides_clear"]
        group["sides_clear"] = sides[:1]

    change_room(next((shards / "test").glob("*.h5")), cut, seal=False)
    problems("changed numbers", shards)


def test_a_truncated_shard_a_missing_one_and_another_label_set(shards):
    path = next((shards / "test").glob("*.h5"))
    whole = path.read_bytes()
    path.write_bytes(whole[:3000])
    (problem,) = verify(shards).problems
    assert problem.startswith(f"{path} cannot be read") and problem.count(str(path)) == 1
    path.unlink()
    problems("a missing shard", shards)
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        file.attrs["label_set"] = "scannet"
    problems("another label set", shards)


def test_the_command_prints_and_draws(shards, tmp_path, cli):
    looked = cli("inspect", shards)
    assert looked.exit_code == 0, looked.output
    assert "nightstand" in looked.stdout and "160 x 120" in looked.stdout
    with Image.open(shards / "inspect.png") as sheet:
        assert sheet.width == 4 * 488 + 8
    one = cli("inspect", shards, "--room", "house0_Bedroom-0", "--png", tmp_path / "a" / "b.png")
    assert one.exit_code == 0 and "double_bed" in one.stdout and "1.80" in one.stdout
    assert (tmp_path / "a" / "b.png").is_file()
    blocked = cli("inspect", shards, "--png", shards / "index.json" / "x.png")
    assert "a file is where a folder is needed" in sentence_of(blocked.exception)


def test_verify_prints_the_overlap_and_exits_with_3_where_something_is_wrong(shards, cli):
    well = cli("inspect", shards, "--verify")
    assert well.exit_code == 0 and "meshes" in well.stdout, well.output
    hold("verify", {"well": well.stdout.splitlines()[-1]}, slack=0.02, shards=shards)
    assert not (shards / "inspect.png").exists()
    paths = sorted((shards / "train").glob("*.h5"))
    with h5py.File(paths[0], "a") as file:
        for group in list(file["rooms"].values())[:2]:
            group["mask_pixels"][0, 0] += 1
    wrong = cli("inspect", shards, "--verify")
    assert wrong.exit_code == 3, wrong.output
    last = wrong.stderr.strip().splitlines()[-1]
    assert last.startswith(f"Error: {paths[0]}, room ") and "its checksum does not match" in last
    assert last.endswith("(3 more problems, listed above)")


def test_the_worst_rooms_keep_their_names_in_a_narrow_terminal():
    name = "2bc95aea-aa71-57ad-9ed2-3852b7420110_LivingDiningRoom-1010"
    checks = [
        RoomCheck("a", f"{name}{k}", agreement={"mesh": Tally("mesh", 9, k)}) for k in range(9)
    ]
    console = Console(width=60, record=True)
    console.print(check_tables(FolderCheck({"train": checks[::-1]}, ()))[1])
    rows = [line for line in console.export_text().splitlines() if line.startswith("│")]
    said = "".join(line.split("│")[1].strip() for line in rows)
    assert said == "".join(f"{name}{k}" for k in range(5))


def test_verify_says_what_it_could_not_check(shards, cli):
    for path in shards.glob("*/*.h5"):
        with h5py.File(path, "a") as file:
            for group in file["rooms"].values():
                del group.attrs["sha256"]
                group["sides_clear"][...] = False
    # Nothing is seen whole, and all the same every mask lies within its projection.
    said = cli("inspect", shards, "--verify").stdout.splitlines()[-1]
    hold("verify", {"little is checked": said}, slack=0.02, shards=shards)


def test_a_sheet_of_a_folder_and_of_a_room(shards):
    # Tiles of 480 x 360 with 8 pixels between and 18 for the caption, under the legend.
    for pictures, columns, rows in ((1, 1, 1), (5, 4, 2), (8, 4, 2)):
        sheet = draw_sheet(shards, None, pictures)
        assert sheet.width == columns * 488 + 8
        assert (sheet.height - 8) // 386 == rows
    assert draw_sheet(shards, "house0_Bedroom-0", 3).width == 4 * 488 + 8  # with its plan
    with refused("inspect/no such room", shards=shards):
        draw_sheet(shards, "attic", 3)


def test_the_legend_explains_what_the_sheet_shows():
    hold("verify", {f"legend {a} {b}": legend(a, b) for a in (True, False) for b in (True, False)})


def test_tables_say_how_far_rooms_were_turned(tmp_path):
    room = PosedRoom(tmp_path / "rooms" / "attic", size=(192, 256), focal_px=160.0)
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7)]:
        room.look(eye, (0.1, 0.1, 0.3))
    room.write()
    turn = np.eye(4)
    turn[:2, :2] = yaw_rotation(np.radians(20.0))[::2, ::2]
    room.poses = [turn @ pose for pose in room.poses]
    room.write_transforms(room.data)
    build_shards(Job(Posed(room.folder, classes=SET), tmp_path / "shards"))
    (caption,) = (table.caption for table in count_tables(tmp_path / "shards") if table.caption)
    table = room_table(tmp_path / "shards", "attic")
    assert list(map(str, table.columns[0].cells)) == ["1", "2"], "as in the images of ids"
    hold("verify", {"turned": [caption, table.title]}, slack=0.05)
