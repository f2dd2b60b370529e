"""`python -m sceneprior`: the same as the console script."""

from sceneprior.cli import main

main()
