"""Rock that moved on the page: methods, detection limits, and unrolled maps of one pair."""
