"""One LightningModule a training stage, and what runs them."""
