"""A GAN on semantic maps, in place of the view loss."""
