"""Learns 3D scene priors from posed 2D instance masks."""

__version__ = "0.1.0"
