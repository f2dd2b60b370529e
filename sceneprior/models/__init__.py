"""The prior: latents -> object features -> classes, boxes and meshes."""
