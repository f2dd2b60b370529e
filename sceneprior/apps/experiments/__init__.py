"""Experiments: evaluation of runs, comparisons of methods, and the demo."""
