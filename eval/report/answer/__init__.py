"""One answer in three dimensions, without any truth: its content, one offline page, and a view for the browser."""
