"""Renderers and their cameras: the interface, the software renderer, and shaded pictures.

The z-buffer is imported when it draws: Numba takes 60 MB and half a second, which commands that
draw nothing (prep-scannet) should not spend.
"""

import abc
from collections.abc import Sequence

import numpy as np

from sceneprior.core.cameras import Camera, Pinhole, to_camera
from sceneprior.core.scene import Mesh, join_meshes
from sceneprior.render.offscreen.zbuffer import sky_light

EVEN = 0.2
"""Exponent that brightens walls and evens out their brightness: 0.4 becomes 0.83."""


class Renderer(abc.ABC):
    """A renderer of meshes; `open_renderer` returns one."""

    name: str
    """Name for reports: "software" or "pyrender (EGL, <name of the GL renderer>)"."""
    kind: str
    """Argument of `open_renderer` for the same renderer: "pyrender" or "software"."""

    @abc.abstractmethod
    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        """Draw which mesh is visible at each pixel centre, in several views of one room.

        Returns (views, height, width) uint16: k + 1 where `meshes[k]` is visible, 0 for no mesh.
        Both sides of a face are drawn.
        """

    def instance_ids(
        self, meshes: Sequence[Mesh], camera: Camera, image_size: tuple[int, int]
    ) -> np.ndarray:
        """Instance ids of one view: (height, width) uint16."""
        return self.instance_ids_of_views(meshes, [camera], image_size)[0]

    def shaded(
        self,
        meshes: Sequence[Mesh],
        colors: np.ndarray,
        camera: Camera,
        image_size: tuple[int, int],
        background: tuple[int, int, int] | np.ndarray = (255, 255, 255),
        shadowed: int = 0,
    ) -> np.ndarray:
        """Draw a shaded picture, (H, W, 3) uint8, with mesh k in the colour `colors[k]`.

        The light comes from the camera. If the camera is a `Pinhole`, the first `shadowed` meshes
        also shadow each other softly under light from the sky (`zbuffer.py`). The other meshes,
        such as walls, are lit almost evenly if `shadowed` is not 0. The background is a colour, or
        a picture of the same size. Both renderers draw this with the software z-buffer, so that
        pictures look the same everywhere.
        """
        height, width = image_size
        joined, mesh_of_face = _join(meshes)
        face_index, depth_m = _draw(joined, camera, (2 * height, 2 * width), supersampling=2)
        light = _face_light(joined, camera)
        if shadowed:
            light = np.where(mesh_of_face < shadowed, light, light**EVEN)
        palette = np.asarray(colors, dtype=np.float64).reshape(-1, 3)[mesh_of_face]
        palette = np.concatenate([palette * light[:, None], [(0, 0, 0)]])  # -1 is the last row
        picture = palette[face_index]
        if shadowed and isinstance(camera, Pinhole):
            # Computed at half the resolution, because this light changes slowly.
            casting = mesh_of_face < shadowed
            here = np.append(casting, False)[face_index[::2, ::2]]
            depth_m = np.where(here, depth_m[::2, ::2], np.inf)
            light = sky_light(joined.vertices_m, joined.faces[casting], camera, depth_m)
            picture *= light.repeat(2, axis=0).repeat(2, axis=1)[..., None]
        fine = picture.reshape(height, 2, width, 2, 3)
        behind = np.broadcast_to(np.asarray(background), (height, width, 3))[:, None, :, None]
        fine = np.where((face_index < 0).reshape(height, 2, width, 2, 1), behind, fine)
        return np.rint(fine.mean(axis=(1, 3))).astype(np.uint8)


class SoftwareRenderer(Renderer):
    """The package's Numba z-buffer: no system libraries, the same pixels on every machine."""

    name = "software"
    kind = "software"

    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        joined, mesh_of_face = _join(meshes)
        images = np.empty((len(cameras), *image_size), dtype=np.uint16)
        for image, camera in zip(images, cameras, strict=True):
            image[...] = _draw(joined, camera, image_size, labels=mesh_of_face)[0] + 1
        return images


def _join(meshes: Sequence[Mesh]) -> tuple[Mesh, np.ndarray]:
    """All meshes of a room joined into one, and the mesh of each face."""
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    lengths = [len(mesh.faces) for mesh in meshes]
    return join_meshes([nothing, *meshes]), np.repeat(np.arange(len(meshes)), lengths)


def _draw(
    mesh: Mesh,
    camera: Camera,
    image_size: tuple[int, int],
    supersampling: int = 1,
    labels: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw with `zbuffer.rasterize` and return its result; `image_size` is the supersampled
    size."""
    from sceneprior.render.offscreen.zbuffer import rasterize

    if isinstance(camera, Pinhole):
        K = np.asarray(camera.intrinsics, dtype=np.float64) * supersampling
        projection = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    else:
        scale = supersampling / camera.metres_per_pixel
        projection = (scale, scale, image_size[1] / 2, image_size[0] / 2)
    return rasterize(
        mesh.vertices_m, mesh.faces, camera.world_to_camera, projection, image_size,
        isinstance(camera, Pinhole), labels,
    )  # fmt: skip


def _face_light(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Brightness of each face in [0.4, 1]: ambient light, and a lamp slightly above the camera."""
    world_to_camera = np.asarray(camera.world_to_camera, dtype=np.float64)
    corners = to_camera(mesh.vertices_m, world_to_camera)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    if isinstance(camera, Pinhole):
        towards_eye = -corners.mean(axis=1)
    else:
        towards_eye = np.broadcast_to([0.0, 0.0, -1.0], normals.shape)
    normals *= np.where((normals * towards_eye).sum(axis=1, keepdims=True) < 0, -1, 1)
    lamp = np.array([-0.25, -0.55, -0.8])
    lamp /= np.linalg.norm(lamp)
    return 0.4 + 0.6 * np.clip(normals @ lamp, 0, 1)
