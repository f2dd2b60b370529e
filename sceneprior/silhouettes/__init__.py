"""The differentiable renderer (`render_silhouettes`, `render_scene`) and the hard rasteriser."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprior.silhouettes.render import RenderedScene, render_scene, render_silhouettes

__all__ = ["RenderedScene", "render_scene", "render_silhouettes"]


def __getattr__(name: str) -> Any:
    # Looked up when asked for: drawing with the z-buffer alone should not load torch.
    if name in __all__:
        from sceneprior.silhouettes import render

        return getattr(render, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
