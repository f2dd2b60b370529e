"""ScanNet, from .sens, zips, JSON and PLY to shards: the truth projects onto the masks."""

import json
import shutil
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from room_scans import ROOM_TABLE, make_room_scan
from scan_files import (
    TABLE,
    make_scan,
    png,
    sens_bytes,
    sens_header,
    write_ply,
    write_table,
    write_zip,
)

from data_prep.engine.build import Job, build_shards
from data_prep.engine.source import RoomTask
from data_prep.inspection.verify import agreement_of, verify
from data_prep.readers.annotations import read_labels
from data_prep.readers.rooms import focal_and_center, unoccluded
from data_prep.readers.scan_files import open_masks, read_sens
from data_prep.readers.scannet import (
    FULL_SIZE,
    QUARTER_SIZE,
    ScanNet,
)
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.shards import Shard
from sceneprior.render.offscreen.zbuffer import rasterize

BITS = (np.arange(8)[:, None] >> np.arange(3)) & 1
NAMES = label_set("scannet")
IDS = ["scene0000_00", "scene0000_01", "scene0001_00", "scene0002_00"]


@pytest.fixture
def scan(tmp_path):
    """Not written yet."""
    return make_scan(tmp_path / "scans" / "scene0000_00")


@pytest.fixture
def reader(tmp_path):
    table = write_table(tmp_path / "labels.tsv")
    return ScanNet(tmp_path / "scans", labels=table, frame_step=1)


def task_of(scan):
    return RoomTask(scan.folder.name, scan.folder.name, "train")


def survey(reader):
    return reader.survey()


# -- Files -----------------------------------------------------------------------------------------


def poses(count):
    made = np.repeat(np.eye(4)[None], count, axis=0)
    made[:, :3] = np.random.default_rng(0).normal(size=(count, 3, 4)).astype(np.float32)
    return made


def test_recordings_and_archives_cut_anywhere_are_refused_by_name(tmp_path):
    path = tmp_path / "a.sens"
    data = sens_bytes(poses(3), [b"colour"] * 3, (24, 32), kind=0, imu=3)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_sens(path).camera_to_world, poses(3).astype(np.float32))
    data = sens_bytes(poses(3), [b"colour"] * 3, (24, 32))
    tracemalloc.start()
    for end in {*range(0, len(data), 3), len(data) - 8, len(data) - 1}:
        path.write_bytes(data[:end])
        if end == len(data) - 8:  # the count of IMU records, of which we use none
            read_sens(path)
            continue
        with pytest.raises(InputError, match=r"a\.sens, .*, byte \d+: .*truncated"):
            read_sens(path)
    path.write_bytes(sens_header(1 << 60))  # an impossible count asks for no memory
    with pytest.raises(InputError, match="frame 0"):
        read_sens(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    masks = {f"instance-filt/{k}.png": png(mask(k)) for k in range(2)}
    data = write_zip(tmp_path / "a.zip", masks).read_bytes()
    for end in range(0, len(data), 3):
        (tmp_path / "cut.zip").write_bytes(data[:end])
        with (
            pytest.raises(InputError, match=r"cut\.zip cannot be opened as a zip"),
            open_masks(tmp_path / "cut.zip"),
        ):
            pass


def mask(seed=0, height=12, width=16):
    return np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)


def test_masks_are_read_in_place(tmp_path):
    members = {
        "instance-filt/": b"",
        "instance-filt/15.png": png(mask(1)),
        "instance-filt/0.png": png(mask(0)),
        "scene/other/000030.PNG": png(mask(2)),
        "__MACOSX/instance-filt/._0.png": b"resource fork",
        "readme.txt": b"",
    }
    path = write_zip(tmp_path / "a.zip", members)
    with open_masks(path) as archive:
        assert archive.frames == (0, 15, 30) and archive.image_size == (12, 16)
        for seed, frame in ((2, 30), (0, 0), (1, 15)):
            values = archive.read(frame)
            assert values.dtype == np.uint8 and values.flags.writeable
            np.testing.assert_array_equal(values, mask(seed))
    assert list(tmp_path.iterdir()) == [path]


