"""Prepares view shards from raw data sets."""
