"""Published ways to measure displacement, at the same places and from the same cells as ours."""
