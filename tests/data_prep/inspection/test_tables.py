"""The sheet, the counts and the command around them."""

import re
import shutil

import h5py
import numpy as np
import pytest
from front_jobs import six_bedrooms_shards
from PIL import Image
from posed_files import SET, PosedRoom

from data_prep.engine.build import Job, build_shards
from data_prep.inspection.sheet import draw_sheet, legend
from data_prep.inspection.tables import count_tables, room_table
from data_prep.readers.posed.reader import Posed
from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.errors import InputError


@pytest.fixture
def shards(made_once, tmp_path):
    return shutil.copytree(made_once("six_bedrooms", six_bedrooms_shards), tmp_path / "shards")


def test_a_sheet_of_a_folder_and_of_a_room(shards):
    # Tiles of 480 x 360 with 8 pixels between and 18 for the caption, under the legend.
    for pictures, columns, rows in ((1, 1, 1), (5, 4, 2), (8, 4, 2)):
        sheet = draw_sheet(shards, pictures=pictures)
        assert sheet.width == columns * 488 + 8
        assert (sheet.height - 8) // 386 == rows
    room = draw_sheet(shards, "house0_Bedroom-0", pictures=3)
    assert room.width == 4 * 488 + 8  # its plan comes first
    with pytest.raises(InputError, match=r"has no room 'attic'; its report\.csv lists the rooms"):
        draw_sheet(shards, "attic")


def test_the_legend_explains_what_the_sheet_shows(shards, tmp_path, monkeypatch):
    drawn = []

    def spied(wires, floors):
        drawn.append((wires, floors))
        return legend(wires, floors)

    monkeypatch.setattr("data_prep.inspection.sheet.legend", spied)
    room = PosedRoom(tmp_path / "rooms" / "attic").write()
    build_shards(Job(Posed(room.folder, classes=SET), tmp_path / "posed"))
    draw_sheet(shards, pictures=1)
    draw_sheet(shards, "house0_Bedroom-0", pictures=1)
    draw_sheet(tmp_path / "posed", "attic", pictures=1)
    assert drawn == [(True, False), (True, True), (False, False)]
    # Captures have no ground truth, and nothing in the legend says that they have.
    assert "ground truth" not in legend(False, True) and "From above" not in legend(True, False)
    assert "Black wires: 3D boxes of the ground truth" in legend(True, False)
    assert "walls (brown)" in legend(False, True)


def test_the_command_prints_and_draws(shards, tmp_path, cli):
    looked = cli("inspect", shards)
    assert looked.exit_code == 0, looked.output
    assert "nightstand" in looked.stdout and "120 x 90" in looked.stdout
    with Image.open(shards / "inspect.png") as sheet:
        assert sheet.width == 4 * 488 + 8
    one = cli("inspect", shards, "--room", "house0_Bedroom-0", "--png", tmp_path / "a" / "b.png")
    assert one.exit_code == 0 and "double_bed" in one.stdout and "1.80" in one.stdout
    assert (tmp_path / "a" / "b.png").is_file()
    blocked = cli("inspect", shards, "--png", shards / "index.json" / "x.png")
    assert isinstance(blocked.exception, InputError)
    assert "x.png cannot be written" in str(blocked.exception)
    assert str(blocked.exception).endswith("name another file with --png.")


def test_verify_prints_the_overlap_and_exits_with_3_where_something_is_wrong(shards, cli):
    (shards / "inspect.png").unlink(missing_ok=True)
    well = cli("inspect", shards, "--verify")
    said = " ".join(well.stdout.split())
    assert well.exit_code == 0, well.output
    assert "all is well. Checksums, shapes, ranges, 2D boxes and masks agree; 100.0% of " in said
    assert "mean 2D IoU of 0.9" in said and "meshes" in said
    assert not (shards / "inspect.png").exists()
    paths = sorted((shards / "train").glob("*.h5"))
    with h5py.File(paths[0], "a") as file:
        for group in list(file["rooms"].values())[:2]:
            group["mask_pixels"][0, 0] += 1
    wrong = cli("inspect", shards, "--verify")
    assert wrong.exit_code == 3, wrong.output
    last = wrong.stderr.strip().splitlines()[-1]
    assert (
        last.startswith(f"Error: {paths[0]}, room ") and "its checksum does not match its" in last
    )
    assert last.endswith("(3 more problems, listed above)")
    assert "mask_pixels says" in wrong.stderr


def test_verify_says_what_it_could_not_check(shards, cli):
    for path in shards.glob("*/*.h5"):
        with h5py.File(path, "a") as file:
            for group in file["rooms"].values():
                del group.attrs["sha256"]
                group["sides_clear"][...] = False
    said = " ".join(cli("inspect", shards, "--verify").stdout.split())
    assert "6 rooms carry no checksum (shards of an earlier release)" in said
    # Nothing is seen whole, and all the same every mask lies within its projection.
    assert "masks lie within their projected meshes; " in said and "100.0% of " in said
    assert "not excluded: matrices of another kind or with other axes, " in said
    assert said.endswith(
        "wrong focal lengths (0 measurements to spare; too few views show whole objects)."
    )


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
    assert re.fullmatch(
        r"1 rooms were turned to lie along their walls and furniture, by (\S+) to \1 degrees\.",
        caption,
    )
    table = room_table(tmp_path / "shards", "attic")
    assert list(map(str, table.columns[0].cells)) == ["1", "2"], "as in the images of ids"
    title = table.title
    assert title is not None
    assert re.fullmatch(r"attic \(turned by -?[12]\d\.\d\d degrees\)", title)
