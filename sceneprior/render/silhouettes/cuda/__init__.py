"""The GPU backend of the renderer, in Triton."""