def test_raw_categories_become_the_nineteen_classes(tmp_path):
    rows = [*TABLE, ("12", "chair", "chair", "4646", "7", "table"), ("13", "short")]
    labels = read_labels(write_table(tmp_path / "a.tsv", rows))
    assert labels.label("chair") == "table"  # the last row wins
    assert labels.label("couch") == "sofa" and labels.label(" Bed ") == "bed"
    for category in ("backpack", "wall", "floor", "never heard of"):
        assert labels.label(category) == "void"
        name = category if labels.is_shell(category) else "unknown"
        assert STUFF[labels.stuff(category)] == name
    assert labels.nyu40_class("backpack") and labels.nyu40_class("never heard of") is None
    assert labels.is_shell("wall") and labels.is_shell("floor") and not labels.is_shell("backpack")
    rows = [("nyu40class", "x", "raw_category"), ("bed", "1", 'a 12" bed'), ("sofa",)]
    assert read_labels(write_table(tmp_path / "a.tsv", rows)).nyu40 == {'a 12" bed': "bed"}


# -- One scan --------------------------------------------------------------------------------------


def test_frames_are_stored_whole_or_at_a_quarter(scan, reader):
    """647.75 + 0.5 in our count of pixel centres; the third of each four lines is half a pixel
    late. Of six frames, the first is every 15th."""
    made = reader.prepare(task_of(scan.write()), None)
    quarter = [(292.5, 0, (648.25 - 0.5) / 4), (0, 292.5, (484.25 - 0.5) / 4), (0, 0, 1)]
    np.testing.assert_allclose(made.views.intrinsics[0], quarter, rtol=1e-7)
    every15 = replace(reader, frame_step=15, image_size=FULL_SIZE)
    (full,) = every15.prepare(task_of(scan), None).views.intrinsics
    np.testing.assert_allclose(full, [(1170, 0, 648.25), (0, 1170, 484.25), (0, 0, 1)], rtol=1e-7)


def test_an_object_without_triangles_is_a_cube_in_its_box(scan, reader):
    """Triangles that reach out of an object are no part of it."""
    vertices, faces, _ = scan.write().mesh
    write_ply(scan.path("_vh_clean_2.ply"), vertices, np.vstack([faces[12:24], [(8, 9, 16)]]))
    made = reader.prepare(task_of(scan), None)
    truth = made.truth
    assert truth.model_ids == ("scene0000_00_001", "") and len(made.models) == 1
    placed = np.c_[BITS - 0.5, np.ones(8)] @ truth.model_to_room[1].T
    low, high = placed[:, :3].min(axis=0), placed[:, :3].max(axis=0)
    np.testing.assert_allclose((low + high) / 2, truth.centers_m[1], atol=1e-6)
    np.testing.assert_allclose(high - low, truth.sizes_m[1], atol=1e-6)


def test_notes_tell_what_was_left_out(scan, reader):
    scan.boxes[3].category = "never heard of"
    scan.write()
    data = json.loads(scan.path(".aggregation.json").read_text())
    data["segGroups"].append({"objectId": 40, "label": "bed", "segments": [999]})
    data["segGroups"].append({"objectId": 2, "label": "sofa", "segments": []})
    scan.path(".aggregation.json").write_text(json.dumps(data))
    masks = {f"{frame}.png": png(scan.mask(frame, (242, 324))) for frame in (0, 2, 3, 5)}
    write_zip(scan.path("_2d-instance-filt.zip"), masks)
    assert reader.prepare(task_of(scan), None).notes == (
        "object 2 is listed twice; its parts were joined",
        "object 3: 'never heard of' is not in labels.tsv, so void",
        "object 40 (bed) has no vertices; left out",
        "1 of 6 frames have no usable pose; skipped",
        "2 of 6 frames have no mask; skipped",
    )


def test_entries_with_equal_segments_are_one_object(scan, reader):
    """scene0217_00 lists every object twice; its masks may show either number."""
    scan.write()
    once, _ = painted(scan, reader, (2, 5, 10, 30, 40), (3, 40, 10, 60, 40))
    path = scan.path(".aggregation.json")
    data = json.loads(path.read_text())
    again = [group | {"objectId": group["objectId"] + 100} for group in data["segGroups"]]
    path.write_text(json.dumps({**data, "segGroups": [*again, *data["segGroups"]]}))
    twice, _ = painted(scan, reader, (102, 5, 10, 30, 40), (3, 40, 10, 60, 40))
    for name in ("object_class", "instance_ids", "boxes"):
        assert np.array_equal(getattr(once.views, name), getattr(twice.views, name))
    assert np.array_equal(once.truth.centers_m, twice.truth.centers_m)
    told = [note for note in twice.notes if "is listed again with the same segments" in note]
    assert len(told) == len(again)


