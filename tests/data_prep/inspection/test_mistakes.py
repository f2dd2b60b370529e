"""Mistakes in a user's files: the first cause named is the mistake, and right files pass.

The table of docs/mistakes.md has a row for each.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from captures import FLIP, Z_UP, changed, make_captures, of_ids, of_keys, of_poses, shards_of
from mutations import scaled

from data_prep.inspection.given import given_of
from data_prep.inspection.tables import summary
from data_prep.inspection.verdicts import find_mistake
from data_prep.inspection.verify import verify
from sceneprior.core.errors import InputError

MIRROR = np.diag([1.0, -1, 1, 1])
UNITY = np.diag([1.0, 1, -1, 1])


class Mistake(NamedTuple):
    change: Callable[[Path, dict], None]
    said: str
    """Pattern of the first sentence, of preparing or of verifying."""


def _turned(poses):
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1).copy()
    return poses


def _moved(poses):
    poses[:, :3, 3] = np.linalg.inv(poses)[:, :3, 3]
    return poses


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
    "OpenCV's axes": Mistake(
        of_poses(lambda poses: poses @ FLIP),
        r"the matrices in transforms\.json have OpenCV's axes \(x right, y down, z forward\) where "
        r"OpenGL's axes \(x right, y up, z backward\) are expected: negate the second and third "
        r"column of each matrix",
    ),
    "inverted": Mistake(
        of_poses(np.linalg.inv), r"the matrices seem to be world-to-camera: invert each"
    ),
    "inverted, without floor_m": Mistake(
        _and_without_floor(np.linalg.inv),
        r"transforms\.json hold world-to-camera transforms where camera-to-world transforms are "
        r"expected: invert each matrix",
    ),
    "inverted, OpenCV's axes, without floor_m": Mistake(
        _and_without_floor(lambda poses: np.linalg.inv(poses @ FLIP)),
        r"hold world-to-camera transforms with OpenCV's axes .* are expected: invert each matrix, "
        r"then negate the second and third column",
    ),
    "rotations transposed": Mistake(
        of_poses(_turned), r"transpose the upper left 3 x 3 of each matrix"
    ),
    "translations of the inverse": Mistake(
        of_poses(_moved), r"are the last columns .* translations from world to camera, not posit"
    ),
    "matrices transposed": Mistake(
        of_poses(lambda poses: poses.transpose(0, 2, 1)),
        r"it is transposed: its translation is in the last row",
    ),
    "left-handed, as Unity's": Mistake(
        of_poses(lambda poses: Z_UP @ UNITY @ np.linalg.inv(Z_UP) @ poses @ UNITY),
        r"are of a left-handed system, with Unity's axes \(x right, y up, z forward\) where .* "
        r"negate the second row of each matrix, then negate the third column",
    ),
    "mirrored": Mistake(
        of_poses(lambda poses: MIRROR @ poses), r"it is left-handed, as of Unity or Unreal"
    ),
    "poses of the frame before": Mistake(
        of_poses(lambda poses: np.roll(poses, 1, axis=0)),
        r"each frame in transforms\.json has the pose of the frame before",
    ),
    "reversed": Mistake(of_poses(lambda poses: poses[::-1]), r"are in reverse order"),
    "sorted as text": Mistake(of_poses(_sorted_as_text), r"pictures and poses .* are sorted diff"),
    "shuffled": Mistake(
        of_poses(_shuffled), r"the poses in transforms\.json belong to other frames than the masks"
    ),
    "y up": Mistake(of_poses(lambda poses: np.linalg.inv(Z_UP) @ poses), r"pass --up y"),
    "centimetres": Mistake(
        of_poses(scaled(100)), r"metres_per_unit.*--metres-per-unit 0\.01"
    ),
    "feet": Mistake(of_poses(scaled(1 / 0.3048)), r"in feet: pass --metres-per-unit 0\.3048"),
    "focal length 0.5": Mistake(_longer(0.5), r"are about 2 times too short: multiply them by 2"),
    "focal length 0.7": Mistake(_longer(0.7), r"are about 1\.[346] times too short"),
    "focal length 1.3": Mistake(_longer(1.3), r"\(fl_x, fl_y .* about 1\.[34] times too long"),
    "focal length 1.5": Mistake(_longer(1.5), r"are about 1\.[46] times too long"),
    "focal length 2": Mistake(_longer(2.0), r"are about 2 times too long: multiply them by 0\.5"),
    "principal point in the corner": Mistake(
        of_keys(cx=lambda data: 0.0, cy=lambda data: 0.0),
        r"the principal point in transforms\.json \(cx, cy\) does not fit, the middle of the",
    ),
    "intrinsics of another size": Mistake(
        of_keys(**{key: lambda data, key=key: 2.7 * data[key] for key in ("fl_x", "fl_y", "cx",
                                                                         "cy")}),
        r"the intrinsics in transforms\.json belong to pictures of another size",
    ),
    "ids unique in every image": Mistake(_unique, r"--tracks auto"),
    "ids that restart in every image": Mistake(
        of_ids(_restart), r"the ids of the masks are not those of objects .*: pass --tracks auto"
    ),
    "one frame a room": Mistake(_one_frame, r"there is only one frame per room.* at least two"),
}  # fmt: skip
QUICK = ("OpenCV's axes", "inverted", "mirrored", "shuffled", "focal length 1.3",
         "ids that restart in every image")  # fmt: skip


@pytest.fixture
def captures(made_once) -> Path:
    """Six captures, which tests only read."""
    return made_once("captures", make_captures)


def first_said(folder: Path, out: Path) -> str:
    """First sentence of preparing and verifying; "" if all is well."""
    try:
        problems = verify(shards_of(folder, out)).problems
    except InputError as error:
        return str(error)
    return problems[0] if problems else ""


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
             for name in MISTAKES]
)  # fmt: skip
def test_the_first_cause_named_is_the_mistake(captures, name, tmp_path):
    mistake = MISTAKES[name]
    wrong = changed(captures, tmp_path / "wrong", mistake.change)
    assert re.search(mistake.said, first_said(wrong, tmp_path / "shards"))


@pytest.mark.parametrize(("rooms", "seed", "views_per_m2"), [(2, 120, 0.5), (3, 196, 0.8)])
def test_few_pieces_tell_neither_floor_nor_unit(tmp_path, rooms, seed, views_per_m2):
    """Two lamps that hang at one height, and a room with a single piece, badly seen."""
    make_captures(tmp_path / "captures", rooms, seed, views_per_m2)
    assert verify(shards_of(tmp_path / "captures", tmp_path / "shards")).problems == ()


def test_a_floor_at_the_wrong_height_is_named(captures, tmp_path):
    shards = shards_of(captures, tmp_path / "shards")
    evidence, given = verify(shards).evidence, given_of(shards, "posed")[0]
    found = find_mistake(evidence._replace(floor_m=0.4), given, lambda: pytest.fail("no doubt"))
    assert found.sentence.startswith(
        "the lowest objects end 0.40 m above the floor: correct or leave out floor_m"
    )


def test_right_captures_pass_and_what_was_checked_is_said(captures, tmp_path):
    found = verify(shards_of(captures, tmp_path / "shards"))
    assert found.problems == ()
    assert re.search(
        r"^all is well\. .*masks and cameras agree by 0\.[78]\d of 1 "
        r"\(shuffled cameras: 0\.[123]\d\), which excludes matrices of another kind or "
        r"with other axes, poses of other frames",
        summary(found),
    )
