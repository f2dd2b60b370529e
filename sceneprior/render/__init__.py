"""Rendering of rooms: silhouettes with gradients, instance ids, pictures, and scene files."""
