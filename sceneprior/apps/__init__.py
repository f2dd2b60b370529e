"""User-facing code: Python API, command line, viewer, packed priors and comparisons."""
