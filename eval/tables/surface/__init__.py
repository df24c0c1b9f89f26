"""What a run says about rock that moved: a row a method, and detection limits."""
