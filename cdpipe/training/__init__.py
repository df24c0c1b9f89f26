"""Training the learned descriptors on the shards that `tunnelcd dataset` makes."""
