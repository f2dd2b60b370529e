"""Sets of rooms, drawn once more as boxes, in; how far their layouts alone are apart, out.

Top-down pictures show outlines as well as places. A method that decodes coarse meshes, one that
retrieves models and one that has boxes alone are compared here by what all of them have.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sceneprior.evaluation.bootstrap import Figure
from sceneprior.evaluation.features import SceneFeatures
from sceneprior.evaluation.figures import Rooms, frechet_figures, gap_figures

SUFFIX = "_boxes"
"""Of a figure's key: the same figure, all rooms drawn as boxes, real ones too."""


def box_figures(
    sets: Mapping[str, Rooms],
    features: Mapping[str, SceneFeatures],
    compared: Mapping[str, str],
    fair_rows: Sequence[int],
    seed: tuple[int, ...],
) -> dict[str, dict[str, Figure]]:
    """Frechet distances to the test rooms, and the gap closed, of rooms drawn as boxes.

    Args:
        sets: By name, `test`, `generated`, `train` and `independent` among them.
        features: Of the same sets, drawn as boxes.
        compared: The set that stands in each column.
        fair_rows: As many generated rooms as there are training rooms.
        seed: Of the resamples of those.

    Returns:
        By column; every key ends in `_boxes`.
    """
    drawn = {name: replace(rooms, features=features[name]) for name, rooms in sets.items()}
    columns = {
        column: frechet_figures(drawn[name], drawn["test"]) for column, name in compared.items()
    }
    columns["generated"] |= gap_figures(
        drawn["generated"].of(fair_rows, seed),
        drawn["test"],
        columns["independent"],
        columns["train_rooms"],
    )
    return {
        column: {f"{key}{SUFFIX}": figure for key, figure in figures.items()}
        for column, figures in columns.items()
    }
