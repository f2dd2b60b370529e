"""Pictures without a screen: meshes and cameras in, instance ids or shaded colours out.

The one front door to pyrender. Where the machine has no GL library, a z-buffer of our own
(silhouettes/zbuffer.py) draws the same ids.
"""

import abc
import contextlib
import ctypes
import ctypes.util
import functools
import importlib.util
import os
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.scene import Mesh

KINDS = ("auto", "pyrender", "software")
ENVIRONMENT_VARIABLE = "SCENEPRIOR_RENDERER"
"""Set to `pyrender` or `software`, it decides what `auto` means."""
APT_LINE = "apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"
_NO_GL_VARIABLE = "SCENEPRIOR_NO_GL"
"""Set by tests: behave as on a machine without GL."""
_FAR_M = 200.0
# The z-buffer is imported where it draws: Numba takes 60 MB and half a second, which a command
# that draws nothing (prep-scannet) should not pay.


@dataclass(frozen=True)
class Pinhole:
    """A perspective camera: `point_camera = world_to_camera @ point_world`, OpenCV axes."""

    world_to_camera: np.ndarray
    """(4, 4), metres."""
    intrinsics: np.ndarray
    """(3, 3), pixels; without skew."""


@dataclass(frozen=True)
class Orthographic:
    """A parallel camera; the centre of the image lies on its optical axis."""

    world_to_camera: np.ndarray
    """(4, 4), metres. Only what lies in front of the camera is drawn."""
    metres_per_pixel: float


Camera = Pinhole | Orthographic


class Renderer(abc.ABC):
    """What draws meshes; `open_renderer` gives one."""

    name: str
    """What was chosen, for reports: "software" or "pyrender (EGL, <GL's own name>)"."""
    kind: str
    """"pyrender" or "software": what `open_renderer` takes to get the same again."""

    @abc.abstractmethod
    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        """Which mesh each pixel's centre sees, for many views of one room.

        Returns:
            (views, height, width) uint16: 0 for nothing, k + 1 for `meshes[k]`. Both sides of a
            face are seen.
        """

    def instance_ids(
        self, meshes: Sequence[Mesh], camera: Camera, image_size: tuple[int, int]
    ) -> np.ndarray:
        """The same for one view: (height, width) uint16."""
        return self.instance_ids_of_views(meshes, [camera], image_size)[0]

    def shaded(
        self,
        meshes: Sequence[Mesh],
        colors: np.ndarray,
        camera: Camera,
        image_size: tuple[int, int],
        background: tuple[int, int, int] | np.ndarray = (255, 255, 255),
    ) -> np.ndarray:
        """A picture for people: mesh k in `colors[k]` (uint8), lit from the camera: (H, W, 3).

        Behind the meshes is a colour, or another picture of this size. Our z-buffer draws it for
        both kinds, so that pictures look the same everywhere.
        """
        from sceneprior.silhouettes.zbuffer import rasterize

        height, width = image_size
        soup = _join(meshes)
        fine_size = (2 * height, 2 * width)
        face_index, _ = rasterize(
            soup.vertices,
            soup.faces,
            camera.world_to_camera,
            _projection(camera, fine_size, supersampling=2),
            fine_size,
            perspective=isinstance(camera, Pinhole),
        )
        light = _face_light(soup, camera)
        palette = np.asarray(colors, dtype=np.float64).reshape(-1, 3)[soup.mesh_of_face]
        palette = np.concatenate([palette * light[:, None], [(0, 0, 0)]])  # -1 is the last row
        fine = palette[face_index].reshape(height, 2, width, 2, 3)
        behind = np.broadcast_to(np.asarray(background), (height, width, 3))[:, None, :, None]
        fine = np.where((face_index < 0).reshape(height, 2, width, 2, 1), behind, fine)
        return np.rint(fine.mean(axis=(1, 3))).astype(np.uint8)


