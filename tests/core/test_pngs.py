"""PNGs of ids: 8 bits, 16 bits, palettes; nothing else."""

import numpy as np
import pytest
from PIL import Image, ImageFile

from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import mask_size, read_mask

IDS = np.array([[0, 1, 2], [7, 200, 255]])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.png"


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "palette"])
def test_the_values_are_the_ids(path, kind):
    ids = IDS * 257 if kind == "16 bits" else IDS
    picture = Image.fromarray(ids.astype(np.uint16 if kind == "16 bits" else np.uint8))
    if kind == "palette":
        picture.putpalette(list(range(255, -1, -1)) * 3)
        assert picture.mode == "P"
    picture.save(path)
    read = read_mask(path)
    np.testing.assert_array_equal(read, ids)
    assert read.dtype == np.uint16 and mask_size(path) == (2, 3)


@pytest.mark.parametrize(
    ("mode", "said"),
    [("RGB", "is 8-bit RGB; expected one channel"), ("1", "is 1-bit grey; expected one channel of"),
     ("LA", "is 8-bit grey with alpha; expected"), ("RGBA", "is 8-bit RGBA; expected one channel")],
)  # fmt: skip
def test_pictures_are_no_ids(path, mode, said):
    Image.fromarray(IDS.astype(np.uint8)).convert(mode).save(path)
    with pytest.raises(InputError, match=said):
        mask_size(path)
    with pytest.raises(InputError, match="whose values are instance ids"):
        read_mask(path)


def test_what_is_no_png(path):
    with pytest.raises(InputError, match=r"a\.png is missing"):
        read_mask(path)
    Image.fromarray(IDS.astype(np.uint8)).save(path, "JPEG")
    with pytest.raises(InputError, match="is not a PNG; give ids as PNGs"):
        read_mask(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="is not a PNG"):
        mask_size(path)


def test_damage_is_a_sentence(path, rng):
    ids = rng.integers(0, 256, (60, 80)).astype(np.uint8)
    Image.fromarray(ids).save(path)
    whole = path.read_bytes()
    for end in (30, 60, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match=r"a\.png is (damaged|not a readable PNG)"):
            read_mask(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="is not a readable PNG"):
        read_mask(path)


def test_a_png_that_is_said_to_be_too_large_for_memory(tmp_path, monkeypatch):
    """Pillow reads as many bytes as the length of a chunk says."""
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((4, 4), dtype=np.uint8)).save(path)

    def load(picture):
        raise MemoryError

    monkeypatch.setattr(ImageFile.ImageFile, "load", load)
    with pytest.raises(InputError, match=r"a\.png is damaged .a part of it is said to be too"):
        read_mask(path)
