"""Single pairs on the page: maps, regions, worst cases and 3-D views."""
