"""A run as one offline page, with its tables as CSV and LaTeX."""
