"""What every part of the evaluation stands on: output folders, progress, provenance, statistics, workers, figures."""
