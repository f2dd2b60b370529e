"""Code shared by all other folders: scenes, views, shards, classes, settings, geometry."""
