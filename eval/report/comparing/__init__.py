"""Two runs, or the methods of one run, compared pair by pair: differences with verdicts, and their page."""
