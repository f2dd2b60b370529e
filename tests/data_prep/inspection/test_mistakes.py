"""Mistakes in a user's files: the first sentence names the mistake, and right files pass.

The table of docs/mistakes.md has a row for each; the whole sentences are in
tests/golden/data_prep/mistakes.json.
"""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from front_jobs import homes_shards
from golden_values import hold
from PIL import Image

from data_prep.engine.build import Job, build_shards
from data_prep.inspection.causes import C2W, OPENGL, Cause, Convention, sentence_of
from data_prep.inspection.diagnosis import find_mistake
from data_prep.inspection.tables import summary, verdict
from data_prep.inspection.verify import evidence_of, read_conventions, verify
from data_prep.readers.posed.reader import Posed
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.shards import iterate_rooms, read_index

FLIP = np.diag([1.0, -1, -1, 1])
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From y up to z up."""


def make_captures(folder: Path, rooms: int = 6, seed: int = 0, views_per_m2: float = 0.8) -> None:
    """Posed rooms of made bedrooms: `transforms.json`, masks, classes; z up, metres."""
    rules = (f"views.per_m2={views_per_m2}", "views.image_size=[90, 120]",
             "views.min_object_pixels=20")  # fmt: skip
    shards = folder.parent / f"{folder.name}.front"
    homes_shards(shards, rooms, *rules, seed=seed)
    names = label_set(read_index(shards)["label_set"])
    for split in ("train", "val", "test"):
        if any((shards / split).glob("*.h5")):
            for shard, room_id in iterate_rooms(shards, split):
                _write_room(shard.read_room(room_id, images=True), names, folder / room_id[-40:])


def _write_room(views, names, room: Path) -> None:
    height, width = views.image_size
    (room / "instances").mkdir(parents=True)
    # The room stands elsewhere in the user's world.
    world = np.eye(4)
    world[:3, 3] = 1.3, -0.7, 0.0
    poses = world @ Z_UP @ np.linalg.inv(views.world_to_camera.astype(np.float64)) @ FLIP
    frames = []
    for k, (pose, ids) in enumerate(zip(poses, views.instance_ids, strict=True)):
        values = np.where(ids == len(views.object_class) + 1, 0, ids)
        Image.fromarray(values.astype(np.uint16)).save(room / f"instances/frame_{k + 1}.png")
        frames.append({"file_path": f"images/frame_{k + 1}.jpg", "transform_matrix": pose.tolist()})
    K = views.intrinsics[0].astype(float)
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    (room / "transforms.json").write_text(json.dumps({**lens, "floor_m": 0.0, "frames": frames}))
    table = {str(k + 1): names[index] for k, index in enumerate(views.object_class)}
    (room / "classes.json").write_text(json.dumps(table))


def changed(folder: Path, target: Path, change) -> Path:
    """A copy of captures in which `change` changes each room's files, given its transforms.json."""
    shutil.copytree(folder, target)
    for room in sorted(target.iterdir()):
        data = json.loads((room / "transforms.json").read_text())
        change(room, data)
        if (room / "transforms.json").is_file():
            (room / "transforms.json").write_text(json.dumps(data))
    return target


def of_poses(change):
    """A change of all matrices, (T, 4, 4), of a room."""

    def changes(room: Path, data: dict) -> None:
        matrices = np.array([frame["transform_matrix"] for frame in data["frames"]])
        for frame, matrix in zip(data["frames"], change(matrices.copy()), strict=True):
            frame["transform_matrix"] = matrix.tolist()

    return changes


def of_keys(**changes):
    """A change of keys of transforms.json."""
    return lambda room, data: data.update({key: value(data) for key, value in changes.items()})


def of_ids(change):
    """A change of each frame's image of ids, given the number of the frame."""

    def changes(room: Path, data: dict) -> None:
        for k in range(len(data["frames"])):
            path = room / f"instances/frame_{k + 1}.png"
            with Image.open(path) as image:
                ids = np.array(image)
            Image.fromarray(change(ids, k).astype(np.uint16)).save(path)

    return changes


def shards_of(folder: Path, out: Path, **settings) -> Path:
    """Shards of captures."""
    build_shards(Job(Posed(folder, classes="front3d_bedroom", **settings), out))
    return out


