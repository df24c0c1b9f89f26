"""The changed regions on the page."""
