"""Priors that travel: one file each, wherever it lies; those of the package are in this folder."""
