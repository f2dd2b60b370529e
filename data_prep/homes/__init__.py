"""Furnished homes that the package makes itself, in 3D-FRONT's on-disk format."""
