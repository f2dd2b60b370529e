"""Off-screen instance ids with pyrender, on EGL."""

import contextlib
import ctypes
import functools
import importlib.util
import os
import sys
import types
from collections.abc import Sequence
from typing import Any

import numpy as np

from sceneprior.core.cameras import Camera, Pinhole
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen.renderer import Renderer

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
def id_renderer_class() -> type:
    """A subclass of pyrender's renderer for exact ids, built when pyrender is imported."""
    from OpenGL import GL as gl  # noqa: N811
    from OpenGL.raw.GL.VERSION import GL_1_0 as raw_gl  # noqa: N811
    from pyrender.constants import RenderFlags
    from pyrender.renderer import Renderer as PyrenderRenderer

    class IdRenderer(PyrenderRenderer):
        """Renderer without multisampling, culling or depth readback; its drawing order is fixed."""

        _main_fb_dims: tuple[Any, Any]
        _ids: Any = None

        def _forward_pass(
            self, scene: Any, flags: int, seg_node_map: Any = None
        ) -> tuple[np.ndarray, None] | None:
            # Replaces pyrender's pass, which repeats bindings and matrix products for every mesh.
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
            # A set's order would decide between equally near faces.
            for node in sorted(scene.mesh_nodes, key=lambda node: node.mesh.name):
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
            """(height, width) uint16: the red and the green byte of each pixel."""
            gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._main_fb)
            ids = np.empty((self.viewport_height, self.viewport_width), dtype="<u2")
            gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
            # The raw call, since PyOpenGL's wrapper does not support this format.
            raw_gl.glReadPixels(
                0, 0, self.viewport_width, self.viewport_height, gl.GL_RG, gl.GL_UNSIGNED_BYTE,
                ctypes.c_void_p(ids.ctypes.data),
            )  # fmt: skip
            return ids[::-1], None  # GL's first row is the lowest

    return IdRenderer


_FAR_M = 200.0


class NoGLError(Exception):
    """GL does not work on this machine; the message completes "because ..."."""


def _probe_gl() -> None:
    """Find with ctypes alone whether EGL has a device; raise a `NoGLError` if not.

    PyOpenGL is not imported for this: its errors without GL are unhelpful, and it chooses its
    platform once per process.
    """
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
    except (OSError, AttributeError):
        raise NoGLError("libEGL or libGL is not installed") from None
    if count.value == 0:
        raise NoGLError("EGL has no device (no driver is installed)")


_pyrender: "_PyrenderRenderer | None" = None  # one per process: deleting one breaks the others
_failure: str | None = None


def open_pyrender() -> "_PyrenderRenderer":
    global _pyrender, _failure
    if _pyrender is None and _failure is None:
        try:
            # Mesa's software GL and Triton each load an LLVM. A process that loads Triton second,
            # as Lightning does if Triton is installed, crashes with a segmentation fault.
            if importlib.util.find_spec("triton") is not None:
                with contextlib.suppress(Exception):  # a broken Triton should fail where it is used
                    importlib.import_module("triton")
            _probe_gl()
            if "OpenGL" not in sys.modules:  # PyOpenGL chooses at its first import
                os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
            _pyrender = _PyrenderRenderer()
        except NoGLError as error:
            _failure = str(error)
        except Exception as error:
            _failure = f"no GL context can be made ({type(error).__name__}: {error})"
            _failure = " ".join(_failure.split())[:200]
    if _pyrender is None:
        raise NoGLError(_failure)
    return _pyrender


class _PyrenderRenderer(Renderer):
    """pyrender's SEG pass on EGL."""

    kind = "pyrender"

    def __init__(self) -> None:
        # A stub replaces pyrender's viewer, which needs pyglet, libGLU and an X server.
        viewer = types.ModuleType("pyrender.viewer")
        viewer.Viewer = None  # type: ignore[attr-defined]
        sys.modules.setdefault("pyrender.viewer", viewer)
        import pyrender
        from OpenGL.GL import GL_RENDERER, glGetString

        self._pyrender = pyrender
        self._process = os.getpid()
        # OffscreenRenderer creates its renderer by this name.
        pyrender.offscreen.Renderer = id_renderer_class()
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
        from sceneprior.render.offscreen.zbuffer import NEAR_PLANE_M

        if isinstance(camera, Pinhole):
            K = np.asarray(camera.intrinsics, dtype=np.float64)
            pyrender_camera = self._pyrender.IntrinsicsCamera(
                K[0, 0], K[1, 1], K[0, 2], K[1, 2], znear=NEAR_PLANE_M, zfar=_FAR_M
            )
        else:
            half = camera.metres_per_pixel * image_size[0] / 2
            pyrender_camera = self._pyrender.OrthographicCamera(
                half, half, znear=NEAR_PLANE_M, zfar=_FAR_M
            )
        to_world = np.linalg.inv(np.asarray(camera.world_to_camera, dtype=np.float64))
        opengl = to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # GL looks along -z, with y up
        return scene.add(pyrender_camera, pose=opengl)


def _open_context(pyrender: Any) -> Any:
    """Open a context on the first EGL device that works; a listed GPU may be inaccessible."""
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
