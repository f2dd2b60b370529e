"""A folder of models in 3D-FUTURE's format, out of meshes in memory."""

import json
from pathlib import Path

import trimesh


def write_models(folder: Path, models: dict[str, tuple[str, trimesh.Trimesh]]) -> Path:
    """Write `<id>/raw_model.obj` of each id -> (category, mesh), and model_info.json."""
    rows = []
    for model_id, (category, mesh) in models.items():
        write_model(folder, model_id, mesh)
        rows.append({"model_id": model_id, "super-category": "Any", "category": category})
    (folder / "model_info.json").write_text(json.dumps(rows))
    return folder


def write_model(folder: Path, model_id: str, mesh: trimesh.Trimesh) -> Path:
    """Write one model's OBJ."""
    path = folder / model_id / "raw_model.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in mesh.vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def blocks(
    *boxes: tuple[tuple[float, float, float], tuple[float, float, float]],
) -> trimesh.Trimesh:
    """Boxes given by (centre, size), as one mesh."""
    parts = []
    for center, size in boxes:
        part = trimesh.creation.box(size)
        part.apply_translation(center)
        parts.append(part)
    return trimesh.util.concatenate(parts)


def corner_sofa(length: float = 2.0) -> trimesh.Trimesh:
    """An L: no turn of it is like another."""
    return blocks(
        ((0, 0.2, 0), (length, 0.4, 0.6)), ((-length / 2 + 0.2, 0.4, 0.6), (0.4, 0.8, 0.9))
    )
