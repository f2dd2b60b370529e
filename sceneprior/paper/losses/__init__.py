"""The view loss: matching, layout terms and the shape term, as functions on tensors."""
