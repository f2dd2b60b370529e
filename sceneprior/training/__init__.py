"""Training (sections 3.4 and 4): the stages of a run, their settings, checkpoints and
monitoring."""
