"""ATISS with 3D supervision."""
