"""Reconstruction of an image object by object, from the shapes of the training rooms."""
