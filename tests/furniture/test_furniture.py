"""Furniture from tables of parts: solids, tables, and the sizes of the catalogue."""

import numpy as np
import pytest

from sceneprior.furniture.catalog import make_catalog
from sceneprior.furniture.tables import Table, build


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
