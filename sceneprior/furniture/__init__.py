"""Procedural furniture: solids, tables of parts for each class, and models of all sizes."""
