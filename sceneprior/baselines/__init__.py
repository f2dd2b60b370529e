"""Baselines for comparison with the paper's method, trained with 2D or 3D supervision."""