def open_renderer(kind: str = "auto") -> Renderer:
    """Open the renderer of this process.

    Args:
        kind: `pyrender` (GPU or software GL), `software` (our z-buffer), or `auto`: pyrender where
            GL works, else software with one line of notice. The environment variable
            SCENEPRIOR_RENDERER overrides `auto`.

    Raises:
        InputError: no such kind, or pyrender was asked for and GL does not work here.
    """
    if kind == "auto":
        kind = os.environ.get(ENVIRONMENT_VARIABLE) or "auto"
    if kind not in KINDS:
        raise InputError(f"No renderer is called '{kind}'; there are {', '.join(KINDS)}.")
    if kind == "software":
        return SoftwareRenderer()
    try:
        return _open_pyrender()
    except _NoGLError as error:
        if kind == "pyrender":
            raise InputError(
                f"pyrender cannot draw here: {error}. Install GL with `{APT_LINE}`, "
                "or choose `--renderer software`."
            ) from None
        _notice(str(error))
        return SoftwareRenderer()


@functools.cache
def _notice(reason: str) -> None:
    print(
        f"Note: drawing with the software z-buffer, because {reason} (`{APT_LINE}` would let "
        "pyrender draw).",
        file=sys.stderr,
    )


class SoftwareRenderer(Renderer):
    """Our Numba z-buffer: needs no library of the system, the same pixels on every machine."""

    name = "software"
    kind = "software"

    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        from sceneprior.silhouettes.zbuffer import draw_labels

        soup = _join(meshes)
        id_of_face = (soup.mesh_of_face + 1).astype(np.int32)
        images = np.empty((len(cameras), *image_size), dtype=np.uint16)
        for image, camera in zip(images, cameras, strict=True):
            image[...] = draw_labels(
                soup.vertices,
                soup.faces,
                id_of_face,
                camera.world_to_camera,
                _projection(camera, image_size),
                image_size,
                perspective=isinstance(camera, Pinhole),
            )
        return images


@dataclass(frozen=True)
class _Soup:
    """All meshes of a room as one."""

    vertices: np.ndarray
    faces: np.ndarray
    mesh_of_face: np.ndarray


def _join(meshes: Sequence[Mesh]) -> _Soup:
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    counts = [len(mesh.faces) for mesh in meshes]
    return _Soup(
        np.concatenate([np.zeros((0, 3)), *(mesh.vertices_m for mesh in meshes)]),
        np.concatenate(
            [np.zeros((0, 3), np.int32)]
            + [
                np.asarray(mesh.faces, np.int32).reshape(-1, 3) + np.int32(start)
                for mesh, start in zip(meshes, starts, strict=False)
            ]
        ),
        np.repeat(np.arange(len(meshes)), counts),
    )


def _projection(
    camera: Camera, image_size: tuple[int, int], supersampling: int = 1
) -> tuple[float, float, float, float]:
    """What the z-buffer asks for; `image_size` is the supersampled one."""
    if isinstance(camera, Pinhole):
        K = np.asarray(camera.intrinsics, dtype=np.float64) * supersampling
        return K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    scale = supersampling / camera.metres_per_pixel
    return scale, scale, image_size[1] / 2, image_size[0] / 2


def _face_light(soup: _Soup, camera: Camera) -> np.ndarray:
    """Brightness of each face in [0.4, 1]: ambient, and a lamp a little above the camera."""
    to_camera = np.asarray(camera.world_to_camera, dtype=np.float64)
    corners = (soup.vertices @ to_camera[:3, :3].T + to_camera[:3, 3])[soup.faces]
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


class _NoGLError(Exception):
    """GL does not work here; the message completes "because ..."."""


