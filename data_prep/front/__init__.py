"""3D-FRONT houses and 3D-FUTURE models, or homes in their format, as a source of rooms."""
