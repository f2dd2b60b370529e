"""Evaluation of generated and reconstructed rooms: metrics, protocol, tables, the page."""
