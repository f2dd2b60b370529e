"""The differentiable renderer: `render_scene`, and `render_silhouettes` for its masks alone."""

from sceneprior.render.silhouettes.render import RenderedScene, render_scene, render_silhouettes

__all__ = ["RenderedScene", "render_scene", "render_silhouettes"]
