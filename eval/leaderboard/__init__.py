"""A method of others, from its command to the leaderboard: evaluation on a plan's pairs, packed results, the page."""
