"""Images of instance ids: PNGs and tables of classes in, 2D boxes and tracks out."""
