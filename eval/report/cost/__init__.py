"""Quality against cost on the page."""
