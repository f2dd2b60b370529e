"""The CPU backend of the renderer, in Numba."""
