"""Draws rooms object by object with a sampler: plain, requested, and partly given ones."""
