"""Rooms on request: a floor, doors and windows, and wishes enter the sampler's distribution; what
cannot be conditioned is met by sequential Monte Carlo over partly furnished rooms."""
