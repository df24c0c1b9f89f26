"""Training data for descriptors, and training on them."""
