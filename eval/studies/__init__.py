"""Measurements beside the plans, run as `python -m eval.studies.NAME`: thresholds and gates."""
