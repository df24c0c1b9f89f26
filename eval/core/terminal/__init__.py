"""What a person at a terminal meets: printed tables, progress, interrupts, and exits with one clear line."""
