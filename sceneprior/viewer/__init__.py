"""A page in the browser: walk the latent space, keep objects, complete rooms (extra `view`)."""
