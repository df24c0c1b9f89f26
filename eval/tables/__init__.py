"""From rows of results.csv to tables: by method, domain, size and setting."""
