"""The differentiable renderer (`render_silhouettes`) and the hard rasteriser (`zbuffer`)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprior.silhouettes.render import render_silhouettes

__all__ = ["render_silhouettes"]


def __getattr__(name: str) -> Any:
    # Looked up when asked for: drawing with the z-buffer alone should not load torch.
    if name == "render_silhouettes":
        from sceneprior.silhouettes.render import render_silhouettes

        return render_silhouettes
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
