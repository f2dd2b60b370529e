"""Evaluation of generated and reconstructed rooms: metrics, protocol, tables and report pages."""
