"""Pure functions on cameras, boxes and meshes, without weights."""
