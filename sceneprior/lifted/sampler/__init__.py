"""The sampler: generates new rooms object by object, trained on the lifted objects of the training
rooms."""
