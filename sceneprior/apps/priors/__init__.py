"""Packed priors, one file each; the priors that the package ships are in this folder."""
