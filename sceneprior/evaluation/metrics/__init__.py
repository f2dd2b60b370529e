"""The metrics, one file a metric or a family of them."""
