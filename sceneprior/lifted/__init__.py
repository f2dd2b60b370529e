"""The lifted method: 3D boxes and shapes are estimated from masks before training; a sampler learns
new rooms from them."""
