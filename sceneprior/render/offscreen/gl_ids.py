"""A pyrender renderer that draws exact instance ids."""

import ctypes
import functools
from typing import Any

import numpy as np

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

        def _sorted_mesh_nodes(self, scene: Any) -> list[Any]:
            # pyrender iterates over a set, whose order would decide between equally near faces.
            return sorted(scene.mesh_nodes, key=lambda node: node.mesh.name)

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

        # OSMesa draws into the window's buffer, which pyrender reads by these two methods.
        def read_color_buf(self) -> np.ndarray:
            return self._read_ids()

        def read_depth_buf(self) -> None:
            return None

        def _read_ids(self) -> np.ndarray:
            """(height, width) uint16: the red and the green byte of each pixel."""
            ids = np.empty((self.viewport_height, self.viewport_width), dtype="<u2")
            gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
            # The raw call, since PyOpenGL's wrapper does not support this format.
            raw_gl.glReadPixels(
                0, 0, self.viewport_width, self.viewport_height, gl.GL_RG, gl.GL_UNSIGNED_BYTE,
                ctypes.c_void_p(ids.ctypes.data),
            )  # fmt: skip
            return ids[::-1]  # GL's first row is the lowest

    return IdRenderer
