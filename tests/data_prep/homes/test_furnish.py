"""Contents drawn for a room: the number of pieces, and their groups."""

from dataclasses import replace

import numpy as np
import pytest

from data_prep.homes.bedroom import BEDROOM
from data_prep.homes.bedroom import COUNTS as BEDROOM_COUNTS
from data_prep.homes.furnish import furnish
from data_prep.homes.living import COUNTS as LIVING_COUNTS
from sceneprior.furniture.catalog import make_catalog


@pytest.mark.parametrize(
    ("room_type", "histogram"), [("bedroom", BEDROOM_COUNTS), ("living", LIVING_COUNTS)]
)
def test_object_counts_follow_the_histogram(rooms, room_type, histogram):
    counts = np.array([len(room["pieces"]) for room in rooms[room_type]])
    cumulative = np.cumsum(list(histogram.values())) / sum(histogram.values())
    ours = [np.mean(counts <= count) for count in histogram]
    # Golden-ratio multiples leave at most a few of 400 rooms on the wrong side of a step.
    np.testing.assert_allclose(ours, cumulative, atol=0.012)
    mean = sum(k * v for k, v in histogram.items()) / sum(histogram.values())
    assert counts.mean() == pytest.approx(mean, abs=0.1)


def test_a_room_for_which_no_place_is_found_is_an_error():
    hopeless = replace(BEDROOM, place_first=lambda furnisher, groups: None)
    catalog = make_catalog(0, "front3d_bedroom")
    with pytest.raises(
        RuntimeError, match=r"No bedroom could hold these 5 pieces in 400 tries: \['"
    ):
        furnish(hopeless, catalog, np.random.default_rng(0), 0.5)
