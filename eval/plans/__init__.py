"""What is run: plans, their worlds, variants and grids; the shipped plans lie here."""
