"""The pipeline on one pair: each stage runs once for all variants that share its input, and its result is kept."""
