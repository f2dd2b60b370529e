"""Loads view shards as batches of `SceneViews`."""
