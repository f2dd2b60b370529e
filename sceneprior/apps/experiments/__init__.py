"""Commands in a row: evaluation of runs, comparisons of methods, the demo."""