MIRROR = np.diag([1.0, -1, 1, 1])
UNITY = np.diag([1.0, 1, -1, 1])


def _turned(poses):
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1).copy()
    return poses


def _moved(poses):
    poses[:, :3, 3] = np.linalg.inv(poses)[:, :3, 3]
    return poses


def _scaled(factor):
    return lambda poses: poses * [[1, 1, 1, factor], [1, 1, 1, factor], [1, 1, 1, factor], [1] * 4]


def _sorted_as_text(poses):
    return poses[sorted(range(len(poses)), key=lambda k: str(k + 1))]


def _shuffled(poses):
    return poses[np.random.default_rng(len(poses)).permutation(len(poses))]


def _restart(ids, frame):
    """Ids 1, 2, 3, ... in every image, in any order."""
    numbers = np.unique(ids[ids > 0])
    table = np.zeros(int(ids.max()) + 1, dtype=int)
    order = np.random.default_rng(frame)
    table[order.permutation(numbers)] = np.arange(1, len(numbers) + 1)
    return table[ids]


def _unique(room, data):
    """An id of its own for each mask of each image, and its class."""
    table = json.loads((room / "classes.json").read_text())
    new = {}

    def change(ids, frame):
        for k in np.unique(ids[ids > 0]):
            new[str(1000 * frame + k)] = table[str(k)]
        return np.where(ids > 0, 1000 * frame + ids.astype(int), 0)

    of_ids(change)(room, data)
    (room / "classes.json").write_text(json.dumps(new))


def _longer(factor):
    return of_keys(fl_x=lambda data: factor * data["fl_x"], fl_y=lambda data: factor * data["fl_y"])


def _and_without_floor(change):
    def changes(room, data):
        del data["floor_m"]
        of_poses(change)(room, data)

    return changes


def _one_frame(room, data):
    data["frames"] = data["frames"][:1]


MISTAKES = {
    "OpenCV's axes": of_poses(lambda poses: poses @ FLIP),
    "inverted": of_poses(np.linalg.inv),
    "inverted, without floor_m": _and_without_floor(np.linalg.inv),
    "inverted, OpenCV's axes, without floor_m": _and_without_floor(
        lambda poses: np.linalg.inv(poses @ FLIP)
    ),
    "rotations transposed": of_poses(_turned),
    "translations of the inverse": of_poses(_moved),
    "matrices transposed": of_poses(lambda poses: poses.transpose(0, 2, 1)),
    "left-handed, as Unity's": of_poses(
        lambda poses: Z_UP @ UNITY @ np.linalg.inv(Z_UP) @ poses @ UNITY
    ),
    "mirrored": of_poses(lambda poses: MIRROR @ poses),
    "poses of the frame before": of_poses(lambda poses: np.roll(poses, 1, axis=0)),
    "reversed": of_poses(lambda poses: poses[::-1]),
    "sorted as text": of_poses(_sorted_as_text),
    "shuffled": of_poses(_shuffled),
    "y up": of_poses(lambda poses: np.linalg.inv(Z_UP) @ poses),
    "centimetres": of_poses(_scaled(100)),
    **{f"focal length {factor}": _longer(factor) for factor in (0.5, 0.7, 1.3, 1.5, 2)},
    "principal point in the corner": of_keys(cx=lambda data: 0.0, cy=lambda data: 0.0),
    "intrinsics of another size": of_keys(
        **{key: lambda data, key=key: 2.7 * data[key] for key in ("fl_x", "fl_y", "cx", "cy")}
    ),
    "ids unique in every image": _unique,
    "ids that restart in every image": of_ids(_restart),
    "one frame a room": _one_frame,
}
QUICK = ("OpenCV's axes", "inverted", "mirrored", "shuffled", "focal length 1.3",
         "ids that restart in every image")  # fmt: skip


@pytest.fixture
def captures(made_once) -> Path:
    """Six captures, which tests only read."""
    return made_once("captures", make_captures)


def first_said(folder: Path, out: Path) -> str:
    """First sentence of preparing and verifying; else what was checked."""
    try:
        found = verify(shards_of(folder, out))
    except InputError as error:
        return str(error)
    return found.problems[0] if found.problems else summary(found)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
             for name in MISTAKES]
)  # fmt: skip
def test_the_first_cause_named_is_the_mistake(captures, name, tmp_path):
    wrong = changed(captures, tmp_path / "wrong", MISTAKES[name])
    said = first_said(wrong, tmp_path / "shards")
    hold("mistakes", {name: said}, slack=0.02, tmp=tmp_path)


