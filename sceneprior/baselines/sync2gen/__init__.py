"""A Sync2Gen-style VAE with 3D supervision."""
