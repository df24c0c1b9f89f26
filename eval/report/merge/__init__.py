"""The merge on the page."""
