"""Images of instance ids, tables of their classes, and the 2D boxes and tracks in them."""
