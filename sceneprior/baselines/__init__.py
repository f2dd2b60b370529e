"""Baselines that the paper is compared with, learnt from 2D or 3D supervision."""
