"""Names, folders, splits, sizes and the selection of scenes, for all data sets."""

import pytest
from public_files import furnished, write_scannetpp, write_structured3d

from data_prep.engine.workers import pool
from data_prep.readers.source import DATA_SETS, PublicSource, open_reader
from sceneprior.core.errors import InputError


@pytest.fixture
def folder(tmp_path):
    for k in range(4):
        write_structured3d(tmp_path / "s3d", f"scene_0000{k}", "480", furnished(tmp_path))
    return tmp_path / "s3d"


def survey(source):
    source.settings(source.only)
    with pool(1) as run:
        return source.survey(run)


def test_unknown_names_and_foreign_folders_are_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"No folder at .*nowhere; expected the scenes of hypersim"
    ):
        open_reader("hypersim", tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"No data set is called 'kitti'; choose from blenderproc"):
        open_reader("kitti", tmp_path)
    with pytest.raises(InputError, match=r"--recipe selects rooms of 3D-FRONT, so it is not"):
        open_reader("hypersim", tmp_path, "living")
    for name in DATA_SETS:
        with pytest.raises(InputError, match=rf"holds no scene of {name}; docs/public_data.md"):
            open_reader(name, tmp_path)


def test_settings_are_checked(folder):
    reader = open_reader("structured3d", folder)
    for name in ("max_side", "max_views"):
        with pytest.raises(InputError, match=f"{name} is 0; expected at least 1"):
            PublicSource(reader, **{name: 0}).settings(None)
    with pytest.raises(InputError, match=r"has no scene 'scene_9' \(--only takes a scene"):
        PublicSource(reader, only="scene_9").settings("scene_9")


def test_one_room_can_be_selected(folder):
    rooms = survey(PublicSource(open_reader("structured3d", folder), only="scene_00002/480")).rooms
    assert [room.room_id for room in rooms] == ["scene_00002_480"]


def test_a_table_splits_by_scene_or_room(folder, tmp_path):
    table = tmp_path / "splits.csv"
    table.write_text("scene_00000,test\nscene_00001_480,val\nscene_00002,train\n")
    found = survey(PublicSource(open_reader("structured3d", folder), table))
    assert [room.split for room in found.rooms] == ["test", "val", "train"]
    assert [(line.room_id, line.rule) for line in found.left_out] == [("scene_00003_480", "split")]
    table.write_text("scene_00000,test\n")
    with pytest.raises(InputError, match=r"The 'train' split is empty: .* Check .*splits.csv"):
        survey(PublicSource(open_reader("structured3d", folder), table))


def test_scenes_without_a_stated_split_are_split_by_the_seed(tmp_path):
    for k in range(4):
        write_scannetpp(tmp_path / "data", f"{k}a5c", furnished(tmp_path))
    reader = open_reader("scannetpp", tmp_path / "data")
    splits = [room.split for room in survey(PublicSource(reader)).rooms]
    assert sorted(splits) == ["test", "train", "train", "train"]
    others = {
        tuple(room.split for room in survey(PublicSource(reader, seed=k)).rooms) for k in range(9)
    }
    assert len(others) > 1


def test_rooms_of_another_size_are_left_out(folder, tmp_path):
    room = furnished(tmp_path)
    room.size = (96, 96)
    write_structured3d(folder, "scene_00009", "481", room)
    found = survey(PublicSource(open_reader("structured3d", folder)))
    assert len(found.rooms) == 4
    (line,) = found.left_out
    assert line.rule == "image_size" and "its views are 96 x 96 pixels" in line.reason


def test_a_folder_of_test_scenes_alone_says_what_to_do(tmp_path):
    write_structured3d(tmp_path / "s3d", "scene_03400", "480", furnished(tmp_path))
    with pytest.raises(InputError, match=r"'train' split is empty: .* give one with --splits"):
        survey(PublicSource(open_reader("structured3d", tmp_path / "s3d")))
