"""ScanNet++'s labels, poses of other conventions, and damaged or foreign files."""

import json

import numpy as np
import pytest
from public_files import furnished, write_scannetpp
from scan_files import write_table

from data_prep.engine.source import RoomTask
from data_prep.engine.workers import pool
from data_prep.readers.source import PublicSource, open_reader
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError

SCENE = "0a5c013435"
POSES = "dslr/nerfstudio/transforms.json"
IPHONE = "iphone/pose_intrinsic_imu.json"


@pytest.fixture
def scene(tmp_path):
    write_scannetpp(tmp_path / "data", SCENE, furnished(tmp_path))
    return tmp_path / "data" / SCENE


def read(scene):
    source = PublicSource(open_reader("scannetpp", scene.parent))
    with pool(1) as run:
        (task,) = source.survey(run).rooms
    return source.prepare(task, None)


def change(path, **changes):
    data = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))


def relabel(scene, **names):
    path = scene / "scans/segments_anno.json"
    groups = json.loads(path.read_text())["segGroups"]
    for group in groups:
        group["label"] = names.get(group["label"].replace(" ", "_"), group["label"])
    path.write_text(json.dumps({"segGroups": groups}))


def test_scannets_table_adds_labels(scene):
    relabel(scene, office_chair="trash can")
    names = label_set("scannet")
    assert [names[k] for k in read(scene).views.object_class] == ["bed"]
    path = write_table(scene.parent / "scannetv2-labels.combined.tsv")
    path.write_text(path.read_text() + "\n99\ttrash can\t0\t0\t0\t0\tbathtub\n")
    header = path.read_text().splitlines()[0].split("\t")
    rows = [["" for _ in header]]
    rows[0][header.index("raw_category")] = "trash can"
    rows[0][header.index("nyu40class")] = "bathtub"
    lines = path.read_text().splitlines()[:-1] + ["\t".join(row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    assert [names[k] for k in read(scene).views.object_class] == ["bed", "bathtub"]


def test_a_scene_without_a_labelled_floor_stands_on_its_lowest_object(scene):
    relabel(scene, floor="unknown")
    made = read(scene)
    lows = made.truth.centers_m[:, 1] - made.truth.sizes_m[:, 1] / 2
    assert lows.min() == pytest.approx(0, abs=1e-6)


def move(scene, by):
    path = scene / POSES
    frames = json.loads(path.read_text())["frames"]
    for frame in frames:
        frame["transform_matrix"][0][3] += by
    change(path, frames=frames)


DAMAGE = {
    "poses of another scene": (
        lambda s: move(s, 50), r"5 of 5 cameras are more than 1 m outside of mesh_aligned_0.05.ply",
    ),
    "no poses": (lambda s: (s / POSES).unlink(), r"has no poses; expected dslr/colmap, dslr"),
    "no size": (lambda s: change(s / POSES, w=None), r"transforms.json has no w and h, the size"),
    "no frames": (lambda s: change(s / POSES, frames=[]), r"has no list `frames` with a frame"),
    "a truncated mesh": (
        lambda s: (s / "scans/mesh_aligned_0.05.ply").write_bytes(
            (s / "scans/mesh_aligned_0.05.ply").read_bytes()[:200]
        ),
        r"is not a mesh that can be read",
    ),
    "segments of another scene": (
        lambda s: change(s / "scans/segments.json", segIndices=[1, 2]),
        r"segments.json has 2 segIndices, but mesh_aligned_0.05.ply 40 vertices",
    ),
    "no annotation": (
        lambda s: (s / "scans/segments_anno.json").unlink(), r"segments_anno.json cannot be read",
    ),
    "a foreign annotation": (
        lambda s: (s / "scans/segments_anno.json").write_text("{}"), r"segGroups is",
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_named_in_one_sentence(scene, damage):
    change_it, message = DAMAGE[damage]
    change_it(scene)
    with pytest.raises(InputError, match=message):
        read(scene)


def test_damaged_poses_of_the_iphone_are_named(tmp_path):
    write_scannetpp(tmp_path / "data", SCENE, furnished(tmp_path), "iphone")
    scene = tmp_path / "data" / SCENE
    frame = json.loads((scene / IPHONE).read_text())["frame_000000"]
    change(scene / IPHONE, frame_000000=frame | {"aligned_pose": [[1.0]] * 4})
    with pytest.raises(InputError, match=r"aligned_pose and intrinsic are not 4 x 4 and 3 x 3"):
        read(scene)
    change(scene / IPHONE, frame_000000={"pose": []})
    with pytest.raises(InputError, match=r"pose_intrinsic_imu.json: frame_000000.aligned_pose is"):
        read(scene)


def test_a_model_without_images_is_refused(tmp_path):
    write_scannetpp(tmp_path / "data", SCENE, furnished(tmp_path), "colmap")
    (tmp_path / "data" / SCENE / "dslr/colmap/images.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match=r"images.txt has no image with a pose; download it again"):
        read(tmp_path / "data" / SCENE)


def test_a_lost_frame_is_skipped(scene):
    frames = json.loads((scene / POSES).read_text())["frames"]
    frames[2]["transform_matrix"] = np.full((4, 4), np.nan).tolist()
    change(scene / POSES, frames=frames)
    made = PublicSource(open_reader("scannetpp", scene.parent)).prepare(
        RoomTask(SCENE, SCENE, "train"), None
    )
    assert len(made.views.visible) == 4
    assert made.notes[0] == "1 of 5 frames have no usable pose; skipped"
