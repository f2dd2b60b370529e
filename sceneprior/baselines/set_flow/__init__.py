"""A flow model of sets of objects, with 3D supervision."""