ROS = ((0, 0, 1), (-1, 0, 0), (0, -1, 0))
UNREAL = ((0, 0, 1), (1, 0, 0), (0, -1, 0))


@pytest.mark.parametrize("axes", [ROS, UNREAL])
def test_columns_in_another_order_are_told_with_their_signs(axes):
    """The columns, put as the sentence says, are those of OpenGL's axes."""
    said = sentence_of(Cause("poses", (C2W, axes)), Convention.stated("posed"))
    columns = dict(zip(("first", "second", "third"), np.linalg.inv(axes).T, strict=True))
    columns |= {f"minus the {name}": -column for name, column in columns.items()}
    told = said.partition("let the first three columns of each matrix be ")[2].split(", ")
    found = [columns[words.removeprefix("the ")] for words in told]
    np.testing.assert_array_equal(np.stack(found, axis=1), np.linalg.inv(OPENGL))


def test_a_damaged_shard_hides_no_mistake_of_another_room(captures, tmp_path):
    two = tmp_path / "two"
    for room in sorted(captures.iterdir())[:2]:
        shutil.copytree(room, two / room.name)
    shards = shards_of(changed(two, tmp_path / "wrong", of_poses(_shuffled)), tmp_path / "shards")
    (path,) = (shards / "test").glob("*.h5")
    path.write_bytes(path.read_bytes()[:3000])
    damage, mistake = verify(shards).problems
    assert damage.startswith(f"{path} cannot be read")
    hold("mistakes", {"shuffled, beside a damaged shard": mistake}, slack=0.02, tmp=tmp_path)


@pytest.mark.parametrize(("rooms", "seed", "views_per_m2"), [(2, 120, 0.5), (3, 196, 0.8)])
def test_few_pieces_tell_neither_floor_nor_unit(tmp_path, rooms, seed, views_per_m2):
    """Two lamps that hang at one height, and a room with a single piece, badly seen."""
    make_captures(tmp_path / "captures", rooms, seed, views_per_m2)
    found = verify(shards_of(tmp_path / "captures", tmp_path / "shards"))
    assert found.problems == ()
    assert ("the scale (" in verdict(found)) == (evidence_of(found.every).scale is None)


@pytest.mark.parametrize(
    "scale", [0.3, *(pytest.param(scale, marks=pytest.mark.slow) for scale in (0.1, 0.5, 2, 3.3))]
)
def test_sizes_of_known_classes_tell_the_unit(captures, tmp_path, scale):
    """The sentence gives about the factor that undoes a wrong `metres_per_unit`."""
    (said, *more) = verify(shards_of(captures, tmp_path / "shards", metres_per_unit=scale)).problems
    told = float(re.search(r"pass --metres-per-unit ([\d.]+),", said)[1])
    assert abs(np.log(told * scale)) < np.log(1.25) and not more
    assert "pendant_lamp" in said  # the classes that were compared


def test_names_that_are_no_classes_of_known_size_leave_the_scale_unchecked(captures, tmp_path):
    def unknown(room, data):
        table = json.loads((room / "classes.json").read_text())
        (room / "classes.json").write_text(json.dumps(dict.fromkeys(table, "thing")))

    folder = changed(captures, tmp_path / "unknown", unknown)
    out = tmp_path / "shards"
    build_shards(Job(Posed(folder, classes="void,thing"), out))
    found = verify(out)
    assert found.problems == ()
    assert "could not be checked" in verdict(found) and "(0 objects of known" in verdict(found)


def test_right_captures_pass_and_a_floor_at_the_wrong_height_is_named(captures, tmp_path):
    shards = shards_of(captures, tmp_path / "shards")
    found, (usual, *_) = verify(shards), read_conventions(shards, "posed")
    assert found.problems == ()
    high = evidence_of(found.every)._replace(floor_m=0.4)
    said = find_mistake(high, usual, lambda: pytest.fail("no doubt")).sentence
    hold("mistakes", {"nothing": summary(found), "floor": said}, slack=0.02)
