"""Models: enough of them, and as large as real ones."""

from statistics import median

import pytest
from homes_on_disk import TYPES

from data_prep.homes.catalog import at_score, make_catalog, real_sizes
from sceneprior.core.classes import LABEL_SETS


@pytest.mark.parametrize(("room_type", "label_set"), TYPES.items())
def test_every_class_occurs_in_five_variants_or_more(rooms, room_type, label_set):
    jids: dict[str, set] = {}
    for room in rooms[room_type]:
        for piece in room["pieces"]:
            jids.setdefault(piece["class"], set()).add(piece["jid"])
    assert set(jids) == set(LABEL_SETS[label_set][1:])
    catalog = make_catalog(0, label_set)
    assert all(len({model.jid for model in models}) >= 5 for models in catalog.values())


def test_sizes_keep_to_the_real_percentiles():
    for name, models in make_catalog(0, "front3d_bedroom").items():
        for axis, (low, middle, high) in enumerate(real_sizes()[name]):
            sizes = [model.size_m[axis] for model in models]
            # An even dozen has no model at the median itself: the middle two straddle it.
            assert median(sizes) == pytest.approx(middle, rel=0.15), (name, axis)
            assert low < median(sizes) < high
            assert sum(low <= size <= high for size in sizes) >= 10
    assert [at_score(1, 2, 6, score) for score in (-1.2816, 0, 1.2816)] == pytest.approx([1, 2, 6])
