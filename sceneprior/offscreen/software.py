"""The renderer of machines without GL: our z-buffer (offscreen/zbuffer.py)."""

from collections.abc import Sequence

import numpy as np

from sceneprior.offscreen.renderer import Camera, Pinhole, Renderer, join, projection
from sceneprior.scene import Mesh


class SoftwareRenderer(Renderer):
    """Our Numba z-buffer: needs no library of the system, the same pixels on every machine."""

    name = "software"
    kind = "software"

    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        from sceneprior.offscreen.zbuffer import draw_labels

        soup = join(meshes)
        id_of_face = (soup.mesh_of_face + 1).astype(np.int32)
        images = np.empty((len(cameras), *image_size), dtype=np.uint16)
        for image, camera in zip(images, cameras, strict=True):
            image[...] = draw_labels(
                soup.vertices,
                soup.faces,
                id_of_face,
                camera.world_to_camera,
                projection(camera, image_size),
                image_size,
                perspective=isinstance(camera, Pinhole),
            )
        return images
