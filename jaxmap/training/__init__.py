"""Training of the networks: data, augmentation, losses, the compiled step and the loop around it."""
