"""Places of furniture in made homes."""

import numpy as np
import pytest
from homes_on_disk import BEDS, TYPES


def _is_angled(piece: dict) -> bool:
    return abs((np.degrees(piece["yaw"]) + 45) % 90 - 45) > 1


@pytest.mark.parametrize("room_type", TYPES)
def test_one_piece_in_ten_stands_askew_and_none_of_those_on_walls(rooms, room_type):
    pieces = [piece for room in rooms[room_type] for piece in room["pieces"]]
    assert 0.05 < np.mean([_is_angled(piece) for piece in pieces]) < 0.15
    upright = BEDS | {"wardrobe", "cabinet", "bookshelf", "tv_stand", "nightstand", "desk", "sofa"}
    assert not any(_is_angled(piece) for piece in pieces if piece["class"] in upright)
