"""Furniture made of tables of parts: solids, the tables of each class, and models of all sizes."""
