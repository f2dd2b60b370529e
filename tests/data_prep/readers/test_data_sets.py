"""Public data sets, from files to shards: classes, masks, cameras, boxes, splits, commands."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from pages import ROOT, commands_of, first_block
from public_files import (
    cam_from_uv,
    classes_of,
    furnished,
    write_blenderproc,
    write_hypersim,
    write_scannetpp,
    write_structured3d,
)
from refusals import refused
from scan_files import write_table

from data_prep.readers import open_reader
from data_prep.readers.annotations import NYU40, SHELL, ids_and_classes
from data_prep.readers.hypersim import pinhole, straight_grid
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import reference_scenes

NAMES = label_set("scannet")


def prepared(name, folder, **settings):
    """Rooms of a folder by id, prepared without the engine."""
    source = open_reader(name, folder, **settings)
    return {task.room_id: source.prepare(task, None) for task in survey(source).rooms}


def survey(source):
    source.settings(source.only)
    return source.survey()


def splits_of(source):
    return [task.split for task in survey(source).rooms]


@pytest.fixture
def room(tmp_path):
    return furnished(tmp_path / "unused")


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


def test_a_scene_that_could_not_be_listed_is_prepared_when_it_is_mended(room, tmp_path, cli):
    folder = tmp_path / "renders"
    for k in range(3):
        write_blenderproc(folder, f"house_{k}", room)
    whole = {path: path.read_bytes() for path in (folder / "house_1").iterdir()}
    for path, content in whole.items():
        path.write_bytes(content[:900])
    words = ("prep-dataset", "blenderproc", folder, "--out", tmp_path / "a", "--workers", 1)
    for more in ((), ("--retry-failed",)):
        assert cli(*words, *more).exit_code == 3
    for path, content in whole.items():
        path.write_bytes(content)
    assert "0 shards made" in " ".join(cli(*words).stdout.split())
    done = cli(*words, "--retry-failed")
    assert done.exit_code == 0, done.output
    index = json.loads((tmp_path / "a" / "index.json").read_text())
    assert sum(count["rooms"] for count in index["counts"].values()) == 3


# -- What single data sets have --------------------------------------------------------------------


def test_prefixed_attributes_and_numbers_of_rooms_are_read(room, tmp_path):
    folder = tmp_path / "renders"
    write_blenderproc(folder, "house", room)
    for view in range(5):
        with h5py.File(folder / "house" / f"{view}.hdf5", "r+") as file:
            parts = json.loads(bytes(file["instance_attribute_maps"][()]))
            old = [{k if k == "idx" else f"cp_{k}": x for k, x in part.items()} for part in parts]
            del file["instance_attribute_maps"]
            text = json.dumps([part | {"cp_room_id": 7} for part in old])
            file["instance_attribute_maps"] = np.bytes_(text)
    ((name, made),) = prepared("blenderproc", folder, recipe="all").items()
    assert name == "house_7" and len(made.views.visible) == 5


def test_rooms_of_other_types_are_left_out(room, tmp_path):
    write_blenderproc(tmp_path, "house", room)
    assert list(prepared("blenderproc", tmp_path, recipe="kitchen")) == ["house_Kitchen-2"]
    with pytest.raises(InputError, match=r"No room of .* can be prepared"):
        prepared("blenderproc", tmp_path, recipe="library")


def test_objects_without_a_box_leave_a_room_without_ground_truth(room, tmp_path):
    write_hypersim(tmp_path, "ai_001_001", room, cam_from_uv(room))
    path = next((tmp_path / "ai_001_001/_detail/mesh").glob("*positions*"))
    with h5py.File(path, "r+") as file:
        file["dataset"][300] = np.nan
    (made,) = prepared("hypersim", tmp_path).values()
    assert made.truth is None and made.notes[-1] == "1 of 2 objects have no 3D box: no ground truth"


def relabel(scene, **names):
    path = scene / "scans/segments_anno.json"
    groups = json.loads(path.read_text())["segGroups"]
    for group in groups:
        group["label"] = names.get(group["label"].replace(" ", "_"), group["label"])
    path.write_text(json.dumps({"segGroups": groups}))


def test_labels_of_scannetpp(room, tmp_path):
    """ScanNet's table adds some; a scene without a floor stands on its lowest object."""
    write_scannetpp(tmp_path, "0a5c01", room)
    relabel(tmp_path / "0a5c01", office_chair="trash can", floor="unknown")
    (made,) = prepared("scannetpp", tmp_path).values()
    assert classes_of(made.views, NAMES) == ["bed"]
    lows = made.truth.centers_m[:, 1] - made.truth.sizes_m[:, 1] / 2
    assert lows.min() == pytest.approx(0, abs=1e-6)
    table = [("raw_category", "nyu40class"), ("trash can", "bathtub")]
    write_table(tmp_path / "scannetv2-labels.combined.tsv", table)
    (made,) = prepared("scannetpp", tmp_path).values()
    assert classes_of(made.views, NAMES) == ["bed", "bathtub"]
    path = tmp_path / "0a5c01/dslr/nerfstudio/transforms.json"
    data = json.loads(path.read_text())
    data["frames"][2]["transform_matrix"] = np.full((4, 4), np.nan).tolist()
    path.write_text(json.dumps(data))
    (made,) = prepared("scannetpp", tmp_path).values()
    assert len(made.views.visible) == 4
    assert made.notes[0] == "1 of 5 frames have no usable pose; skipped"


