"""`python -m sceneprior`: the same as the console script."""

from sceneprior.apps.cli import main

main()
