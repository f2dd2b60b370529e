"""Zips of masks: names, bits, sizes and damage."""

import io

import numpy as np
import pytest
from PIL import Image
from scan_files import png, write_zip

from data_prep.readers.scannet.masks import MaskArchive
from sceneprior.core.errors import InputError


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
    with MaskArchive(path) as archive:
        assert archive.frames == (0, 15, 30)
        assert archive.image_size == (12, 16)
        for seed, frame in ((2, 30), (0, 0), (1, 15)):
            values = archive.read(frame)
            assert values.dtype == np.uint8 and values.flags.writeable
            np.testing.assert_array_equal(values, mask(seed))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "name",
    ["../0.png", "instance-filt/../../0.png", "/etc/0.png", "..\\0.png", "C:\\0.png", "a/.."],
)
def test_names_that_lead_out_are_refused(tmp_path, name):
    path = write_zip(tmp_path / "a.zip", {"instance-filt/1.png": png(mask()), name: b"x"})
    with pytest.raises(InputError) as caught:
        MaskArchive(path)
    assert f"a.zip holds '{name}', a path outside of the archive" in str(caught.value)


def test_a_frame_may_not_be_there_twice(tmp_path):
    path = write_zip(tmp_path / "a.zip", {"a/1.png": png(mask()), "b/001.png": png(mask(1))})
    with pytest.raises(InputError, match=r"holds frame 1 twice: 'a/1\.png' and 'b/001\.png'"):
        MaskArchive(path)


def test_an_archive_without_masks(tmp_path):
    with pytest.raises(InputError, match=r"a\.zip holds no masks; expected .*instance-filt/0\.png"):
        MaskArchive(write_zip(tmp_path / "a.zip", {"label.txt": b"x"}))


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (mask().astype(np.uint16), r"16 bits, grey; .* 8 bits, grey; 16-bit .*_2d-label"),
        (np.repeat(mask()[..., None], 3, axis=2), "8 bits, RGB; an instance mask has 8 bits, grey"),
        (mask() > 99, "1 bits, grey;"),
    ],
)
def test_only_eight_bits_of_grey(tmp_path, picture, words):
    with pytest.raises(InputError, match=r"a\.zip, instance-filt/3\.png has " + words):
        MaskArchive(write_zip(tmp_path / "a.zip", {"instance-filt/3.png": png(picture)}))


def test_a_palette_is_no_grey(tmp_path):
    file = io.BytesIO()
    Image.fromarray(mask()).convert("P").save(file, "PNG")
    with pytest.raises(InputError, match=r"0\.png has 8 bits, palette"):
        MaskArchive(write_zip(tmp_path / "a.zip", {"0.png": file.getvalue()}))


def test_one_archive_has_one_size(tmp_path):
    path = write_zip(tmp_path / "a.zip", {"0.png": png(mask()), "1.png": png(mask(0, 12, 17))})
    with (
        MaskArchive(path) as archive,
        pytest.raises(InputError, match=r"1\.png is 17 x 12 pixels, .* before it 16 x 12"),
    ):
        archive.read(1)


def test_members_that_are_no_picture(tmp_path):
    huge = bytearray(png(mask()))
    huge[16:24] = (60000).to_bytes(4, "big") * 2
    for data, words in (
        (b"GIF89a" + bytes(30), "it is not a PNG"),
        (png(mask())[:20], "it is not a PNG"),
        (bytes(huge), "its header is damaged"),
        (bytes((64 << 20) + 1), "67108865 bytes unpacked"),
    ):
        path = write_zip(tmp_path / "a.zip", {"0.png": data})
        with pytest.raises(
            InputError, match=rf"a\.zip, 0\.png cannot be read \({words}\); download"
        ):
            MaskArchive(path)


def test_a_picture_that_ends_early(tmp_path):
    data = png(mask(0, 200, 300))
    path = write_zip(tmp_path / "a.zip", {"0.png": data[: len(data) // 2]})
    with (
        MaskArchive(path) as archive,
        pytest.raises(InputError, match=r"0\.png cannot be read .*truncated"),
    ):
        archive.read(0)


def test_an_archive_with_a_password(tmp_path):
    path = write_zip(tmp_path / "a.zip", {"0.png": png(mask())})
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"0\.png cannot be read .*password"):
        MaskArchive(path)


def test_a_missing_archive(tmp_path):
    with pytest.raises(InputError, match=r"a\.zip cannot be opened as a zip .*No such file"):
        MaskArchive(tmp_path / "a.zip")


def read_all(path):
    with MaskArchive(path) as archive:
        for frame in archive.frames:
            archive.read(frame)


def test_an_archive_cut_anywhere_is_refused(tmp_path):
    members = {f"instance-filt/{k}.png": png(mask(k)) for k in range(2)}
    data = write_zip(tmp_path / "a.zip", members).read_bytes()
    path = tmp_path / "cut.zip"
    for cut in range(len(data)):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=r"cut\.zip cannot be opened as a zip"):
            read_all(path)
