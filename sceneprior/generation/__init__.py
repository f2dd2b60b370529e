"""New rooms from a trained prior: sampled, interpolated, completed, with CAD models."""
