"""Programs beside the plans, run as `python -m eval.studies.NAME`: thresholds, gates, descriptors, the real sensor."""
