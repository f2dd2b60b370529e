"""Images of instance ids and tables of their classes, and the 2D boxes and tracks in them."""
