"""Views of worlds and sessions: in the browser, as one HTML file, or as pictures."""
