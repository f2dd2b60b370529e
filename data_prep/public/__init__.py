"""Sources for public data sets of images with instance ids (docs/public_data.md)."""
