"""Contact sheets and painted ids, pixel by pixel."""

import numpy as np

from sceneprior.render.appearance import CAPTION_PX, contact_sheet, paint_ids


def plain(height, width, value):
    return np.full((height, width, 3), value, dtype=np.uint8)


def test_gaps_and_captions_are_beside_the_tiles():
    tiles = [plain(30, 40, 10)] * 3
    sheet = contact_sheet(tiles, 2, ["one", "two", "three"], gap_px=5)
    row = 5 + CAPTION_PX + 30
    assert sheet.shape == (2 * row + 5, 2 * 45 + 5, 3)
    for top, left in ((row - 30, 5), (row - 30, 50), (2 * row - 30, 5)):
        assert (sheet[top : top + 30, left : left + 40] == 10).all()
        assert (sheet[top - CAPTION_PX : top, left : left + 40] < 200).any()
    assert (sheet[-5:] == 255).all() and (sheet[:, :4] == 255).all()


def test_ids_have_their_colours_and_dark_borders():
    ids = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 2, 2]])
    picture = paint_ids(ids, np.array([[100, 0, 0], [0, 60, 0]]), (9, 9, 9))
    assert picture[0].tolist() == [[9, 9, 9], [9, 9, 9], [50, 0, 0], [100, 0, 0]]
    assert picture[2].tolist() == [[0, 30, 0]] * 4
