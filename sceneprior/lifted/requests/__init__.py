"""Rooms on request: the sampler is conditioned on a floor, doors, windows and wishes. Conditions
that are not inputs of its network are met by sequential Monte Carlo over partly furnished rooms."""