def _probe_gl() -> str:
    """Look for GL libraries with ctypes alone: "egl" or "osmesa".

    PyOpenGL's own errors on a machine without GL help nobody, and it chooses once a process.
    """
    if os.environ.get(_NO_GL_VARIABLE):
        raise _NoGLError(f"{_NO_GL_VARIABLE} is set")
    try:
        ctypes.CDLL("libGL.so.1")
        egl = ctypes.CDLL("libEGL.so.1")
        egl.eglGetProcAddress.restype = ctypes.c_void_p
        egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
        address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
        count = ctypes.c_int(0)
        if address:
            query = ctypes.CFUNCTYPE(
                ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
            )(address)
            query(0, None, ctypes.byref(count))
        if count.value > 0:
            return "egl"
        reason = "EGL has no device (no driver is installed)"
    except (OSError, AttributeError):
        reason = "libEGL or libGL is not installed"
    if ctypes.util.find_library("OSMesa"):
        return "osmesa"
    raise _NoGLError(reason)


_pyrender: "_PyrenderRenderer | None" = None  # one a process: deleting one kills the others
_failure: str | None = None


def _open_pyrender() -> "_PyrenderRenderer":
    global _pyrender, _failure
    if _pyrender is None:
        if _failure is None:
            try:
                _load_triton_before_mesa()
                platform = _probe_gl()
                if "OpenGL" not in sys.modules:  # PyOpenGL chooses at its first import
                    platform = os.environ.setdefault("PYOPENGL_PLATFORM", platform)
                _pyrender = _PyrenderRenderer()
                return _pyrender
            except _NoGLError as error:
                _failure = str(error)
            except Exception as error:
                _failure = f"no GL context can be made ({type(error).__name__}: {error})"
                _failure = " ".join(_failure.split())[:200]
        raise _NoGLError(_failure)
    return _pyrender


def _load_triton_before_mesa() -> None:
    # Mesa's software GL and Triton each bring an LLVM. A process that loads Triton second, as
    # Lightning does where torch's CUDA build has installed it, dies of a segmentation fault.
    if importlib.util.find_spec("triton") is not None:
        with contextlib.suppress(Exception):  # a broken Triton is its user's to meet
            importlib.import_module("triton")


class _PyrenderRenderer(Renderer):
    """pyrender's SEG pass on EGL or OSMesa."""

    kind = "pyrender"

    def __init__(self) -> None:
        # pyrender's viewer wants pyglet, libGLU and an X server; nothing here opens a window.
        viewer = types.ModuleType("pyrender.viewer")
        viewer.Viewer = None  # type: ignore[attr-defined]
        sys.modules.setdefault("pyrender.viewer", viewer)
        import pyrender
        from OpenGL.GL import GL_RENDERER, glGetString

        self._pyrender = pyrender
        self._process = os.getpid()
        # OffscreenRenderer makes its renderer by this name, and again when OSMesa changes size.
        pyrender.offscreen.Renderer = _id_renderer_class()
        self._offscreen = _open_context(pyrender)
        self._offscreen._platform.make_current()
        platform = type(self._offscreen._platform).__name__.removesuffix("Platform")
        self.name = f"pyrender ({platform}, {glGetString(GL_RENDERER).decode()})"
        probe = Mesh(np.array([[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]]), np.array([[0, 1, 2]]))
        K = np.array([[4.0, 0, 4], [0, 4, 4], [0, 0, 1]])
        drawn = self.instance_ids([probe], Pinhole(np.eye(4), K), (8, 8))
        if drawn[4, 4] != 1:
            raise RuntimeError("a test triangle was not drawn")

    def instance_ids_of_views(
        self, meshes: Sequence[Mesh], cameras: Sequence[Camera], image_size: tuple[int, int]
    ) -> np.ndarray:
        if os.getpid() != self._process:
            raise RuntimeError(
                "A GL context does not survive a fork; start worker processes with 'spawn'."
            )
        images = np.zeros((len(cameras), *image_size), dtype=np.uint16)
        scene = self._pyrender.Scene()
        color_of_node = {}
        for index, mesh in enumerate(meshes):
            if len(mesh.faces):
                primitive = self._pyrender.Primitive(
                    positions=mesh.vertices_m, indices=np.asarray(mesh.faces).reshape(-1, 3)
                )
                node = scene.add(self._pyrender.Mesh([primitive], name=f"{index:05d}"))
                color_of_node[node] = ((index + 1) & 255, (index + 1) >> 8, 0)
        if not color_of_node:
            return images
        self._offscreen.viewport_height, self._offscreen.viewport_width = image_size
        for image, camera in zip(images, cameras, strict=True):
            node = self._add_camera(scene, camera, image_size)
            image[...], _ = self._offscreen.render(
                scene, self._pyrender.RenderFlags.SEG, seg_node_map=color_of_node
            )
            scene.remove_node(node)
        return images

    def _add_camera(self, scene: Any, camera: Camera, image_size: tuple[int, int]) -> Any:
        from sceneprior.silhouettes.zbuffer import NEAR_M

        if isinstance(camera, Pinhole):
            K = np.asarray(camera.intrinsics, dtype=np.float64)
            lens = self._pyrender.IntrinsicsCamera(
                K[0, 0], K[1, 1], K[0, 2], K[1, 2], znear=NEAR_M, zfar=_FAR_M
            )
        else:
            half = camera.metres_per_pixel * image_size[0] / 2
            lens = self._pyrender.OrthographicCamera(half, half, znear=NEAR_M, zfar=_FAR_M)
        to_world = np.linalg.inv(np.asarray(camera.world_to_camera, dtype=np.float64))
        opengl = to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # GL looks along -z, with y up
        return scene.add(lens, pose=opengl)


