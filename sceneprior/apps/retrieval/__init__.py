"""Retrieval of CAD models for the objects of a scene."""
