"""Wrong cameras under right checksums: `inspect --verify` fails and names what is wrong.

Two of each family of causes; test_mistakes.py makes all of them.
"""

import numpy as np
import pytest
from mutations import KINDS, OPENGL, longer, mutated, scaled, swapped

from data_prep.inspection.causes import GIVEN
from data_prep.inspection.verify import verify

INVERTED = "hold camera-to-world transforms where world-to-camera transforms are expected: "
MISTAKES = {
    "inverted": ({"poses": np.linalg.inv}, INVERTED),
    "opengl": (
        {"poses": lambda poses: OPENGL @ poses},
        "have OpenGL's axes (x right, y up, z backward) where OpenCV's axes (x right, y down, z "
        "forward) are expected: ",
    ),
    "longer lens": ({"lenses": longer(1.5)}, " times too long: multiply them by 0."),
    "next frames": (
        {"poses": lambda poses: np.roll(poses, 1, axis=0)}, "has the pose of the frame before: "
    ),
}  # fmt: skip
OF_TRUTH = {
    "z up": (
        {"poses": lambda poses: poses @ np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0],
                                                  [0, 0, 0, 1.0]])},
        "the tops of the pictures point along the z axis of the shards",
    ),
    "larger": (
        {"poses": scaled(1.3)},
        "the translations of the cameras seem to have another unit than the objects; times 0.7",
    ),
    "centimetres": ({"poses": scaled(100)}, "the cameras stand "),
}  # fmt: skip


@pytest.fixture
def shards(made_once):
    """Kind of data -> a right folder of it, which tests only read."""
    return lambda kind: made_once(f"verified_{kind}", KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_right_cameras_pass(shards, kind):
    found = verify(shards(kind))
    assert found.problems == ()
    assert found.evidence.share(GIVEN) > 0.75 or found.evidence.spare < 12
    if kind != "posed":
        (tally,) = found.agreement.tallies.values()
        # Also masks that something hides in part, and those at the image's border.
        assert tally.masks > 2 * tally.whole > 0 and tally.share == 1.0


@pytest.mark.parametrize("name", [*MISTAKES, *OF_TRUTH])
def test_wrong_cameras_of_all_rooms_are_one_sentence_that_names_the_cause(shards, name, tmp_path):
    mistake, cause = {**MISTAKES, **OF_TRUTH}[name]
    folder = mutated(shards("homes"), tmp_path / "wrong", **mistake)
    (said,) = verify(folder).problems
    assert said.startswith(f"{folder}: ") and cause in said


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
    (said,) = verify(folder).problems
    assert "m above the floor in the median, expected 0.2 to 4 m" in said
    if factor == 100:
        assert "the poses seem to be in centimetres: pass --metres-per-unit 0.01 (or" in said
    if factor == 0.1:
        assert said.endswith("are the poses in metres, and is the floor at the right height?.")


def test_one_room_with_wrong_cameras_is_named_among_right_ones(shards, tmp_path):
    folder = mutated(shards("homes"), tmp_path / "wrong", poses=np.linalg.inv, rooms=1)
    (said,) = verify(folder).problems
    assert ", room " in said and INVERTED in said and said.endswith("; corrected, 100% would.")
