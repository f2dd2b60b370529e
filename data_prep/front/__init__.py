"""Source for 3D-FRONT houses with 3D-FUTURE models, and for homes in the same format."""
