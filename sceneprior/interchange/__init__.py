"""Conversion of rooms to and from other projects' formats."""
