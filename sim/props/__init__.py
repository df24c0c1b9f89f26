"""The things that stand in a tunnel and may change: one builder for each kind."""
