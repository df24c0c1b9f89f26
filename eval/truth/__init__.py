"""What a pair is scored against, and the only place where a simulated session becomes input of the pipeline."""
