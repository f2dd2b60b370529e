"""Learning 3D scene priors from 2D supervision: posed instance masks in, new rooms out."""

__version__ = "0.1.0"
