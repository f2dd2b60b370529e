"""Training (sections 3.4 and 4): the two stages, their settings, checkpoints."""