def test_floors_and_splits_of_structured3d(room, tmp_path):
    """The authors' split; a floor that does not close is replaced by a rectangle."""
    for k, scene in enumerate(("scene_00007", "scene_03249", "scene_03499")):
        write_structured3d(tmp_path / "s3d", scene, f"48{k}", room)
    assert splits_of(open_reader("structured3d", tmp_path / "s3d")) == ["train", "val", "test"]
    made = prepared("structured3d", tmp_path / "s3d")["scene_00007_480"]
    outline = [(y + 0.1, x - 0.05) for x, y in [(-3, -3.2), (3.1, -3.2), (3.1, 3), (-3, 3)]]
    np.testing.assert_allclose(made.truth.floor_m, outline, atol=1e-5)
    assert made.truth.height_m == pytest.approx(2.6)
    write_structured3d(tmp_path, "scene_00007", "480", room)
    path = tmp_path / "scene_00007/annotation_3d.json"
    data = json.loads(path.read_text())
    data["planeLineMatrix"][0][0] = 0
    path.write_text(json.dumps(data))
    (made,) = prepared("structured3d", tmp_path).values()
    np.testing.assert_allclose(np.ptp(made.truth.floor_m, axis=0), (1.7, 2.2), atol=1e-5)


def one_by_one(instances, semantics):
    """The rule as a loop: the most frequent class of each instance, the lowest id among equals; no
    class loses against any other."""
    classes = {}
    for instance in set(instances.ravel().tolist()) - {-1}:
        own = [max(int(s), 0) for s in semantics[instances == instance]]
        best = max(sorted(set(own)), key=lambda s: (own.count(s), s > 0))
        classes[instance + 1] = NYU40[best - 1] if best else "void"
    ids, stuff = np.zeros_like(instances), np.zeros_like(instances)
    for place in np.ndindex(instances.shape):
        name = NYU40[semantics[place] - 1] if semantics[place] > 0 else ""
        if instances[place] >= 0:
            number = instances[place] + 1
            ids[place] = 0 if classes[number] in SHELL else number
        else:
            ids[place] = 0 if name in SHELL else -1
        stuff[place] = STUFF.index(name) if name in STUFF else 0
    return ids, {k: name for k, name in classes.items() if name not in SHELL}, stuff


def test_ids_and_classes_match_the_rule(numbers, tmp_path):
    assert set(NAMES[1:]) < set(NYU40) and len(set(NYU40)) == 40 and set(NYU40) > SHELL
    for _ in range(20):
        instances = numbers.integers(-1, 6, (2, 5, 7))
        semantics = numbers.choice([-1, 0, 1, 2, 5, 11, 20, 40], (2, 5, 7))
        ids, classes, stuff = ids_and_classes(instances, semantics, "scene")
        expected = one_by_one(instances, semantics)
        np.testing.assert_array_equal(ids, expected[0])
        assert classes == expected[1]
        np.testing.assert_array_equal(stuff, expected[2])
    with refused("readers/instance ids"):
        ids_and_classes(np.full((1, 1), 70_000), np.zeros((1, 1), int), "scene")


