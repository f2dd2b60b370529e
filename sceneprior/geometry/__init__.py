"""Pure tensor functions on cameras, boxes and meshes; nothing here has weights."""
