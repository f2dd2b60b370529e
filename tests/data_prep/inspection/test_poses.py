"""Wrong cameras under right checksums: `inspect --verify` fails and names what is wrong."""

import numpy as np
import pytest
from mutations import (
    KINDS,
    OPENGL,
    longer,
    mutated,
    of_another_size,
    posed,
    scaled,
    swapped,
    transposed,
)

from data_prep.inspection.verify import verify

UNKNOWN = "is an axis or a unit wrong?"
INVERTED = "world_to_camera seems to hold camera-to-world matrices; inverted, "
FLIPPED = (
    "the cameras seem to have OpenGL axes (y up, z backward) instead of OpenCV's; with y and z "
    "flipped, "
)
MISTAKES = {
    "inverted": ({"poses": np.linalg.inv}, INVERTED),
    "opengl": ({"poses": lambda poses: OPENGL @ poses}, FLIPPED),
    "nerfstudio": (
        {"poses": lambda poses: np.linalg.inv(poses) @ OPENGL},
        "world_to_camera seems to hold camera-to-world matrices with OpenGL axes; inverted, and "
        "with y and z flipped, ",
    ),
    "transposed": (
        {"poses": transposed},
        "the rotations of world_to_camera seem to be transposed; transposed back, ",
    ),
    "intrinsics of another size": (
        {"lenses": of_another_size},
        "the intrinsics seem to be those of pictures of another size; scaled to these, ",
    ),
    "another axis": ({"poses": lambda poses: poses[:, [2, 0, 1, 3]]}, UNKNOWN),
}
OF_TRUTH = {
    "z up": (
        {"poses": lambda poses: poses @ np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0],
                                                  [0, 0, 0, 1.0]])},
        "the cameras' world seems to have z up instead of y; turned, ",
    ),
    "longer lens": (
        {"lenses": longer(1.5)}, "the focal lengths seem to be wrong; times 0.6"
    ),
    "shorter lens": ({"lenses": longer(0.7)}, "the focal lengths seem to be wrong; times 1.4"),
    "larger": (
        {"poses": scaled(1.3)},
        "the translations of the cameras seem to have another unit than the objects; times 0.7",
    ),
    "centimetres": (
        {"poses": scaled(100)},
        "the translations of the cameras seem to have another unit than the objects; times 0.0",
    ),
    "next frames": (
        {"poses": lambda poses: np.roll(poses, 1, axis=0)},
        "frames and cameras seem to be out of order; with cameras of other frames of the room, ",
    ),
}  # fmt: skip
OF_FOUND = {
    "next frames": (
        {"poses": lambda poses: np.roll(poses, 1, axis=0)},
        "each frame seems to have the camera of the frame before; with that of the next, ",
    ),
    "reversed": (
        {"poses": lambda poses: poses[::-1].copy()},
        "the cameras seem to be in reverse order; with the first for the last, ",
    ),
}
"""Masks alone do not tell of another lens: cameras round a room see it as a room of other depth."""
CASES = [
    (kind, name)
    for kind in KINDS
    for name in {**MISTAKES, **(OF_FOUND if kind == "posed" else OF_TRUTH)}
]


@pytest.fixture
def shards(made_once):
    """Kind of data -> a right folder of it, which tests only read."""
    return lambda kind: made_once(f"verified_{kind}", KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_right_cameras_pass(shards, kind):
    found = verify(shards(kind))
    assert found.problems == ()
    name = {"homes": "mesh", "scans": "mesh", "posed": "found"}[kind]
    tally = found.agreement.tallies[name]
    # Also masks that something hides in part, and those at the image's border.
    assert tally.masks > 2 * tally.whole > 0
    assert tally.share == 1.0 if kind != "posed" else tally.share > 0.9


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_wrong_cameras_of_all_rooms_fail_and_the_likely_cause_is_named(
    shards, kind, name, tmp_path
):
    right = verify(shards(kind)).agreement
    mistake, cause = {**MISTAKES, **(OF_FOUND if kind == "posed" else OF_TRUTH)}[name]
    folder = mutated(shards(kind), tmp_path / "wrong", **mistake)
    wrong = verify(folder)
    *_, last = wrong.problems
    assert last.startswith(f"{folder}: ") and "masks lie within the projected " in last
    assert cause in last
    if kind != "posed":  # nothing is left out for want of a projection
        (before,), (after,) = right.tallies.values(), wrong.agreement.tallies.values()
        assert (after.masks, after.whole) == (before.masks, before.whole)


def test_a_capture_with_the_axes_of_opencv_is_told_as_turned_once_too_often(tmp_path):
    posed(tmp_path / "shards", written=lambda poses: poses @ OPENGL)
    assert FLIPPED in verify(tmp_path / "shards").problems[-1]


@pytest.mark.parametrize("kind", ["homes", "scans"])
def test_two_swapped_frames_are_named(shards, kind, tmp_path):
    folder = mutated(shards(kind), tmp_path / "wrong", poses=swapped, rooms=1)
    first, *_ = verify(folder).problems
    assert "masks of views 1, 2 lie within their projections, in other views nearly all do" in first
    assert "those of other frames would fit: 1 (by 2), 2 (by 1)." in first


@pytest.mark.parametrize("factor", [0.01, 0.1, 10, 100])
def test_a_capture_of_another_unit_is_told_by_its_cameras_or_its_furniture(
    shards, factor, tmp_path
):
    folder = mutated(shards("posed"), tmp_path / "wrong", poses=scaled(factor))
    problems = verify(folder).problems
    assert len(problems) >= 4
    assert all("are the poses in metres, and the floor where it should be?" in text
               or "masks lie within the projected" in text for text in problems)  # fmt: skip
    assert any("its cameras stand" in text for text in problems)


def test_no_better_than_chance_is_said(shards, tmp_path):
    order = np.random.default_rng(3)
    folder = mutated(
        shards("homes"), tmp_path / "wrong", poses=lambda poses: order.permutation(poses)
    )
    assert "; no better than randomly shuffled cameras (" in verify(folder).problems[-1]


def test_one_room_with_wrong_cameras_is_named_among_right_ones(shards, tmp_path):
    for kind in KINDS:
        folder = mutated(shards(kind), tmp_path / kind, poses=np.linalg.inv, rooms=1)
        first, *_ = verify(folder).problems
        assert ", room " in first and INVERTED in first, kind
