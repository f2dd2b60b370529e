"""Valid range of random seeds."""

from sceneprior.core.errors import InputError

LARGEST_SEED = 2**32 - 1
"""Largest seed that NumPy, PyTorch, scikit-learn and Lightning all accept."""


def check_seed(seed: int) -> None:
    """Check that a seed is in the valid range."""
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"The seed is {seed}; expected a whole number from 0 to {LARGEST_SEED}.")
