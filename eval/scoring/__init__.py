"""From an answer and the truth to the columns of results.csv and the rows of the item tables."""
