"""One toy room in every format: each reader makes the same views of it, those of the golden file.

`TAKE=1 pytest tests/data_prep/readers/test_conformance.py` writes the golden file anew.
"""

import os

import numpy as np
import pytest
from golden_values import FOLDER, TAKE
from toy_formats import FORMATS, arrays_of, read

from data_prep.inspection.agreement import boxes_around, hull_of
from data_prep.inspection.verify import array_problems, mask_problems
from data_prep.readers.upright import own_sides
from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError

GOLDEN = FOLDER / "readers.npz"
IMAGES = ("instance_ids", "stuff")
PIXELS = 2e-3
"""Share of pixels that may differ: a triangle's edge through a pixel's centre, on another CPU."""
TOLERANCE = {"boxes": 0.02, "mask_pixels": 4.0}
"""Largest difference of arrays that follow such a pixel; of other numbers, 1e-4."""


def small(name: str, array: np.ndarray) -> np.ndarray:
    """Parts that the golden file keeps: every second pixel of images, the ends of long tables."""
    if name in IMAGES:
        return array[:, ::2, ::2].astype(np.uint8)
    return np.concatenate([array[:5], array[-5:]]) if array.ndim and len(array) > 60 else array


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as file:
        return dict(file)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The room of each format, read once."""
    rooms: dict = {}

    def of(name: str):
        if name not in rooms:
            rooms[name] = read(name, tmp_path_factory.mktemp("files") / "rooms")
        return rooms[name]

    return of


@pytest.mark.skipif(not TAKE, reason="writes the golden file")
def test_take(made):
    kept = {
        f"{name}/{key}": small(key, array)
        for name in FORMATS
        for key, array in arrays_of(made(name)[0]).items()
    }
    np.savez_compressed(GOLDEN, **kept)


@pytest.mark.parametrize("name", FORMATS)
def test_shards_stay_as_they_are(made, golden, name):
    arrays = {key: small(key, array) for key, array in arrays_of(made(name)[0]).items()}
    wanted = {key.partition("/")[2]: a for key, a in golden.items() if key.startswith(f"{name}/")}
    assert arrays.keys() == wanted.keys()
    for key, array in arrays.items():
        assert array.shape == wanted[key].shape, key
        if key in IMAGES:
            assert (array != wanted[key]).mean() < PIXELS, key
        elif array.dtype.kind == "f" or key in TOLERANCE:
            np.testing.assert_allclose(
                array, wanted[key], rtol=0, atol=TOLERANCE.get(key, 1e-4), err_msg=key
            )
        else:
            np.testing.assert_array_equal(array, wanted[key], key)


@pytest.mark.parametrize("name", FORMATS)
def test_things_are_where_their_masks_are(made, name):
    """Cameras are where they were, up to a move in the plane and a turn about the vertical; the
    boxes of things, moved likewise, are projected onto their masks."""
    room, toy = made(name)
    views = room.views
    names = label_set(toy.source.label_set)
    assert not [*array_problems(views, len(names)), *mask_problems(views)]
    eyes = camera_centers(views.world_to_camera.astype(float))
    middle, true = eyes.mean(axis=0), toy.eyes_m.mean(axis=0)
    u, _, v = np.linalg.svd((eyes - middle).T @ (toy.eyes_m - true))
    # Cameras in a plane leave open on which side of it their room is.
    turn = u @ np.diag([1, 1, (-1 if toy.mirrored else 1) * np.linalg.det(u @ v)]) @ v
    np.testing.assert_allclose(eyes, (toy.eyes_m - true) @ turn.T + middle, atol=0.02)
    assert turn[1, 2] > 0.9999  # up is up
    clear = own_sides(views, views.image_size)
    compared = 0
    for k, index in enumerate(views.object_class):
        corners = [box for kind, box in toy.corners_m.items() if kind in names[index]]
        if not corners:
            continue
        hull = hull_of((corners[0] - true) @ turn.T + middle)
        boxes = boxes_around(hull, views.world_to_camera, views.intrinsics)
        inside_px = (views.boxes[:, k] * np.tile(views.image_size[::-1], 2) - boxes) * (
            1,
            1,
            -1,
            -1,
        )
        # Masks are sampled at pixel centres, and lenses straightened by the nearest pixels.
        assert inside_px[views.visible[:, k]].min() > -1.01
        # A wall that hides a side goes unnoticed.
        assert (inside_px[clear[:, k]] < 1.01).mean() > 0.7
        compared += clear[:, k].sum()
    assert compared >= 5
    if not any("the floor is assumed" in note for note in room.notes):
        # Scans stand on their lowest piece, 5 cm above the floor.
        assert np.abs(np.median(eyes[:, 1] - toy.eyes_m[:, 2])) < 0.051


def strangers(folder):
    """Files as other systems leave them: dot files beside every file and folder, Windows' thumbs,
    and texts that begin with a byte order mark."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".json", ".csv", ".tsv", ".txt"):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
        if path.is_dir():
            (path / "__MACOSX").mkdir()
        for name in (f"._{path.name}", ".DS_Store", "Thumbs.db", f"__MACOSX/{path.name}"):
            (path.parent / name).parent.mkdir(exist_ok=True)
            (path.parent / name).write_bytes(b"\0\5\26\7")


@pytest.mark.parametrize("name", FORMATS)
def test_files_of_other_systems_change_nothing(made, tmp_path, name):
    arrays = arrays_of(read(name, tmp_path / "rooms", strangers)[0])
    wanted = arrays_of(made(name)[0])
    assert arrays.keys() == wanted.keys()
    for key, array in arrays.items():
        np.testing.assert_array_equal(array, wanted[key], key)


def as_pipe(path):
    os.mkfifo(path)


def as_device(path):
    path.symlink_to("/dev/zero")


def as_loop(path):
    path.symlink_to(path)


def as_huge(path):
    with path.open("wb") as file:
        file.truncate(3 << 30)


OTHERS = (as_pipe, as_device, as_loop, as_huge)


def told_of(source) -> list[str]:
    """Sentences of the rooms that are left out."""
    try:
        source.settings(None)
        survey = source.survey()
        for task in survey.rooms:
            source.prepare(task, None)
    except InputError as error:
        return [str(error)]
    return [line.reason for line in survey.left_out]


@pytest.mark.parametrize("name", [name for name in FORMATS if "," not in name])
def test_things_that_are_no_files_are_refused_in_a_sentence(tmp_path, name):
    """One file of each kind that a format has is replaced, in turn, by a pipe, a device, a link to
    itself or 3 GB."""
    FORMATS[name](tmp_path / "whole")
    paths = [path for path in (tmp_path / "whole").rglob("*") if path.is_file()]
    first = {
        (path.parent.name, path.suffix): path.relative_to(tmp_path / "whole") for path in paths
    }
    for number, kept in enumerate(first.values()):
        folder = tmp_path / str(number)
        source = FORMATS[name](folder).source
        (folder / kept).unlink()
        OTHERS[number % len(OTHERS)](folder / kept)
        for sentence in told_of(source):
            assert sentence.endswith(".") and "Error" not in sentence, (kept, sentence)
