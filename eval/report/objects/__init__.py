"""The changed objects on the page."""
