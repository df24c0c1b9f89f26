"""Charts as elements of a page, and the look of every method."""
