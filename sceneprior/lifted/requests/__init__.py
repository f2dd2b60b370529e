"""Rooms on request: floor, doors, windows and wishes condition the sampler. Conditions that are not
inputs of its network are enforced by sequential Monte Carlo over partly furnished rooms."""
