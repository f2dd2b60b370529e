"""A posed room and its views, which the tests of other tools' files compare with."""

import pytest
from posed_files import prepared
from toy_formats import attic


@pytest.fixture
def room(tmp_path):
    """The bed, a chair that stands before a part of it in some views, and the backpack."""
    return attic(tmp_path / "rooms" / "attic")


@pytest.fixture
def plain(room):
    """The views of the room as transforms.json and PNGs."""
    return prepared(room)