def _open_context(pyrender: Any) -> Any:
    """The first EGL device that gives a context: a GPU may be listed and yet be forbidden."""
    if os.environ.get("PYOPENGL_PLATFORM") != "egl" or "EGL_DEVICE_ID" in os.environ:
        return pyrender.OffscreenRenderer(8, 8)
    first_error: Exception | None = None
    for device in range(16):
        os.environ["EGL_DEVICE_ID"] = str(device)
        try:
            return pyrender.OffscreenRenderer(8, 8)
        except Exception as error:
            first_error = first_error or error
            if isinstance(error, ValueError) and "device ID" in str(error):
                break  # no more devices
        finally:
            del os.environ["EGL_DEVICE_ID"]
    raise first_error or RuntimeError("EGL lists no device")


_VERTEX_SHADER = """#version 330 core
layout(location = 0) in vec3 position;
uniform mat4 world_to_clip;
void main() { gl_Position = world_to_clip * vec4(position, 1.0); }
"""
_FRAGMENT_SHADER = """#version 330 core
uniform vec3 color;
out vec4 shown;
void main() { shown = vec4(color, 1.0); }
"""


@functools.cache
def _id_renderer_class() -> type:
    """pyrender's renderer, changed where exact ids need it (built once pyrender is imported)."""
    from OpenGL import GL as gl  # noqa: N811
    from OpenGL.raw.GL.VERSION import GL_1_0 as raw_gl  # noqa: N811
    from pyrender.constants import RenderFlags
    from pyrender.renderer import Renderer as PyrenderRenderer

    class IdRenderer(PyrenderRenderer):
        """No multisampling, no culling, a fixed drawing order, and no depth read back."""

        _main_fb_dims: tuple[Any, Any]
        _ids: Any = None

        def _sorted_mesh_nodes(self, scene: Any) -> list[Any]:
            # pyrender walks a set: where two faces are equally near, its order would decide.
            return sorted(scene.mesh_nodes, key=lambda node: node.mesh.name)

        def _forward_pass(
            self, scene: Any, flags: int, seg_node_map: Any = None
        ) -> tuple[np.ndarray, None] | None:
            # pyrender's own pass binds, looks up and multiplies again for every mesh and vertex.
            self._configure_forward_pass_viewport(flags)
            gl.glClearColor(0, 0, 0, 1)
            gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
            for switch in (gl.GL_MULTISAMPLE, gl.GL_BLEND, gl.GL_CULL_FACE):
                gl.glDisable(switch)  # no culling: furniture has faces of either winding
            gl.glPolygonMode(gl.GL_FRONT_AND_BACK, gl.GL_FILL)
            program = self._ids_program()
            gl.glUseProgram(program)
            world_to_camera, projection = self._get_camera_matrices(scene)
            world_to_clip = (projection @ world_to_camera).astype(np.float32)
            gl.glUniformMatrix4fv(
                gl.glGetUniformLocation(program, "world_to_clip"), 1, gl.GL_TRUE, world_to_clip
            )
            color_place = gl.glGetUniformLocation(program, "color")
            for node in self._sorted_mesh_nodes(scene):
                red, green, blue = seg_node_map[node]
                gl.glUniform3f(color_place, red / 255, green / 255, blue / 255)
                for primitive in node.mesh.primitives:
                    gl.glBindVertexArray(primitive._vaid)
                    gl.glDrawElements(
                        primitive.mode, primitive.indices.size, gl.GL_UNSIGNED_INT, None
                    )
            gl.glBindVertexArray(0)
            gl.glUseProgram(0)
            offscreen = flags & RenderFlags.OFFSCREEN
            return self._read_main_framebuffer(scene, flags) if offscreen else None

        def _ids_program(self) -> int:
            if self._ids is None:
                self._ids = gl.glCreateProgram()
                for kind, source in (
                    (gl.GL_VERTEX_SHADER, _VERTEX_SHADER),
                    (gl.GL_FRAGMENT_SHADER, _FRAGMENT_SHADER),
                ):
                    shader = gl.glCreateShader(kind)
                    gl.glShaderSource(shader, source)
                    gl.glCompileShader(shader)
                    gl.glAttachShader(self._ids, shader)
                gl.glLinkProgram(self._ids)
                if not gl.glGetProgramiv(self._ids, gl.GL_LINK_STATUS):
                    raise RuntimeError(f"shaders do not link: {gl.glGetProgramInfoLog(self._ids)}")
            return self._ids

        def _configure_main_framebuffer(self) -> None:
            size = (self.viewport_width, self.viewport_height)
            if size == self._main_fb_dims:
                return
            self._delete_main_framebuffer()
            self._main_fb = self._main_fb_ms = gl.glGenFramebuffers(1)
            gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._main_fb)
            self._main_cb, self._main_db = gl.glGenRenderbuffers(2)
            for buffer, form, role in (
                (self._main_cb, gl.GL_RG8, gl.GL_COLOR_ATTACHMENT0),
                (self._main_db, gl.GL_DEPTH_COMPONENT24, gl.GL_DEPTH_ATTACHMENT),
            ):
                gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
                gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, form, *size)
                gl.glFramebufferRenderbuffer(
                    gl.GL_DRAW_FRAMEBUFFER, role, gl.GL_RENDERBUFFER, buffer
                )
            self._main_fb_dims = size

        def _delete_main_framebuffer(self) -> None:
            if self._main_fb is not None:
                gl.glDeleteFramebuffers(1, [self._main_fb])
                gl.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
            self._main_fb = self._main_fb_ms = self._main_cb = self._main_db = None
            self._main_fb_dims = (None, None)

        def _read_main_framebuffer(self, scene: Any, flags: int) -> tuple[np.ndarray, None]:
            gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._main_fb)
            return self._read_ids(), None

        # OSMesa draws into the window's buffer, and asks for it in two parts.
        def read_color_buf(self) -> np.ndarray:
            return self._read_ids()

        def read_depth_buf(self) -> None:
            return None

        def _read_ids(self) -> np.ndarray:
            """(height, width) uint16: the red and the green byte of each pixel."""
            ids = np.empty((self.viewport_height, self.viewport_width), dtype="<u2")
            gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
            # The raw call: PyOpenGL's own does not know this format.
            raw_gl.glReadPixels(
                0, 0, self.viewport_width, self.viewport_height, gl.GL_RG, gl.GL_UNSIGNED_BYTE,
                ctypes.c_void_p(ids.ctypes.data),
            )  # fmt: skip
            return ids[::-1]  # GL's first row is the lowest

    return IdRenderer
