"""The metrics, one file per metric or family of metrics."""