def painted(scan, reader, *rectangles):
    """The made scan with one mask painted by hand, stored pixel for pixel, and that mask."""
    image = np.zeros((60, 80), dtype=np.uint8)
    for value, x1, y1, x2, y2 in rectangles:
        image[y1:y2, x1:x2] = value
    write_zip(scan.path("_2d-instance-filt.zip"), {"0.png": png(image)})
    return replace(reader, image_size=(60, 80)).prepare(task_of(scan), None), image


def test_ids_without_an_object_hide_and_are_told(scan, reader):
    scan.write()
    room, image = painted(
        scan, reader, (2, 5, 10, 30, 40), (90, 30, 20, 40, 30), (255, 70, 0, 80, 10)
    )
    assert room.views.sides_clear.tolist() == [[[True, True, False, True]]]
    assert "masks show objects that the aggregation does not have (89, 254): void" in room.notes
    np.testing.assert_array_equal(room.views.instance_ids[0] == 2, image >= 90)
    # Objects that no view shows, or of which a mask of 8 bits cannot say it, are truth alone.
    data = json.loads(scan.path(".aggregation.json").read_text())
    data["segGroups"][1]["objectId"] = 255
    scan.path(".aggregation.json").write_text(json.dumps(data))
    room, _ = painted(scan, reader, (3, 5, 5, 30, 30))
    assert [NAMES[k] for k in room.views.object_class] == ["chair"]
    assert [NAMES[k] for k in room.truth.object_class] == ["chair", "bed"]
    assert room.truth.centers_m.shape == room.truth.sizes_m.shape == (2, 3)


# -- A walled room, scanned from inside ------------------------------------------------------------


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """A right scan on disk, and its reader."""
    folder = tmp_path_factory.mktemp("right")
    scan = make_room_scan(folder / "scans" / "scene0000_00").write(mask_size=QUARTER_SIZE)
    table = write_table(folder / "labels.tsv", ROOM_TABLE)
    return scan, ScanNet(folder / "scans", labels=table, frame_step=1)


@pytest.mark.parametrize("aligned", [True, False])
def test_a_right_scan_passes_with_a_high_iou(right, tmp_path, aligned):
    scan, reader = right
    folder = shutil.copytree(scan.folder, tmp_path / "scans" / scan.folder.name)
    if not aligned:
        (folder / f"{folder.name}.txt").write_text("sceneType = Bedroom / Hotel\n")
    build_shards(Job(replace(reader, folder=tmp_path / "scans"), tmp_path / "shards"))
    found = verify(tmp_path / "shards")
    assert found.problems == ()
    tally = agreement_of(found.every)["mesh"]
    assert tally.share > 0.98 and tally.whole >= 10 and tally.mean_iou > 0.95


def test_whole_objects_are_those_drawn_the_same_alone(right):
    """Against the definition: nothing of an object is lost when all the rest is drawn, too."""
    scan, reader = right
    room = reader.read(task_of(scan))
    mesh, parts, cameras = room.scan.mesh, room.scan.parts, np.linalg.inv(room.camera_to_world)
    chosen = np.flatnonzero(room.object_class[:-1])
    found = unoccluded(room.scan, [*chosen, len(parts)], cameras, room.intrinsics, QUARTER_SIZE)
    assert not found[:, -1].any()  # ids without an object
    lens = focal_and_center(room.intrinsics)
    agree = wanted = 0
    for view, camera in enumerate(cameras):
        index, _ = rasterize(mesh.vertices_m, mesh.faces, camera, lens, QUARTER_SIZE)
        for column, k in enumerate(chosen):
            inside = np.zeros(len(mesh.vertices_m), dtype=bool)
            inside[parts[k]] = True
            own = inside[mesh.faces].all(axis=1)
            alone, _ = rasterize(mesh.vertices_m, mesh.faces[own], camera, lens, QUARTER_SIZE)
            boxes = [_box(alone >= 0), _box((index >= 0) & own[index])]
            if found[view, column]:
                # Half a triangle at its border, which is 2 cm, is 4 pixels 1.5 m away.
                assert np.abs(boxes[0] - boxes[1]).max() <= 4
            if (
                (boxes[0] == boxes[1]).all()
                and (boxes[0] > 2).all()
                and (boxes[0] < [319, 237, 319, 237]).all()
            ):
                wanted += 1
                agree += found[view, column]
    assert wanted > 10 and agree > 0.7 * wanted


