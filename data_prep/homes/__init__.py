"""Procedurally generated furnished homes in 3D-FRONT's on-disk format."""
