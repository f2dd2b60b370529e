"""New rooms, object by object, from what lifting found in the training rooms; ours."""