def _box(mask):
    if not mask.any():
        return np.zeros(4)
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max()])


# -- Folders of scans ------------------------------------------------------------------------------


@pytest.fixture
def source(reader):
    for scan_id in IDS:
        make_scan(reader.folder / scan_id).write(mask_size=(242, 324))
    return reader


def listed(source, train, val):
    folder = source.folder.parent
    for name, ids in (("train.txt", train), ("val.txt", val)):
        (folder / name).write_text("\n".join(ids) + "\n")
    return replace(source, train=folder / "train.txt", val=folder / "val.txt")


def test_lists_become_splits_and_the_rest_is_counted(source):
    official = listed(source, [IDS[0], IDS[1], "scene0700_00"], [IDS[3]])
    found = survey(official)
    assert [(room.room_id, room.split) for room in found.rooms] == [
        (IDS[0], "train"), (IDS[1], "train"), (IDS[3], "test"),
    ]  # fmt: skip
    assert [(item.room_id, item.rule, item.reason[:10]) for item in found.left_out] == [
        (IDS[2], "split", "it is in n"), ("scene0700_00", "split", "a list nam"),
    ]  # fmt: skip
    for only, expected in ((IDS[1], [IDS[1]]), ("scene0000", IDS[:2])):
        assert [room.room_id for room in survey(replace(source, only=only)).rooms] == expected
    for seed in range(6):  # without lists, a space is in one half
        rooms = survey(replace(source, seed=seed)).rooms
        assert [room.room_id for room in rooms] == IDS
        assert rooms[0].split == rooms[1].split
        assert {room.split for room in rooms} == {"train", "test"}


def test_settings_follow_what_the_bytes_depend_on(source):
    before = source.settings(None)
    assert json.loads(json.dumps(before)) == source.settings(None) | {
        "recipe": {"frame_step": 1, "max_views": 100, "masks": "filt", "image_size": [242, 324]}
    }
    assert listed(source, IDS[:2], IDS[2:]).settings(None) != before
    write_table(source.labels, [("raw_category", "nyu40class"), ("bed", "bed")])
    after = source.settings(None)
    assert [key for key in before if before[key] != after[key]] == ["labels"]
    (source.folder / IDS[0] / f"{IDS[0]}.txt").write_text("")
    assert source.settings(None) == after  # a mended scan may be tried again
    (source.folder / IDS[0]).rename(source.folder / "scene0005_00")
    assert source.settings(None)["scans"] != after["scans"]
    with refused("readers/no scan", tmp=source.folder):
        source.settings("scene0009_00")


def test_the_command_writes_shards_whose_boxes_project_onto_their_masks(source, cli, tmp_path):
    listed(source, IDS[:3], IDS[3:])
    words = ("prep-scannet", "--scans", source.folder, "--labels", source.labels, "--workers", 1,
             "--frame-step", 1)  # fmt: skip
    lists = ("--train-list", tmp_path / "train.txt", "--val-list", tmp_path / "val.txt")
    made = cli(*words, *lists, "--out", tmp_path / "a")
    assert made.exit_code == 0, made.output
    assert "train 3 rooms, 15 views, 6 objects; test 1 rooms, 5 views, 2 objects" in made.stdout
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert [(row["what"], row["difference"]) for row in report["expected"]["rows"]] == [
        ("rooms", 4 - 1513), ("train", 3 - 1201), ("test", 1 - 312), ("views", 20 - 108_059),
    ]  # fmt: skip
    assert "-1509" in made.stdout and "ScanNet v2 by its lists" in made.stdout
    checked = cli("inspect", tmp_path / "a", "--verify")
    said = " ".join(checked.stdout.split())
    assert checked.exit_code == 0 and "projected meshes" in said
    assert "100.0% of" in said and "mean 2D IoU of 0.9" in said
    assert cli("inspect", tmp_path / "a", "--room", "scene0000_00").exit_code == 0
    options = ("--full-size", "--max-views", 2, "--only", "scene0001", "--out", tmp_path / "b")
    assert cli(*words, *options).exit_code == 0
    (path,) = (tmp_path / "b").glob("*/*.h5")
    with Shard(path) as shard:
        room = shard.read_room("scene0001_00")
    assert room.image_size == (968, 1296) and len(room.visible) == 2
