"""What the paper is compared with, in 2D and in 3D."""
