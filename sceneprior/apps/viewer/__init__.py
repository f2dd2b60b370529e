"""A browser page to explore the latent space and complete rooms (needs the extra `view`)."""
