"""Runs beyond one disk and one machine: shards and their union, sessions made again, copies elsewhere, large tables."""
