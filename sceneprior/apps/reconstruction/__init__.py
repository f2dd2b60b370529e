"""Reconstruction of rooms from the instance masks of single images (section 5.2)."""
