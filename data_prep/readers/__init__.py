"""Readers of data sets and captures: each makes the views of a room from its files."""
