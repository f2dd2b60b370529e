"""Write tests/golden/silhouettes.npz: what our float64 reference draws of one small scene.

    cd tests && python -m references.make_silhouettes_oracle

A change that moves these numbers changes what the renderer means; write the file anew only then.
"""

import itertools
from pathlib import Path

import numpy as np
import torch
from toy_rooms import look_at

from sceneprior.core.geometry.meshes import icosphere
from sceneprior.render.silhouettes.render import render_scene

FILE = Path(__file__).resolve().parents[1] / "golden" / "silhouettes.npz"
MODES = ("exact", "fast")
COMPOSITING = ("alone", "layered", "paper")
SIGMA_PX2 = 0.4


def scene_arrays() -> dict[str, np.ndarray]:
    """Three lumpy balls of 80 faces that hide each other, two views; in the second one of them
    is around the camera."""
    sphere, faces = icosphere(1)
    points = sphere.double().numpy()
    lumps = 1 + 0.4 * np.sin(4 * points[:, :1] + 1) * np.cos(5 * points[:, 1:2])
    sizes = np.array([[0.5, 0.4, 0.6], [0.3, 0.7, 0.3], [0.45, 0.3, 0.5]])
    centers = np.array([[0.1, 0, 0.2], [-0.4, 0.1, -0.5], [0.7, -0.1, -0.3]])
    eyes = np.array([[0.2, 0.5, 2.3], [1.1, 0.1, -0.2]])
    vertices = points * lumps * sizes[:, None] + centers[:, None]
    rows, columns = np.mgrid[:12, :18]
    return {
        "vertices_m": vertices[None],
        "faces": faces.numpy(),
        "world_to_camera": np.stack([look_at(eye, np.zeros(3)) for eye in eyes])[None],
        "intrinsics": np.tile([[9.0, 0, 9.3], [0, 9.5, 5.8], [0, 0, 1]], (1, 2, 1, 1)),
        # The loss is the sum of masks times this picture, 1, 2 and 3 times for the three objects.
        "picture": np.cos(0.7 * rows + 0.9 * columns + 0.3),
    }


def draw(arrays: dict[str, np.ndarray], mode: str, compositing: str, backend: str) -> dict:
    """Masks, ids, depths and the vertices' gradient of one way to draw the scene."""
    tensors = {name: torch.from_numpy(np.ascontiguousarray(arrays[name])) for name in arrays}
    picture = tensors.pop("picture")
    vertices = tensors["vertices_m"].clone().requires_grad_()
    drawn = render_scene(
        **tensors | {"vertices_m": vertices},
        image_size=tuple(picture.shape),
        sigma_px2=SIGMA_PX2,
        mode=mode,
        compositing=compositing,
        backend=backend,
    )
    times = torch.arange(1, 4, dtype=torch.float64)[:, None, None]
    (drawn.masks * picture * times).sum().backward()
    return {
        "masks": drawn.masks.detach().numpy(),
        "front": drawn.front.numpy(),
        "depth_m": drawn.depth_m.numpy(),
        "gradient": vertices.grad.numpy(),
    }


def main() -> None:
    scene = scene_arrays()
    arrays = dict(scene)
    for mode, compositing in itertools.product(MODES, COMPOSITING):
        drawn = draw(scene, mode, compositing, "reference")
        for name in ("masks", "gradient"):
            arrays[f"{name}_{mode}_{compositing}"] = drawn[name]
        for name in ("front", "depth_m"):  # the same in every compositing
            arrays[f"{name}_{mode}"] = drawn[name]
    np.savez_compressed(FILE, **arrays)
    print(f"{FILE}: {FILE.stat().st_size / 1024:.0f} KB")


if __name__ == "__main__":
    main()
