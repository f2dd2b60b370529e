"""Joins masks of single frames to objects, by geometry and classes."""
