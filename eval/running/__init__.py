"""Running a plan: cells, workers, the run folder, stored answers and their scores."""
