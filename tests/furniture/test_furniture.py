"""Furniture from tables of parts: solids, tables, and the sizes of the catalogue."""

from statistics import median

import numpy as np
import pytest

from sceneprior.core.classes import LABEL_SETS
from sceneprior.furniture import solids
from sceneprior.furniture.catalog import make_catalog, real_sizes
from sceneprior.furniture.tables import Table, build, furniture_tables


@pytest.mark.parametrize(
    ("solid", "low", "high"),
    [
        (solids.box(1, 2, 3, 4, 5, 6), (3.5, 5, 4.5), (4.5, 7, 7.5)),
        (solids.beveled_box(1, 2, 3, 4, 5, 6), (3.5, 5, 4.5), (4.5, 7, 7.5)),
        (solids.cylinder(1, 2, 3, 4, 5), (2, 4, 4), (4, 6, 6)),
        (solids.torus(1, 0.2, 3), (-1, 3, -1), (1, 3.2, 1)),
        (solids.panel(solids.arch(2, 3, 2, steps=11), 0.5, 1), (-1, 0, 0.75), (1, 3, 1.25)),
        (
            solids.shifted(solids.tilted(solids.box(2, 4, 6), np.pi / 2), 1, 2, 3),
            (0, -1, 3),
            (2, 5, 7),
        ),
        (solids.scaled(solids.box(1, 1, 1), [1, 2, 3]), (-0.5, 0, -1.5), (0.5, 2, 1.5)),
    ],
)
def test_solids_are_closed_and_stand_where_they_should(solid, low, high):
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0
    np.testing.assert_allclose(solid.bounds, [low, high], atol=1e-12)


def build_from(tables: dict, size_m=(1.0, 2.0, 0.5), style: int = 0):
    parsed = [Table.parse(heading, rows) for heading, rows in tables.items()]
    rng = np.random.default_rng(0)
    return build("piece", size_m, style, rng, {table.name: table for table in parsed})


@pytest.mark.parametrize("seed", [0, 3])
def test_furniture_is_closed_faces_outward_and_stands_on_the_floor(seed):
    for models in make_catalog(seed, "front3d_bedroom").values():
        for model in models:
            for part in model.parts:
                assert part.is_watertight, model
                assert part.is_winding_consistent
                assert part.volume > 0
            low, high = model.mesh.bounds
            np.testing.assert_allclose(high - low, model.size_m, atol=1e-9)
            np.testing.assert_allclose(low + high, [0, model.size_m[1], 0], atol=1e-9)
            assert 40 <= len(model.mesh.faces) <= 4000


def test_every_class_has_a_table_and_every_style_another_look():
    for name in {*LABEL_SETS["front3d_bedroom"][1:], *LABEL_SETS["front3d_living"][1:]}:
        rows = furniture_tables()[name].rows
        count = len(rows.get("styles", {})) if isinstance(rows, dict) else 0
        looks = set()
        for style in range(count):
            parts = build(name, (2.0, 0.8, 0.6), style, np.random.default_rng(0))
            looks.add(tuple(part.vertices.tobytes() for part in parts))
        assert len(looks) == count, name


def test_a_new_piece_is_a_few_rows():
    rows = ["box(w, 0.1, d, y=h - 0.1)", "leg(x, z, h - 0.1) for x, z in corners(w/2 - 0.1, 0.1)"]
    top, *legs = build_from({"piece": rows, "leg(x, z, top, t=0.05)": ["box(t, top, t, x, 0, z)"]})
    np.testing.assert_allclose(top.bounds, [[-0.5, 1.9, -0.25], [0.5, 2, 0.25]], atol=1e-12)
    middles = [leg.bounds.mean(axis=0) for leg in legs]
    np.testing.assert_allclose(
        middles, [[-0.4, 0.95, -0.1], [-0.4, 0.95, 0.1], [0.4, 0.95, -0.1], [0.4, 0.95, 0.1]]
    )
    np.testing.assert_allclose(legs[0].extents, [0.05, 1.9, 0.05])


def test_a_table_repeats_names_values_and_picks_a_style():
    table = {
        "for": "k, x in enumerate((2.0, 3.0))",
        "let": {"width": "k + 1", "height": "2*width"},
        "parts": ["box(width, height, x)"],
        "styles": {"plain": ["box(9, 9, 9) if k else []"], "bare": []},
        "last": "box(5, 5, 5)",
    }
    sizes = [part.extents.tolist() for part in build_from({"piece": table}, style=4)]
    nine, five = [9.0] * 3, [5.0] * 3
    assert sizes == [[1, 2, 2], five, [2, 4, 3], nine, five]
    sizes = [part.extents.tolist() for part in build_from({"piece": table}, style=1)]
    assert sizes == [[1, 2, 2], five, [2, 4, 3], five]


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"piece": ["blok(w, h, d)"]}, "table 'piece', row .blok.w, h, d.*'blok' is not defined"),
        ({"piece": ["box(w h)"]}, "table 'piece', row .box.w h.*invalid syntax"),
        ({"piece": [{"part": ["box(w, h, d)"]}]}, "table 'piece' has the key 'part'"),
        (
            {"piece": ["leg(1)"], "leg(x, z)": []},
            "table 'piece', row .leg.1.*missing 1 required positional",
        ),
        (
            {"piece": {"let": {"k": "w/0"}, "parts": []}},
            "table 'piece', row w/0: float division by zero",
        ),
    ],
)
def test_a_row_that_cannot_be_worked_out_is_named(tables, said):
    with pytest.raises(ValueError, match=f"Furniture {said}"):
        build_from(tables)


def test_sizes_keep_to_the_real_percentiles():
    for name, models in make_catalog(0, "front3d_bedroom").items():
        for axis, (low, middle, high) in enumerate(real_sizes()[name]):
            sizes = [model.size_m[axis] for model in models]
            # An even dozen has no model at the median itself: the middle two straddle it.
            assert median(sizes) == pytest.approx(middle, rel=0.15), (name, axis)
            assert low < median(sizes) < high
            assert sum(low <= size <= high for size in sizes) >= 10
