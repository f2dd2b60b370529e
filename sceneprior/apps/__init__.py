"""User-facing code: the Python API, the command line, the viewer, packed priors, comparisons."""
