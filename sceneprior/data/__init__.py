"""View shards in, batches of `SceneViews` out."""
