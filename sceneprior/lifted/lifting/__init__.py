"""Lifting: 3D boxes and shapes of tracked objects from masks and cameras alone, before any
training."""
