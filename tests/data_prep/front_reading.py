"""Houses of the tests read back, and what lies in the rooms."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from front_files import FrontFolder

from data_prep.front.furnished import Furniture, ModelBank, Room
from data_prep.front.houses import HouseRooms, read_house
from data_prep.front.recipe import load_recipe
from sceneprior.core.scene import Mesh


def read(
    front: FrontFolder,
    path: Path,
    rules: tuple[str, ...] = (),
    recipe: str = "bedroom",
    **options: Any,
) -> HouseRooms:
    """All rooms of a house, under the bedroom's recipe and these changes of its rules."""
    return read_house(path, ModelBank(front.future), load_recipe(recipe, rules), **options)


def only_room(front: FrontFolder, path: Path, **options: Any) -> Room:
    """The one room of a house in which nothing fails."""
    result = read(front, path, **options)
    assert not result.left_out and len(result.rooms) == 1, result
    return result.rooms[0]


def extent(piece: Furniture) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a piece in the room."""
    vertices = piece.mesh.vertices_m
    return vertices.min(axis=0), vertices.max(axis=0)


def described(result: HouseRooms) -> dict[str, Any]:
    """Contents that were read, in numbers and words: for a golden file."""
    rooms = {
        room.room_id: {
            "type": room.type,
            "floor": [*rounded(room.floor.bounds), *rounded([room.floor.area])],
            "height": float(room.height_m),
            "notes": list(room.notes),
            "without model": [list(pair) for pair in room.without_model],
            "shell": {name: len(faces) for name, faces in sorted(room.shell.items())},
            "furniture": [
                [
                    piece.model_id, piece.category, piece.label, rounded([piece.yaw_rad]),
                    *map(rounded, extent(piece)), rounded([signed_volume(piece.mesh)]),
                ]
                for piece in room.furniture
            ],
        }
        for room in result.rooms
    }  # fmt: skip
    lines = [[line.room_id, line.status, line.rule, line.reason] for line in result.left_out]
    return {"rooms": rooms, "left out": lines}


def rounded(values: Any) -> list[float]:
    return (np.round(values, 6) + 0.0).tolist()


def signed_volume(mesh: Mesh) -> float:
    """Positive where faces turn outwards."""
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def shared_front() -> Path:
    """The houses beside the repository, made by others."""
    folder = Path(os.environ.get("SCENEPRIOR_SHARED", Path(__file__).parents[3] / "shared"))
    folder = folder / "data" / "front"
    if not folder.is_dir():
        pytest.skip("no shared data beside the repository")
    return folder