@pytest.mark.parametrize("shifts", [(0.0, 0.0), (0.3, 0.0), (-0.8, 0.0), (-0.07, -0.17)])
def test_a_tilted_image_plane_is_that_of_a_turned_pinhole(room, numbers, shifts):
    projection = 1.7 * cam_from_uv(room, *shifts)
    intrinsics, turn = pinhole(projection, (96, 128))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) > 0 and np.abs(np.tril(intrinsics, -1)).max() < 1e-12
    for u, v in numbers.uniform(-1, 1, (20, 2)):
        ray = projection @ (u, v, 1) * (1, -1, -1)  # to OpenCV's axes
        assert ray[2] > 0
        x, y, w = intrinsics @ turn @ ray
        np.testing.assert_allclose([x / w, y / w], [64 * (u + 1), 48 * (1 - v)], atol=1e-9)


def test_a_skewed_grid_is_straightened_pixel_by_pixel():
    K = np.array([[80.0, 9, 30], [0, 70, 21], [0, 0, 1]])
    straight = K * (1 - np.eye(3)[0][:, None] * np.eye(3)[1])
    lines = np.ix_(np.arange(40), np.arange(60))
    (rows, columns), inside = straight_grid(lines, K, (40, 60))
    for row, column in np.ndindex(40, 60):
        x, y, _ = K @ np.linalg.solve(straight, (column + 0.5, row + 0.5, 1))
        assert inside[row, column] == (0 <= x < 60)
        if inside[row, column]:
            assert (rows[row, column], columns[row, column]) == (int(y), int(x))
    assert 0 < (~inside).sum() < 100
    (_, same), all_of_it = straight_grid(lines, straight, (40, 60))
    assert (same == np.arange(60)).all() and all_of_it.all()


# -- Splits and selections -------------------------------------------------------------------------


def test_rooms_are_selected_and_split_by_tables_names_and_seeds(room, tmp_path):
    for k in range(4):
        write_structured3d(tmp_path / "s3d", f"scene_0000{k}", "480", room)
    folder, table = tmp_path / "s3d", tmp_path / "splits.csv"
    one = open_reader("structured3d", folder, only="scene_00002/480")
    assert [task.room_id for task in survey(one).rooms] == ["scene_00002_480"]
    table.write_text("scene_00000,test\nscene_00001_480,val\nscene_00002,train\n")
    found = survey(open_reader("structured3d", folder, splits=table))
    assert [task.split for task in found.rooms] == ["test", "val", "train"]
    assert [(line.room_id, line.rule) for line in found.left_out] == [("scene_00003_480", "split")]
    table.write_text("scene_00000,test\n")
    with refused("readers/no training room", tmp=tmp_path):
        survey(open_reader("structured3d", folder, splits=table))
    with refused("readers/no scene", tmp=tmp_path):
        survey(open_reader("structured3d", folder, only="scene_9"))
    other = furnished(tmp_path)
    other.size = (96, 96)
    write_structured3d(folder, "scene_00009", "481", other)
    found = survey(open_reader("structured3d", folder))
    (line,) = found.left_out
    assert len(found.rooms) == 4 and line.rule == "image_size"
    write_structured3d(tmp_path / "test", "scene_03400", "480", room)
    with refused("readers/test scenes alone", tmp=tmp_path):
        survey(open_reader("structured3d", tmp_path / "test"))
    for k in range(4):
        write_scannetpp(tmp_path / "pp", f"{k}a5c", room)
    seeds = {tuple(splits_of(open_reader("scannetpp", tmp_path / "pp", seed=k))) for k in range(9)}
    assert len(seeds) > 1
    assert {tuple(sorted(splits)) for splits in seeds} == {("test", "train", "train", "train")}
